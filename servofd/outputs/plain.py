"""Text from outside, in which nothing acts: on a terminal, in a page, in a picture."""

from __future__ import annotations

import re

_ACTS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]")
"""C0 but tabulator and newline, C1, what turns or hides text, halves of characters (in names that are no UTF-8)."""


def plain(text: str) -> str:
    r"""Text in which what would act is spelled out.

    Examples
    --------
    >>> print(plain("a\x1b[31m\x9b2J\udcff.csv"))
    a\x1b[31m\x9b2J\udcff.csv
    """
    return _ACTS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)

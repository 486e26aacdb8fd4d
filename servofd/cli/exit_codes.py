"""The exit codes of all verbs: 0 done and healthy, 1 a fault, 2 not cleared or could not tell."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


def worst(codes: Iterable[int]) -> int:
    """Exit code of several results: a fault anywhere outranks what could not be judged.

    Examples
    --------
    >>> worst([0, 2, 1]), worst([0, 2]), worst([0])
    (1, 2, 0)
    """
    return max(codes, key=(0, 2, 1).index, default=2)

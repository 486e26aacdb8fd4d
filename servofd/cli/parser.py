"""How the program reports a wrong call: in one line, with the way to help."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from collections.abc import Callable

COULD_NOT_TELL = 2
_DIGITS = 10


class OneLineParser(argparse.ArgumentParser):
    """Reports a wrong call in one line; options must be spelt out."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 - whatever argparse takes
        super().__init__(**(options | {"allow_abbrev": False}))

    def error(self, message: str) -> NoReturn:
        """End with one line on stderr."""
        self.exit(COULD_NOT_TELL, f"{self.prog}: {message} (see '{self.prog} --help')\n")


def number(what: str, least: float, most: float = math.inf) -> Callable[[str], float]:
    """Reader of an option that takes a number within bounds, which it calls so.

    Examples
    --------
    >>> number("a time in seconds", 0.0)("2.5")
    2.5
    """

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"must be {what}, not {text}")
        return value

    return read


def whole(what: str, least: int, most: int) -> Callable[[str], int]:
    """The same for a whole number of at most nine digits."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) < _DIGITS and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"must be {what}, not {text}")
        return int(text)

    return read


LARGEST, SMALLEST = 1.7e308, 5e-324
"""Of the numbers that are finite, and of those above zero."""

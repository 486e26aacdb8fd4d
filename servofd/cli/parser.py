"""How the program reports a wrong call: in one line, with the way to help."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

COULD_NOT_TELL = 2


class OneLineParser(argparse.ArgumentParser):
    """Reports a wrong call in one line; options must be spelt out."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 - whatever argparse takes
        super().__init__(**(options | {"allow_abbrev": False}))

    def error(self, message: str) -> NoReturn:
        """End with one line on stderr."""
        self.exit(COULD_NOT_TELL, f"{self.prog}: {message} (see '{self.prog} --help')\n")

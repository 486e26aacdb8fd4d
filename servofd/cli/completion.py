"""``servofd --print-completion SHELL``: with it the tabulator key completes verbs, options and files."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

SHELLS = ("bash", "zsh", "tcsh")
_FILE = re.compile(r"LOG|FILE|RECORDING|\.(?:toml|rrd|py|png)\b")
"""Words of the help that stand for a file."""


class PrintCompletion(argparse.Action):
    """Prints the script that completes the whole command line, and ends, as ``--version`` does."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,  # noqa: ARG002 - argparse prescribes these
        values: str | Sequence[Any] | None,
        option_string: str | None = None,  # noqa: ARG002
    ) -> None:
        """Write the script to stdout."""
        import shtab

        for action in _actions(parser):
            if action.metavar == "DIR":
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined] # where shtab looks for it
            elif isinstance(action.metavar, str) and _FILE.search(action.metavar):
                action.complete = shtab.FILE  # type: ignore[attr-defined]
        print(shtab.complete(parser, str(values)))
        parser.exit()


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Every option and argument of a program and of its verbs."""
    for action in parser._actions:  # argparse has no other way to them
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for verb in dict.fromkeys(action.choices.values()):
                yield from _actions(verb)

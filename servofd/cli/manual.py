"""``servofd help``: the manual of a verb, page by page on a terminal."""

from __future__ import annotations

import argparse
import pydoc
import sys
from typing import Any

from servofd.core.errors import UnknownName, suggest


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb; it tells of all those that are declared by the time it runs."""
    parser = verbs.add_parser(
        "help",
        help="show the manual of a verb",
        description="Shows the options of a verb, or the list of verbs, with a pager where stdout is a terminal.",
        epilog="Example: servofd help audit",
    )
    parser.add_argument("about", nargs="?", metavar="VERB", help="verb to tell of (default: all of them)")
    parser.set_defaults(run=run, pages=verbs.choices)


def run(options: argparse.Namespace) -> int:
    """Print one page."""
    if options.about is None:
        page = options.whole.format_help()
    elif options.about in options.pages:
        page = options.pages[options.about].format_help()
    else:
        raise UnknownName(suggest("verb", options.about, options.pages))
    if sys.stdout.isatty():
        pydoc.pager(page)
    else:
        print(page, end="")
    return 0

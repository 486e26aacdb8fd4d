"""``servofd fleet``: what many logs say together."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.cli.audit_fleet import PAGE, print_overview, write_page

if TYPE_CHECKING:
    import argparse


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "fleet",
        help="show what an audit of many logs found",
        description="Prints the overview of a folder of results that servofd audit LOGS/ -o DIR made, and writes it "
        "as a page. Exit code 0: all healthy; 1: a fault was found; 2: some logs could not be judged.",
        epilog="Example: servofd audit flights/ -o results && servofd fleet results",
    )
    parser.add_argument("folder", metavar="DIR", help="folder of results")
    parser.add_argument("--html", metavar="FILE", help=f"page to write (default: {PAGE} in the folder)")
    parser.add_argument("--json", metavar="FILE", help="write the overview as JSON; - prints it instead of the table")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, write the page, print."""
    from servofd.cli.targets import give_json
    from servofd.fleet.overview import overview
    from servofd.fleet.store import read_logs

    seen = overview(read_logs(Path(options.folder)))
    target = options.html or str(Path(options.folder, PAGE))
    write_page(seen, target)
    if give_json(options.json, seen.document()):
        return seen.exit_code
    print_overview(seen)
    for fault in seen.faults:
        print(f"{fault['path']}: {fault['surface']}: {fault['kind']} from {fault['start_s']:.1f} s")
    for one in seen.not_judged:
        print(f"{one['path']}: {one['reason'].removeprefix(one['path'] + ': ')}")
    print(f"wrote {target}")
    return seen.exit_code

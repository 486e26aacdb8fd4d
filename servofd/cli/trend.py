"""``servofd trend``: one aircraft over many flights."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from servofd.cli.audit_fleet import add_options
from servofd.cli.exit_codes import worst

if TYPE_CHECKING:
    import argparse

    from servofd.wear.trend import AircraftTrend

_SHOWN = 5


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "trend",
        help="follow the servos of one aircraft over many flights",
        description="Estimates bias, dead band, delay, bandwidth, rate limit, noise and margin of each servo in each "
        "flight, finds what changes, tells wear from a swap, and forecasts when a limit is crossed. Exit code 0: no "
        "limit in sight; 1: one is exceeded or will be; 2: some logs tell nothing.",
        epilog="Example: servofd trend flights/ -c my_plane.toml --html trend.html",
    )
    parser.add_argument("logs", nargs="+", metavar="LOG", help="logs, folders, patterns or addresses")
    parser.add_argument(
        "-c", "--config", required=True, metavar="AIRCRAFT.toml", help="aircraft file, or a shipped one"
    )
    parser.add_argument("-s", "--surface", action="append", default=[], metavar="NAME", help="follow only this surface")
    parser.add_argument("--json", metavar="FILE", help="write the result as JSON; - prints it instead of the tables")
    parser.add_argument("--html", metavar="FILE", help="write a page that can be sent by mail")
    add_options(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Follow, write what was asked for, print."""
    from servofd.cli.tables import one_line
    from servofd.cli.targets import check_targets, give_json
    from servofd.core.files import write_whole
    from servofd.wear.document import trend_document

    check_targets((options.json, options.html), {"a log": options.logs, "the aircraft file": [options.config]})
    seen = _followed(options)
    document = trend_document(seen)
    if options.html:
        from servofd.outputs.trend_page import trend_page

        write_whole(options.html, trend_page(document).encode())
    if not give_json(options.json, document):
        _print(document)
    for problem in seen.problems[:_SHOWN]:
        print(f"servofd: {one_line(problem)}", file=sys.stderr)
    if len(seen.problems) > _SHOWN:
        print(f"servofd: and {len(seen.problems) - _SHOWN} more like these", file=sys.stderr)
    return worst([int(seen.has_alarm), 2 if seen.not_judged else 0])


def _followed(options: argparse.Namespace) -> AircraftTrend:
    from functools import partial

    from servofd.cli.tables import progress_with_estimate
    from servofd.wear.trend import trend_logs

    return trend_logs(
        options.logs,
        options.config,
        surfaces=tuple(options.surface),
        cluster=options.cluster,
        workers=options.workers,
        progress=partial(progress_with_estimate, "trend"),
    )


def _print(document: dict[str, Any]) -> None:
    from servofd.cli.tables import print_table
    from servofd.outputs.trend_page import (
        axes_of,
        effects_of,
        flight_name,
        number_of_flights,
        quantity_row,
        verdict,
    )
    from servofd.wear.records import QUANTITIES

    print(f"{number_of_flights(document)}, {document['order']['reason']}")
    for name, surface in document["surfaces"].items():
        serial = surface["serials"][-1]["serial"]
        title = f"{name}, servo {serial}" if serial else name
        rows = [list(quantity_row(one)) for one in surface["quantities"].values()]
        print_table(["quantity", "now", "per flight", "limit", "forecast"], rows, title)
        for line in (*(event["reason"] for event in surface["events"]), *surface["notes"]):
            print(f"{name}: {line}")
        for what, why in surface["missing"].items():
            print(f"{name}: no {QUANTITIES[what].title}: {why}")
    axes = axes_of(document)
    if axes:
        rows = [[str(one["number"]), flight_name(one), *effects_of(document, one)] for one in document["flights"]]
        print_table(["flight", "log", *axes], rows, "effect that was left in each flight [%]")
    print(verdict(document))

"""``servofd trend``: one aircraft over many flights."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from servofd.cli.terminal import check_targets, complain, give_json, print_table, progress, worst
from servofd.core.files import write_whole
from servofd.outputs.fleet_page import flight_name
from servofd.outputs.trend_page import (
    axes_of,
    effects_of,
    number_of_flights,
    quantity_row,
    trend_page,
    verdict,
)
from servofd.wear.estimate import QUANTITIES
from servofd.wear.trend import trend_document, trend_logs

if TYPE_CHECKING:
    from servofd.cli.options import Options

_SHOWN = 5


def run(options: Options) -> int:
    """Follow, write what was asked for, print."""
    check_targets((options.json, options.html), {"a log": options.logs, "the aircraft file": [options.config]})
    seen = trend_logs(
        options.logs,
        options.config,
        surfaces=tuple(options.surface),
        cluster=options.cluster,
        workers=options.workers,
        progress=partial(progress, "trend"),
    )
    document = trend_document(seen)
    if options.html:
        write_whole(options.html, trend_page(document).encode())
    if not give_json(options.json, document):
        _print(document)
    for problem in seen.problems[:_SHOWN]:
        complain(problem)
    if len(seen.problems) > _SHOWN:
        complain(f"and {len(seen.problems) - _SHOWN} more like these")
    return worst([int(seen.has_alarm), 2 if seen.not_judged else 0])


def _print(document: dict[str, Any]) -> None:
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

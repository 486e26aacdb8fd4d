"""``servofd explain``: where simulation and measurement disagree, and which effect is missing."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servofd.explaining import ExplainedLog

__all__ = ["add_parser", "run"]

_STEPS = 30
"""Effects in the catalogue, for the progress bar."""


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "explain",
        help="name the effect that a servo's model lacks",
        description="Finds where simulation and measurement disagree on a servo that is well, names the missing "
        "effect, adds it and shows the gap shrink on data that it was not fitted to. Exit code 0: nothing is missing, "
        "or it was found; 1: something stays unexplained; 2: could not tell.",
        epilog="Example: servofd explain flight.csv -s elevator --save better.toml",
    )
    parser.add_argument("log", metavar="LOG", nargs="+", help="any log that audit reads; several of the same servo")
    parser.add_argument("-s", "--surface", metavar="SURFACE", help="which surface, if the log holds several")
    parser.add_argument("-c", "--config", metavar="AIRCRAFT.toml", help="aircraft file, or the name of a shipped one")
    parser.add_argument("--servo", metavar="NAME", help="servo to assume: of the library, FILE.toml, or unknown")
    parser.add_argument("--json", metavar="FILE", help="write the result as JSON; - prints it instead of the text")
    parser.add_argument("--save", metavar="MODEL.toml", help="write the aircraft with the better model, for audit -c")
    parser.add_argument("--html", metavar="FILE", help="write a page: the gap before and after")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Explain, write what was asked for, print."""
    from servofd.cli.tables import progress_bar
    from servofd.cli.targets import check_targets
    from servofd.explaining import explain_log
    from servofd.outputs.files import write_whole
    from servofd.outputs.json_report import to_json

    outputs = (options.json, options.save, options.html)
    check_targets(outputs, {"a log": options.log, "the aircraft file": [options.config]})
    with progress_bar("explain", _STEPS) as step:
        found = explain_log(options.log, options.config, surface=options.surface, servo=options.servo, progress=step)
    document = to_json(found.explanation.document())
    if options.json and options.json != "-":
        write_whole(options.json, document.encode())
    print(document if options.json == "-" else _text(found), end="")
    if options.save:
        from servofd.outputs.model_file import model_file

        write_whole(options.save, model_file([found.explanation], found.aircraft, found.source).encode())
    if options.html:
        from servofd.outputs.explain_page import explain_page

        write_whole(
            options.html, explain_page([found.explanation], ", ".join(Path(log).name for log in options.log)).encode()
        )
    return 1 if found.explanation.conclusion in ("partly_explained", "unexplained") or found.explanation.fault_s else 0


def _text(found: ExplainedLog) -> str:
    """Everything that was found, a line each."""
    document = found.explanation.document()
    floor = document["noise_floor_rms_deg"]
    lines = [
        f"{found.source}: {document['surface']}: {document['conclusion'].replace('_', ' ')}",
        "",
        "where",
        *(f"  {sentence}" for sentence in document["where"]),
        "",
        f"{'model':<34}{'fitted':>10}{'held out':>10}   deg rms; noise floor {floor:.3g}",
        _row("as it was", document["nominal"]),
    ]
    for step in document["steps"]:
        lines.append(_row(f"+ {step['effect']}" + (f" ({step['form']})" if step["form"] else ""), step))
        for name, each in step["parameters"].items():
            lines.append(f"    {name} = {each['value']:.4g}   [{each['low']:.4g}, {each['high']:.4g}]")
        rivals = ", ".join(f"{r['effect']} {r['held_out_rms_deg']:.3g}" for r in step["rivals"][:3])
        if rivals:
            lines.append(f"    instead: {rivals}")
    if document["runs"]:
        lines += ["", f"{'each run as the others predict it':<34}{'as it was':>10}{'now':>10}   deg rms"]
        lines += [
            f"  {each['run'] + 1:<32}{each['nominal_rms_deg']:>10.4f}{each['held_out_rms_deg']:>10.4f}"
            for each in document["runs"]
        ]
    for tie in document["indistinguishable"]:
        lines += ["", f"these data cannot tell {tie[0]} from {' or '.join(tie[1:])}"]
    if document["notes"]:
        lines += ["", *document["notes"]]
    return "\n".join(lines) + "\n"


def _row(name: str, errors: dict[str, Any]) -> str:
    return f"{name:<34}{errors['train_rms_deg']:>10.4f}{errors['held_out_rms_deg']:>10.4f}"

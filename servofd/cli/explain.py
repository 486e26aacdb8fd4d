"""``servofd explain``: where simulation and measurement disagree, and which effect is missing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.cli.terminal import check_targets, complain, give_json, one_line, progress
from servofd.core.errors import ConfigError
from servofd.core.files import write_whole
from servofd.jobs.explaining import explain_logs
from servofd.outputs.explain_page import explain_page
from servofd.outputs.identify_recording import save_explanation
from servofd.outputs.model_file import model_file

if TYPE_CHECKING:
    from servofd.cli.options import Options
    from servofd.jobs.explaining import ExplainedLogs

_STEPS = 30
"""Effects in the catalogue, for the progress bar."""


def run(options: Options) -> int:
    """Explain, write what was asked for, print."""
    inputs = {
        "a log": [*options.logs, *options.also],
        "the aircraft file": [options.config],
        "an effect": [options.effect],
    }
    check_targets((options.json, options.save, options.rrd, options.html), inputs)
    with progress("explain", _STEPS) as step:
        found = explain_logs(
            options.logs,
            options.config,
            surfaces=tuple(options.surface),
            servo=options.servo,
            also=options.also,
            own=options.effect,
            progress=step,
        )
    if found.explanations:
        _write(options, found)
    for failure in found.failures:
        complain(failure)
    if found.explanations and options.save:
        text, kept = model_file(found.explanations, found.aircraft, found.source, found.logs)
        for surface, reason in kept.items():
            complain(f"{options.save}: {surface} stays as it was: {one_line(reason)}")
        write_whole(options.save, text.encode())
    if found.failures:
        return 2
    left = ("partly_explained", "unexplained")
    return int(any(one.conclusion in left or one.fault_s is not None for one in found.explanations))


def _write(options: Options, found: ExplainedLogs) -> None:
    """Results to the files that were asked for, and to stdout."""
    documents = {one.surface: one.document() for one in found.explanations}
    single = len(found.explanations) == 1 and not found.failures
    whole = {"schema": "servofd.explain/1", "surfaces": documents}
    if options.rrd and len(found.explanations) > 1:
        raise ConfigError(f"{options.rrd}: --rrd takes one surface at a time: choose it with -s")
    if options.rrd:
        save_explanation(found.explanations[0], options.rrd, _names(options))
    if options.html:
        gains = {one.surface: audit_rows(one.gain.document()) for one in found.explanations if one.gain}
        write_whole(options.html, explain_page(found.explanations, _names(options), thresholds=gains).encode())
    if not give_json(options.json, documents[found.explanations[0].surface] if single else whole):
        print("\n".join(explanation_text(found.source, each) for each in documents.values()), end="")


def _names(options: Options) -> str:
    """Of the logs, without their folders: what leaves the machine tells nothing of it."""
    return ", ".join(Path(log).name for log in options.logs)


def explanation_text(source: str, document: dict[str, Any]) -> str:
    """Everything that was found, a line each."""
    floor = document["noise_floor_rms_deg"]
    lines = [
        f"{source}: {document['surface']}: {document['conclusion'].replace('_', ' ')}",
        document["answer"],
        "",
        "where",
        *(f"  {sentence}" for sentence in document["where"]),
        "",
        f"{'model':<34}{'fitted':>10}{'held out':>10}   deg rms; noise floor {floor:.3g}",
        _row("as it was", document["nominal"]),
    ]
    for step in document["steps"]:
        lines += _step(step)
    if document["runs"]:
        lines += ["", f"{'each run as the others predict it':<34}{'as it was':>10}{'now':>10}   deg rms"]
        lines += [
            f"  {each['run'] + 1:<32}{each['nominal_rms_deg']:>10.4f}{each['held_out_rms_deg']:>10.4f}"
            for each in document["runs"]
        ]
    for tie in document["indistinguishable"]:
        lines += ["", f"these data cannot tell {tie[0]} from {' or '.join(tie[1:])}"]
    lines += [f"  {each['sentence']}" for each in document["separating"]]
    if document["also"]:
        lines += ["", f"{'on other flights, nothing fitted':<34}{'as it was':>10}{'now':>10}   deg rms"]
        lines += [_also(each) for each in document["also"]]
    if document["audit"]:
        lines += ["", *_audit(document["audit"])]
    if document["notes"]:
        lines += ["", *document["notes"]]
    return "\n".join(lines) + "\n"


def _row(name: str, errors: dict[str, Any]) -> str:
    return f"{name:<34}{errors['train_rms_deg']:>10.4f}{errors['held_out_rms_deg']:>10.4f}"


def _step(step: dict[str, Any]) -> list[str]:
    lines = [_row(f"+ {step['effect']}" + (f" ({step['form']})" if step["form"] else ""), step)]
    for name, each in step["parameters"].items():
        lines.append(f"    {name} = {each['value']:.4g}   [{each['low']:.4g}, {each['high']:.4g}]")
    rivals = ", ".join(f"{r['effect']} {r['held_out_rms_deg']:.3g}" for r in step["rivals"][:3])
    return [*lines, f"    instead: {rivals}"] if rivals else lines


def _also(each: dict[str, Any]) -> str:
    errors = f"{each['nominal_rms_deg']:>10.4f}{each['extended_rms_deg']:>10.4f}"
    return f"  {each['path']:<32}{errors}   noise floor {each['noise_floor_rms_deg']:.3g}"


def audit_rows(gain: dict[str, Any]) -> list[tuple[str, str, str]]:
    """What an audit gains: quantity, before and after [deg]."""
    before, after = gain["before"], gain["after"]
    return [
        (name, f"{before[key]:.3f}", f"{after[key]:.3f}")
        for name, key in (
            ("residual, standard deviation", "residual_std_deg"),
            ("residual, largest", "residual_max_abs_deg"),
            ("threshold for one false alarm in 1000 h", "threshold_deg"),
            ("smallest step surely seen within 1 s", "smallest_step_deg"),
        )
    ]


def _audit(gain: dict[str, Any]) -> list[str]:
    head = f"{'for an audit [deg]':<54}{'before':>10}{'after':>10}"
    return [head, *(f"  {name:<52}{before:>10}{after:>10}" for name, before, after in audit_rows(gain))]

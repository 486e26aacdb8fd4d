"""An explanation as text, from its document."""

from __future__ import annotations

from typing import Any


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

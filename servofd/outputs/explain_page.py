"""Explanations as one HTML page: what is missing, in words, and the gap before and after."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.discrepancy.locate import errors_by_regime
from servofd.outputs.audit_page import quantity
from servofd.outputs.explain_figures import explain_figures
from servofd.outputs.page import page

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.discrepancy.explanation import Explanation

_MOST_RIVALS = 5
_STATUS = {"nothing_missing": "healthy", "explained": "healthy", "partly_explained": "suspect", "unexplained": "fault"}


def explain_page(
    found: Sequence[Explanation], source: str, *, thresholds: Mapping[str, Sequence[tuple[str, str, str]]] | None = None
) -> str:
    """Text of the page.

    Parameters
    ----------
    source : str
        Name of the log, without its folder.
    thresholds : mapping of str to sequence of (quantity, before, after), optional
        By surface: what the audit's residual and threshold are with the old and the new model.
    """
    known = thresholds or {}
    surfaces = [_surface(one, f"surface-{k}", known.get(one.surface, ())) for k, one in enumerate(found, start=1)]
    return page("explain.html", source=source, surfaces=surfaces)


def _surface(found: Explanation, anchor: str, thresholds: Sequence[tuple[str, str, str]]) -> dict[str, Any]:
    document, selection = found.document(), found.selection
    simulated_deg = found.record.measured_deg - selection.final.error_deg
    regimes = errors_by_regime(found.record, selection.nominal.error_deg, selection.final.error_deg, simulated_deg)
    return {
        "name": found.surface,
        "anchor": anchor,
        "status": _STATUS[found.conclusion],
        "conclusion": found.conclusion.replace("_", " "),
        "verdict": document["answer"],
        "numbers": _numbers(document),
        "where": [f"{sentence[:1].upper()}{sentence[1:]}." for sentence in document["where"]],
        "notes": [f"{note[:1].upper()}{note[1:]}." for note in document["notes"]],
        "ties": document["indistinguishable"],
        "separating": [f"{one.sentence[:1].upper()}{one.sentence[1:]}." for one in found.separating],
        "elsewhere": [
            *(
                (f"run {run.run}", _number(run.nominal_rms_deg), _number(run.held_out_rms_deg), "")
                for run in found.runs
            ),
            *(
                (
                    Path(one.path).name,
                    *map(_number, (one.nominal_rms_deg, one.extended_rms_deg, one.noise_floor_rms_deg)),
                )
                for one in found.also
            ),
        ],
        "steps": [_step("as it was", document["nominal"]), *(_step(f"+ {_name(s)}", s) for s in document["steps"])],
        "parameters": [
            (_name(step), quantity(name), *(_number(each[key]) for key in ("value", "low", "high")))
            for step in document["steps"]
            for name, each in step["parameters"].items()
        ],
        "rivals": [
            (_name(step), rival["effect"].replace("_", " "), _number(rival["held_out_rms_deg"]))
            for step in document["steps"]
            for rival in step["rivals"][:_MOST_RIVALS]
        ],
        "regimes": [
            (r.name, f"{r.share:.0%}", _number(r.before_deg), _number(r.after_deg), _number(selection.sigma_deg))
            for r in regimes
        ],
        "thresholds": thresholds,
        "pictures": explain_figures(found, anchor),
    }


def _numbers(document: dict[str, Any]) -> str:
    before, after = (document[key]["held_out_rms_deg"] for key in ("nominal", "final"))
    floor = document["noise_floor_rms_deg"]
    names = " and ".join(_name(step) for step in document["steps"])
    shrinks = f"the error shrinks from {before:.3g} to {after:.3g} deg rms on samples that were not fitted"
    if document["fault_s"] is not None:
        told = (
            f"with {names} what came before shrinks from {before:.3g} to {after:.3g} deg rms"
            if names
            else (f"{before:.3g} deg rms are left of what came before")
        )
        return f"a fault sets in at {document['fault_s']:.1f} s; {told}, the noise floor is {floor:.3g} deg."
    return {
        "nothing_missing": f"{before:.3g} deg rms are left; the noise floor is {floor:.3g} deg.",
        "explained": f"{names} explains the gap: {shrinks}; the noise floor is {floor:.3g} deg.",
        "partly_explained": f"{names} explains a part: {shrinks}; something stays above the noise floor of "
        f"{floor:.3g} deg.",
        "unexplained": f"nothing in the catalogue explains the gap of {before:.3g} deg rms; the noise floor is "
        f"{floor:.3g} deg.",
    }[document["conclusion"]]


def _name(step: dict[str, Any]) -> str:
    form = f" ({step['form'].replace('_', ' ')})" if step["form"] else ""
    return f"{step['effect'].replace('_', ' ')}{form}"


def _step(name: str, errors: dict[str, Any]) -> tuple[str, str, str]:
    return name, _number(errors["train_rms_deg"]), _number(errors["held_out_rms_deg"])


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "not known"

"""Explanations: what is missing, in words and pictures, and the gap before and after."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.core.statistics import Z_95
from servofd.discrepancy.locate import binned, errors_by_regime, maps, quantities, spectrum
from servofd.outputs.audit_report import quantity
from servofd.outputs.document import Bullets, Document, Figures, Section, Table, Words
from servofd.outputs.palette import COLOURS
from servofd.outputs.picture import Picture, finish, new_figure
from servofd.outputs.sentence import spoken

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

    from servofd.discrepancy.explanation import Explanation
    from servofd.discrepancy.varying import Varying

_EXCERPT_S = 6.0
"""Length of the excerpt of the motion that is drawn [s]."""
_BEFORE, _AFTER, _FLOOR = COLOURS["fault"], COLOURS["simulated"], COLOURS["command"]
_LAG_S = 1.0
_SEGMENT_S = 4.0
"""Length of Welch's segments [s], which resolve 0.25 Hz."""


def explain_figures(found: Explanation, name: str) -> list[Picture]:
    """All pictures of one explanation."""
    return [
        _traces(found, f"{name}-traces"),
        _ladder(found, f"{name}-ladder"),
        _predicted(found, f"{name}-predicted"),
        _maps(found, f"{name}-maps"),
        _memory(found, f"{name}-memory"),
        *(_varying(each, f"{name}-varying-{k}") for k, each in enumerate(found.varying, start=1)),
    ]


def _traces(found: Explanation, name: str) -> Picture:
    """Seconds around the block that disagrees most."""
    record, selection = found.record, found.selection
    begins = np.diff(record.run, prepend=0) != 0  # nothing joins a run to the next
    not_judged = begins | ~record.counts if record.side is not None else begins
    before, after = (np.where(not_judged, np.nan, fit.error_deg) for fit in (selection.nominal, selection.final))
    squared = np.where(record.counts, np.nan_to_num(before) ** 2, 0.0)
    worst = int(np.argmax(np.bincount(record.block, weights=squared)))
    middle_s = float(np.median(record.time_s[record.block == worst]))
    inside = np.abs(record.time_s - middle_s) <= 0.5 * _EXCERPT_S
    time_s, measured = record.time_s[inside], np.where(begins, np.nan, record.measured_deg)[inside]
    commands = record.commands
    asked = np.abs(commands.effective_s - middle_s) <= 0.5 * _EXCERPT_S
    figure, (upper, lower) = new_figure(2, height=5.6, ratios=(3, 2))
    upper.plot(
        commands.effective_s[asked],
        commands.command_deg[asked],
        color=COLOURS["command"],
        lw=0.9,
        drawstyle="steps-post",
        label="command",
    )
    upper.plot(time_s, measured, color=COLOURS["measured"], lw=2.2, label="measured")
    upper.plot(time_s, measured - before[inside], color=_BEFORE, lw=1.1, ls="--", label="model before")
    if selection.steps:
        upper.plot(time_s, measured - after[inside], color=_AFTER, lw=1.1, label="model after")
    _draw_floor(lower, selection.sigma_deg)
    lower.plot(time_s, before[inside], color=_BEFORE, lw=1.0, ls="--", label="error before")
    if selection.steps:
        lower.plot(time_s, after[inside], color=_AFTER, lw=1.0, label="error after")
    finish(upper, lower, x="time [s]", y=["deflection [deg]", "error [deg]"], legend="above")
    largest = [float(np.nanmax(np.abs(error[inside & record.counts]))) for error in (before, after)]
    text = (
        f"The seconds around {middle_s:.1f} s, where model and measurement differ most: by up to {largest[0]:.2f} deg "
        f"before, {largest[1]:.2f} deg after. The band is two standard deviations of the noise floor."
    )
    return Picture(name, "Where they differ most", text, figure)


def _ladder(found: Explanation, name: str) -> Picture:
    """Error on fitted and on held-out samples after each step."""
    selection = found.selection
    fits = [selection.nominal, *(step.fit for step in selection.steps)]
    labels = ["as it was", *(f"+ {step.fit.names[-1].replace('_', ' ')}" for step in selection.steps)]
    errors = [found.rms_deg(fit) for fit in fits]
    figure, (axes,) = new_figure(height=1.4 + 0.5 * len(fits))
    place = np.arange(len(fits), dtype=float)
    for offset, key, colour, label in (
        (-0.19, "train_rms_deg", COLOURS["no_data"], "fitted samples"),
        (0.19, "held_out_rms_deg", _AFTER, "held-out samples"),
    ):
        values = [each[key] for each in errors]
        axes.barh(place + offset, values, height=0.36, color=colour, label=label)
        for y, value in zip(place + offset, values, strict=True):
            axes.text(value, y, f" {value:.3g}", va="center", fontsize=9)
    axes.axvline(selection.sigma_deg, color=COLOURS["fault"], ls="--", lw=1.0, label="noise floor")
    axes.set_yticks(place, labels)
    axes.invert_yaxis()
    finish(axes, x="error [deg rms]", legend="above")
    last = errors[-1]["held_out_rms_deg"]
    falls = f"falls from {errors[0]['held_out_rms_deg']:.3g} to" if selection.steps else "is"
    text = (
        f"On samples that were not fitted the error {falls} {last:.3g} deg rms; the noise floor is "
        f"{selection.sigma_deg:.3g} deg."
    )
    return Picture(name, "How the gap shrinks" if selection.steps else "What is left", text, figure)


def _maps(found: Explanation, name: str) -> Picture:
    record, selection = found.record, found.selection
    chosen = quantities(record, record.measured_deg - selection.final.error_deg)
    figure, axes = new_figure(len(chosen), 2, height=0.6 + 1.75 * len(chosen), share_x=False)
    for row, each in enumerate(chosen):
        left, right = axes[2 * row], axes[2 * row + 1]
        right.sharey(left)
        for panel, error, colour in (
            (left, selection.nominal.error_deg, _BEFORE),
            (right, selection.final.error_deg, _AFTER),
        ):
            bins = binned(each, error, record.counts)
            _draw_floor(panel, selection.sigma_deg)
            panel.fill_between(bins.centre, bins.low_deg, bins.high_deg, color=colour, alpha=0.3, lw=0)
            panel.plot(bins.centre, bins.median_deg, color=colour, lw=1.4, marker=".", ms=4)
            panel.set_xlabel(f"{each.name} [{each.unit}]", fontsize=9)
        left.set_ylabel("error [deg]")
    axes[0].set_title("before", fontsize=11)
    axes[1].set_title("after", fontsize=11)
    finish(*axes)
    text = (
        "Median error (line) and the middle 90% of it (shaded) over each quantity; left the model as it was, right "
        "with the effects that were found; the grey band is two standard deviations of the noise floor."
    )
    return Picture(name, "What the error depends on", text, figure)


def _predicted(found: Explanation, name: str) -> Picture:
    """How much of the gap each quantity predicts, and how linearly the position follows."""
    record, nominal = found.record, found.selection.nominal
    shares = [each for each in maps(record, nominal.error_deg, found.selection.sigma_deg) if each.quantity != "time"]
    figure, (left, right) = new_figure(1, 2, height=1.2 + 0.24 * len(shares), share_x=False)
    place = np.arange(len(shares), dtype=float)
    share = np.array([each.share for each in shares])
    reach = np.abs(np.array([[each.low, each.high] for each in shares]).T - share)
    left.barh(place, share, xerr=reach, color=_BEFORE, ecolor="0.4", error_kw={"lw": 1.0})
    left.set_yticks(place, [each.quantity for each in shares], fontsize=8)
    left.invert_yaxis()
    left.set_xlim(0.0, 1.05)
    left.set_xlabel("share of the gap")
    linear = spectrum(record, nominal.error_deg)
    if linear is not None:
        right.semilogx(linear.frequency_hz[1:], linear.coherence[1:], color=COLOURS["measured"])
    right.xaxis.set_minor_formatter("")
    right.set_ylim(0.0, 1.02)
    finish(left, right, x="frequency [Hz]", y=["", "coherence"])
    text = (
        "Left, the share of the gap that each quantity predicts in blocks to which it was not fitted; the lines are "
        "what chance makes of it in 99 of 100 logs, all quantities together. Right, coherence of command and position: "
        "1 where the position follows linearly, whatever the servo; it also falls where nothing was asked."
    )
    return Picture(name, "What predicts the gap", text, figure)


def _memory(found: Explanation, name: str) -> Picture:
    """Spectrum and autocorrelation of the error."""
    from scipy.signal import welch

    record, selection = found.record, found.selection
    period_s = record.period_s
    uniform_s = np.arange(record.time_s[0], record.time_s[-1], period_s)
    figure, (left, right) = new_figure(1, 2, height=3.4, share_x=False)
    lags = round(_LAG_S / period_s)
    for error_deg, colour, style, label in (
        (selection.nominal.error_deg, _BEFORE, "--", "before"),
        (selection.final.error_deg, _AFTER, "-", "after"),
    ):
        counted = np.where(record.counts, np.nan_to_num(error_deg), 0.0)
        error = np.interp(uniform_s, record.time_s, counted)
        frequency_hz, power = welch(error, 1.0 / period_s, nperseg=min(error.size, round(_SEGMENT_S / period_s)))
        left.loglog(frequency_hz[1:], np.sqrt(power[1:]), color=colour, ls=style, label=label)
        centred = error - error.mean()
        kept = min(lags, centred.size - 1)
        power = np.abs(np.fft.rfft(centred, 2 * centred.size)) ** 2
        correlation = np.fft.irfft(power)[: kept + 1]
        right.plot(period_s * np.arange(kept + 1), correlation / correlation[0], color=colour, ls=style, label=label)
    floor = selection.sigma_deg * np.sqrt(2.0 * period_s)
    left.axhline(floor, color=_FLOOR, lw=1.0, label="noise floor")
    bound = Z_95 / np.sqrt(max(int(record.counts.sum()), 1))
    right.axhspan(-bound, bound, color=_FLOOR, alpha=0.35, lw=0, label="white noise")
    for axis in (left.xaxis, left.yaxis):
        axis.set_minor_formatter("")
    left.set_xlabel("frequency [Hz]")
    finish(left, right, x="lag [s]", y=["error [deg/√Hz]", "autocorrelation"], legend="above")
    text = (
        "Left, amplitude spectrum of the error; right, its autocorrelation. An error that is noise only has a flat "
        "spectrum and no memory, and stays in the grey band in 95% of all lags."
    )
    return Picture(name, "Spectrum and autocorrelation of the error", text, figure)


def _varying(each: Varying, name: str) -> Picture:
    """A value of each run over the condition that it goes with."""
    figure, (axes,) = new_figure(1, height=3.2)
    axes.plot(each.condition, each.values, "o", color=_BEFORE, ms=4, label="each run by itself")
    axes.plot(*zip(*each.ends, strict=True), color=_AFTER, label="line through the runs that were fitted")
    finish(axes, x=each.conditions[0], y=[each.parameter], legend="above")
    text = (
        f"The value of {each.parameter} that suits each run best, where the run shows it, over {each.conditions[0]} as "
        "it was logged. With one value for all, the runs that were held out are off by "
        f"{each.common_rms_deg:.3g} deg rms; with the line, by {each.line_rms_deg:.3g}."
    )
    return Picture(name, f"{each.parameter} over {each.conditions[0]}", text, figure)


def _draw_floor(axes: Axes, sigma_deg: float) -> None:
    axes.axhspan(-2.0 * sigma_deg, 2.0 * sigma_deg, color=_FLOOR, alpha=0.25, lw=0)


_MOST_RIVALS = 5
"""Rivals of an effect that are listed at most."""
_STATUS = {"nothing_missing": "healthy", "explained": "healthy", "partly_explained": "suspect", "unexplained": "fault"}
_METHOD = (
    "The servo is simulated with its model as it is known, and with each effect of a catalogue added to it. All "
    "parameters are fitted together on every other block of 0.3 s; the blocks between judge. An effect stays only "
    "if it shrinks the error on those by more than chance. The noise floor is what third differences of the error "
    "say no servo could follow."
)
_GAINS = {
    "residual_std_deg": "residual, standard deviation",
    "residual_max_abs_deg": "residual, largest",
    "threshold_deg": "threshold for one false alarm in 1000 h",
    "smallest_step_deg": "smallest step surely seen within 1 s",
}


def explain_report(found: Sequence[Explanation], source: str, failures: Sequence[str] = ()) -> Document:
    """What the model of each surface lacks, the gap before and after, and why other surfaces were not explained."""
    sections = [_surface(one, f"surface-{k}") for k, one in enumerate(found, start=1)]
    documents = {one.surface: one.document() for one in found}
    first, alone = found[0], len(found) == 1
    parts = sections[0].parts[1:] if alone else sections  # whose verdict is the sentence of the whole
    return Document(
        title=f"What the model lacks: {source}",
        status=sections[0].status,
        sentence=f"{spoken(first.surface)}: {first.answer}" if alone else f"{len(found)} surfaces were explained.",
        facts=source,
        parts=parts,
        evidence=[
            *([Section("Not explained", [Bullets(failures)])] if failures else []),
            Section("Method", [Words(_METHOD)], folded=True),
        ],
        data=documents[first.surface]
        if alone and not failures
        else {"schema": "servofd.explain/1", "surfaces": documents},
    )


def _surface(found: Explanation, anchor: str) -> Section:
    document, floor = found.document(), _number(found.selection.sigma_deg)
    steps = [(_name(step), step) for step in document["steps"]]
    errors = [("as it was", document["nominal"]), *((f"+ {name}", step) for name, step in steps)]
    ladder = [(name, *(_number(one[key]) for key in ("train_rms_deg", "held_out_rms_deg"))) for name, one in errors]
    parameters = [
        (effect, quantity(name), *(_number(one[key]) for key in ("value", "low", "high")))
        for effect, step in steps
        for name, one in step["parameters"].items()
    ]
    rivals = [
        (effect, spoken(rival["effect"]), _number(rival["held_out_rms_deg"]))
        for effect, step in steps
        for rival in step["rivals"][:_MOST_RIVALS]
    ]
    elsewhere = [
        (f"run {run.run + 1}", *map(_number, (run.nominal_rms_deg, run.held_out_rms_deg)), "") for run in found.runs
    ]
    elsewhere += [
        (Path(one.path).name, *map(_number, (one.nominal_rms_deg, one.extended_rms_deg, one.noise_floor_rms_deg)))
        for one in found.also
    ]
    gain = found.gain.document() if found.gain else {"before": {}, "after": {}}
    gains = [
        (words, *(f"{gain[when][key]:.3f}" for when in ("before", "after")))
        for key, words in _GAINS.items()
        if found.gain
    ]
    simulated_deg = found.record.measured_deg - found.selection.final.error_deg
    errors_deg = (found.selection.nominal.error_deg, found.selection.final.error_deg)
    regimes = [
        (r.name, f"{r.share:.0%}", _number(r.before_deg), _number(r.after_deg), floor)
        for r in errors_by_regime(found.record, *errors_deg, simulated_deg)
    ]
    ties = [
        f"these data cannot tell {spoken(tie[0])} from {' or '.join(map(spoken, tie[1:]))}"
        for tie in document["indistinguishable"]
    ]
    said = [*document["where"], *ties, *(one.sentence for one in found.separating), *document["notes"]]
    on_others = "On other flights and runs, to which nothing was fitted [deg rms]"
    regime_head = ("regime", "share of samples", "before", "after", "noise floor")
    return Section(
        found.surface,
        [
            Words(found.answer, style="verdict"),
            Words(_numbers(document), f"{spoken(found.conclusion).capitalize()}:"),
            Section("Where model and measurement disagree", [Bullets(said)]),
            Figures(lambda: [_traces(found, f"{anchor}-traces"), _ladder(found, f"{anchor}-ladder")]),
            Table("Error after each step [deg rms]", ("model", "fitted samples", "held-out samples"), ladder),
            Table("What was found, with 95% intervals", ("effect", "parameter", "value", "from", "to"), parameters),
            Table(
                "Rivals, tried in the place of what was found", ("instead of", "rival", "held out [deg rms]"), rivals
            ),
            Table(on_others, ("flight", "before", "after", "noise floor"), elsewhere),
            Table("What the audit of this log gains [deg]", ("quantity", "before", "after"), gains),
            Figures(lambda: explain_figures(found, anchor)[2:]),
            Section("Error by regime", [Table("Error by regime [deg rms]", regime_head, regimes)], folded=True),
        ],
        "fault" if found.has_fault else _STATUS[found.conclusion],
        spoken(found.conclusion),
        anchor=anchor,
    )


def _numbers(document: dict[str, Any]) -> str:
    before, after = (document[key]["held_out_rms_deg"] for key in ("nominal", "final"))
    names = " and ".join(_name(step) for step in document["steps"])
    shrinks = f"the error shrinks from {before:.3g} to {after:.3g} deg rms on samples that were not fitted"
    text = {
        "nothing_missing": f"{before:.3g} deg rms are left",
        "explained": f"{names} explains the gap: {shrinks}",
        "partly_explained": f"{names} explains a part: {shrinks}, and something stays",
        "unexplained": f"nothing in the catalogue explains the gap of {before:.3g} deg rms",
    }[document["conclusion"]]
    if document["fault_s"] is not None:
        left = f"with {names} what came before shrinks from {before:.3g} to {after:.3g} deg rms"
        text = f"a fault sets in at {document['fault_s']:.1f} s; "
        text += left if names else f"{before:.3g} deg rms are left of what came before"
    return f"{text}; the noise floor is {document['noise_floor_rms_deg']:.3g} deg."


def _name(step: dict[str, Any]) -> str:
    return spoken(f"{step['effect']} ({step['form']})" if step["form"] else step["effect"])


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "not known"

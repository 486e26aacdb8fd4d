"""Explanations: what is missing, in words and charts, and the gap before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.core.statistics import Z_95
from servofd.core.types import FloatArray
from servofd.discrepancy.locate import SHOWN_SHARE, binned, maps, spectrum
from servofd.discrepancy.separate import in_words
from servofd.outputs.audit_report import quantity
from servofd.outputs.chart import Chart, Curve, Panel
from servofd.outputs.document import Bullets, Document, Figures, Section, Table, Words
from servofd.outputs.sentence import LEAST_CLEARED, known_digits, spoken

if TYPE_CHECKING:
    from servofd.discrepancy.explanation import Explanation

_EXCERPT_S = 6.0
"""Length of the excerpt of the motion that is drawn [s]."""
_LAG_S = 1.0
"""Largest lag of the autocorrelation that is drawn [s]."""
_SEGMENT_S = 4.0
"""Length of Welch's segments [s], which resolve 0.25 Hz."""


def explain_charts(found: Explanation) -> dict[str, Chart]:
    """All charts of one explanation, by name: traces, what the error depends on, spectrum and correlation."""
    charts = {"traces": _traces(found, excerpt=True), "whole": _traces(found, excerpt=False)}
    charts |= {f"over-{one.axis.split(' [')[0].replace(' ', '-')}": one for one in _maps(found)}
    return charts | {"spectrum": _spectrum(found), "correlation": _correlation(found)}


def _traces(found: Explanation, *, excerpt: bool) -> Chart:
    """The model before and after, beside what was measured: around the block that disagrees most, or all of it."""
    record, selection, commands = found.record, found.selection, found.record.commands
    begins = np.diff(record.run, prepend=0) != 0  # nothing joins a run to the next
    not_judged = begins | ~record.counts if record.side is not None else begins
    before, after = (np.where(not_judged, np.nan, fit.error_deg) for fit in (selection.nominal, selection.final))
    squared = np.where(record.counts, np.nan_to_num(before) ** 2, 0.0)
    worst = int(np.argmax(np.bincount(record.block, weights=squared)))
    middle_s = float(np.median(record.time_s[record.block == worst]))
    inside = np.abs(record.time_s - middle_s) <= (0.5 * _EXCERPT_S if excerpt else math.inf)
    time_s, measured = record.time_s[inside], np.where(begins, np.nan, record.measured_deg)[inside]
    before, after = before[inside], after[inside]
    asked = (commands.effective_s >= time_s[0]) & (commands.effective_s <= time_s[-1])
    floor = np.full(2, 2.0 * selection.sigma_deg)
    done = [
        Curve("command", "command", commands.effective_s[asked], commands.command_deg[asked], "steps"),
        Curve("measured", "measured", time_s, measured),
        Curve("model before", "before", time_s, measured - before),
    ]
    left = [Curve("error before", "before", time_s, before)]
    if selection.steps:
        done.append(Curve("model after", "after", time_s, measured - after))
        left.append(Curve("error after", "after", time_s, after))
    left += [Curve("noise", "command", time_s[[0, -1]], floor), Curve("", "command", time_s[[0, -1]], -floor)]
    panels = (Panel.around("deflection", "deg", done), Panel.around("error", "deg", left))
    largest = [float(np.nanmax(np.abs(error[record.counts[inside]]), initial=0.0)) for error in (before, after)]
    text = f"The error is at most {largest[0]:.2f} deg before, {largest[1]:.2f} deg after; noise is two deviations."
    if excerpt:
        text = f"The seconds around {middle_s:.1f} s, where model and measurement differ most. {text}"
    title = "Where they differ most" if excerpt else "The whole log"
    return Chart(title, text, float(time_s[0]), float(time_s[-1]), panels)


def _maps(found: Explanation) -> list[Chart]:
    """The error before and after, over each quantity that it depends on."""
    record, selection = found.record, found.selection
    charts = []
    for each in maps(record, selection.nominal.error_deg, selection.sigma_deg):
        if each.share < SHOWN_SHARE or not each.unit or each.quantity == "time":  # the direction of motion is no axis
            continue
        curves = []
        for name, role, fit in (("before", "before", selection.nominal), ("after", "after", selection.final)):
            bins = binned(each, fit.error_deg, record.counts)
            curves.append(Curve(name, role, bins.centre, bins.median_deg))
            curves.append(Curve("", role, bins.centre, bins.low_deg, "bars", bins.high_deg))
        ends = float(bins.centre.min()), float(bins.centre.max())
        if not ends[0] < ends[1]:
            continue
        text = (
            f"It predicts {each.share:.0%} of the gap in blocks from which that was not learnt. Median error, with the "
            f"middle 90% of it as bars; noise is {2 * selection.sigma_deg:.2g} deg either way."
        )
        panels, axis = (Panel.around("error", "deg", curves),), f"{each.quantity} [{each.unit}]"
        charts.append(Chart(f"Error over {each.quantity}", text, *ends, panels, axis=axis))
    return charts


def _uniform(found: Explanation) -> list[tuple[str, FloatArray]]:
    """The errors before and after at equal steps; zero where nothing counts."""
    record, selection = found.record, found.selection
    uniform_s = np.arange(record.time_s[0], record.time_s[-1], record.period_s)
    errors = (("before", selection.nominal.error_deg), ("after", selection.final.error_deg))
    counted = [(role, np.where(record.counts, np.nan_to_num(error), 0.0)) for role, error in errors]
    return [(role, np.interp(uniform_s, record.time_s, error)) for role, error in counted]


def _spectrum(found: Explanation) -> Chart:
    """Amplitude spectrum of the error, and the coherence of command and position."""
    from scipy.signal import welch

    period_s, sigma_deg = found.record.period_s, found.selection.sigma_deg
    curves = []
    for role, error in _uniform(found):
        frequency_hz, power = welch(error, 1.0 / period_s, nperseg=min(error.size, round(_SEGMENT_S / period_s)))
        curves.append(Curve(role, role, frequency_hz[1:], 10.0 * np.log10(np.maximum(power[1:], 1e-12))))
    ends = float(frequency_hz[1]), float(frequency_hz[-1])
    floor = np.full(2, 20.0 * math.log10(max(sigma_deg, 1e-9) * math.sqrt(2.0 * period_s)))
    curves.append(Curve("noise floor", "command", np.array(ends), floor))
    panels = [Panel.around("error", "dB, 1 deg/√Hz", curves)]
    linear = spectrum(found.record, found.selection.nominal.error_deg)
    if linear is not None:
        coherent = Curve("", "measured", linear.frequency_hz[1:], linear.coherence[1:])
        panels.append(Panel("coherence", "", (coherent,), 0.0, 1.02))
    text = (
        "An error that is noise only has a flat spectrum. Coherence of command and position is 1 where the position "
        "follows linearly, whatever the servo; it also falls where nothing was asked."
    )
    return Chart("Spectrum of the error", text, *ends, tuple(panels), axis="frequency [Hz]", log=True)


def _correlation(found: Explanation) -> Chart:
    """Autocorrelation of the error."""
    period_s = found.record.period_s
    curves = []
    for role, error in _uniform(found):
        centred = error - error.mean()
        kept = min(round(_LAG_S / period_s), centred.size - 1)
        power = np.abs(np.fft.rfft(centred, 2 * centred.size)) ** 2
        correlation = np.fft.irfft(power)[: kept + 1]
        curves.append(Curve(role, role, period_s * np.arange(kept + 1), correlation / max(correlation[0], 1e-30)))
    bound, ends = np.full(2, Z_95 / np.sqrt(max(int(found.record.counts.sum()), 1))), np.array([0.0, kept * period_s])
    curves += [Curve("white noise", "command", ends, bound), Curve("", "command", ends, -bound)]
    text = "Residuals that are noise are not correlated: they stay between the level lines in 95% of all lags."
    panel = Panel.around("autocorrelation", "", curves)
    return Chart("Correlation of the error", text, 0.0, float(ends[1]), (panel,), axis="lag [s]")


_MOST_RIVALS = 5
"""Rivals of an effect that are listed at most."""
_STATUS = {"nothing_missing": "healthy", "explained": "unknown", "partly_explained": "suspect", "unexplained": "fault"}
_METHOD = (
    "The servo is simulated with its model as it is known, and with each effect of a catalogue added to it. All "
    "parameters are fitted together on every other block of 0.3 s; the blocks between judge. An effect stays only "
    "if it shrinks the error on those by more than chance. The noise floor is what third differences of the error "
    "say no servo could follow."
)


def explain_report(found: Sequence[Explanation], source: str, failures: Sequence[str] = ()) -> Document:
    """What the model of each surface lacks, the gap before and after, and why other surfaces were not explained."""
    sections = [_surface(one, f"surface-{k}") for k, one in enumerate(found, start=1)]
    sections.sort(key=lambda one: LEAST_CLEARED.index(one.status))
    documents = {one.surface: one.document() for one in found}
    first, alone = found[0], len(found) == 1
    parts = sections[0].parts[1:] if alone else sections  # whose verdict is the sentence of the whole
    sentence, data = f"{spoken(first.surface)}: {first.answer}", dict(documents[first.surface])
    if not alone:  # how well several surfaces are explained, the worst first
        kinds = {kind: [spoken(one.surface) for one in found if one.conclusion == kind] for kind in reversed(_STATUS)}
        said = "; ".join(f"{spoken(kind)}: {', '.join(names)}" for kind, names in kinds.items() if names)
        sentence = f"{said[:1].upper()}{said[1:]}."
    if failures or not alone:
        data = {"schema": "servofd.explain/1", "surfaces": documents}
    return Document(
        title=f"What the model lacks: {source}",
        status=sections[0].status,
        sentence=sentence,
        facts=source,
        parts=parts,
        evidence=[
            *[Section("Not explained", [Bullets(failures)])] * bool(failures),
            Section("How this was found", [Words(_METHOD)], folded=True),
        ],
        data=data,
    )


def _surface(found: Explanation, anchor: str) -> Section:
    document = found.document()
    ladder, parameters, rivals = [_errors("as it was", document["nominal"])], [], []
    for step in document["steps"]:
        effect = spoken(f"{step['effect']} ({step['form']})" if step["form"] else step["effect"])
        ladder.append(_errors(f"+ {effect}", step))
        for name, value in step["parameters"].items():
            parameters.append((effect, quantity(name), *known_digits(value["value"], value["low"], value["high"])))
        tried = step["rivals"][:_MOST_RIVALS]
        rivals += [(effect, spoken(one["effect"]), _number(one["held_out_rms_deg"])) for one in tried]
    elsewhere = [
        (f"run {run.run + 1}", *map(_number, (run.nominal_rms_deg, run.held_out_rms_deg)), "") for run in found.runs
    ]
    for one in found.also:
        errors_deg = (one.nominal_rms_deg, one.extended_rms_deg, one.noise_floor_rms_deg)
        elsewhere.append((Path(one.path).name, *map(_number, errors_deg)))
    tied = ((spoken(first), " or ".join(map(spoken, others))) for first, *others in document["indistinguishable"])
    ties = [f"these data cannot tell {first} from {others}" for first, others in tied]
    said = [*document["where"], *ties, *in_words(found.separating), *document["notes"]]
    on_others = "On other flights and runs, to which nothing was fitted [deg rms]"
    on_rivals = "Rivals, tried in the place of what was found"
    return Section(
        spoken(found.surface),
        [
            Words(found.answer, style="verdict"),
            Section("Where model and measurement disagree", [Bullets(said)]),
            Figures(lambda: [_traces(found, excerpt=True), _traces(found, excerpt=False)]),
            Table("Error after each step [deg rms]", ("model", "fitted samples", "held-out samples"), ladder),
            Table("What was found, with 95% intervals", ("effect", "parameter", "value", "from", "to"), parameters),
            Table(on_rivals, ("instead of", "rival", "held out [deg rms]"), rivals),
            Table(on_others, ("flight", "before", "after", "noise floor"), elsewhere),
            Figures(lambda: [*explain_charts(found).values()][2:]),
        ],
        "fault" if found.has_fault else _STATUS[found.conclusion],
        spoken(found.conclusion),
        anchor=anchor,
    )


def _errors(model: str, fit: dict[str, Any]) -> tuple[str, str, str]:
    return model, _number(fit["train_rms_deg"]), _number(fit["held_out_rms_deg"])


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "not known"

"""An identification: its numbers, and charts after thesis Figs 3.3 to 3.9."""

from __future__ import annotations

import math

import numpy as np

from logparsers.units import MS_PER_S
from servofd.core.types import FloatArray
from servofd.identification.choice import steps_of
from servofd.identification.identify import is_stepwise
from servofd.identification.records import longest_uniform
from servofd.identification.response import raw_response
from servofd.identification.result import Identification
from servofd.outputs.chart import Chart, Curve, Panel, Span
from servofd.outputs.document import Bullets, Document, Figures, Table
from servofd.outputs.sentence import known_digits, spoken

_FEWEST = 2
"""Samples from which on there is a response."""
_EXCERPT_S = 4.0
"""Length of the excerpt of the motion that is drawn [s]."""
_STEP_S = 0.6
"""Time after a step that is drawn [s]."""
_RAW_POINTS = 3000
"""About how many points of the raw response are drawn."""
_SERVOS = ("measured", "other2", "after", "command")
"""Roles of the curves of several servos, one after the other."""
_COHERENT = 0.8
"""Coherence from which on a frequency counts (thesis Fig. 3.7)."""


def identify_charts(found: Identification) -> dict[str, Chart]:
    """All charts that the tests allow, by name: step, motion, response, validation."""
    charts, runs = {}, found.runs
    stepwise = [(k, step) for k, run in enumerate(runs) if is_stepwise(run) for step in steps_of(run)]
    if stepwise:
        index, step = max(stepwise, key=lambda one: abs(one[1].jump_deg))
        last_s = min(step.start_s + _STEP_S, step.end_s)
        charts["step"] = _traced(found, index, "Step (thesis Fig. 3.3)", step.start_s - 0.1, last_s)
    begin_s, end_s = float(runs[0].measured_s[0]), float(runs[0].measured_s[-1])
    title = f"First {_EXCERPT_S:g} s of the test (thesis Fig. 3.4)"
    charts["motion"] = _traced(found, 0, title, begin_s, min(begin_s + _EXCERPT_S, end_s))
    if found.response is not None:
        charts["response"] = _response(found)
    longest = int(np.argmax([run.measured_s.size for run in runs]))
    time_s, title = runs[longest].measured_s, "Validation in time (thesis Fig. 3.9)"
    charts["validation"] = _traced(found, longest, title, float(time_s[0]), float(time_s[-1]))
    return charts


def _response(found: Identification) -> Chart:
    """Magnitude, phase, coherence and normalised error over frequency, of each servo and of the fit."""
    nominal, (low, high) = found.responses[0], found.band_rad_s or (1.0, 100.0)
    run = longest_uniform(next(r for r in found.runs if r.command_s.size > _FEWEST))
    raw = raw_response(run.command_deg - run.command_deg.mean(), run.measured_deg - run.measured_deg.mean())
    w_raw = np.asarray(2.0 * np.pi * np.fft.rfftfreq(run.command_deg.size, run.sample_time_s), dtype=float)
    chosen = (w_raw > 0.0) & np.isfinite(raw)
    stride = max(1, int(np.count_nonzero(chosen)) // _RAW_POINTS)
    w_raw, raw = w_raw[chosen][::stride], raw[chosen][::stride]
    fit = found.servo.linear.sampled_response(nominal.frequency_rad_s, nominal.sample_time_s)
    fit_rad = np.unwrap(np.angle(fit))
    at_raw = found.servo.linear.sampled_response(w_raw, nominal.sample_time_s)
    raw_rad = np.unwrap(np.angle(at_raw)) + np.angle(raw / at_raw)  # on the branch of the fit
    magnitude = [Curve("raw", "raw", w_raw, _decibels(raw), "dots")]
    phase = [Curve("", "raw", w_raw, np.degrees(raw_rad), "dots")]
    coherence, error = [], []
    for k, (each, off) in enumerate(zip(found.responses, found.normalized_errors(), strict=True)):
        role, w = _SERVOS[k % len(_SERVOS)], each.frequency_rad_s
        ahead_rad = each.phase_rad - np.interp(w, nominal.frequency_rad_s, fit_rad)
        turns = np.round(np.median(ahead_rad[(w >= low) & (w <= high)]) / (2.0 * np.pi))
        name = f"servo {k + 1}" if len(found.responses) > 1 else "smoothed"
        magnitude.append(Curve(name, role, w, _decibels(each.response)))
        phase.append(Curve("", role, w, np.degrees(each.phase_rad - 2.0 * np.pi * turns)))
        coherence.append(Curve("", role, w, each.coherence))
        error.append(Curve("", role, w, off))
    magnitude.append(Curve("fit", "before", nominal.frequency_rad_s, _decibels(fit)))
    phase.append(Curve("", "before", nominal.frequency_rad_s, np.degrees(fit_rad)))
    coherence.append(Curve("", "threshold", np.array([0.5 * low, 1.6 * high]), np.full(2, _COHERENT)))
    inside = (nominal.frequency_rad_s >= 0.5 * low) & (nominal.frequency_rad_s <= 1.6 * high)
    fit_db, fit_deg = _decibels(fit[inside]), np.degrees(fit_rad[inside])
    largest = found.max_normalized_error or 0.0
    panels = (
        Panel("magnitude", "dB", tuple(magnitude), float(fit_db.min()) - 12.0, max(6.0, float(fit_db.max()) + 4.0)),
        # A servo that runs against its command begins at half a turn.
        Panel("phase", "deg", tuple(phase), float(fit_deg.min()) - 60.0, float(fit_deg.max()) + 60.0),
        Panel("coherence", "", tuple(coherence), 0.0, 1.05),
        Panel("normalised error", "", tuple(error), 0.0, max(2.0 * largest, 0.1)),
    )
    text = (
        f"The fit follows the smoothed response between {low:.1f} and {high:.1f} rad/s (shaded), where coherence is "
        f"above {_COHERENT}; the hold is included. The normalised error of Eq. 3.2 is at most {largest:.3f} there. "
        "Thesis Figs 3.5 to 3.8."
    )
    spans = (Span("ok", low, high, ""),)
    return Chart("Frequency response", text, 0.5 * low, 1.6 * high, panels, spans, axis="frequency [rad/s]", log=True)


def _traced(found: Identification, index: int, title: str, first_s: float, last_s: float) -> Chart:
    """Command, measured and simulated position of a test; below, their difference."""
    run, error_deg = found.runs[index], found.errors_deg[index]
    inside = (run.measured_s >= first_s) & (run.measured_s <= last_s)
    asked = (run.command_s >= first_s) & (run.command_s <= last_s)
    curves = (
        Curve("command", "command", run.command_s[asked], run.command_deg[asked], "steps"),
        Curve("simulated", "simulated", run.measured_s[inside], (run.measured_deg - error_deg)[inside]),
        Curve("measured", "measured", run.measured_s[inside], run.measured_deg[inside]),
    )
    error = Curve("measured - simulated", "residual", run.measured_s[inside], error_deg[inside])
    panels = (Panel.around("deflection", "deg", curves), Panel.around("error", "deg", [error]))
    text = (
        f"Above, what was asked, what the servo that was found does, and what was measured; below, the error, "
        f"{np.std(error_deg[inside]):.3g} deg rms here. Of the whole test the fit is {found.fits_percent[index]:.1f}%."
    )
    return Chart(title, text, first_s, last_s, panels)


def _decibels(response: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> FloatArray:
    return 20.0 * np.log10(np.maximum(np.abs(response), 1e-9))


def identify_report(found: Identification, source: str) -> Document:
    """The numbers of the servo with their 95 % intervals, and the figures of the evidence."""
    linear, servo = found.servo.linear, found.servo
    bandwidth = linear.transfer.bandwidth_rad_s
    sentence = f"{spoken(found.surface)}: a servo of order {linear.order}, delay {MS_PER_S * linear.delay_s:.3g} ms"
    if found.not_told:
        sentence = f"{spoken(found.surface)}: {found.not_told}"
    elif math.isfinite(bandwidth):
        sentence += f", bandwidth {bandwidth:.3g} rad/s"
    values: dict[str, tuple[str, float | None, float]] = {
        "dc_gain": ("dc gain", linear.gain, 1.0),
        "delay_s": ("delay [ms], hold apart", linear.delay_s, MS_PER_S),
        "lag_s": ("total lag [ms]", linear.lag_s, MS_PER_S),
        "bandwidth_rad_s": ("bandwidth [rad/s]", bandwidth, 1.0),
        "rate_up_deg_s": ("rate limit up [deg/s]", servo.rate_up_deg_s, 1.0),
        "rate_down_deg_s": ("rate limit down [deg/s]", servo.rate_down_deg_s, 1.0),
        "dead_band_deg": ("dead band [deg]", servo.dead_band_deg, 1.0),
    }
    for k, pole in enumerate(found.poles_rad_s):
        if pole.imag >= 0.0:
            label = "pair, real part [rad/s]" if pole.imag else "pole [rad/s]"
            values[f"pole_{k}_real_rad_s"] = (label, pole.real, 1.0)
        if pole.imag > 0.0:
            values[f"pole_{k}_imag_rad_s"] = ("pair, imaginary part ± [rad/s]", pole.imag, 1.0)
    rows = []
    for name, (label, value, scale) in values.items():
        if value is None or not math.isfinite(value):
            continue
        interval, shown, between = found.intervals.get(name), f"{scale * value:.4g}", ""
        if interval is not None and interval.low < interval.high < math.inf:
            shown, low, high = known_digits(scale * value, scale * interval.low, scale * interval.high)
            between = f"{low} to {high}"
        rows.append((label, shown, between))
    rows.append(("rms error [deg]", f"{found.rms_deg:.4g}", ""))
    if found.band_rad_s is not None:
        begin, end = found.band_rad_s
        rows.append(("normalised error", f"up to {found.max_normalized_error:.3f}", f"{begin:.1f} to {end:.1f} rad/s"))
    return Document(
        title=f"Identification of {spoken(found.surface)}",
        status="unknown" if found.not_told else "healthy",
        sentence=f"{sentence}; the fit leaves {found.rms_deg:.3g} deg rms",
        facts=f"{source}, method {found.method}",
        parts=[
            Table("Numbers and their 95% intervals", ("quantity", "value", "interval"), rows),
            Bullets(found.notes),
            Figures(lambda: [*identify_charts(found).values()]),
        ],
        data=found.document(),
    )

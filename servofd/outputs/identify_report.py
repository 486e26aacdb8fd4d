"""An identification: its numbers, and pictures after thesis Figs 3.3 to 3.9."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.units import MS_PER_S
from servofd.core.series import latest
from servofd.identification.choice import step_slopes
from servofd.identification.records import longest_uniform
from servofd.identification.response import raw_response
from servofd.outputs.document import Bullets, Document, Figures, Table
from servofd.outputs.palette import COLOURS
from servofd.outputs.picture import Picture, finish, new_figure
from servofd.outputs.sentence import spoken

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from servofd.core.types import FloatArray
    from servofd.identification.response import FrequencyResponse
    from servofd.identification.result import Identification

_EXCERPT_S = 4.0
"""Length of the excerpt of the motion that is drawn [s]."""
_STEP_S = 0.6
"""Time after a step that is drawn [s]."""
_RAW_POINTS = 3000
"""About how many points of the raw response are drawn."""
_SERVOS = ("#0072b2", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442")


def identify_figures(found: Identification) -> tuple[Picture, ...]:
    """All figures that the tests allow: response, coherence, normalised error, steps, motion."""
    pictures = []
    if step_slopes(found.runs):
        pictures.append(_steps(found))
    pictures.append(_motion(found))
    if found.response is not None:
        pictures += [_bode(found), _coherence(found), _error(found)]
    pictures.append(_validation(found))
    return tuple(pictures)


def _bode(found: Identification) -> Picture:
    figure, (upper, lower) = new_figure(2, height=6.0)
    run = next(r for r in found.runs if r.command_s.size > 2)
    uniform = longest_uniform(run)
    raw = raw_response(
        uniform.command_deg - uniform.command_deg.mean(), uniform.measured_deg - uniform.measured_deg.mean()
    )
    w_raw = np.asarray(2.0 * np.pi * np.fft.rfftfreq(uniform.command_deg.size, uniform.sample_time_s), dtype=float)
    chosen = (w_raw > 0.0) & np.isfinite(raw)
    stride = max(1, int(np.count_nonzero(chosen)) // _RAW_POINTS)
    w_raw, raw = w_raw[chosen][::stride], raw[chosen][::stride]
    upper.plot(w_raw, _decibels(raw), ".", ms=1.5, color="0.75", label="raw")
    nominal = found.responses[0]
    inside = _shown(found, nominal)
    fit = found.servo.linear.sampled_response(nominal.frequency_rad_s, nominal.sample_time_s)
    fit_phase_rad = np.unwrap(np.angle(fit))
    for k, response in enumerate(found.responses):
        style: dict[str, Any] = {
            "color": _SERVOS[k % len(_SERVOS)],
            "lw": 1.2,
            "ls": ":" if len(found.responses) > 1 else "-",
        }
        label = f"smoothed, servo {k + 1}" if len(found.responses) > 1 else "smoothed"
        upper.plot(response.frequency_rad_s, _decibels(response.response), label=label, **style)
        ahead_rad = response.phase_rad - np.interp(response.frequency_rad_s, nominal.frequency_rad_s, fit_phase_rad)
        turns = np.round(np.median(ahead_rad[_shown(found, response)]) / (2.0 * np.pi))
        lower.plot(response.frequency_rad_s, np.degrees(response.phase_rad - 2.0 * np.pi * turns), **style)
    at_raw = found.servo.linear.sampled_response(w_raw, nominal.sample_time_s)
    near = np.unwrap(np.angle(at_raw)) + np.angle(raw / at_raw)  # on the branch of the fit
    lower.plot(w_raw, np.degrees(near), ".", ms=1.5, color="0.75", zorder=0)
    upper.plot(nominal.frequency_rad_s, _decibels(fit), color=COLOURS["measured"], lw=2, ls="--", label="fit")
    lower.plot(nominal.frequency_rad_s, np.degrees(fit_phase_rad), color=COLOURS["measured"], lw=2, ls="--")
    upper.set_ylim(float(_decibels(fit[inside]).min()) - 12.0, max(6.0, float(_decibels(fit[inside]).max()) + 4.0))
    phase_deg = np.degrees(fit_phase_rad[inside])
    # A servo that runs against its command begins at half a turn.
    lower.set_ylim(float(phase_deg.min()) - 60.0, float(phase_deg.max()) + 60.0)
    _finish(found, upper, lower, y=["magnitude [dB]", "phase [deg]"])
    low, high = found.band_rad_s or (0.0, 0.0)
    text = f"The fit follows the smoothed response between {low:.1f} and {high:.1f} rad/s (shaded); hold included."
    return Picture("response", "Frequency response", text, figure)


def _each_servo(found: Identification, curves: Sequence[FloatArray], label: str) -> tuple[Figure, Axes]:
    """A curve of each servo over frequency."""
    figure, (axes,) = new_figure()
    for k, (response, curve) in enumerate(zip(found.responses, curves, strict=True)):
        name = f"servo {k + 1}" if len(found.responses) > 1 else label
        axes.plot(response.frequency_rad_s, curve, color=_SERVOS[k % len(_SERVOS)], label=name)
    return figure, axes


def _coherence(found: Identification) -> Picture:
    figure, axes = _each_servo(found, [each.coherence for each in found.responses], "command to position")
    axes.axhline(0.8, color=COLOURS["fault"], lw=1.0, ls="--", label="0.8")
    axes.set_ylim(0.0, 1.05)
    _finish(found, axes, y=["coherence"])
    low, high = found.band_rad_s or (0.0, 0.0)
    text = f"Coherence is above 0.8 from {low:.1f} to {high:.1f} rad/s, the band of the fit."
    return Picture("coherence", "Coherence (thesis Fig. 3.7)", text, figure)


def _error(found: Identification) -> Picture:
    figure, axes = _each_servo(found, found.normalized_errors(), "|G smoothed - G fit| / |G fit|")
    axes.set_yscale("log")
    axes.set_ylim(1e-4, 10.0)
    _finish(found, axes, y=["normalised error"])
    text = f"Normalised error of Eq. 3.2: at most {found.max_normalized_error or 0.0:.3f} within the band."
    return Picture("normalised_error", "Normalised error (thesis Fig. 3.8, Eq. 3.2)", text, figure)


def _motion(found: Identification) -> Picture:
    """First seconds of the first test, thesis Fig. 3.4."""
    run, error = found.runs[0], found.errors_deg[0]
    begin_s = float(run.measured_s[0])
    figure, (axes,) = new_figure()
    inside = run.measured_s <= begin_s + _EXCERPT_S
    _draw(axes, found, 0, inside)
    finish(axes, x="time [s]", y=["angle [deg]"])
    text = f"Command, measured and simulated position; the error is {np.std(error[inside]):.3g} deg rms here."
    return Picture("motion", f"First {_EXCERPT_S:g} s of the test (thesis Fig. 3.4)", text, figure)


def _validation(found: Identification) -> Picture:
    """All of the longest test, thesis Fig. 3.9."""
    index = int(np.argmax([run.measured_s.size for run in found.runs]))
    run, error = found.runs[index], found.errors_deg[index]
    figure, (upper, lower) = new_figure(2, height=5.0)
    _draw(upper, found, index, np.ones(run.measured_s.size, dtype=bool))
    lower.plot(run.measured_s, error, color="black", lw=0.6, label="measured - simulated")
    finish(upper, lower, x="time [s]", y=["angle [deg]", "error [deg]"])
    text = f"Simulation of the whole test: {np.std(error):.3g} deg rms, fit {found.fits_percent[index]:.1f}%."
    return Picture("validation", "Validation in time (thesis Fig. 3.9)", text, figure)


def _steps(found: Identification) -> Picture:
    """Largest step with the line whose slope is the rate limit, thesis Fig. 3.3."""
    step = max(step_slopes(found.runs), key=lambda one: abs(one.travel_deg))
    run = found.runs[step.run]
    figure, (axes,) = new_figure()
    inside = (run.measured_s >= step.start_s - 0.1) & (run.measured_s <= min(step.start_s + _STEP_S, step.end_s))
    _draw(axes, found, step.run, inside)
    after = (run.measured_s >= step.start_s) & inside
    begin_deg = float(run.measured_deg[after][0])
    way = (run.measured_deg[after] - begin_deg) / step.travel_deg
    middle_s = float(np.interp(0.5, np.maximum.accumulate(way), run.measured_s[after]))
    half_s = 0.4 * abs(step.travel_deg / step.slope_deg_s)
    line_s = middle_s + np.array([-half_s, half_s])
    line_deg = begin_deg + 0.5 * step.travel_deg + step.slope_deg_s * (line_s - middle_s)
    axes.plot(line_s, line_deg, color=COLOURS["fault"], lw=2.5, ls="--", label=f"{abs(step.slope_deg_s):.0f} deg/s")
    finish(axes, x="time [s]", y=["angle [deg]"])
    text = (
        f"A step of {step.travel_deg:.1f} deg runs at {abs(step.slope_deg_s):.0f} deg/s between 20 and 80% of its way."
    )
    return Picture("step", "Step (thesis Fig. 3.3)", text, figure)


def _draw(axes: Axes, found: Identification, index: int, inside: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> None:
    run = found.runs[index]
    time_s, measured_deg = run.measured_s[inside], run.measured_deg[inside]
    command_deg = latest(run.command_s, run.command_deg, time_s)
    axes.plot(time_s, command_deg, color=COLOURS["command"], lw=0.9, drawstyle="steps-post", label="command")
    axes.plot(time_s, measured_deg, color=COLOURS["measured"], lw=2.0, label="measured")
    simulated_deg = measured_deg - found.errors_deg[index][inside]
    axes.plot(time_s, simulated_deg, color=COLOURS["simulated"], lw=0.9, label="simulated")


def _decibels(response: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> FloatArray:
    decibels: FloatArray = 20.0 * np.log10(np.maximum(np.abs(response), 1e-9))
    return decibels


def _shown(found: Identification, response: FrequencyResponse) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    low, high = found.band_rad_s or (1.0, 100.0)
    w = response.frequency_rad_s
    shown: np.ndarray[tuple[int], np.dtype[np.bool_]] = (w >= 0.5 * low) & (w <= 1.6 * high)
    return shown


def _finish(found: Identification, *all_axes: Axes, y: Sequence[str]) -> None:
    """Over frequency, with the band of the fit shaded."""
    low, high = found.band_rad_s or (1.0, 100.0)
    for axes in all_axes:
        axes.set_xscale("log")
        axes.set_xlim(0.5 * low, 1.6 * high)
        axes.axvspan(low, high, color=COLOURS["ok"], alpha=0.08, lw=0)
    finish(*all_axes, x="frequency [rad/s]", y=y)


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
        "delay_s": ("delay [ms], hold apart", linear.delay_s, 1e3),
        "lag_s": ("total lag [ms]", linear.lag_s, 1e3),
        "bandwidth_rad_s": ("bandwidth [rad/s]", bandwidth, 1.0),
        "rate_up_deg_s": ("rate limit up [deg/s]", servo.rate_up_deg_s, 1.0),
        "rate_down_deg_s": ("rate limit down [deg/s]", servo.rate_down_deg_s, 1.0),
        "dead_band_deg": ("dead band [deg]", servo.dead_band_deg, 1.0),
    }
    for k, pole in enumerate(found.poles_rad_s):
        if pole.imag >= 0.0:
            values[f"pole_{k}_real_rad_s"] = (
                "pair, real part [rad/s]" if pole.imag else "pole [rad/s]",
                pole.real,
                1.0,
            )
        if pole.imag > 0.0:
            values[f"pole_{k}_imag_rad_s"] = ("pair, imaginary part ± [rad/s]", pole.imag, 1.0)
    rows = []
    for name, (label, value, scale) in values.items():
        if value is not None and math.isfinite(value):
            interval = found.intervals.get(name)
            shown = "" if interval is None else f"{scale * interval.low:.5g} to {scale * interval.high:.5g}"
            rows.append((label, f"{scale * value:.5g}", shown))
    rows.append(("rms error [deg]", f"{found.rms_deg:.4g}", ""))
    if found.band_rad_s is not None:
        low, high = found.band_rad_s
        rows.append(("normalised error", f"up to {found.max_normalized_error:.3f}", f"{low:.1f} to {high:.1f} rad/s"))
    return Document(
        title=f"Identification of {spoken(found.surface)}",
        status="unknown" if found.not_told else "healthy",
        sentence=f"{sentence}; the fit leaves {found.rms_deg:.3g} deg rms",
        facts=f"{source}, method {found.method}",
        parts=[
            Table("Numbers and their 95% intervals", ("quantity", "value", "interval"), rows),
            Bullets(found.notes),
            Figures(lambda: identify_figures(found)),
        ],
        data=found.document(),
    )

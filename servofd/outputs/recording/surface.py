"""One surface or axis in a recording: curves, states, shaded faults, markers, events."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.series import tenths
from servofd.core.types import BoolArray, FloatArray
from servofd.detection.verdict import WITHIN_SIGMAS, CurrentAudit, SurfaceAudit, describe
from servofd.outputs.recording.content import Trace
from servofd.outputs.recording.stream import STATES, Recorder, microseconds, seconds, surface_place
from servofd.outputs.sentence import spoken
from servofd.servo.context import Context

if TYPE_CHECKING:
    from servofd.axes.verdict import AxisAudit
    from servofd.onboard.seen import Seen

_DEFLECTIONS = ("command", "simulated", "measured")
_RESIDUALS = ("residual", "+threshold", "-threshold")
_CURRENTS = ("drawn", "good servo", "+good ones differ by", "-good ones differ by")
AIRSPEED, SUPPLY = "/flight/airspeed", "/flight/supply"
"""Entities of airspeed and supply."""
MARKER_HEIGHT = 4.6
"""Of onset markers in the overview, whose plot reaches to 5 thresholds."""

_MARGIN = 1.12
"""Height of a plot over the range of its curves."""


def plot_range(values: FloatArray, least: float) -> tuple[float, float]:
    """Bottom and top of a plot that shows all values and as much as `least` around them."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    middle, half = (low + high) / 2.0, max(_MARGIN * (high - low) / 2.0, least)
    return round(middle - half, 6), round(middle + half, 6)


def deflection_range(trace: Trace) -> tuple[float, float]:
    """Bottom and top of the plot of deflections [deg]."""
    return plot_range(np.concatenate([trace.command_deg, trace.simulated_deg, trace.measured_deg]), 1.0)


def residual_range(trace: Trace) -> tuple[float, float]:
    """Bottom and top of the plot of the residual and its thresholds [deg]."""
    return plot_range(np.concatenate([trace.residual_deg, trace.threshold_deg, -trace.threshold_deg]), 0.1)


def send_surface(
    recorder: Recorder, surface: SurfaceAudit, trace: Trace | None, start_s: float, tint: str = "simulated"
) -> None:
    """Send everything that an audit read and found about a surface."""
    place = surface_place(surface.surface)
    recorder.texts(f"{place}/events", events(trace, surface, start_s))
    if surface.current is not None:
        _send_current(recorder, place, surface.current, is_alone=trace is None)
    if trace is None or not trace.time_s.size:
        return
    send_styles(recorder, surface.surface, tint)
    changes = _states_of(trace, surface)
    recorder.states(f"{place}/state", changes)
    # Before the first sample, and from where the cursor stands at first: else the legend has colours of its own.
    tints = [(start_s, STATES[changes[0][1]]), *((time_s, STATES[word]) for time_s, word in changes[1:])]
    recorder.line_colours(f"{place}/residual", [(t, (tint, "threshold", "threshold")) for t, tint in tints])
    send_curves(recorder, place, breaks_s(trace.time_s), trace)
    # Commands on their own time stamps, unless each came with a measurement: then the curve has them all.
    _send_seconds(recorder, f"{place}/seconds", trace.time_s)
    if not np.array_equal(trace.asked_s, trace.time_s):
        recorder.scalars(f"{place}/command", trace.asked_s, trace.asked_deg)
        _send_seconds(recorder, f"{place}/command_seconds", trace.asked_s)
    starts_s = np.array([fault.start_s for fault in surface.faults])
    if starts_s.size:
        heights = np.full(starts_s.size, MARKER_HEIGHT)
        recorder.markers(f"{place}/onset", starts_s, heights, f"{surface.surface}: onset", "fault")
    for name, (low, high) in (("deflection", deflection_range(trace)), ("residual", residual_range(trace))):
        for found, level in ((surface.faults, "fault"), (surface.suspicions, "suspect")):
            end_s = float(trace.time_s[-1])
            spans = [(fault.start_s, end_s if fault.end_s is None else fault.end_s) for fault in found]
            if spans:
                recorder.shade(f"{place}/shade/{name}/{level}", spans, (low + high) / 2.0, high - low, level)


def _send_current(recorder: Recorder, place: str, current: CurrentAudit, *, is_alone: bool) -> None:
    """What was drawn and what a good servo draws; without a position, what was asked as well."""
    time_s, drawn_a, healthy_a, sigma_a = current.time_s, current.current_a, current.healthy_a, current.sigma_a
    if time_s is None or drawn_a is None or healthy_a is None or sigma_a is None:
        return
    style_current(recorder, place)
    send_current(recorder, place, breaks_s(time_s), (time_s, drawn_a, healthy_a, WITHIN_SIGMAS * sigma_a))
    if is_alone and current.command is not None:
        recorder.scalars(f"{place}/command", *current.command)


def style_current(recorder: Recorder, place: str) -> None:
    """Name and colour the curves of a current, and the command above it."""
    recorder.lines(f"{place}/current", _CURRENTS, ("measured", "simulated", "threshold", "threshold"))
    recorder.lines(f"{place}/command", ("command",), ("command",))


def send_current(recorder: Recorder, place: str, broken_s: FloatArray, columns: Sequence[FloatArray]) -> None:
    """Send time, what was drawn, what a good servo draws, and what good ones differ by, and break the curves."""
    time_s, drawn_a, healthy_a, width_a = columns
    _send_broken(
        recorder, f"{place}/current", broken_s, time_s, [drawn_a, healthy_a, healthy_a + width_a, healthy_a - width_a]
    )


def send_on_board(recorder: Recorder, surface: str, seen: Seen) -> None:
    """Residual and threshold that a script on board logged, for the plot of the residual."""
    place = f"{surface_place(surface)}/onboard"
    recorder.lines(place, ("on board", "+ on board", "- on board"), ("measured", "command", "command"))
    values = np.column_stack([seen.residual_deg, seen.threshold_deg, -seen.threshold_deg])
    recorder.scalars(place, seen.time_s, values)


def send_styles(recorder: Recorder, surface: str, tint: str = "simulated") -> None:
    """Name and colour the curves of a surface, but the residual, which its state colours; `tint`: in the overview."""
    place = surface_place(surface)
    recorder.lines(f"{place}/deflection", _DEFLECTIONS, _DEFLECTIONS, widths=(1.0, 2.5, 1.5))
    recorder.lines(f"{place}/residual", _RESIDUALS, widths=[1.5, 1.0, 1.0])
    recorder.lines(f"{place}/ratio", [surface], [tint], aggregation_policy="Max")


def send_curves(recorder: Recorder, place: str, broken_s: FloatArray, trace: Trace) -> None:
    """Send deflections, residual and threshold, break these curves, and send how near the threshold it was."""
    time_s, *deflections, residual_deg, threshold_deg = trace[:6]
    _send_broken(recorder, f"{place}/deflection", broken_s, time_s, deflections)
    _send_broken(recorder, f"{place}/residual", broken_s, time_s, [residual_deg, threshold_deg, -threshold_deg])
    recorder.scalars(f"{place}/ratio", *ratio(time_s, residual_deg, threshold_deg))


def _send_broken(
    recorder: Recorder, place: str, broken_s: FloatArray, time_s: FloatArray, columns: Sequence[FloatArray]
) -> None:
    recorder.scalars(place, broken_s, np.full((broken_s.size, len(columns)), np.nan))
    recorder.scalars(place, time_s, np.column_stack(columns))


def _send_seconds(recorder: Recorder, place: str, time_s: FloatArray) -> None:
    """Time stamps that are no whole microseconds (a log of 32-bit floats), so that they can be read back exactly."""
    if np.any(seconds(microseconds(time_s)) != time_s):
        recorder.scalars(place, time_s, time_s)


def around(context: Context) -> list[tuple[str, str, FloatArray, FloatArray]]:
    """Entity, name, times [s] and values of airspeed and supply."""
    airspeed = (AIRSPEED, "airspeed [m/s]", context.airspeed_s, context.airspeed_m_s)
    return [airspeed, (SUPPLY, "servo supply [V]", context.voltage_s, context.voltage_v)]


def send_context(recorder: Recorder, context: Context) -> None:
    """Airspeed and supply, on their own time stamps."""
    for place, name, time_s, values in around(context):
        if time_s.size:
            recorder.lines(place, [name], ["simulated"])
            recorder.scalars(place, time_s, values)
            _send_seconds(recorder, f"{place}/seconds", time_s)


def axis_place(axis: AxisAudit) -> str:
    """Entity path of an axis."""
    return f"/axes/{axis.axis}"


def send_axis(recorder: Recorder, axis: AxisAudit) -> None:
    """Send what the motion tells of an axis."""
    place, usable = axis_place(axis), axis.inputs.usable
    effect = np.column_stack([axis.asked, axis.shown])
    recorder.lines(f"{place}/effect", ["expected", "seen"], ["simulated", "measured"])
    recorder.scalars(f"{place}/effect", axis.time_s, np.where(usable[:, np.newaxis], effect, np.nan))
    recorder.lines(f"{place}/distance", ["distance from healthy", "threshold"], ["residual", "threshold"])
    distance = np.column_stack([np.sqrt(np.maximum(axis.score, 0.0)), np.ones(axis.time_s.size)])
    recorder.scalars(f"{place}/distance", axis.time_s, np.where(usable[:, np.newaxis], distance, np.nan))
    recorder.states(f"{place}/state", _states(axis))


def _states(axis: AxisAudit) -> list[tuple[float, str]]:
    """Times at which the state changes, and the new state: judged or not, and the verdict."""
    usable = axis.inputs.usable
    words = np.where(usable, "OK", "NO DATA")
    said = "FAULT" if axis.status == "fault" else "SUSPECT"
    for event in axis.events:
        if event.is_own:
            until_s = np.inf if event.end_s is None else event.end_s
            words[(axis.time_s >= event.start_s) & (axis.time_s < until_s)] = said
    first = np.flatnonzero(np.concatenate(([True], words[1:] != words[:-1])))
    return [(float(axis.time_s[k]), str(words[k])) for k in first]


_SHORTEST_SILENCE_S = 0.5
_PERIODS = 5.0
"""Longer than that without a sample, the curve is broken."""


def _silences(trace: Trace) -> list[tuple[float, float]]:
    """From when to when nothing was judged for half a second and more [s]."""
    judged_s = trace.time_s[np.isfinite(trace.residual_deg)]
    edges_s = np.concatenate([trace.time_s[:1], judged_s, trace.time_s[-1:]])
    long = np.flatnonzero(np.diff(edges_s) >= _SHORTEST_SILENCE_S)
    return [(float(edges_s[i]), float(edges_s[i + 1])) for i in long]


def _states_of(trace: Trace, surface: SurfaceAudit) -> list[tuple[float, str]]:
    """Times [s] at which the state of a surface changed, and to what.

    A fault begins with its alarm: what the lane shows, a monitor would have known in flight. Where nothing was judged
    it says so, whatever was before.
    """
    first_s, last_s = float(trace.time_s[0]), float(trace.time_s[-1])
    if not surface.is_judged:
        return [(first_s, "NO DATA")]
    spans = [(f.alarm_s, f.end_s, "SUSPECT") for f in surface.suspicions]
    spans += [(f.alarm_s, f.end_s, "FAULT") for f in surface.faults]
    spans += [(begin, end, "NO DATA") for begin, end in _silences(trace)]
    edges = sorted({first_s, *(t for a, b, _ in spans for t in (a, b) if t is not None and first_s <= t <= last_s)})
    changes: list[tuple[float, str]] = []
    for time_s in edges:
        held = [word for begin, end, word in spans if begin <= time_s and (end is None or time_s < end)]
        word = held[-1] if held else "OK"  # the later in the list, the more it says
        if not changes or changes[-1][1] != word:
            changes.append((time_s, word))
    return changes


def events(trace: Trace | None, surface: SurfaceAudit, start_s: float = 0.0) -> list[tuple[float, str, str]]:
    """Lines of the text log: when [s], level, words; of a surface without curves, at the start of the others."""
    name = surface.surface
    lines = []
    for found, level in ((surface.faults, "ERROR"), (surface.suspicions, "WARN")):
        for fault in found:
            lines.append((fault.alarm_s, level, f"{name}: {describe(fault)}"))
            if fault.end_s is not None:
                lines.append((fault.end_s, "INFO", f"{name}: last sign of {spoken(fault.kind)}"))
    if trace is None or not trace.time_s.size:
        level = "INFO" if surface.status == "healthy" else "WARN"
        return sorted(lines) or [(start_s, level, f"{name}: {surface.status}, {surface.reason}")]
    if surface.is_judged:
        late = (s for s in _silences(trace) if s[0] > trace.time_s[0])
        lines += [(a, "WARN", f"{name}: nothing to judge for {b - a:.1f} s") for a, b in late]
    if not lines:
        lines.append((float(trace.time_s[-1]), "INFO", f"{name}: {surface.status}, {surface.reason}"))
    return sorted(lines)


def ratio(time_s: FloatArray, residual_deg: FloatArray, threshold_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest |residual| / threshold of each tenth of a second: times [s] and ratios, of shape (m,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.abs(residual_deg) / threshold_deg
    first = tenths(time_s)
    known: BoolArray = np.isfinite(size)
    largest = np.maximum.reduceat(np.where(known, size, -1.0), first)
    return time_s[first], np.where(largest < 0.0, np.nan, largest)


def breaks_s(time_s: FloatArray) -> FloatArray:
    """Where a curve has to be broken, because nothing came for long: a microsecond after the sample before [s]."""
    if time_s.size < 3:
        return np.zeros(0)
    step_s = np.diff(time_s)
    long = step_s > max(_PERIODS * float(np.median(step_s)), 1e-3)
    # Counted in the microseconds of the recording: 0.5 us + 1 us may be rounded to 0 or 2 us.
    return seconds(microseconds(time_s[:-1][long]) + 1)

"""What a surface was when: lanes, colours, overview curves, out of curves and faults."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.core.series import tenths
from servofd.detection.verdict import describe
from servofd.outputs.recording.stream import microseconds, seconds

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.verdict import SurfaceAudit
    from servofd.outputs.recording.content import Trace

_SHORTEST_SILENCE_S = 0.5
_PERIODS = 5.0
"""Longer than that without a sample, the curve is broken."""


def silences(trace: Trace) -> list[tuple[float, float]]:
    """From when to when nothing was judged for half a second and more [s].

    Examples
    --------
    >>> from servofd.outputs.recording.content import Trace
    >>> t = np.array([0.0, 0.1, 0.2, 5.0, 5.1])
    >>> silences(Trace(t, t, t, t, t, t, t, t))
    [(0.2, 5.0)]
    """
    judged_s = trace.time_s[np.isfinite(trace.residual_deg)]
    edges_s = np.concatenate([trace.time_s[:1], judged_s, trace.time_s[-1:]])
    long = np.flatnonzero(np.diff(edges_s) >= _SHORTEST_SILENCE_S)
    return [(float(edges_s[i]), float(edges_s[i + 1])) for i in long]


def states(trace: Trace, surface: SurfaceAudit) -> list[tuple[float, str]]:
    """Times [s] at which the state of a surface changed, and to what.

    A fault begins with its alarm: what the lane shows, a monitor would have known in flight. Where nothing was judged
    it says so, whatever was before.
    """
    if not trace.time_s.size:
        return []
    first_s, last_s = float(trace.time_s[0]), float(trace.time_s[-1])
    if not surface.is_judged:
        return [(first_s, "NO DATA")]
    spans = [(f.alarm_s, f.end_s, "SUSPECT") for f in surface.suspicions]
    spans += [(f.alarm_s, f.end_s, "FAULT") for f in surface.faults]
    spans += [(begin, end, "NO DATA") for begin, end in silences(trace)]
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
                lines.append((fault.end_s, "INFO", f"{name}: last sign of {fault.kind.replace('_', ' ')}"))
    if trace is None or not trace.time_s.size:
        return [(start_s, "WARN", f"{name}: {surface.status}, {surface.reason}")]
    if surface.is_judged:
        late = (s for s in silences(trace) if s[0] > trace.time_s[0])
        lines += [(a, "WARN", f"{name}: nothing to judge for {b - a:.1f} s") for a, b in late]
    if not lines:
        lines.append((float(trace.time_s[-1]), "INFO", f"{name}: {surface.status}, {surface.reason}"))
    return sorted(lines)


def ratio(time_s: FloatArray, residual_deg: FloatArray, threshold_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest |residual| / threshold of each tenth of a second: times [s] and ratios, of shape (m,)."""
    if not time_s.size:
        return time_s, time_s
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

"""Search for the period of pulse frames: a needle in a long log, a hill in a short one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.residual import Commands
from servofd.discrepancy.record import simulate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import FloatArray
    from servofd.discrepancy.record import Record
    from servofd.servo.physics import Physics

_SHORTEST_S, _LONGEST_S = 0.01, 0.055
_WINDOW_S = 4.0
_REMEMBERED_S = 1.5
"""Longest time that a command takes to the surface, with the longest frame before it."""
_ROUGHLY_S, _NEARLY_S, _PRECISELY_S = 3e-3, 1.5e-3, 4e-4
"""Between the phases that are tried in a window, for usual periods, and for one that is known: frames
that pick other commands are far off."""
_SHARE_OF_BEAT = 0.4
"""Of the change of period that moves the last frame of a window by one period."""
_ZOOM, _KEPT, _LIKELY = 3.0, 27, 24
_WORSE_AT_FIRST, _WORSE = 100.0, 10.0
"""Squared noise by which frames may be worse than what is no frame: true ones, not yet met exactly, were better by 10
and 89 in the two windows where they were hardest to see, and where there were none, worse by 1300 and 2600."""
_SHIFTS = (-0.1, -0.04, 0.0, 0.04, 0.1)
_FINER = (0.5, 0.2, 0.08, 0.03, 0.01)
_USUAL_S = (*(k / 1000.0 for k in range(10, 26)), 0.004, 0.005, 0.03, 0.04, 0.05, 1 / 70, 1 / 60, 1 / 45, 1 / 150)
"""Whole milliseconds, and common frame rates that are not."""


def frames_like(
    record: Record, physics: Physics, rival_deg: FloatArray | None = None, sigma_deg: float = 0.0
) -> list[tuple[float, float]]:
    """Frames that explain lively seconds of a record best; none where a rival's error [deg] is clearly smaller there.

    A window of length L tells periods T apart that differ by T²/L. They are tried at that spacing in a short window,
    and those around the best in one three times as long.
    """
    longer_s, centre_s = _WINDOW_S * _ZOOM, _liveliest_s(record, _WINDOW_S)
    best = _grid(_SHORTEST_S, _LONGEST_S, _WINDOW_S, _ROUGHLY_S)
    part = _window(record, centre_s, _WINDOW_S)
    best = _best(part, physics, best, _KEPT, _rival_loss(record, part, rival_deg) + _WORSE_AT_FIRST * sigma_deg**2)
    near = [frame for one in best for frame in _around(one, centre_s, longer_s)]
    part = _window(record, centre_s, longer_s)
    return _best(part, physics, near, _KEPT // 3, _rival_loss(record, part, rival_deg) + _WORSE * sigma_deg**2)


def _grid(shortest_s: float, longest_s: float, window_s: float, apart_s: float) -> list[tuple[float, float]]:
    """Periods that a window tells apart, each with phases so far apart."""
    periods = [shortest_s]
    while periods[-1] < longest_s:
        periods.append(periods[-1] * (1.0 + _SHARE_OF_BEAT * periods[-1] / window_s))
    return [(period, phase) for period in periods for phase in _phases(period, apart_s)]


def _best(
    part: Record, physics: Physics, frames: list[tuple[float, float]], kept: int, most: float
) -> list[tuple[float, float]]:
    """Those that explain a part of a record best, if any leaves no more than that."""
    losses = [_loss(part, physics, frame) for frame in frames]
    return [frames[k] for k in np.argsort(losses, kind="stable")[:kept]] if min(losses, default=np.inf) <= most else []


def _rival_loss(record: Record, part: Record, rival_deg: FloatArray | None) -> float:
    there = np.isin(record.time_s, part.time_s[part.counts])
    return np.inf if rival_deg is None else float(rival_deg[there] @ rival_deg[there])


def best_frame(record: Record, physics: Physics, begin: Sequence[tuple[float, float]] = ()) -> tuple[float, float]:
    """Period [s] and phase of the frames that explain a record best, from those that explain lively seconds of it.

    The window that told these apart is widened step by step around the best.
    """
    window_s, kept = _WINDOW_S * _ZOOM, _KEPT // 3
    best = list(begin) or frames_like(record, physics)
    centre_s = _liveliest_s(record, _WINDOW_S)
    total_s = float(record.time_s[-1] - record.time_s[0])
    part = _window(record, centre_s, window_s)
    usual = sorted(_usual(0.0, np.inf), key=lambda frame: _loss(part, physics, frame))
    while window_s < total_s:
        window_s, kept = window_s * _ZOOM, max(kept // 3, 1)
        part = _window(record, centre_s, window_s)
        near = [frame for one in best for frame in _around(one, centre_s, window_s)]
        best = sorted(near, key=lambda frame: _loss(part, physics, frame))[:kept]
    found = min([best[0], *usual[:_LIKELY]], key=lambda frame: _loss(record, physics, frame))
    for finer in _FINER:
        found = min(_around(found, centre_s, window_s, finer), key=lambda frame: _loss(record, physics, frame))
    # Half a frame later nearly the same commands are picked, where two come in a frame: that is another hill.
    turned = [(found[0], phase) for phase in _phases(found[0], _PRECISELY_S)]
    found = min([found, *turned], key=lambda frame: _loss(record, physics, frame))
    for finer in _FINER if found in turned else ():
        found = min(_around(found, centre_s, window_s, finer), key=lambda frame: _loss(record, physics, frame))
    return found


def _usual(low_s: float, high_s: float) -> list[tuple[float, float]]:
    usual_s = [period_s for period_s in _USUAL_S if low_s <= period_s <= high_s]
    return [(period_s, phase) for period_s in usual_s for phase in _phases(period_s, _NEARLY_S)]


def _phases(period_s: float, step_s: float) -> list[float]:
    """Evenly over a period, as shares of it."""
    count = int(np.ceil(period_s / step_s))
    phases: list[float] = ((np.arange(count) + 0.5) / count).tolist()
    return phases


def _around(
    frame: tuple[float, float], centre_s: float, window_s: float, finer: float = 1.0
) -> list[tuple[float, float]]:
    """Frames nearby; they are counted from 0 s, so that another period turns the phase in mid-window as well."""
    period, phase = frame
    frames = []
    for step in (period**2 / window_s * _SHARE_OF_BEAT * finer * np.arange(-4, 5)).tolist():
        turned = phase - centre_s / period + centre_s / (period + step)
        frames += [(period + step, (turned + finer * shift) % 1.0) for shift in _SHIFTS]
    return frames


def _liveliest_s(record: Record, window_s: float) -> float:
    """Middle of the window in which the position moves fastest [s]."""
    speed = np.gradient(simulate(record, record.plant.neutral), record.time_s)
    moved = np.where(record.counts, speed, np.nan)
    number = ((record.time_s - record.time_s[0]) / window_s).astype(int)
    spread = [np.nanstd(moved[number == k]) if np.isfinite(moved[number == k]).sum() > 50 else 0.0 for k in set(number)]
    return float(record.time_s[0] + (int(np.argmax(spread)) + 0.5) * window_s)


def _window(record: Record, centre_s: float, window_s: float) -> Record:
    inside = np.abs(record.time_s - centre_s) <= window_s / 2.0
    inside &= np.isfinite(record.measured_deg)
    counts = record.counts & (record.time_s >= record.time_s[inside][0] + 0.3)
    sent_s = record.commands.effective_s
    heard = slice(*np.searchsorted(sent_s, (record.time_s[inside][0] - _REMEMBERED_S, record.time_s[inside][-1])))
    commands = Commands(sent_s[heard], record.commands.command_deg[heard], record.commands.slope_deg_s[heard])
    return replace(
        record,
        commands=commands if commands.effective_s.size else record.commands,
        time_s=record.time_s[inside],
        measured_deg=record.measured_deg[inside],
        counts=counts[inside],
        block=record.block[inside],
        pressure_pa=None if record.pressure_pa is None else record.pressure_pa[inside],
        voltage_v=None if record.voltage_v is None else record.voltage_v[inside],
        current_a=None if record.current_a is None else record.current_a[inside],
        temperature_c=None if record.temperature_c is None else record.temperature_c[inside],
    )


def _loss(part: Record, physics: Physics, frame: tuple[float, float]) -> float:
    error = (part.measured_deg - simulate(part, physics._replace(frame_s=frame[0], frame_phase=frame[1])))[part.counts]
    return float(error @ error)

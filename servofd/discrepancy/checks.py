"""What makes a record unfit for the question, in sentences."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import NoMeasurement
from servofd.detection.residual import Commands
from servofd.discrepancy.at_rest import rest_sentence
from servofd.discrepancy.noise import noise_floor_deg
from servofd.discrepancy.record import SLOWEST_RATE_HZ, simulate

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.discrepancy.record import Record

_SHORTEST_S, _SHORTEST_ON_BENCH_S = 4.0, 1.0
"""The shorter one for runs that begin at rest with a step, of which nothing is lost."""
_MOTION_OF_NOISE, _SMALLEST_MOTION_DEG = 2.0, 0.1
_SAME, _SHIFT_S = 0.9, 0.1
"""Share of the position that a multiple of what was asked tells, by so much earlier or later: of another servo. Of one
that is too slow for its command (25 to 70 deg/s, 200 logs) none is told by more than 0.7 and a multiple below 0.5."""
_GAINS, _LATE_GAINS = (0.3, 1.7), (0.15, 3.4)
"""A servo of low gain that lags behind a large command moves by 0.29 of it (a smart servo under a weight)."""
_SWAPPED = 0.5
_STANDS, _FOLLOWS, _CLEARLY_DEG = 0.12, 0.05, 0.5
"""Swing of a servo that stands (that of its noise) and the share that it follows, both over what it was asked, which
must be so much [deg]."""


def check(record: Record) -> None:
    """Refuse what cannot show an effect."""
    rate_hz = min(1.0 / each.period_s for each in record.runs or (record,))
    if rate_hz < SLOWEST_RATE_HZ and not (record.side is not None and record.side.any()):
        rested = f" ({rest_sentence(record)})" if record.counts.any() else ""
        raise NoMeasurement(
            f"position comes at {rate_hz:.3g} Hz; what a model lacks cannot be told below 20 Hz, but for play where "
            f"the surface rests, and none is seen{rested}: log faster"
        )
    seconds = float(record.counts.sum()) * record.period_s
    shortest_s = _SHORTEST_ON_BENCH_S if record.runs else _SHORTEST_S
    if seconds < shortest_s:
        raise NoMeasurement(
            f"only {seconds:.1f} s of command and position together; at least {shortest_s:g} s are needed, and "
            "30 s with brisk inputs are better"
        )
    simulated = simulate(record, record.plant.neutral)
    error = record.measured_deg - simulated
    asked, measured = simulated[record.counts], record.measured_deg[record.counts]
    # First, for noise that is scaled, too, hides the motion that was asked for.
    _check_scale(asked, measured, round(_SHIFT_S / record.period_s))
    if record.side is not None:
        return
    noise = noise_floor_deg(record, error)
    if float(np.std(asked)) < max(_MOTION_OF_NOISE * noise, _SMALLEST_MOTION_DEG):
        raise NoMeasurement(
            f"hardly asked to move ({float(np.std(asked)):.2g} deg rms, noise {noise:.2g} deg): no effect can show; "
            "fly doublets of several degrees"
        )
    _check_motion(asked, measured)
    _check_order(record, error)


def _check_motion(asked: FloatArray, measured: FloatArray) -> None:
    """Refuse a position that stands still all along though the servo was clearly asked to move."""
    asked_deg, moved_deg = float(np.std(asked)), float(np.std(measured))
    followed = abs(float(np.cov(asked, measured)[0, 1])) / max(asked_deg, _CLEARLY_DEG) ** 2
    if asked_deg > _CLEARLY_DEG and moved_deg < _STANDS * asked_deg and followed < _FOLLOWS:
        raise NoMeasurement(
            f"position stands still ({moved_deg:.2g} deg rms) where {asked_deg:.2g} deg rms were asked: jammed, "
            "without power, or no reading of this servo; no effect can show"
        )


def _check_scale(asked: FloatArray, measured: FloatArray, shift: int) -> None:
    """Refuse a position that is another multiple of what was asked, so many samples early or late at most."""
    shift = min(shift, asked.size // 4)
    at = measured[shift : measured.size - shift]
    for late in sorted(range(-shift, shift + 1), key=abs):
        spread = np.cov(asked[shift - late : shift - late + at.size], at)
        gain = float(spread[0, 1] / max(spread[0, 0], 1e-300))
        likeness = float(spread[0, 1] ** 2 / max(spread[0, 0] * spread[1, 1], 1e-300))
        low, high = _LATE_GAINS if late else _GAINS
        if likeness > _SAME and not low <= gain <= high:
            what = "sign" if gain < 0.0 else "scale"
            raise NoMeasurement(f"position is {gain:.3g}x the command throughout: check the {what} of the calibration")


def _check_order(record: Record, error_deg: FloatArray) -> None:
    """Refuse a position that a servo would have had to follow, and better than the other way round."""
    known, command_deg = np.isfinite(record.measured_deg), record.commands.at(record.time_s)
    given = Commands(record.time_s[known], record.measured_deg[known], np.zeros(int(known.sum())))
    swapped = replace(record, commands=given, measured_deg=command_deg, own=None)
    wrong_deg = command_deg - simulate(swapped, record.plant.neutral)
    if np.std(wrong_deg[record.counts]) < _SWAPPED * np.std(error_deg[record.counts]):
        raise NoMeasurement(
            "the command follows the position, as a servo follows its command: are the two columns swapped?"
        )

"""What no model says: records that cannot show an effect, and where a servo was not driven (torque off, a hand)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servofd.aircraft.series import Series
from servofd.core.errors import NoMeasurement
from servofd.core.series import stretches
from servofd.core.statistics import LEAST_DIVISOR, MAD_TO_SIGMA
from servofd.core.types import BoolArray, FloatArray
from servofd.discrepancy.noise import noise_floor_deg, rest_sentence
from servofd.discrepancy.record import SLOWEST_EXPLAINED_HZ, Record, simulate
from servofd.identification.records import DRIFT_SHARE, drift_deg
from servofd.servo.effects.commands import Commands
from servofd.servo.physics import Physics

_SHORTEST_RECORD_S, _SHORTEST_ON_BENCH_S = 4.0, 1.0
"""The shorter one for runs that begin at rest with a step, of which nothing is lost."""
_MOTION_OF_NOISE, _SMALLEST_MOTION_DEG = 2.0, 0.1
"""Smallest swing of the command that shows an effect: in noise floors, and in degrees."""
_SAME, _SHIFT_S = 0.9, 0.1
"""Share of the position that a multiple of the simulated one, shifted by so much [s], explains for another servo.
For one that is too slow for its command (25 to 70 deg/s, 200 logs) it is 0.7 at most, and no multiple is below 0.5."""
_GAINS, _LATE_GAINS = (0.3, 1.7), (0.15, 3.4)
"""A servo of low gain that lags behind a large command moves by 0.29 of it (a smart servo under a weight)."""
_SWAPPED = 0.5
_NOWHERE_NEAR_DEG, _UNLIKE, _LATEST_S = 180.0, 0.3, 1.5
"""Half a turn; and the correlation below which a position that moves follows nothing, for so long after [s]. A servo of
10 deg/s keeps 0.63 or more (six flights of each style of `servofd simulate`), of commands of another surface in the
same style, but for chirps and doublets, half have less than 0.3."""
_STANDS_STILL, _FOLLOWS, _CLEARLY_DEG = 0.12, 0.05, 0.5
"""Swing of a servo that stands (that of its noise) and the share that it follows, both over what it was asked, which
must be so much [deg]."""


def check(record: Record) -> None:
    """Refuse what cannot show an effect."""
    rate_hz = min(1.0 / each.period_s for each in record.runs or (record,))
    if rate_hz < SLOWEST_EXPLAINED_HZ and not (record.side is not None and record.side.any()):
        rested = f" ({rest_sentence(record)})" if record.counts.any() else ""
        raise NoMeasurement(
            f"position comes at {rate_hz:.3g} Hz; what a model lacks cannot be found below {SLOWEST_EXPLAINED_HZ:g} "
            f"Hz, but for play where the surface rests, and none is seen{rested}: log faster"
        )
    seconds = float(record.counts.sum()) * record.period_s
    shortest_s = _SHORTEST_ON_BENCH_S if record.runs else _SHORTEST_RECORD_S
    if seconds < shortest_s:
        raise NoMeasurement(
            f"only {seconds:.1f} s of command and position together; at least {shortest_s:g} s are needed, and "
            "30 s with fast inputs are better"
        )
    simulated = simulate(record, record.model.physics)
    error = record.measured_deg - simulated
    asked, measured = simulated[record.counts], record.measured_deg[record.counts]
    apart_deg = abs(float(np.median(measured) - np.median(asked)))
    if apart_deg > _NOWHERE_NEAR_DEG:
        raise NoMeasurement(
            f"this position does not belong to this command: it lies {apart_deg:.0f} deg from it; check channel, unit"
        )
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
    if not record.runs:
        _check_drift(record, error, asked)
    _check_belongs(asked, measured, record.period_s)
    _check_order(record, error)


def _check_motion(asked: FloatArray, measured: FloatArray) -> None:
    """Refuse a position that stands still all along though the servo was clearly asked to move."""
    asked_deg, moved_deg = float(np.std(asked)), float(np.std(measured))
    followed = abs(float(np.cov(asked, measured)[0, 1])) / max(asked_deg, _CLEARLY_DEG) ** 2
    if asked_deg > _CLEARLY_DEG and moved_deg < _STANDS_STILL * asked_deg and followed < _FOLLOWS:
        raise NoMeasurement(
            f"position stands still ({moved_deg:.2g} deg rms) where {asked_deg:.2g} deg rms were asked: jammed, "
            "without power, or no reading of this servo; no effect can show"
        )


def _check_drift(record: Record, error_deg: FloatArray, asked_deg: FloatArray) -> None:
    """Refuse a position that wanders off while its command does not: no effect of a servo does that."""
    drifts_deg = drift_deg(record.time_s[record.counts], error_deg[record.counts], asked_deg)
    if abs(drifts_deg) > DRIFT_SHARE * np.ptp(record.commands.command_deg):
        raise NoMeasurement(
            f"position drifts by {drifts_deg:.3g} deg over the log while the command does not: a sensor that wanders, "
            "or a horn that slips; mend it, and record it again"
        )


def _check_scale(asked: FloatArray, measured: FloatArray, shift: int) -> None:
    """Refuse a position that is another multiple of what was asked, so many samples early or late at most."""
    shift = min(shift, asked.size // 4)
    at = measured[shift : measured.size - shift]
    for late in sorted(range(-shift, shift + 1), key=abs):
        spread = np.cov(asked[shift - late : shift - late + at.size], at)
        gain = float(spread[0, 1] / max(spread[0, 0], LEAST_DIVISOR))
        likeness = float(spread[0, 1] ** 2 / max(spread[0, 0] * spread[1, 1], LEAST_DIVISOR))
        low, high = _LATE_GAINS if late else _GAINS
        if likeness > _SAME and not low <= gain <= high:
            what = "sign" if gain < 0.0 else "scale"
            raise NoMeasurement(f"position is {gain:.3g}x the command throughout: check the {what} of the calibration")


def _likeness(one: FloatArray, other: FloatArray) -> float:
    """Correlation; 0 where either stands still."""
    spread = np.cov(one, other)
    return float(spread[0, 1] / np.sqrt(max(spread[0, 0] * spread[1, 1], LEAST_DIVISOR)))


def _check_belongs(asked: FloatArray, measured: FloatArray, period_s: float) -> None:
    """Refuse a position that moves without having anything to do with its command."""
    latest = min(round(_LATEST_S / period_s), asked.size // 4)
    like = max(
        abs(_likeness(asked[: asked.size - k], measured[k:])) for k in range(0, latest + 1, max(latest // 50, 1))
    )
    if like < _UNLIKE and float(np.std(measured)) > _MOVES_SHARE * float(np.std(asked)):
        raise NoMeasurement(
            "this position does not belong to this command: it moves, but does not follow within "
            f"{_LATEST_S:g} s (correlation {like:.2f}); check which channel is which"
        )


def _check_order(record: Record, error_deg: FloatArray) -> None:
    """Refuse a position ahead of its command that explains the command better than the other way round.

    A servo of low gain under a weight is far from what was asked, but late; nothing moves before its command.
    """
    known, command_deg = np.isfinite(record.measured_deg), record.commands.at(record.time_s)
    given = Commands(record.time_s[known], record.measured_deg[known], np.zeros(int(known.sum())))
    swapped = replace(record, commands=given, measured_deg=command_deg)
    wrong_deg = command_deg - simulate(swapped, record.model.physics)
    asked, measured = command_deg[record.counts], record.measured_deg[record.counts]
    shift = min(max(round(_SHIFT_S / record.period_s), 1), asked.size // 4)
    is_late = _likeness(asked[:-shift], measured[shift:]) > _likeness(asked[shift:], measured[:-shift])
    if not is_late and np.std(wrong_deg[record.counts]) < _SWAPPED * np.std(error_deg[record.counts]):
        raise NoMeasurement(
            "the command follows the position, as a servo follows its command: are the two columns swapped?"
        )


_WINDOW_S, _EVERY_S, _SHORTEST_S = 1.5, 0.1, 0.8
"""Length of a window [s], time between two, and the shortest record that is searched [s]."""
_SURE_S, _SURE_ALONE_S = 1.3, 4.0
"""Length of a stretch that is no chance [s]; without other runs a slow servo may look like it for longer."""
_OBEYS, _IGNORES = 0.6, 0.2
"""Regression of the position on the model's: from the first on a servo is driven, below the second it is not."""
_STANDS, _STILL = 0.08, 4.0
"""Swing of a servo that stands, over that of the model, and over the noise."""
_BEYOND, _STAYS_S, _MOSTLY, _FEW = 3.0, 0.2, 0.8, 25
"""How far from its model, in usual errors, a servo must stay for how long to have left it."""
_LOOK_BACK_S, _BEFORE_IT_SHOWS_S = 4.0, 0.3
"""Time before a stretch that belongs to it at most [s], and before it shows [s]."""
_LIKE = 0.7
"""Share of the position that the model tells elsewhere, or nothing can be said of it here."""
_MOVES_OF_NOISE, _MOVES_DEG, _MOVES_SHARE = 6.0, 0.5, 0.25
"""Motion that no standing servo makes: in noise floors, in degrees, and as a share of the model's swing."""


@dataclass(frozen=True, slots=True)
class Undriven:
    """A stretch of a run in which the servo did not follow its command."""

    run: int
    start_s: float
    end_s: float
    to_end: bool
    reason: str

    def sentence(self, *, several: bool) -> str:
        """In words."""
        until = "to its end" if self.to_end else f"to {self.end_s:.1f} s"
        where = f"run {self.run + 1}: " if several else ""
        return f"{where}not driven from {self.start_s:.1f} s {until} ({self.reason}): left out"


def undriven(segment: Series, run: int) -> list[Undriven]:
    """Stretches in which the log says that the torque was off."""
    end_s = float(segment.measured_s[-1])
    return [
        Undriven(run, each.start_s, each.end_s, each.end_s >= end_s, "the log says that the torque is off")
        for each in segment.left_out
        if each.why == "torque off"
    ]


def driven(records: Sequence[Record], physics: Physics) -> tuple[list[Record], list[Undriven]]:
    """Runs in which only what was driven counts, and where that was not so."""
    moved = [simulate(each, physics) for each in records]
    # Without evidence that the model tells how this servo moves when it is driven, nothing can be said.
    shares = [share_followed(each, sim, each.counts) for each, sim in zip(records, moved, strict=True)]
    swings = [np.std(sim[each.counts]) for each, sim in zip(records, moved, strict=True) if each.counts.any()]
    swing = float(np.median(swings))
    found, kept = [], []
    for run, (record, sim) in enumerate(zip(records, moved, strict=True)):
        least_deg = max(_MOVES_OF_NOISE * noise_floor_deg(record, record.measured_deg - sim), _MOVES_DEG)
        least_deg = max(least_deg, _MOVES_SHARE * swing)
        off = _ignored(record, sim, least_deg, _SURE_S if len(records) > 1 else _SURE_ALONE_S)
        others = [share for k, share in enumerate(shares) if k != run]
        if off.any() and max([*others, share_followed(record, sim, record.counts & ~off)], default=0.0) > _LIKE:
            reason = "the position does not follow its command: torque or power lost, jammed or held"
            found += [
                Undriven(run, float(record.time_s[a]), float(record.time_s[b - 1]), b == off.size, reason)
                for a, b in stretches(off)
            ]
            for a, _ in stretches(off):  # it may have begun before it shows
                off |= (record.time_s >= record.time_s[a] - _BEFORE_IT_SHOWS_S) & (record.time_s <= record.time_s[a])
            record = replace(record, counts=record.counts & ~off)  # noqa: PLW2901
        kept.append(record)
    return kept, found


def clear_of(records: Sequence[Record], undriven: Sequence[Undriven]) -> list[Record]:
    """Runs without stretches that were not driven, nor what came shortly before: their beginning is rough at first."""
    clear = []
    for run, record in enumerate(records):
        counts = record.counts.copy()
        for each in undriven:
            if each.run == run:
                counts &= (record.time_s < each.start_s - _LOOK_BACK_S) | (record.time_s > each.end_s)
        clear.append(replace(record, counts=counts))
    return clear


def share_followed(record: Record, simulated_deg: FloatArray, where: BoolArray) -> float:
    """Share of the position that the model tells."""
    if where.sum() < 20 or float(np.std(simulated_deg[where])) < 1e-9:
        return 0.0
    return float(np.corrcoef(simulated_deg[where], record.measured_deg[where])[0, 1] ** 2)


def _ignored(record: Record, simulated_deg: FloatArray, least_deg: float, sure_s: float) -> BoolArray:
    """Samples of stretches in which the model moves and the servo does not."""
    time_s, counts = record.time_s, record.counts
    off = np.zeros(time_s.size, dtype=bool)
    if not counts.any() or time_s[-1] - time_s[0] < _SHORTEST_S:
        return off
    known = np.where(counts, np.nan_to_num(record.measured_deg), 0.0)
    sim = np.where(counts, simulated_deg, 0.0)
    products = (counts, sim, known, sim * sim, sim * known, known * known)
    sums = [np.concatenate([[0.0], np.cumsum(v)]) for v in products]
    floor_deg = noise_floor_deg(record, record.measured_deg)
    state, since, obeyed = "driven", 0, 0
    marks: list[tuple[int, int, int]] = []
    for start_s in np.arange(time_s[0], max(time_s[-1] - _SHORTEST_S, time_s[0] + 1e-9), _EVERY_S):
        a, b = np.searchsorted(time_s, (start_s, start_s + _WINDOW_S)).tolist()
        n, s, m, ss, sm, mm = (float(total[b] - total[a]) for total in sums)
        if n < 10:
            continue
        variance = ss / n - (s / n) ** 2
        if variance < least_deg**2:
            continue
        slope = (sm / n - s * m / n**2) / variance
        # One that cannot follow moves all the same.
        stands = mm / n - (m / n) ** 2 < max(_STANDS**2 * variance, (_STILL * floor_deg) ** 2)
        if state == "driven" and slope < _IGNORES and stands:
            state, since = "off", a
        elif state == "off" and slope > _OBEYS:
            marks.append((obeyed, since, a))
            state = "driven"
        if state == "driven" and slope > _OBEYS:
            obeyed = a
    if state == "off":
        marks.append((obeyed, since, time_s.size))
    for sure, first, last in marks:
        begin = _onset(record, simulated_deg, sure, first)
        if time_s[last - 1] - time_s[begin] >= sure_s:
            off[begin:last] = True
    return off


def _onset(record: Record, simulated_deg: FloatArray, sure: int, first: int) -> int:
    """Sample from which on the servo leaves its model for good, near the first window in which it ignores it.

    Where little is asked, that window may begin long after the last one in which it surely obeyed.
    """
    time_s = record.time_s
    error = np.abs(np.nan_to_num(record.measured_deg - simulated_deg))
    before = record.counts[:first]
    usual = error[:first][before] if before.sum() > _FEW else error[record.counts]
    far = _BEYOND * max(MAD_TO_SIGMA * float(np.median(usual)), noise_floor_deg(record, record.measured_deg))
    stays = max(round(_STAYS_S / record.period_s), 2)
    last = min(int(np.searchsorted(time_s, time_s[first] + 2.0 * _WINDOW_S)), time_s.size - stays)
    earliest_s = min(max(time_s[sure], time_s[first] - _LOOK_BACK_S), time_s[first] - 0.5 * _WINDOW_S)
    for k in range(int(np.searchsorted(time_s, earliest_s)), last):
        if np.mean(error[k : k + stays] > far) > _MOSTLY:
            while k > 1 and error[k - 2 : k].max() > far / _BEYOND:  # it had begun to leave it before
                k -= 1  # noqa: PLW2901
            return k
    return first

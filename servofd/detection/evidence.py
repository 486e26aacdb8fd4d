r"""What a flight would have shown: how much of it was judged, the smallest faults, and whether that clears a surface.

A fault of size :math:`k` that adds :math:`k\,s(t)` to the residual raises an alarm in a log whose residual is :math:`r`
and whose threshold is :math:`\tau` as soon as :math:`|r + k s| > \tau`: it needs :math:`k(t) = (\tau \mp r) / |s|`, and
if it sets in at :math:`t_0`, :math:`\min_{t \ge t_0} k(t)`: one pass from the end of the log to its beginning. What is
detectable is the size that 19 of 20 onsets need. An offset adds a constant, a loss of travel what an immobile surface
leaves, an oscillation a filtered wave; less speed adds a lag, and play what play leaves, of sizes found by bisection.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.core.evidence import NOTHING_DETECTABLE, Detectable
from servofd.detection.named import in_a_row
from servofd.detection.verdict import two_digits
from servofd.servo.loops import compiled, play

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from servofd.aircraft.series import Series
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.residual import ResidualGenerator, Residuals, Threshold

MOST_OF_THE_LOG, SHORTEST_JUDGED_S = 0.9, 0.25
"""Share of the log, and seconds of it, that must be judged for a verdict."""
MOST_LOST = 0.34
"""A surface that could have lost more than a third of its travel unseen is not called healthy."""
_THIRD_OF_SPEED, _LARGER_MOTION = 1.0 / 3.0, 1.5
"""Motion so much larger shows that much less of a loss."""
_MARGIN = 1.2
"""Factor by which a movement that is advised is larger than needed."""
_FARTHEST_DEG = 30.0
"""No control surface moves much further to either side: one that would have to needs a narrower threshold."""
_NAMES = {
    "bias_deg": "offset",
    "slow_share": "speed",
    "loss_share": "travel",
    "deadband_deg": "play",
    "oscillation_deg": "oscillation",
}


def why_not_cleared(residuals: Residuals, shown: Detectable, level_deg: float) -> str:
    """Why a log without an alarm does not clear a surface, and what to fly; empty if it does."""
    if shown.loss_share is not None and shown.loss_share <= MOST_LOST:
        return ""
    moved = residuals.simulated_deg[residuals.settled]
    reach_deg = float(np.ptp(moved)) / 2.0 if moved.size else 0.0
    unseen = "a jam" if shown.loss_share is None else f"the loss of {shown.loss_share:.0%} of its travel"
    wanted_deg = max(3.0 * _MARGIN * level_deg, _MARGIN * reach_deg)
    level = f"{two_digits(level_deg)} deg"
    if wanted_deg > max(_FARTHEST_DEG, _MARGIN * reach_deg):
        return (
            f"too little motion for so wide a threshold ({level}): even {unseen} might not have shown; fly "
            "or bench-test slow movements beside fast ones, or calibrate on a good flight"
        )
    return (
        f"too little motion: even {unseen} might not have shown (threshold {level}); fly or bench-test "
        f"several movements of ±{wanted_deg:.0f} deg or more, or calibrate on a good flight"
    )


def is_blind(shown: Detectable) -> bool:
    """Whether neither a third of the speed would show, nor, in larger motion, the loss of a third of the travel."""
    loss_shows = shown.loss_share is not None and shown.loss_share <= _LARGER_MOTION * MOST_LOST
    speed_shows = shown.slow_share is not None and shown.slow_share >= _THIRD_OF_SPEED
    return not (loss_shows or speed_shows)


def not_judgeable(shown: Detectable) -> str:
    """Kinds of faults that a log could not have shown, in words."""
    missing = [_NAMES[name] for name in shown.missing]
    if not missing:
        return ""
    why = ": no fast motion" if missing == ["speed"] else ""
    *first, last = missing
    return f"{', '.join(first)} and {last} not judgeable{why}" if first else f"{last} not judgeable{why}"


_BIN_S = 1.0
_MOVES_DEG = 0.5
_CLEARLY_MOVES_DEG = 2.0
_JUDGED = 0.4
"""Share of the usual samples from which on a second counts as judged."""
_FEWEST_S = 3.0
"""Motion that counts [s]."""
_LEAST = 0.5
LEAST_OF_THE_LOG = 0.5
"""Share of the log that must be judged before a surface is cleared."""
TRIED_DEG = 3.0
"""A surface that was asked to move by so much was tried, also where its threshold is too wide to show a jam."""
_STOPS_S, _STOPS_SHARE = 3.0, 0.1
"""A stream that ends earlier than the log, by this many seconds and by this share of it, has stopped."""


def coverage(segment: Series, residuals: Residuals) -> tuple[str, tuple[str, ...]]:
    """Why too little of a flight was judged to clear a surface, empty if it was not; and what to know of it."""
    measured = np.isfinite(segment.measured_deg)
    if not measured.any() or segment.command_s.size == 0:
        return "", ()
    first_s = float(min(segment.command_s[0], segment.measured_s[0]))
    last_s = float(max(segment.command_s[-1], segment.measured_s[-1]))
    position_s = segment.measured_s[measured]
    times_s = segment.command_s, position_s, residuals.time_s[residuals.settled]
    bins = [((time_s - first_s) / _BIN_S).astype(np.int64) for time_s in times_s]
    seconds = np.unique(np.concatenate([each[np.diff(each, prepend=-1) > 0] for each in bins]))
    command, position, settled = (np.searchsorted(seconds, each) for each in bins)
    asked = _spans(command, segment.command_deg, seconds.size)
    moved = _spans(position, segment.measured_deg[measured], seconds.size)
    is_judged = np.bincount(settled, minlength=seconds.size) >= _JUDGED * _BIN_S / max(segment.period_s, 1e-9)
    commanded = np.bincount(command, minlength=seconds.size) > 0
    moving: BoolArray = (asked >= _MOVES_DEG) | (moved >= _CLEARLY_MOVES_DEG)
    total = int(np.count_nonzero(moving))
    share = float(np.count_nonzero(moving & is_judged)) / total if total * _BIN_S >= _FEWEST_S else 1.0
    alone_s = float(np.count_nonzero(~commanded & (moved >= _CLEARLY_MOVES_DEG))) * _BIN_S
    alone = f"the position moved for {alone_s:.0f} s without any command in the log"
    notes = (alone,) if alone_s >= _FEWEST_S else ()
    longest_s = max(_STOPS_S, _STOPS_SHARE * (last_s - first_s))
    streams = ("command", segment.command_s, "positions"), ("position that counts", position_s, "commands")
    for what, time_s, other in streams:
        left_s = last_s - time_s[-1]
        if left_s > longest_s:
            return f"no {what} after {time_s[-1]:.1f} s although {other} go on for {left_s:.1f} s", notes
    if share < _LEAST:
        return f"judged for only {share:.0%} of the time in which it moved or was asked to", notes
    return "", notes


def _spans(where: NDArray[np.intp], values_deg: FloatArray, bins: int) -> FloatArray:
    """How far a stream moves in each second [deg]; what happens from one to the next belongs to the later."""
    low, high = np.full(bins, np.inf), np.full(bins, -np.inf)
    for edge, values in ((where, values_deg), (where[1:], values_deg[:-1])):
        np.minimum.at(low, edge, values)
        np.maximum.at(high, edge, values)
    return np.where(high >= low, high - low, 0.0)


_POWER = 95.0
"""Percentage of the instants at which a fault of the smallest size is seen."""
_LATEST_ONSET = 0.5
"""Faults set in during this share of the log, and last to its end."""
_OSCILLATES_HZ = 3.0
"""Frequency of the oscillation whose smallest amplitude is given [Hz]."""
_LEAST_SPEED = 0.1
"""Least speed of a slow servo that is tried, as a share."""
_BISECTIONS = 9
"""Halvings of the interval in which a smallest size is found."""
_WIDEST_DEG = 20.0
"""Widest play that is tried [deg]."""
_LEAST_ROOM_DEG, _LEAST_GAIN = 1e-12, 1e-9
"""Room below a threshold that counts as none [deg], and residual over threshold of a size that never shows."""
_LARGEST = {"bias_deg": 45.0, "loss_share": 1.0, "oscillation_deg": 20.0}


def passing(
    generator: ResidualGenerator, residuals: Residuals, threshold: Threshold, persistence: int = 1
) -> Detectable:
    """Smallest faults that would have passed this threshold, 19 times in 20."""
    use = residuals.settled & np.isfinite(residuals.residual_deg)
    if np.count_nonzero(use) < 2:
        return NOTHING_DETECTABLE
    time_s, still_deg = residuals.time_s, residuals.simulated_deg
    level_deg, residual_deg = threshold.level_deg[use], residuals.residual_deg[use]
    since_s = time_s[use] - time_s[use][0]
    onsets = since_s <= _LATEST_ONSET * since_s[-1]
    ones = np.where(np.isfinite(residuals.measured_deg), 1.0, np.nan)

    def added(error_deg: FloatArray) -> FloatArray:
        """What an error of the position adds to the residual."""
        return np.nan_to_num(generator.filtered(time_s, ones * error_deg, residuals.restart)[use])

    def most(values: FloatArray) -> FloatArray:
        """The most that an alarm would see of these, for each onset."""
        ending = in_a_row(values, persistence)[persistence - 1 :]
        row = np.append(ending, np.zeros(persistence))[: values.size]
        seen: FloatArray = np.maximum.accumulate(row[::-1])[::-1][onsets]
        return seen

    def needed(error_deg: FloatArray, sign: float) -> FloatArray:
        """Size that a fault of each onset needs, if it adds this error for each unit of its size."""
        unit_deg = sign * added(error_deg)
        room_deg = level_deg - np.sign(unit_deg) * residual_deg
        return 1.0 / np.maximum(most(unit_deg / np.maximum(room_deg, _LEAST_ROOM_DEG)), _LEAST_GAIN)

    def shows(error_deg: FloatArray) -> bool:
        """Whether 19 of 20 onsets of this very error raise an alarm."""
        return bool(np.mean(most((residual_deg + added(error_deg)) / level_deg) > 1.0) >= _POWER / 100.0)

    turn = 2.0 * np.pi * _OSCILLATES_HZ * time_s
    signals = {
        "bias_deg": [(ones, 1.0), (ones, -1.0)],
        "loss_share": [(still_deg, -1.0)],
        "oscillation_deg": [(wave, sign) for wave in (np.sin(turn), np.cos(turn)) for sign in (1.0, -1.0)],
    }
    found: dict[str, float | None] = {}
    for name, ways in signals.items():
        size = float(np.percentile(np.concatenate([needed(*way) for way in ways]), _POWER))
        found[name] = size if size <= _LARGEST[name] else None
    lag_s = float(np.sum(1.0 / generator.filter_parameters().decay_rad_s).real)
    start_deg, reach_deg = float(still_deg[use][0]), min(float(np.ptp(still_deg[use])), _WIDEST_DEG)

    def slowed(speed: float) -> FloatArray:
        late_deg = np.empty(time_s.size)
        _lag(time_s, still_deg, max(lag_s * (1.0 / speed - 1.0), 1e-9), late_deg)
        return late_deg - still_deg

    found["slow_share"] = _bisected(lambda speed: shows(slowed(speed)), _LEAST_SPEED, 1.0)
    found["deadband_deg"] = None
    if reach_deg > 0.0:
        loose = _bisected(lambda width: shows(play(still_deg, width, start_deg) - still_deg), reach_deg, 0.0)
        found["deadband_deg"] = loose
    # Two digits: more are not known.
    return Detectable(**{name: None if size is None else float(f"{size:.2g}") for name, size in found.items()})


def _bisected(shows: Callable[[float], bool], large: float, none: float) -> float | None:
    """Size nearest to no fault that shows; None if not even a large one does."""
    if not shows(large):
        return None
    for _ in range(_BISECTIONS):
        middle = 0.5 * (large + none)
        large, none = (middle, none) if shows(middle) else (large, middle)
    return large


@compiled
def _lag(time_s: FloatArray, values: FloatArray, lag_s: float, result: FloatArray) -> None:
    state = values[0]
    for k in range(values.size):
        if k > 0:
            state += (1.0 - np.exp(-(time_s[k] - time_s[k - 1]) / lag_s)) * (values[k] - state)
        result[k] = state


def too_short(judged_s: float) -> str:
    """Why so much of a flight [s] is no ground for a verdict; empty if it is."""
    if judged_s >= SHORTEST_JUDGED_S:
        return ""
    return (
        f"only {judged_s:.1f} s of command and position together; {SHORTEST_JUDGED_S:g} s are needed "
        "after the first second, in which what moved the servo before is not known: fly or bench-test for longer"
    )

r"""What a flight would have shown: how much of it was judged, the smallest faults, and whether that clears a surface.

A fault of size :math:`k` that adds :math:`k\,s(t)` to the residual raises an alarm in a log whose residual is :math:`r`
and whose threshold is :math:`\tau` as soon as :math:`|r + k s| > \tau`: it needs :math:`k(t) = (\tau \mp r) / |s|`, and
if it sets in at :math:`t_0`, :math:`\min_{t \ge t_0} k(t)`: one pass from the end of the log to its beginning. What is
detectable is the size that 19 of 20 onsets need. An offset adds a constant, a loss of travel what an immobile surface
leaves, an oscillation a filtered wave; less speed adds a lag, and play what play leaves, of sizes found by bisection.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.core.evidence import NOTHING_DETECTABLE, Detectable
from servofd.core.series import outline
from servofd.detection.verdict import accusation, describe, two_digits
from servofd.servo.loops import compiled, play

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from servofd.aircraft.series import Series
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.residual import ResidualGenerator, Residuals, Threshold
    from servofd.detection.verdict import Fault, Status, SurfaceAudit

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
_TRIED_DEG = 3.0
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
_LARGEST = {"bias_deg": 45.0, "loss_share": 1.0, "oscillation_deg": 20.0}


def passing(
    generator: ResidualGenerator, residuals: Residuals, threshold: Threshold, persistence: int = 1
) -> Detectable:
    """Smallest faults that would have passed this threshold, 19 times in 20."""
    use = residuals.settled & np.isfinite(residuals.residual_deg)
    if np.count_nonzero(use) < 2:
        return NOTHING_DETECTABLE
    judge = _Judge(residuals, threshold.level_deg, use, persistence)
    ones = np.where(np.isfinite(residuals.measured_deg), 1.0, np.nan)
    signals = {
        "bias_deg": [generator.filtered(residuals.time_s, ones, residuals.restart)],
        "loss_share": [generator.filtered(residuals.time_s, -residuals.simulated_deg, residuals.restart)],
        "oscillation_deg": [
            generator.filtered(
                residuals.time_s, ones * wave(2.0 * np.pi * _OSCILLATES_HZ * residuals.time_s), residuals.restart
            )
            for wave in (np.sin, np.cos)
        ],
    }
    found: dict[str, float | None] = {}
    for name, ways in signals.items():
        signs = (1.0,) if name == "loss_share" else (1.0, -1.0)
        size = float(np.percentile(np.concatenate([judge.needed(s * way) for way in ways for s in signs]), _POWER))
        found[name] = size if size <= _LARGEST[name] else None
    lag_s = float(np.sum(1.0 / generator.filter_parameters().decay_rad_s).real)
    start_deg = float(residuals.simulated_deg[use][0])

    def slowed(speed: float) -> FloatArray:
        result = np.empty(residuals.time_s.size)
        _lag(residuals.time_s, residuals.simulated_deg, max(lag_s * (1.0 / speed - 1.0), 1e-9), result)
        return result

    def loose(width_deg: float) -> FloatArray:
        return play(residuals.simulated_deg, width_deg, start_deg)

    def shows(moved: Callable[[float], FloatArray], size: float) -> bool:
        error_deg = ones * (moved(size) - residuals.simulated_deg)
        return judge.shown(generator.filtered(residuals.time_s, error_deg, residuals.restart))

    reach_deg = min(float(np.ptp(residuals.simulated_deg[use])), _WIDEST_DEG)
    found["slow_share"] = _bisected(lambda speed: shows(slowed, speed), _LEAST_SPEED, 1.0)
    width_deg = _bisected(lambda width: shows(loose, width), reach_deg, 0.0) if reach_deg > 0.0 else None
    found["deadband_deg"] = width_deg
    # Two digits: more are not known.
    return Detectable(**{name: None if size is None else float(f"{size:.2g}") for name, size in found.items()})


class _Judge:
    """Whether an addition to the residual raises an alarm, whenever it sets in."""

    def __init__(self, residuals: Residuals, level_deg: FloatArray, use: BoolArray, persistence: int) -> None:
        self.residual_deg, self.level_deg, self.use = residuals.residual_deg[use], level_deg[use], use
        self.persistence = persistence
        time_s = residuals.time_s[use]
        share = (time_s - time_s[0]) / max(float(time_s[-1] - time_s[0]), 1e-9)
        self.onsets = share <= _LATEST_ONSET

    def needed(self, signal: FloatArray) -> FloatArray:
        """Size that a fault of each onset needs, if it adds this much for each unit of its size."""
        added = signal[self.use]
        sides = []
        for side in (1.0, -1.0):
            with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
                size = (self.level_deg - side * self.residual_deg) / (side * added)
            reached = np.isfinite(size) & (side * added > 0.0)
            sides.append(np.where(reached, np.maximum(size, 0.0), 1e9))
        size = np.minimum(*(_in_a_row(side, self.persistence, np.maximum, 1e9) for side in sides))
        needed: FloatArray = np.minimum.accumulate(size[::-1])[::-1][self.onsets]
        return needed

    def shown(self, added: FloatArray) -> bool:
        """Whether 19 of 20 onsets of this very addition raise an alarm."""
        residual_deg = self.residual_deg + np.nan_to_num(added[self.use])
        sides = (residual_deg > self.level_deg, residual_deg < -self.level_deg)
        beyond = np.logical_or(*(_in_a_row(side, self.persistence, np.logical_and, 0) for side in sides))
        after = np.logical_or.accumulate(beyond[::-1])[::-1][self.onsets]
        return bool(np.mean(after) >= _POWER / 100.0)


def _in_a_row(values: NDArray[Any], many: int, join: np.ufunc, beyond: float) -> NDArray[Any]:
    """Several values from each on, joined (the largest, or whether all hold); `beyond` is the value after the end."""
    joined, width = np.append(values, np.full(many - 1, beyond, values.dtype)), 1
    while width < many:
        step = min(width, many - width)
        joined = join(joined[:-step], joined[step:])
        width += step
    return joined


def _bisected(shows: Callable[[float], bool], large: float, none: float) -> float | None:
    """Size nearest to no fault that shows; None if not even a large one does."""
    if not shows(large):
        return None
    for _ in range(_BISECTIONS):
        middle = 0.5 * (large + none)
        if shows(middle):
            large = middle
        else:
            none = middle
    return large


@compiled
def _lag(time_s: FloatArray, values: FloatArray, lag_s: float, result: FloatArray) -> None:
    state = values[0]
    for k in range(values.size):
        if k > 0:
            state += (1.0 - np.exp(-(time_s[k] - time_s[k - 1]) / lag_s)) * (values[k] - state)
        result[k] = state


def status_of(
    residuals: Residuals,
    threshold: Threshold,
    faults: Sequence[Fault],
    suspicions: Sequence[Fault],
    shown: Detectable,
    well: str,
) -> tuple[Status, str]:
    """What a surface has earned, and why; `well` says in which way it is healthy, if it is."""
    if faults:
        return "fault", accusation(faults)
    if suspicions:
        return "suspect", f"no alarm stands, but look at it: {'; '.join(describe(fault) for fault in suspicions)}"
    problem = why_not_cleared(residuals, shown, threshold.typical_deg)
    if problem:
        return "unknown", problem
    return "healthy", "; ".join(filter(None, (well, not_judgeable(shown))))


def reported(
    verdict: Callable[..., SurfaceAudit],
    segment: Series,
    residuals: Residuals,
    threshold: Threshold,
    judged_share: float,
    status: Status,
    reason: str,
    after: Sequence[str] = (),
    **found: Any,  # noqa: ANN401 - fields of the verdict
) -> SurfaceAudit:
    """The verdict with what was seen of the flight, and what was not."""
    asked_deg = float(np.ptp(segment.command_deg)) if segment.command_deg.size else 0.0
    uncovered, remarks = coverage(segment, residuals)
    problem = uncovered or ("judged for too little of the log" if judged_share < LEAST_OF_THE_LOG else "")
    if status == "healthy" and problem:
        status, reason = "unknown", f"{problem}; as far as it was judged, {reason}"
    reason = "; ".join((reason, *remarks))
    if judged_share < MOST_OF_THE_LOG:
        reason += f"; judged for {judged_share:.0%} of the log"
    if segment.left_out_in_words:
        reason += f"; {segment.left_out_in_words}"
    if segment.frozen_s > 0.0:
        reason += f"; {segment.frozen_s:.1f} s of frozen telemetry not judged"
        if segment.frozen_to_end and status != "fault":
            status, reason = "no_data", "telemetry froze and never came back; before that, " + reason
    return verdict(
        tried=status != "unknown" or found["detectable"].loss_share is not None or asked_deg >= _TRIED_DEG,
        status=status,
        reason="; ".join((reason, *after)),
        segment=segment,
        residuals=residuals,
        threshold=threshold,
        threshold_deg=threshold.typical_deg,
        judged_share=judged_share,
        outline=outline(
            residuals.time_s, np.where(residuals.settled, residuals.residual_deg, np.nan), threshold.level_deg
        ),
        **found,
    )


def too_short(judged_s: float) -> str:
    """Why so much of a flight [s] is no ground for a verdict; empty if it is."""
    if judged_s >= SHORTEST_JUDGED_S:
        return ""
    return (
        f"only {judged_s:.1f} s of command and position together; {SHORTEST_JUDGED_S:g} s are needed "
        "after the first second, in which what moved the servo before is not known: fly or bench-test for longer"
    )

"""Servos fitted to the very log that is judged: what is done where nobody has named or calibrated them."""

from __future__ import annotations

import itertools
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servofd.aircraft.series import Series, bus_of, cut
from servofd.core.errors import CalibrationError, DesignError, NoMeasurement
from servofd.core.evidence import ModelOrigin
from servofd.core.statistics import line
from servofd.core.tolerance import Tolerance
from servofd.detection.contradiction import contradictions, resting_runs, resting_width_deg, step_deg
from servofd.detection.residual import ResidualGenerator, Simulator, noise_deg, prepared
from servofd.detection.threshold import interval_threshold
from servofd.detection.verdict import describe
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import Servo, second_order
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft, Surface
    from servofd.aircraft.series import Series
    from servofd.core.types import BoolArray, FloatArray, IntArray, Marks
    from servofd.servo.servo_model import ServoModel


_MOST_SAMPLES = 4_000
_ORDINARY_SHARE = 0.02
_BANDWIDTHS_HZ = (1.5, 2.3, 3.5, 5.0, 8.0, 12.0, 20.0)
_DAMPINGS = (0.7, 2.0)
_DELAYS_S = (0.0, 0.015, 0.03, 0.05, 0.08, 0.12)
_RATES_DEG_S = (600.0, 400.0, 250.0, 150.0, 100.0, 60.0)
_WORTH_A_LIMIT = 0.95
_MOST_EVALUATIONS = 100
_NEAR, _NEAR_DEG = 1e-3, 1e-5
_STARTS = 3
_REWEIGHTINGS, _NEAR_LINE = 5, (1e-3, 0.5)
_BANDWIDTH_RANGE_HZ, _DAMPING_RANGE, _RATE_RANGE_DEG_S = (0.2, 100.0), (0.2, 10.0), (10.0, 5000.0)
_FEWEST_ROWS = 30
_SLOWEST_SHARE = 0.1
POLE_RAD_S = 30.0
"""Of a filter that only serves to find gaps and starts: gaps beyond 0.17 s, blanking of 0.27 s."""
_BLOCK_S = 5.0
_ROWS_PER_BLOCK, _MOST_BLOCKS = 10, 32
_STRATA = 8
_RESTS_S, _ASKED_DEG = 1.0, 5.0
"""A surface that rests for so long while it is asked to move by so much [deg] tells nothing about its servo."""
_QUIET_SHARE = 20.0
_PREDICTED = 3.0
"""Blocks whose error is below so many times that of the best quarter are those that the model predicts."""
_LEAST_PREDICTED = 0.2
_EXPLAINS = 0.8
"""Share of the motion that a model explains in blocks it was not fitted to, or it is none."""
_NO_MODEL = ModelOrigin(origin="none")
_NOTHING_DEG = 1e9
_REVERSED = 3.0
"""A fit of the opposite sign has to be so many times better."""
_SCALES = (0.1, 5.0)


@dataclass(frozen=True, slots=True)
class RoughFit:
    """Second-order servo and scale that come closest to the position for most of the time."""

    bandwidth_hz: float = 6.0
    damping: float = 0.8
    delay_s: float = 0.02
    rate_limit_deg_s: float = float("inf")
    """In degrees of the command as it was converted."""
    gain: float = 1.0
    """Deflection per degree of the command as it was converted [deg/deg]."""
    bias_deg: float = 0.0
    error_deg: float = float("inf")
    """Typical simulation error of the moving samples, large ones hardly counted [deg]."""
    origin: ModelOrigin = _NO_MODEL
    """``fitted`` if it predicts the blocks that were held out."""
    until_s: float = float("inf")
    """The servo was like this until then; what comes later was not fitted [s]."""

    @property
    def model(self) -> ServoModel:
        """Healthy model with these numbers."""
        linear = ServoModel(second_order(2.0 * np.pi * self.bandwidth_hz, self.damping))
        return linear + Delay(self.delay_s) + RateLimit(self.rate_limit_deg_s)

    @property
    def of_position(self) -> RoughFit:
        """The same servo for a command in degrees of the position: its rate limit is that of the surface."""
        return replace(self, gain=1.0, bias_deg=0.0, rate_limit_deg_s=abs(self.gain) * self.rate_limit_deg_s)


_ORDINARY = RoughFit(bandwidth_hz=2.0)
"""A slow servo: when it moves, any other does."""
_GRID = tuple(RoughFit(*shape) for shape in itertools.product(_BANDWIDTHS_HZ, _DAMPINGS, _DELAYS_S))
_BEGINNINGS, _SHORTEST_BEGINNING_S, _CHANGED = (0.5, 0.25, 0.125), 5.0, 2.7
"""Shares of a log from its start, how long they have to be, and how many times smaller the error of their own servo
is there: 1 to 2.3 in healthy flights, from 3.2 on where a fault bends the fit (aircraft of even seed in
`benchmarks/strangers.py`)."""

_AS_BRISK = 0.3
"""Slow motion does not tell the servo of brisk motion: where a sweep begins slowly, the servo of its beginning may be
anything (`sample_logs/hidden/hidden_11.csv`: in half of it the command moves 0.13 times as fast as in the whole; before
oscillations that an autopilot answers 0.77 times or more)."""
_WAY_BACK = 0.1
"""Least share of the command's travel that goes against the rest of it: half a cycle of a ball screw that only goes up
was explained 3 times better by an offset of 2.5 deg, and going down was then off by twice that."""


def fit_roughly(segment: Series, *, free_scale: bool) -> RoughFit:
    """Fit bandwidth, delay and rate limit, and the scale if it is free, to most of a log.

    Blocks of motion from all over the log are fitted and held out by turns, then all of them are fitted. Where the
    surface rests although it is asked to move, nothing is fitted, and the cost is nearly flat for large errors, so that
    a fault during part of the motion does not bend the model. A wide grid, then downhill; the order is not fitted.

    A servo that fails in flight may bend the model all the same: an autopilot answers an oscillation, and then a servo
    with a resonance explains both. So what is fitted to the whole log has to hold in its beginning. If a servo that is
    fitted to a beginning alone explains that far better, the servo changed, and the one it was at first is returned.
    """
    whole = _fitted(segment, free_scale=free_scale)
    duration_s = float(np.ptp(segment.measured_s)) if segment.measured_s.size else 0.0
    for share in _BEGINNINGS:
        if share * duration_s < _SHORTEST_BEGINNING_S:
            break
        end_s = float(segment.measured_s[0]) + share * duration_s
        beginning = _until(segment, end_s)
        if _briskest_deg_s(beginning) < _AS_BRISK * _briskest_deg_s(segment) or not _goes_both_ways(beginning):
            break
        early = _of_its_own(beginning, whole, free_scale=free_scale)
        if early is not None:
            return replace(early, until_s=end_s)
    return whole


def _until(segment: Series, end_s: float) -> Series:
    """What of a segment comes before a time [s]."""
    commands, positions = segment.command_s < end_s, segment.measured_s < end_s
    return segment.at(positions, commands)


def _briskest_deg_s(segment: Series) -> float:
    """How fast the command moves where it is fastest [deg/s]; how long it moves like that does not count."""
    if segment.command_s.size < 2:
        return 0.0
    rate_deg_s = np.abs(np.diff(segment.command_deg)) / np.maximum(np.diff(segment.command_s), 1e-9)
    return float(np.percentile(rate_deg_s, 99.0))


def _goes_both_ways(segment: Series) -> bool:
    """Whether the command turns back: in motion of one direction, a lag and an offset are the same."""
    steps_deg = np.diff(segment.command_deg)
    back_deg = min(float(steps_deg[steps_deg > 0.0].sum()), float(-steps_deg[steps_deg < 0.0].sum()))
    return back_deg > _WAY_BACK * float(np.abs(steps_deg).sum())


def _of_its_own(beginning: Series, whole: RoughFit, *, free_scale: bool) -> RoughFit | None:
    """The servo of a beginning, if that is far better there than the one that suits the whole log."""
    simulator = _simulator(_busy_blocks(beginning))
    moving = _moving_rows(simulator)
    if np.count_nonzero(moving) < _FEWEST_ROWS:
        return None
    off_deg = _off_deg(whole, simulator, moving)
    coarse = min(map(_Judging(simulator, moving, free_scale), _GRID), key=_error)
    if _off_deg(coarse, simulator, moving) > off_deg:
        return None
    early = _fitted(beginning, free_scale=free_scale)
    changes = early.origin.origin == "fitted" and _CHANGED * _off_deg(early, simulator, moving) < off_deg
    return early if changes else None


def _off_deg(fit: RoughFit, simulator: Simulator, moving: BoolArray) -> float:
    """By how much a servo misses some rows, but for an offset (rms) [deg]."""
    error_deg = simulator.starts.measured_deg - fit.gain * simulator.simulated_deg(fit.model)
    return float(np.std(error_deg[moving]))


def _fitted(segment: Series, *, free_scale: bool) -> RoughFit:
    """One servo for all of a segment."""
    part = _busy_blocks(segment)
    simulator = _simulator(part)
    moving = _moving_rows(simulator)
    rows = np.flatnonzero(moving)
    if rows.size < _FEWEST_ROWS:
        return RoughFit()
    block = np.arange(rows.size) * min(rows.size // _ROWS_PER_BLOCK, _MOST_BLOCKS) // rows.size
    held_out = np.zeros(moving.size, dtype=bool)
    held_out[rows[block % 2 == 1]] = True

    train = _Judging(simulator, moving & ~held_out, free_scale)
    coarse = [train(start) for start in _GRID]
    found = min((_refined(start, train) for start in sorted(coarse, key=_error)[:_STARTS]), key=_error)
    limited = min((train(replace(found, rate_limit_deg_s=rate)) for rate in _RATES_DEG_S), key=_error)
    if limited.error_deg < _WORTH_A_LIMIT * found.error_deg:
        found = _refined(limited, train)
    everything = _Judging(simulator, moving, free_scale)
    origin = _origin(found, simulator, held_out, block[block % 2 == 1] // 2)
    best = replace(_refined(everything(found), everything), origin=origin)
    return _centred(best, simulator) if free_scale else best


def _centred(fit: RoughFit, simulator: Simulator) -> RoughFit:
    """Same fit with the offset that it has all the time, not in motion alone."""
    measured, simulated = simulator.starts.measured_deg, simulator.simulated_deg(fit.model)
    rows = simulator.starts.settled & ~_jammed_rows(simulator)
    return replace(fit, bias_deg=float(np.median((measured - fit.gain * simulated)[rows])))


def _origin(fit: RoughFit, simulator: Simulator, held_out: BoolArray, block: IntArray) -> ModelOrigin:
    """How well a model predicts rows that it was not fitted to, in the blocks that it predicts at all."""
    if not np.isfinite(fit.error_deg):
        return _NO_MODEL
    measured = simulator.starts.measured_deg[held_out]
    error = measured - fit.gain * simulator.simulated_deg(fit.model)[held_out] - fit.bias_deg
    rms_deg = np.sqrt(np.bincount(block, error**2) / np.bincount(block))
    predicted = (rms_deg <= max(_PREDICTED * float(np.percentile(rms_deg, 25.0)), fit.error_deg))[block]
    power = float(np.mean(error[predicted] ** 2))
    explained = 1.0 - power / max(float(np.var(measured[predicted])), 1e-300)
    sound = explained >= _EXPLAINS and np.count_nonzero(predicted) >= _LEAST_PREDICTED * error.size
    return ModelOrigin(
        origin="fitted" if sound else "none",
        held_out_rms_deg=float(np.sqrt(power)),
        explained_share=explained,
    )


def _refined(start: RoughFit, judging: _Judging) -> RoughFit:
    """Downhill from a point of the grid, in logarithms of what must stay positive."""

    def at(x: FloatArray) -> RoughFit:
        shape: dict[str, Any] = {
            "bandwidth_hz": _within(float(np.exp(x[0])), _BANDWIDTH_RANGE_HZ),
            "damping": _within(float(np.exp(x[1])), _DAMPING_RANGE),
            "delay_s": max(float(x[2]), 0.0),
        }
        if x.size > 3:
            shape["rate_limit_deg_s"] = _within(float(np.exp(x[3])), _RATE_RANGE_DEG_S)
        return replace(start, **shape)

    begin = np.array([np.log(start.bandwidth_hz), np.log(start.damping), start.delay_s])
    if np.isfinite(start.rate_limit_deg_s):
        begin = np.append(begin, np.log(start.rate_limit_deg_s))
    simplex = begin + np.vstack([np.zeros(begin.size), np.diag([0.3, 0.4, 0.01, 0.3])[: begin.size, : begin.size]])

    def error_deg(x: FloatArray) -> float:
        return judging(at(x)).error_deg

    found = _lowest(error_deg, simplex)
    return min(start, judging(at(found)), key=_error)


def _within(value: float, limits: tuple[float, float]) -> float:
    return min(max(value, limits[0]), limits[1])


def _lowest(cost: Callable[[FloatArray], float], simplex: FloatArray) -> FloatArray:
    """Where a cost is lowest, from a simplex downhill (Nelder and Mead, 1965; Lagarias et al., 1998).

    The same steps as those of scipy, whose package of optimisers takes half a second to load.
    """
    size = simplex.shape[1]
    costs = np.array([cost(x) for x in simplex])
    spent = size + 1
    while spent < _MOST_EVALUATIONS:
        order = np.argsort(costs)
        simplex, costs = simplex[order], costs[order]
        if np.abs(simplex[1:] - simplex[0]).max() <= _NEAR and np.abs(costs[1:] - costs[0]).max() <= _NEAR_DEG:
            break
        centre = simplex[:-1].mean(axis=0)
        away = centre - simplex[-1]
        tried = centre + away
        found, spent = cost(tried), spent + 1
        if found >= costs[-2] or found < costs[0]:  # further, or back, and how far
            is_best, is_bad = found < costs[0], found >= costs[-1]
            other = centre + (2.0 if is_best else -0.5 if is_bad else 0.5) * away
            there, spent = cost(other), spent + 1
            if there < found if is_best else there < costs[-1] if is_bad else there <= found:
                tried, found = other, there
            elif not is_best:
                simplex[1:] = simplex[0] + 0.5 * (simplex[1:] - simplex[0])
                costs[1:] = [cost(x) for x in simplex[1:]]
                spent += size
                continue
        simplex[-1], costs[-1] = tried, found
    best: FloatArray = simplex[costs.argmin()]
    return best


def _error(fit: RoughFit) -> float:
    return fit.error_deg


def _busy_blocks(segment: Series) -> Series:
    """Blocks of the log with most motion of the command, from all parts of it, few enough to be simulated often."""
    time_s = segment.measured_s
    if time_s.size <= _MOST_SAMPLES:
        return segment
    block = np.floor(time_s / _BLOCK_S).astype(np.int64)
    asked_deg = np.interp(time_s, segment.command_s, segment.command_deg)
    names, first, size = np.unique(block, return_index=True, return_counts=True)
    travel_deg = np.add.reduceat(np.abs(np.diff(asked_deg, prepend=asked_deg[0])), first)
    part = (np.arange(names.size) * _STRATA) // names.size
    rank = np.empty(names.size)
    for stratum in range(_STRATA):
        members = np.flatnonzero(part == stratum)
        rank[members[np.argsort(-travel_deg[members], kind="stable")]] = np.arange(members.size)
    order = np.lexsort((-travel_deg, rank))
    chosen = names[order[np.cumsum(size[order]) <= max(_MOST_SAMPLES, int(size[order[0]]))]]
    rows = np.isin(block, chosen)
    commands = np.isin(np.floor(segment.command_s / _BLOCK_S).astype(np.int64), chosen)
    return segment.at(rows, commands)


def _jammed_rows(simulator: Simulator) -> BoolArray:
    """Rows at which the surface rests although any servo would have moved."""
    measured_deg = simulator.starts.measured_deg
    rows = np.flatnonzero(np.isfinite(measured_deg))
    jammed = np.zeros(measured_deg.size, dtype=bool)
    if rows.size == 0:
        return jammed
    position_deg, time_s = measured_deg[rows], simulator.segment.measured_s[rows]
    asked_deg = simulator.simulated_deg(_ORDINARY.model)[rows]
    # At rest second differences are noise.
    quiet = np.abs(np.diff(position_deg, 2))
    noise = float(np.percentile(quiet, _QUIET_SHARE)) if quiet.size else 0.0
    labels = resting_runs(position_deg, resting_width_deg(noise, step_deg(position_deg)))
    begins = np.flatnonzero(np.diff(labels, prepend=-1))
    asked = np.maximum.reduceat(asked_deg, begins) - np.minimum.reduceat(asked_deg, begins)
    ends = np.append(begins[1:], rows.size) - 1
    rests = (time_s[ends] - time_s[begins] >= _RESTS_S) & (asked >= _ASKED_DEG)
    jammed[rows] = rests[labels]
    return jammed


def _simulator(segment: Series) -> Simulator:
    return Simulator.of(ResidualGenerator(_ORDINARY.model, POLE_RAD_S), segment)


def _moving_rows(simulator: Simulator) -> BoolArray:
    """Rows with a position during which any ordinary servo would be moving, and this one is not jammed."""
    usable = simulator.starts.settled & ~_jammed_rows(simulator)
    if not usable.any():
        return usable
    ordinary_deg = simulator.simulated_deg(_ORDINARY.model)
    rate_deg_s = np.abs(np.gradient(ordinary_deg, simulator.segment.measured_s))
    moving: BoolArray = usable & (rate_deg_s > _SLOWEST_SHARE * np.percentile(rate_deg_s[usable], 99.0))
    return moving


@dataclass(frozen=True, eq=False)
class _Judging:
    """How well fits suit some rows, beside what is ordinary."""

    simulator: Simulator
    rows: BoolArray
    free_scale: bool

    @cached_property
    def ordinary_deg(self) -> float:
        """Error that is nothing special: a share of the travel [deg]."""
        low_deg, high_deg = np.percentile(self.simulator.starts.measured_deg[self.rows], [2.0, 98.0])
        return max(_ORDINARY_SHARE * float(high_deg - low_deg), 1e-9)

    def __call__(self, fit: RoughFit) -> RoughFit:
        """The same fit with its scale, if that is free, and its error."""
        simulated = self.simulator.simulated_deg(fit.model)[self.rows]
        measured = self.simulator.starts.measured_deg[self.rows]
        gain, bias_deg = 1.0, 0.0
        if self.free_scale:
            gain, bias_deg = line(simulated, measured, near=_NEAR_LINE, rounds=_REWEIGHTINGS)
        fit, error_deg = replace(fit, gain=gain, bias_deg=bias_deg), measured - gain * simulated - bias_deg
        if self.free_scale and not _SCALES[0] <= abs(fit.gain) <= _SCALES[1]:
            return replace(fit, error_deg=_NOTHING_DEG)
        # Cauchy's cost: quadratic for errors of a working servo, nearly flat for those of a jammed one.
        cost = float(np.expm1(np.mean(np.log1p((error_deg / self.ordinary_deg) ** 2))))
        # In a closed loop an aircraft that is pushed over is answered by commands the other way.
        reversed_ = _REVERSED if self.free_scale and fit.gain < 0.0 else 1.0
        return replace(fit, error_deg=self.ordinary_deg * float(np.sqrt(cost)) * reversed_)


PERSISTENCE = 3
"""Judged samples in a row that make an alarm of a servo fitted to its log: a reading may be as old as the interval
since the one before it, and so may a command, and for as many samples a step of the command contradicts no servo."""
_ALIKE_S = 2.0
_MOVES_DEG = 2.0
"""Blocks in which the servo travels by so much are compared with each other, and so are the others: what a model lacks
shows in motion, and a log is at rest for most of its time."""
_USUAL_TIMES, _QUIETEST = 4.0, 25.0
"""Blocks whose residual is so many times that of the quietest quarter of their kind, and beyond what tolerances explain
anyway, are no part of what a threshold is drafted from."""
_MARGIN, _UNSURE = 1.25, 2.0
"""A threshold is so many times the largest residual, and more where few blocks were seen."""
_NOISE_SIGMAS = 3.0
SHORTEST_PERIOD_S, LONGEST_PERIOD_S = 1e-4, 0.2
_AROUND_S = 2.0
_SMALLEST_GAIN, _LARGEST_GAIN = 0.3, 1.7


class Drafted(NamedTuple):
    """Tolerances under which the log that they come from raises no alarm, but where it contradicts itself."""

    tolerance: Tolerance
    level_deg: float
    """Median of the threshold that follows from it [deg]."""
    peak_deg: float
    """Largest residual of the blocks from which it was drafted [deg]."""


def fitted_aircraft(log: FlightLog, aircraft: Aircraft, only: Iterable[str] | None = None) -> Aircraft:
    """Return the same aircraft with servos fitted to a log."""
    surfaces, servos, bus = dict(aircraft.surfaces), {}, bus_of(log, aircraft)
    for name in aircraft.surfaces if only is None else only:
        key = f"{name}-fitted"
        surfaces[name], servos[key] = _fitted_surface(log, name, aircraft, key, bus)
    return aircraft.model_copy(update={"surfaces": surfaces, "servos": {**aircraft.servos, **servos}})


def fitted_servo(fit: RoughFit, title: str) -> Servo:
    """What was fitted, as a servo."""
    return Servo(
        title=title,
        bandwidth_hz=round(fit.bandwidth_hz, 3),
        damping=round(fit.damping, 3),
        delay_s=round(fit.delay_s, 4),
        hold="zoh",
        rate_limit_deg_s=round(fit.rate_limit_deg_s, 1) if np.isfinite(fit.rate_limit_deg_s) else None,
        source="fitted to the log that is judged",
    )


def _fitted_surface(
    log: FlightLog, name: str, aircraft: Aircraft, key: str, bus: Mapping[str, Marks]
) -> tuple[Surface, Servo]:
    """One surface with the servo that was fitted to it."""
    surface = aircraft.surfaces[name]
    plain = surface.model_copy(update={"servo": key, "effects": {}, "model": ModelOrigin(origin="none")})
    title = f"fitted to {name} of this log"
    unfit = fitted_servo(RoughFit(), title)
    try:
        segment = cut(log, name, aircraft, bus)
    except NoMeasurement:
        return plain, unfit
    if not SHORTEST_PERIOD_S < segment.period_s < LONGEST_PERIOD_S:
        return plain, unfit
    fit = fit_roughly(segment, free_scale=True)
    if fit.origin.origin != "fitted":
        return plain.model_copy(update={"model": fit.origin}), unfit
    change: dict[str, object] = {"model": fit.origin, "suspicions": False}
    if _SMALLEST_GAIN <= fit.gain <= _LARGEST_GAIN:  # else sign or scale are wrong, and the verdict tells so
        change["command"] = surface.command.corrected(fit.gain, fit.bias_deg)
        if surface.command_saturation_deg is not None:
            ends = tuple(fit.gain * end + fit.bias_deg for end in surface.command_saturation_deg)
            change["command_saturation_deg"] = ends
        fit = fit.of_position
    fitted = plain.model_copy(update=change)
    aircraft = aircraft.model_copy(update={"surfaces": {**aircraft.surfaces, name: fitted}})
    drafted = draft_tolerance(fit.model, cut(log, name, aircraft, bus), until_s=fit.until_s)
    if drafted is None:
        return plain, unfit
    servo = fitted_servo(fit, title)
    levels = {
        "threshold": "interval",
        "tolerance": drafted.tolerance,
        "threshold_deg": drafted.level_deg,
        "persistence": PERSISTENCE,
    }
    return fitted.model_copy(update=levels), servo


def good_levels(aircraft: Aircraft, name: str, logs: Iterable[FlightLog]) -> dict[str, Any]:
    """Entries of a surface that make good runs healthy: tolerances drafted from them, and the origin of its model."""
    segments = []
    for log in logs:
        with suppress(NoMeasurement):
            segments.append(cut(log, name, aircraft))
    return levels_of(aircraft.model(name), segments)


def levels_of(model: ServoModel, segments: Iterable[Series]) -> dict[str, Any]:
    """Entries of a surface that this servo turns, under which good runs are healthy; empty if none can be judged.

    Raises
    ------
    CalibrationError
        If a run contradicts every threshold: then the model does not explain it, or the run is not good.
    """
    drafts, error_deg, moved_deg = [], [], []
    for segment in segments:
        try:
            drafted = draft_tolerance(model, segment, all_of_it=True)
            generator = ResidualGenerator.fitting(model, segment)
        except DesignError:
            continue
        _, residuals, _ = prepared(generator, segment)
        for fault in contradictions(generator, residuals):
            raise CalibrationError(f"{segment.surface}: this model does not explain its own run: {describe(fault)}")
        if drafted is not None:
            drafts.append(drafted)
            error_deg.append(residuals.error_deg[residuals.settled])
            moved_deg.append(residuals.measured_deg[residuals.settled])
    if not drafts:
        return {}
    each = [drafted.tolerance.model_dump() for drafted in drafts]
    power = float(np.mean(np.concatenate(error_deg) ** 2))
    explained = 1.0 - power / max(float(np.var(np.concatenate(moved_deg))), 1e-300)
    return {
        "threshold": "interval",
        "threshold_deg": max(drafted.level_deg for drafted in drafts),
        "tolerance": {key: max(one[key] for one in each) for key in each[0]},
        "persistence": PERSISTENCE,
        "suspicions": False,
        "model": {
            "origin": "fitted",
            "held_out_rms_deg": round(float(np.sqrt(power)), 4),
            "explained_share": round(min(explained, 1.0), 4),
            "good_runs": len(drafts),
        },
    }


def draft_tolerance(
    model: ServoModel, segment: Series, *, all_of_it: bool = False, until_s: float = np.inf
) -> Drafted | None:
    """Tolerances drafted from a log; None if nothing of it can be judged.

    No threshold that follows from them lies below the largest residual of the blocks that are alike, nor below one step
    of the command and one of the reading together; the fewer blocks there are, the wider they become.
    """
    try:
        generator = ResidualGenerator.fitting(model, segment)
    except DesignError:
        return None
    segment, residuals, _ = prepared(generator, segment)
    usual = residuals.settled & np.isfinite(residuals.residual_deg) & (residuals.time_s < until_s)
    for fault in contradictions(generator, residuals):
        end_s = np.inf if fault.end_s is None else fault.end_s + _AROUND_S
        usual &= (residuals.time_s < fault.start_s - _AROUND_S) | (residuals.time_s > end_s)
    if not usual.any():
        return None
    base = Tolerance(noise_deg=max(round(noise_deg(residuals.error_deg[usual]), 4), 0.02))
    level = interval_threshold(generator, segment, residuals, base)
    no_noise_deg = np.maximum(np.abs(residuals.residual_deg) - _NOISE_SIGMAS * level.sigma_deg, 0.0)
    beyond = no_noise_deg / np.maximum(level.tolerance_deg, 1e-9)
    least = float(beyond[usual].max()) if all_of_it else 1.0
    found = _width(residuals.time_s[usual], beyond[usual], residuals.simulated_deg[usual], least)
    steps_deg = step_deg(segment.command_deg) + step_deg(segment.measured_deg)
    scale = max(found.scale, 1.0, steps_deg / base.bias_deg)
    tolerance = _scaled(base, scale)
    inside = usual & (beyond <= found.usual)
    drafted = interval_threshold(generator, segment, residuals, tolerance)
    peak_deg = float(np.abs(residuals.residual_deg[inside]).max()) if inside.any() else 0.0
    return Drafted(tolerance, round(drafted.typical_deg, 3), peak_deg)


def _scaled(base: Tolerance, scale: float) -> Tolerance:
    """Every tolerance so many times as wide; lags, not bandwidths, grow with the scale."""
    lags = scale * base.bandwidth / (1.0 - base.bandwidth)
    return Tolerance(
        gain=round(min(scale * base.gain, 0.9), 4),
        delay_s=round(scale * base.delay_s, 5),
        bandwidth=round(lags / (1.0 + lags), 4),
        rate=round(min(scale * base.rate, 0.9), 4),
        bias_deg=round(scale * base.bias_deg, 4),
        noise_deg=base.noise_deg,
    )


class _Width(NamedTuple):
    """What follows from the blocks of a log."""

    scale: float
    """How many times as wide the tolerances have to be."""
    usual: float
    """Largest excess that counted."""


def _width(time_s: FloatArray, excesses: FloatArray, moved_deg: FloatArray, least: float = 1.0) -> _Width:
    """How many times as wide tolerances have to be, by blocks of 2 s; never narrower than `least` times."""
    first = np.flatnonzero(np.diff(np.floor(time_s / _ALIKE_S), prepend=-np.inf))
    peaks = np.maximum.reduceat(excesses, first)
    moves = np.maximum.reduceat(moved_deg, first) - np.minimum.reduceat(moved_deg, first) >= _MOVES_DEG
    kinds = [peaks[kind] for kind in (moves, ~moves) if kind.any()]
    alike = [kind[kind <= max(_USUAL_TIMES * float(np.percentile(kind, _QUIETEST)), least)] for kind in kinds]
    usual = np.concatenate(alike)
    if usual.size == 0:
        return _Width(least, least)
    largest = float(usual.max())
    return _Width(max(least, largest * (_MARGIN + _UNSURE / float(np.sqrt(usual.size)))), largest)

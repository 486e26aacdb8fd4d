"""A surface whose servo is named by the user: it moves as its own model does, its tolerances being the covariance.

Faults get their names in `servofd.detection.faults`.

The sensitivities to gain, delay, bandwidth and rate limit are those of its own model; what a change of another
parameter adds is that of the family (`servofd.estimate.family`) about the servo that is most like it. The residual that
is shown is that of the nullspace filter, ``r = Qy (y - ŷ)`` (thesis Eq. 4.12), over its own total sigma: the filter
passes noise and sensitivities as it passes the error. A level that the user or the file names is the only test then.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.aircraft.calibrated import CalibratedServo, Noise, lower_triangle
from servofd.aircraft.pace import pace_steps
from servofd.aircraft.priors import FITTED, NAMES, PRIORS
from servofd.aircraft.series import Series
from servofd.detection.faults import SAME_S, Found, judged
from servofd.detection.moving import Asked, Moved, Moving, Shown
from servofd.detection.outages import Outage, held
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.residual import (
    CURVATURE_TO_SIGMA,
    FilterMemory,
    ResidualGenerator,
    Residuals,
    Threshold,
    filter_in_place,
)
from servofd.detection.wiring import wiring_problem
from servofd.estimate.fit import fit
from servofd.estimate.record import Record
from servofd.servo.context import NO_CONTEXT
from servofd.servo.effects.commands import Commands
from servofd.servo.loops import compiled, play
from servofd.servo.motion import Motion, started_anew
from servofd.servo.physics import rate_fields

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface
    from servofd.core.tolerance import Tolerance
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.changes import Tested
    from servofd.detection.faults import Named
    from servofd.detection.moving import Watched
    from servofd.detection.verdict import Fault
    from servofd.servo.context import Context
    from servofd.servo.servo_model import ServoModel

_CHIRP_S, _STEP_S, _CHIRP_DEG, _LAST_HZ = 10.0, 0.01, 10.0, 5.0
"""Command by which the servo of the family that is most like a model is found."""
_LEAD_S = 2.0
"""Commands so long before a stretch of a flight are in force when it begins."""
_ANYWHERE_DEG: Final = 1e4
"""Reach of a servo whose travel no flight has shown."""
_IN_A_ROW: Final = 3
"""Residuals on one side that make an alarm: a reading may be as old as the interval since the one before it, and so may
a command, and for as many samples a step of the command contradicts no servo."""
_UNIFORM: Final = float(np.sqrt(3.0))
"""A uniform spread within a tolerance has its width over this as standard deviation."""
_LEAST: Final = 1e-3
"""Of the usual spread between flights: a covariance has an inverse."""
_CHANGE: Final = 0.02
"""Share by which the bandwidth and the rate limit are changed for their sensitivities."""
_NOISE_SAMPLES = 200
"""Until so many positions have been seen, noise is not taken to be smaller than its tolerance."""
_FASTEST_SAMPLES, _NOISE_MEMORY = 10.0, 1000.0
"""Samples that it takes to change the noise: a few at first, then as many as fill ten seconds."""
_GLITCH = 5.0
"""Second differences count as no more than this many standard deviations."""
_SMALLEST_NOISE_DEG = 1e-3
"""Smallest noise of a position [deg]."""
_RESOLUTION_TO_SIGMA = float(1.0 / np.sqrt(12.0))
_GAIN, _DELAY, _BANDWIDTH, _RATE = (NAMES.index(name) for name in ("gain", "delay_s", "ln_bandwidth", "ln_rate"))

_TOLERANCES = [_GAIN, NAMES.index("bias_deg"), _DELAY, _BANDWIDTH, _RATE]
"""What a file states tolerances of: each term of what they leave (docs/detection.md, D2) is bounded by its own."""


@lru_cache(maxsize=64)
def named_servo(model: ServoModel, tolerance: Tolerance, period_s: float) -> CalibratedServo:
    """The servo of the family that is most like a model, and what a good one may differ by."""
    linear = model.linear()
    time_s = np.arange(0.0, _CHIRP_S, _STEP_S)
    command_deg = _CHIRP_DEG * np.sin(np.pi * _LAST_HZ / _CHIRP_S * time_s**2)
    measured_deg = linear.simulate(time_s, command_deg, time_s)
    start = np.array([prior.value for prior in PRIORS])
    start[_DELAY], start[_BANDWIDTH] = model.delay_s, np.log(model.transfer.bandwidth_rad_s)
    theta = fit([Record.of(Series("", time_s, command_deg, time_s, measured_deg))], start=start).theta
    slowest_deg_s = min(abs(getattr(model.physics, name)) for name in rate_fields())
    if np.isfinite(slowest_deg_s):
        theta[_RATE] = np.clip(np.log(slowest_deg_s), PRIORS[_RATE].low, PRIORS[_RATE].high)
    spread = {
        "gain": tolerance.gain,
        "delay_s": tolerance.delay_s,
        "ln_bandwidth": tolerance.bandwidth,
        "ln_damping": tolerance.bandwidth,
        "ln_rate": tolerance.rate,
        "hinge": tolerance.gain,
    }
    spread = {prior.name: tolerance.bias_deg for prior in PRIORS if prior.unit == "deg"} | spread
    deviation = np.array([spread.get(prior.name, 0.0) for prior in PRIORS]) / _UNIFORM
    deviation = np.maximum(deviation, _LEAST * np.array([prior.between for prior in PRIORS]))
    return CalibratedServo(
        parameters=dict(zip(NAMES, theta.tolist(), strict=True)),
        between=lower_triangle(np.diag(deviation**2)),
        noise=Noise(
            still_deg=max(tolerance.noise_deg, _LEAST), lag_s=0.0, colour=(0.0, 0.0), innovation=1.0, period_s=period_s
        ),
        reach_deg=(-_ANYWHERE_DEG, _ANYWHERE_DEG),
    )


_THIN_PERIOD_S = 0.039
"""Logs at up to 25 Hz may hold fewer commands than the servo received; autopilots command at 50 Hz and more."""
_REAL_PERIOD_S = 0.02
"""Period at which commands are given that are logged more rarely [s]."""
_CLEARLY_SMALLER = 0.7
"""Ratio of two residuals below which the smaller one decides."""


def with_hold(model: ServoModel, segment: Series) -> tuple[Series, tuple[str, ...]]:
    """The segment with the hold that suits its commands, and what was done to it, in words.

    Commands that were given more often than the 10 to 25 Hz of the log look like steps that were not commanded: if
    straight lines between them leave a clearly smaller residual, that is what they were.
    """
    steps_s = pace_steps(segment.command_s)
    period_s = max(segment.period_s, float(np.median(steps_s)) if steps_s.size else 0.0)  # of the rarer stream
    if segment.command_period_s is not None or not period_s >= _THIN_PERIOD_S:
        return segment, ()
    straight = replace(segment, command_period_s=_REAL_PERIOD_S)
    held_deg, straight_deg = (_rms_deg(model, each) for each in (segment, straight))
    if not straight_deg < _CLEARLY_SMALLER * held_deg:
        return segment, ()
    return straight, ("commands are logged more thinly than they were given, and taken as straight lines between",)


def _rms_deg(model: ServoModel, segment: Series) -> float:
    """What a servo leaves of the positions that are judged."""
    residuals = ResidualGenerator.fitting(model, segment.period_s).run(segment)
    judged = residuals.residual_deg[residuals.settled]
    return float(np.sqrt(np.mean(judged**2))) if judged.size else float("inf")


class NamedMoving(Moving):
    """A named servo on its way, and those beside it whose motion gives its sensitivities.

    These are quicker, slower, and the weakest one that is tolerated.

    Raises
    ------
    DesignError
        If no residual filter suits the servo at this pace.
    """

    at_once = True
    missed_deg = 0.02
    """Jitter of the stamps and commands that were lost move a drawn servo so much otherwise than its model (rms of
    chirps to 10 Hz, even seeds of `benchmarks/fleet.py`)."""

    def __init__(self, surface: Surface, model: ServoModel, period_s: float, context: Context = NO_CONTEXT) -> None:
        tolerance = surface.tolerances
        super().__init__(named_servo(model, tolerance, period_s), period_s)
        generator = ResidualGenerator.fitting(model, period_s, surface.filter_pole_rad_s)
        self.alone = surface.threshold == "constant"
        self.own = Moves(model, context, self.known.theta)
        design = design_pulse_filter(model.transfer, 0.0, period_s, generator.pole_rad_s)
        self.noise_gain = design.noise_gain
        servo = model.servo(context)
        beside = servo, servo.slower(1.0 + _CHANGE), servo.slower(1.0 - _CHANGE), servo.weaker(tolerance.rate)
        self._surface, self._delay_s = surface, model.delay_s
        self._motions = [Motion(each) for each in beside]
        self._received = 0
        """Commands, of those that are held, that have reached the servos."""
        self._last = np.array([np.nan, np.nan])
        """Time of the sample before [s], and where the servo was then [deg]."""
        self._seen = np.array([np.nan, np.nan, max(tolerance.noise_deg, _SMALLEST_NOISE_DEG), 0.0, np.nan, np.inf])
        self._filter = generator.filter_parameters()
        self._lags = FilterMemory.of(self._filter, 1 + FITTED)
        self._bounds = _UNIFORM * np.sqrt(np.diag(self.known.covariance))[_TOLERANCES]
        self._before = np.zeros(0)
        """Residual over threshold of the judged samples before, as many as make an alarm together with one more."""

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply as far as they are known by now."""
        for motion in self._motions:
            motion.context = context

    def forget(self, commands: int) -> None:
        """The oldest commands are no longer held."""
        super().forget(commands)
        self._received = max(self._received - commands, 0)

    def moved(self, asked: Asked) -> Moved:
        """How it moves at the next instants: as its own model does, with the family's sensitivities beside its own."""
        moved, (commands, time_s, _, _, start_deg) = super().moved(asked), asked
        if not time_s.size:
            return moved
        effective_s, command_deg, slope_deg_s = commands[0] + self._delay_s, *commands[1:]
        begins = np.union1d(np.flatnonzero(np.isfinite(start_deg)), [0])
        pieces = []
        for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), time_s.size], strict=True):
            until = max(int(np.searchsorted(effective_s, time_s[end - 1], side="right")), self._received)
            span = slice(self._received, until)
            for motion in self._motions:
                motion.receive(effective_s[span], command_deg[span], slope_deg_s[span])
                if np.isfinite(start_deg[begin]):
                    motion.rest(float(time_s[begin]), float(start_deg[begin]))
            self._received = until
            pieces.append(np.stack([motion.at(time_s[begin:end]) for motion in self._motions]))
        healthy_deg, quick_deg, slow_deg, weak_deg = np.concatenate(pieces, axis=1)
        steps_s, steps_deg = np.diff(np.append(self._last[0], time_s)), np.diff(np.append(self._last[1], healthy_deg))
        self._last[:] = time_s[-1], healthy_deg[-1]
        slopes, rate = moved.slopes, self._surface.tolerances.rate
        slopes[:, _GAIN] = healthy_deg
        slopes[:, _DELAY] = -np.nan_to_num(steps_deg / steps_s)
        slopes[:, _BANDWIDTH] = (quick_deg - slow_deg) / (2.0 * _CHANGE)
        slopes[:, _RATE] = (healthy_deg - weak_deg) / rate if rate > 0.0 else 0.0
        return moved._replace(reading_deg=healthy_deg)

    def noise_deg(self, moved: Moved, measured_deg: FloatArray) -> FloatArray:
        """Standard deviation of the noise of the positions (m,) [deg], as the flight has shown it until then."""
        out = np.empty(measured_deg.size)
        error_deg, anew = measured_deg - moved.reading_deg, np.isfinite(moved.start_deg)
        _follow_noise(error_deg, measured_deg, anew, self._surface.tolerances.noise_deg, self._seen, out)
        return out

    def shown(
        self,
        moved: Moved,
        measured_deg: FloatArray,
        judged: BoolArray,
        tested: Tested,  # noqa: ARG002 - the filter has a sigma of its own
        noise_deg: FloatArray,
    ) -> Shown:
        """The residual of the nullspace filter and its threshold, and by how much it passes that so often in a row."""
        time_s, reading_deg, surface = moved.time_s, moved.reading_deg, self._surface
        anew = np.isfinite(moved.start_deg).astype(np.int8)
        residual_deg, passed = measured_deg - reading_deg, np.zeros(time_s.size)
        others_deg = np.ascontiguousarray(moved.slopes[:, :FITTED].T)
        filter_in_place(self._filter, self._lags, time_s, residual_deg, anew, others_deg)
        sigma_deg = self.noise_gain * noise_deg
        if self.alone:  # and what a servo leaves at its rate limit, if that is lower by its tolerance
            level_deg = surface.threshold_deg + surface.tolerances.rate * np.abs(others_deg[_RATE])
            threshold = Threshold("constant", level_deg, sigma_deg, noise_deg)
        else:
            tolerated_deg = self._bounds @ np.abs(others_deg[_TOLERANCES])
            level_deg = surface.threshold_sigmas * sigma_deg + tolerated_deg
            threshold = Threshold("interval", level_deg, sigma_deg, noise_deg)
        many = surface.persistence if self.alone else max(surface.persistence, _IN_A_ROW)
        ratios = np.append(self._before, residual_deg[judged] / threshold.level_deg[judged])
        passed[judged] = in_a_row(ratios, many)[self._before.size :]
        self._before = ratios[ratios.size - min(many - 1, ratios.size) :]
        return Shown(Residuals(time_s, reading_deg, measured_deg, residual_deg, judged, anew), threshold, passed)


@compiled
def _follow_noise(
    error_deg: FloatArray, measured_deg: FloatArray, anew: BoolArray, tolerated_deg: float, kept: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Noise by the second differences of the simulation error, whatever moves slowly in it.

    The smallest believable noise is that of the position's resolution, which is the smallest change of it so far.
    """
    before, before_that, noise, seen, last_deg, resolution = kept[0], kept[1], kept[2], kept[3], kept[4], kept[5]
    for k in range(error_deg.size):
        if anew[k]:
            before = before_that = np.nan
        change = abs(measured_deg[k] - last_deg)
        if 0.0 < change < resolution:
            resolution = change
        last_deg = measured_deg[k]
        curvature = error_deg[k] - 2.0 * before + before_that
        if not np.isnan(curvature):
            seen += 1.0
            shown = min(abs(curvature) * CURVATURE_TO_SIGMA, _GLITCH * noise)
            noise += max(1.0 / (1.0 + seen / _FASTEST_SAMPLES), 1.0 / _NOISE_MEMORY) * (shown - noise)
            noise = max(noise, _SMALLEST_NOISE_DEG)
        before_that, before = before, error_deg[k]
        usual = noise if seen >= _NOISE_SAMPLES else max(noise, tolerated_deg)
        out[k] = max(usual, _RESOLUTION_TO_SIGMA * resolution) if resolution < np.inf else usual
    kept[0], kept[1], kept[2], kept[3], kept[4], kept[5] = before, before_that, noise, seen, last_deg, resolution


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """A named servo that is simulated with other parameters."""

    model: ServoModel
    context: Context
    theta: FloatArray
    """Parameters of the family that is most like it."""

    def __call__(
        self,
        record: Record,
        theta: FloatArray,
        rows: slice,
        start_deg: float,
        *,
        behind: bool = False,
        outages: tuple[Outage, ...] = (),
    ) -> FloatArray:
        """Where it is at some samples [deg] if its parameters differ by as much as these do, from a position on."""
        apart = dict(zip(NAMES, (theta - self.theta).tolist(), strict=True))
        usual = self.model.servo(self.context)
        physics = usual.physics
        rates = {name: float(np.exp(apart["ln_rate"])) * getattr(physics, name) for name in rate_fields()}
        gain = "gain" if behind else "command_gain"
        physics = physics._replace(
            **{gain: getattr(physics, gain) * theta[_GAIN] / self.theta[_GAIN]},
            bias_deg=physics.bias_deg + apart["bias_deg"],
            backlash_deg=physics.backlash_deg + apart["play_deg"],
            **rates,
        )
        if apart["friction_deg"]:
            physics = physics._replace(friction_deg=physics.friction_deg + apart["friction_deg"])
        servo = replace(usual, physics=physics).slower(float(np.exp(apart["ln_bandwidth"])))
        time_s, given = record.time_s[rows], record.commands
        span = slice(*np.searchsorted(given[0], (time_s[0] - _LEAD_S, time_s[-1] + _STEP_S)).tolist())
        command_s, command_deg, slope_deg_s = held((given[0][span], given[1][span], given[2][span]), outages)
        if apart["deadband_deg"] > 0.0 and command_deg.size:  # before the servo, whatever its order is
            rest_deg = (start_deg - physics.bias_deg) / (physics.gain * physics.command_gain)
            command_deg, slope_deg_s = play(command_deg, apart["deadband_deg"], rest_deg), 0.0 * slope_deg_s
        late = Commands(command_s, command_deg, slope_deg_s).later(self.model.delay_s + apart["delay_s"])
        starts_deg = np.append(start_deg, record.start_deg[rows][1:])
        return started_anew(servo, late, time_s, np.nan_to_num(starts_deg), np.isfinite(starts_deg))


def found_of(
    flight: Watched, surface: Surface, names: dict[float, Named] | None = None, *, asked: bool = False
) -> Found:
    """Faults and suspicions of a flight; `asked`: the user named the level, which alone counts then.

    Of a named servo sign and scale may be wrong, which good flights show to be right. Where a level is the only test of
    a fault, what the windows see beside it is suspect, if the model is known exactly enough to tell, and the user has
    not asked for that level alone.
    """
    found = judged(flight, names)
    if flight.alone and asked:
        held = tuple(replace(each, kind="unknown", probability=1.0 - each.probability) for each in found.suspicions)
        faults = sorted((*found.faults, *held), key=lambda fault: fault.alarm_s)
        found = found._replace(faults=tuple(faults), suspicions=())
    elif flight.alone and surface.tells_small_faults:
        silent = flight.shown._replace(passed=np.zeros(flight.reading_deg.size))
        below = judged(replace(flight, alone=False, shown=silent))
        known = (*found.faults, *found.suspicions)
        small = (each for each in (*below.faults, *below.suspicions) if not any(_meet(each, other) for other in known))
        suspicions = (*found.suspicions, *(replace(each, level="suspect") for each in small))
        found = found._replace(suspicions=tuple(sorted(suspicions, key=lambda fault: fault.alarm_s)))
    if flight.own is None or not (found.faults or found.suspicions):
        return found
    return found._replace(against=wiring_problem(flight.shown.residuals))


def _meet(one: Fault, other: Fault) -> bool:
    """Whether two faults overlap in time, or nearly."""
    ends_s = [np.inf if fault.end_s is None else fault.end_s + SAME_S for fault in (one, other)]
    return one.start_s <= ends_s[1] and other.start_s <= ends_s[0]


def in_a_row(values: FloatArray, many: int) -> FloatArray:
    """The least of so many values up to each, as far from 0 as all of them are on one side, shape (n,).

    Examples
    --------
    >>> in_a_row(np.array([2.0, 3.0, -1.0, -4.0]), 2)
    array([0., 2., 0., 1.])
    """
    out = np.zeros(values.size)
    if values.size >= many:
        rows = np.lib.stride_tricks.sliding_window_view(values, many)
        out[many - 1 :] = np.maximum(np.maximum(rows.min(axis=1), -rows.max(axis=1)), 0.0)
    return out

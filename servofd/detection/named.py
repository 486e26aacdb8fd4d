"""A surface whose servo is named: the library's servo, with its tolerances as the covariance of good ones.

It moves as its own model does, with all effects that this has, and the sensitivities to its gain, delay, bandwidth and
rate limit are those of that model; what a change of another parameter adds is that of the family
(`servofd.estimate.family`) about the servo that is most like it. The residual of the nullspace filter over its
threshold is the fast test (thesis Eq. 4.12); the windows of `servofd.detection.changes` see what is smaller and lasts.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.calibrated import CalibratedNoise, CalibratedServo, lower_triangle
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.aircraft.series import Series
from servofd.detection.changes import Memory, Tests, Watched, follow
from servofd.detection.faults import SAME_S, Found, judged
from servofd.detection.outages import Outage, held
from servofd.detection.residual import RESTART_ALL, Commands, commands_at_servo, followed
from servofd.detection.threshold import constant_threshold, interval_threshold
from servofd.estimate.family import new_state, sensitivities, simulated, variants
from servofd.estimate.fit import fit
from servofd.estimate.record import Record, loads
from servofd.servo.loops import play
from servofd.servo.physics import rate_fields

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft.schema import Surface
    from servofd.core.tolerance import Tolerance
    from servofd.core.types import FloatArray
    from servofd.detection.faults import Named
    from servofd.detection.residual import ResidualGenerator, Residuals
    from servofd.detection.threshold import Threshold
    from servofd.detection.verdict import Fault
    from servofd.servo.motion import AnyServo
    from servofd.servo.servo_model import ServoModel

_CHIRP_S, _STEP_S, _CHIRP_DEG, _LAST_HZ = 10.0, 0.01, 10.0, 5.0
"""Command by which the servo of the family that is most like a model is found."""
_LEAD_S = 2.0
"""Commands so long before a stretch of a flight are in force when it begins."""
_ANYWHERE_DEG: Final = 1e4
"""Reach of a servo whose travel no flight has shown."""
_UNIFORM: Final = float(np.sqrt(3.0))
"""A uniform spread within a tolerance has its width over this as standard deviation."""
_LEAST: Final = 1e-3
"""Of the usual spread between flights: a covariance has an inverse."""
_CHANGE: Final = 0.02
"""Share by which the bandwidth and the rate limit are changed for their sensitivities."""
MISSED_DEG: Final = 0.02
"""What a model of the library misses of a servo within its tolerances: jitter of the stamps and commands that were put
back move a drawn servo so much otherwise (rms of chirps to 10 Hz, even seeds of `benchmarks/fleet.py`)."""
_GAIN, _DELAY, _BANDWIDTH, _RATE = (NAMES.index(name) for name in ("gain", "delay_s", "ln_bandwidth", "ln_rate"))


@lru_cache(maxsize=64)
def named_servo(model: ServoModel, tolerance: Tolerance, period_s: float) -> CalibratedServo:
    """The servo of the family that is most like a model, and what a good one may differ by.

    Examples
    --------
    >>> from servofd.core.tolerance import Tolerance
    >>> from servofd.servo.library import servo_named
    >>> from servofd.servo.servo_model import ServoModel
    >>> known = named_servo(ServoModel.of(servo_named("hs225bb-eq31")), Tolerance(), 0.02)
    >>> round(known.parameters["gain"], 1), round(float(known.covariance[0, 0] ** 0.5), 4)
    (1.0, 0.0173)
    """
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
        noise=CalibratedNoise(
            still_deg=max(tolerance.noise_deg, _LEAST), lag_s=0.0, colour=(0.0, 0.0), innovation=1.0, period_s=period_s
        ),
        reach_deg=(-_ANYWHERE_DEG, _ANYWHERE_DEG),
    )


def beside(servo: AnyServo, tolerance: Tolerance) -> tuple[AnyServo, ...]:
    """Servos whose motion beside a named one gives its sensitivities: quicker, slower, and the weakest tolerated."""
    return servo.slower(1.0 + _CHANGE), servo.slower(1.0 - _CHANGE), servo.weaker(tolerance.rate)


def own_slopes(
    slopes: FloatArray, time_s: FloatArray, moved_deg: Sequence[FloatArray], tolerance: Tolerance, last: FloatArray
) -> FloatArray:
    """Sensitivities (m, 15) with those of the named servo's own model: it and those of `beside` move so, (m,) each.

    `last` is when the sample before was [s], and where the servo was then [deg]; NaN before any, and carried on.
    """
    healthy_deg, quick_deg, slow_deg, weak_deg = moved_deg
    steps_s, steps_deg = np.diff(np.append(last[0], time_s)), np.diff(np.append(last[1], healthy_deg))
    own = slopes.copy()
    own[:, _GAIN] = healthy_deg
    own[:, _DELAY] = -np.nan_to_num(steps_deg / steps_s)
    own[:, _BANDWIDTH] = (quick_deg - slow_deg) / (2.0 * _CHANGE)
    own[:, _RATE] = (healthy_deg - weak_deg) / tolerance.rate if tolerance.rate > 0.0 else 0.0
    if time_s.size:
        last[:] = time_s[-1], healthy_deg[-1]
    return own


def tests_of_named(known: CalibratedServo, period_s: float) -> Tests:
    """What the windows need to know of a named servo."""
    return Tests.of(known.noise.noise, known.covariance, period_s, missed_deg=MISSED_DEG)


def noise_of_named(threshold: Threshold) -> FloatArray:
    """Standard deviation of the position's noise as the flight shows it, and of lost commands, shape (n,) [deg]."""
    return np.hypot(threshold.sigma_deg, threshold.saturated_deg / _UNIFORM) / threshold.noise_gain


def watched_named(
    generator: ResidualGenerator,
    surface: Surface,
    residuals: Residuals,
    threshold: Threshold,
    commands: Commands,
    period_s: float,
) -> Watched:
    """What the detector needs of a flight of a named servo; `commands` are those that reach the servo."""
    model = generator.model
    known = named_servo(model, surface.tolerances, period_s)
    time_s, restart = residuals.time_s, residuals.restart
    context = residuals.context
    measured_deg = residuals.measured_deg
    start_deg = np.where(restart == RESTART_ALL, measured_deg, np.nan)
    record = Record(
        commands.effective_s - model.delay_s,
        commands.command_deg,
        time_s,
        measured_deg,
        loads(context, time_s),
        np.ones(time_s.size),
        start_deg,
        residuals.settled & np.isfinite(residuals.residual_deg),
        period_s,
        slope_deg_s=commands.slope_deg_s,
    )
    table = variants(known.theta)
    position_deg, speed_deg_s = simulated(
        table, new_state(table.shape[0]), record.commands, time_s, record.load, record.power, start_deg
    )
    _, slopes = sensitivities(position_deg, speed_deg_s, known.theta, known.reach_deg)
    others = beside(model.servo(context), surface.tolerances)
    moved = [followed(servo, commands, time_s, measured_deg, restart) for servo in others]
    healthy_deg = residuals.simulated_deg
    slopes = own_slopes(slopes, time_s, (healthy_deg, *moved), surface.tolerances, np.full(2, np.nan))
    noise_deg, tests = noise_of_named(threshold), tests_of_named(known, period_s)
    error_deg = np.where(record.usable, residuals.error_deg, np.nan)
    tested = follow(tests, Memory(tests), time_s, error_deg, slopes, noise_deg)
    return Watched(
        known, known.noise.noise, record, healthy_deg, slopes, record.usable, noise_deg, tests, tested,
        own=_Own(model.servo(context), commands, time_s, start_deg, known.theta, model.delay_s),
        passed=over(residuals, threshold, surface.persistence),
        alone=surface.threshold == "constant",
    )  # fmt: skip


class _Own(NamedTuple):
    """The named servo in a flight, to be simulated with other parameters."""

    servo: AnyServo
    commands: Commands
    time_s: FloatArray
    start_deg: FloatArray
    """Where it begins anew [deg], as after a gap; NaN where it goes on."""
    theta: FloatArray
    """Parameters of the family that is most like it."""
    delay_s: float
    """By how much the commands are late."""

    def __call__(
        self,
        theta: FloatArray,
        rows: slice,
        start_deg: float,
        *,
        behind: bool = False,
        outages: tuple[Outage, ...] = (),
    ) -> FloatArray:
        """Where it is at some samples [deg] if its parameters differ by as much as these do, from a position on."""
        apart = dict(zip(NAMES, (theta - self.theta).tolist(), strict=True))
        physics = self.servo.physics
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
        servo = replace(self.servo, physics=physics).slower(float(np.exp(apart["ln_bandwidth"])))
        time_s = self.time_s[rows]
        span = slice(*np.searchsorted(self.commands.effective_s, (time_s[0] - _LEAD_S, time_s[-1] + _STEP_S)).tolist())
        each = self.commands.effective_s[span], self.commands.command_deg[span], self.commands.slope_deg_s[span]
        late = tuple(Outage(from_s + self.delay_s, to_s + self.delay_s) for from_s, to_s in outages)
        effective_s, command_deg, slope_deg_s = held(each, late)
        if apart["deadband_deg"] > 0.0 and command_deg.size:  # before the servo, whatever its order is
            rest_deg = (start_deg - physics.bias_deg) / (physics.gain * physics.command_gain)
            command_deg, slope_deg_s = play(command_deg, apart["deadband_deg"], rest_deg), 0.0 * slope_deg_s
        near = Commands(effective_s + apart["delay_s"], command_deg, slope_deg_s)
        starts_deg = np.append(start_deg, self.start_deg[rows][1:])
        anew = np.where(np.isfinite(starts_deg), RESTART_ALL, 0).astype(np.int8)
        return followed(servo, near, time_s, np.nan_to_num(starts_deg), anew)


class Judgement(NamedTuple):
    """What was found of a named servo, and against which threshold."""

    threshold: Threshold
    flight: Watched
    found: Found

    @property
    def faults(self) -> tuple[Fault, ...]:
        """What was found."""
        return self.found.faults

    @property
    def suspicions(self) -> tuple[Fault, ...]:
        """What is suspect."""
        return self.found.suspicions


def judge(
    generator: ResidualGenerator, segment: Series, residuals: Residuals, surface: Surface, *, asked: bool = False
) -> Judgement:
    """Judge a segment whose residuals are known; `asked`: the user named the constant level, which alone counts then.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> from servofd.detection.residual import ResidualGenerator
    >>> aircraft = plain_aircraft(["rudder"], "hs225bb-eq31")
    >>> model, time_s = aircraft.model("rudder"), np.arange(0.0, 20.0, 0.02)
    >>> command_deg = 10.0 * np.sin(2.0 * time_s)
    >>> jammed_deg = np.where(time_s < 12.0, model.simulate(time_s, command_deg, time_s), 5.0)
    >>> segment = Series("rudder", time_s, command_deg, time_s, jammed_deg)
    >>> generator = ResidualGenerator.fitting(model, segment)
    >>> judgement = judge(generator, segment, generator.run(segment), aircraft.surfaces["rudder"])
    >>> [(fault.kind, round(fault.start_s, 1)) for fault in judgement.faults]
    [('stuck', 12.0)]
    """
    threshold = interval_threshold(generator, segment, residuals, surface.tolerances, surface.threshold_sigmas)
    if surface.threshold == "constant":
        threshold = constant_threshold(threshold, surface.threshold_deg)
    commands = commands_at_servo(segment, generator.model.delay_s, generator.longest_gap_s(segment))
    flight = watched_named(generator, surface, residuals, threshold, commands, segment.period_s)
    found = judged_named(flight, tells=surface.tells_small_faults, asked=asked)
    return Judgement(threshold, flight, found)


def judged_named(flight: Watched, *, tells: bool, asked: bool, names: dict[float, Named] | None = None) -> Found:
    """Faults and suspicions of a named servo.

    Where a constant level is the only test of a fault, what the windows see beside it is suspect, if the model is known
    exactly enough to tell, and the user has not asked for that level alone.
    """
    found = judged(flight, names)
    if not flight.alone:
        return found
    if asked:
        held = tuple(replace(each, kind="unknown", probability=1.0 - each.probability) for each in found.suspicions)
        faults = sorted((*found.faults, *held), key=lambda fault: fault.alarm_s)
        return found._replace(faults=tuple(faults), suspicions=())
    if not tells:
        return found
    below = judged(replace(flight, alone=False, passed=np.zeros(flight.reading_deg.size)))
    known = (*found.faults, *found.suspicions)
    small = (each for each in (*below.faults, *below.suspicions) if not any(_meet(each, other) for other in known))
    suspicions = (*found.suspicions, *(replace(each, level="suspect") for each in small))
    return found._replace(suspicions=tuple(sorted(suspicions, key=lambda fault: fault.alarm_s)))


def _meet(one: Fault, other: Fault) -> bool:
    """Whether two faults overlap in time, or nearly."""
    ends_s = [np.inf if fault.end_s is None else fault.end_s + SAME_S for fault in (one, other)]
    return one.start_s <= ends_s[1] and other.start_s <= ends_s[0]


def over(residuals: Residuals, threshold: Threshold, persistence: int) -> FloatArray:
    """The residual over its threshold, the least of so many in a row on one side, (n,); 0 where none is judged."""
    judged = residuals.settled
    out = np.zeros(judged.size)
    out[judged] = in_a_row(residuals.residual_deg[judged] / threshold.level_deg[judged], persistence)
    return out


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

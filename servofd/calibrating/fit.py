"""Fit of scale, offset and servo to known-good flights, by output error on true time stamps."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.calibrating.flights import busiest
from servofd.calibrating.motion import Motion, line, noise_of
from servofd.calibrating.robust import descended, deviations, mean_loss, ordinary_deg
from servofd.detection.bank.explanation import Estimate
from servofd.errors import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.calibrating.flights import Flight
    from servofd.calibrating.servo import FlownServo
    from servofd.tolerance import Tolerance
    from servofd.types import FloatArray

__all__ = ["ServoFit", "fit_servo"]

_COARSE_SAMPLES, _FINE_SAMPLES, _FEWEST_SAMPLES = 5_000, 30_000, 2_000
_SCALES = (0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
_DAMPINGS = (0.6, 0.9, 1.6)
_DELAYS_S = (0.0, 0.01, 0.02, 0.04, 0.07, 0.11)
_RATE_SHARES = (0.8, 0.5, 0.25, 0.12)
_USUAL_GAIN = 0.3
"""Deviation of the logarithm of the gain before calibration: weak, but it decides where the motion does not."""
_STARTS = 2
_WORTH_A_LIMIT = 0.97
_STEP = 1e-4
_EVALUATIONS = 40
_FOLLOWS = 0.5
"""Largest error while the surface should be away from rest, over how far: medians, half the time may be faulty."""
_AWAY = 0.25
_PROVED = 12.0
"""Twice the gain in log-likelihood that a number must bring over that of the file: 3.5 standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class ServoFit:
    """A servo as some flights show it."""

    servo: FlownServo
    gain: Estimate
    """Position per degree of the command, in the units of the aircraft file before."""
    offset_deg: Estimate
    numbers: Mapping[str, Estimate]
    """What was fitted, of `servofd.calibrating.servo.NUMBERS`."""
    kept: Mapping[str, str]
    """What was not, and why."""
    noise_deg: float
    """Standard deviation of the position measurement [deg of the command]."""
    error_rms_deg: float
    """Of measured minus simulated deflection [deg of the command]."""


def fit_servo(flights: Sequence[Flight], prior: FlownServo, tolerance: Tolerance) -> ServoFit:
    """Fit scale, offset, bandwidth, delay, and what else the flights excite.

    Least squares of measured minus simulated position, errors beyond the ordinary counted less. A number whose 95 %
    interval is wider than the tolerance that the aircraft file has for it, and which does not contradict the file, is
    kept as it was: then the flight knows less about it than the file.

    Parameters
    ----------
    flights : sequence of Flight
        Of one surface, at least one.
    prior : FlownServo
        Servo of the aircraft file; it may be far off.
    tolerance : Tolerance
        How sure the aircraft file is of it.

    Returns
    -------
    ServoFit
        The best of several starting points.

    Raises
    ------
    CalibrationError
        If the position does not follow the command, or leads it.

    Examples
    --------
    >>> from servofd.calibrating.flights import Flight
    >>> from servofd.calibrating.servo import FlownServo
    >>> from servofd.segment import Segment
    >>> from servofd.servos import servo_named
    >>> from servofd.simulation.commands import flight
    >>> from servofd.tolerance import Tolerance
    >>> t = np.arange(3000) / 100.0
    >>> command_deg = flight(t, np.random.default_rng(0))
    >>> prior = FlownServo.of(servo_named("s9256"))
    >>> truth = replace(prior, delay_s=0.017)
    >>> measured_deg = 0.9 * truth.model.simulate(t, command_deg, t) - 2.0
    >>> fit = fit_servo([Flight("good", Segment("x", t, command_deg, t, measured_deg))], prior, Tolerance())
    >>> round(fit.servo.delay_s, 4), round(fit.gain.value, 3), round(fit.offset_deg.value, 3)
    (0.017, 0.9, -2.0)
    """
    few = _motion(flights, prior, _COARSE_SAMPLES)
    starts = _coarse(few, prior)
    gain, offset_deg, _ = line(few.simulated_deg(starts[0]), few.measured_deg)
    _check_follows(few, starts[0], (gain, offset_deg))
    # In degrees of the command from here on, so that a start begins where the servo is.
    scaled = [flight.with_scale(gain, offset_deg) for flight in flights]
    motion, few = (
        replace(_motion(scaled, prior, n), usual_gain=1.0 / abs(gain)) for n in (_FINE_SAMPLES, _COARSE_SAMPLES)
    )
    best = min((_descended(few, start, start.numbers) for start in _with_limits(few, starts)), key=_cost)
    fit, kept = _settled(motion, best.servo, prior, tolerance)
    return _reported(motion, fit, kept, (gain, offset_deg))


def _motion(flights: Sequence[Flight], prior: FlownServo, most_samples: int) -> Motion:
    """The busiest parts of all flights, of about so many samples in all."""
    share = max(_FEWEST_SAMPLES, most_samples // len(flights))
    return Motion.of([piece for flight in flights for piece in busiest(flight, share)], prior)


@dataclass(frozen=True, slots=True, eq=False)
class _Descent:
    """Outcome of one descent."""

    servo: FlownServo
    names: tuple[str, ...]
    line: tuple[float, float]
    cost: float
    """Mean of the robust cost, in units that are the same for all descents on the same motion."""
    deviation: FloatArray
    """Standard deviations of the fitted numbers, then of gain and offset."""
    error_deg: FloatArray


def _cost(descent: _Descent) -> float:
    return descent.cost


def _coarse(motion: Motion, prior: FlownServo) -> list[FlownServo]:
    """Servos from a wide grid under which the position comes closest to a line through the simulation."""
    dampings = _DAMPINGS if prior.damping is not None else (None,)
    delays_s = sorted({*_DELAYS_S, prior.delay_s})
    grid = [
        replace(prior, bandwidth_hz=scale * prior.bandwidth_hz, damping=damping, delay_s=delay_s)
        for scale, damping, delay_s in itertools.product(_SCALES, dampings, delays_s)
    ]
    measured_deg = motion.measured_deg
    left = [_misfit_deg(*line(motion.simulated_deg(servo), measured_deg)) for servo in grid]
    return [grid[k] for k in np.argsort(left)[:_STARTS]]


def _misfit_deg(gain: float, _offset_deg: float, left_deg: float) -> float:
    """Misfit left over, more so for a gain far from one: a slow servo with a large gain looks much like a quick one."""
    return left_deg * (1.0 + float(np.log(max(abs(gain), 1e-6)) / _USUAL_GAIN) ** 2)


def _check_follows(motion: Motion, servo: FlownServo, line_: tuple[float, float]) -> None:
    """Refuse a position that has nothing to do with its command."""
    gain, offset_deg = line_
    simulated_deg = gain * motion.simulated_deg(servo)
    from_rest_deg = np.abs(simulated_deg - np.median(simulated_deg))
    away = from_rest_deg >= _AWAY * float(np.percentile(from_rest_deg, 99.0))
    error_deg = float(np.median(np.abs(motion.measured_deg - simulated_deg - offset_deg)[away]))
    if not error_deg < _FOLLOWS * float(np.median(from_rest_deg[away])):
        surface = motion.rehearsals[0].segment.surface
        raise CalibrationError(
            f"{surface}: the position does not follow the command: a surface that was stuck "
            "or floating all the time, channels that do not belong together, or too little motion"
        )


def _with_limits(motion: Motion, starts: list[FlownServo]) -> list[FlownServo]:
    """The same starting points, and the first with rate limits that this motion would run into."""
    speed_deg_s = motion.top_speed_deg_s(starts[0])
    limited = [replace(starts[0], rate_limit_deg_s=share * speed_deg_s) for share in _RATE_SHARES if speed_deg_s > 0.0]
    return [*starts, *limited]


def _settled(
    motion: Motion, start: FlownServo, prior: FlownServo, tolerance: Tolerance
) -> tuple[_Descent, dict[str, str]]:
    """Fit again and again without the number that these flights know least about, until they know all."""
    known = {
        "bandwidth_hz": tolerance.bandwidth,
        "damping": 3.0 * tolerance.bandwidth,
        "delay_s": 1e3 * tolerance.delay_s,
        "rate_limit_deg_s": tolerance.rate,
    }
    servo, kept = start, {}
    names = servo.numbers
    if servo.rate_limit_deg_s is not None:
        top_deg_s = motion.top_speed_deg_s(servo)
        others = tuple(name for name in names if name != "rate_limit_deg_s")
        plain = _descended(motion, replace(servo, rate_limit_deg_s=prior.rate_limit_deg_s), others)
        if _evidence(motion, plain, _descended(motion, servo, names)) < _PROVED:
            servo, names = plain.servo, others
            kept["rate_limit_deg_s"] = f"not reached, or hardly: no faster than {top_deg_s:.0f} deg/s in these flights"
            unlimited = _descended(motion, replace(servo, rate_limit_deg_s=None), others)
            if _evidence(motion, plain, unlimited) >= _PROVED:
                servo = unlimited.servo
                kept["rate_limit_deg_s"] = (
                    f"none: up to {top_deg_s:.0f} deg/s these flights contradict that of the file"
                )
    fit = _descended(motion, servo, names)
    for name in sorted(names, key=lambda name: _width(fit, name) / known[name], reverse=True):
        if _width(fit, name) <= known[name] or getattr(prior, name) is None:
            continue
        rest = tuple(other for other in fit.names if other != name)
        without = _descended(motion, replace(fit.servo, **{name: getattr(prior, name)}), rest)
        if _evidence(motion, without, fit) < _PROVED:
            fit = without
            kept[name] = "these flights tell less about it than the aircraft file"
    return fit, kept


def _width(fit: _Descent, name: str) -> float:
    """Half the 95 % interval of a fitted number, in the units of `FlownServo.vector`."""
    return 1.96 * float(fit.deviation[fit.names.index(name)])


def _evidence(motion: Motion, plain: _Descent, richer: _Descent) -> float:
    """Twice the gain in log-likelihood of one fit over another, the memory of the errors taken into account."""
    scale_deg = ordinary_deg(float(np.median(np.abs(richer.error_deg)))) + 1e-9
    losses = [mean_loss(one.error_deg, scale_deg) for one in (plain, richer)]
    samples = richer.error_deg.size / motion.memory(richer.error_deg)
    return samples * float(np.log(max(losses[0], 1e-300) / max(losses[1], 1e-300)))


def _descended(motion: Motion, start: FlownServo, names: tuple[str, ...]) -> _Descent:
    """Downhill from one starting point, scale and offset along with the servo's numbers."""
    measured_deg, size = motion.measured_deg, len(names)
    simulated_deg = motion.simulated_deg(start)
    gain, offset_deg, left_deg = line(simulated_deg, measured_deg)
    scale_deg = ordinary_deg(max(left_deg, 1e-6))

    def simulated(x: FloatArray) -> FloatArray:
        return motion.simulated_deg(start.with_vector(names, x[:size]))

    # The prior of the gain as one more row, which counts as one independent sample.
    weight_deg = scale_deg * np.sqrt(motion.memory(measured_deg - gain * simulated_deg - offset_deg)) / _USUAL_GAIN
    usual = motion.usual_gain * np.sign(gain)

    def error(x: FloatArray) -> FloatArray:
        return np.append(measured_deg - x[size] * simulated(x) - x[size + 1], weight_deg * (x[size] / usual - 1.0))

    def slopes(x: FloatArray) -> FloatArray:
        here = simulated(x)
        shape = [x[size] * (here - simulated(x + _STEP * unit)) / _STEP for unit in np.eye(x.size)[:size]]
        rows = np.column_stack([*shape, -here, -np.ones(here.size)])
        last = np.zeros(x.size)
        last[size] = weight_deg / usual
        return np.vstack([rows, last])

    begin = np.array([*start.vector(names), gain, offset_deg])
    delay_at = names.index("delay_s") if "delay_s" in names else None
    found = descended(error, slopes, begin, scale_deg, delay_at=delay_at, evaluations=_EVALUATIONS)
    left = error(found)[:-1]
    deviation = deviations(slopes(found)[:-1], left, motion.memory(left))
    share = max(float(np.ptp(measured_deg)) * 0.02, 1e-9)
    cost = mean_loss(left, share * max(abs(float(found[size])), 1e-6))
    servo = start.with_vector(names, found[:size])
    return _Descent(servo, names, (float(found[size]), float(found[size + 1])), cost, deviation, left)


def _reported(motion: Motion, fit: _Descent, kept: dict[str, str], first: tuple[float, float]) -> ServoFit:
    """The fit in words of the aircraft file: numbers with intervals."""
    names, size = fit.names, len(fit.names)
    gain, offset_deg = fit.line
    numbers = {}
    for name, mine, deviation in zip(names, fit.servo.vector(names).tolist(), fit.deviation[:size], strict=True):
        ends = Estimate.of(mine, float(deviation))
        numbers[name] = (
            Estimate(*(max(1e-3 * end, 0.0) for end in ends))
            if name == "delay_s"
            else Estimate(*np.exp(np.clip(ends, -50.0, 50.0)).tolist())
        )
    total = Estimate.of(first[0] * gain, abs(first[0]) * float(fit.deviation[size]))
    offset = Estimate.of(first[0] * offset_deg + first[1], abs(first[0]) * float(fit.deviation[size + 1]))
    error_deg = fit.error_deg / gain
    return ServoFit(
        fit.servo,
        total,
        offset,
        numbers,
        kept,
        noise_of(motion.measured_deg / gain, error_deg),
        float(np.sqrt(np.mean(error_deg**2))),
    )

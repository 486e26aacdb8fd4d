"""Fit of a servo to its motion: simulate, compare, correct, on true time stamps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import DesignError
from servofd.estimate.statistics import Estimate, descended, memory
from servofd.identification.shape import LARGEST_LOG_GAIN, LONGEST_DELAY_S, LinearServo, shape_bounds
from servofd.servo.effects import Delay, Effect, LinearDynamics, RateLimit
from servofd.servo.play import play
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.identification.records import Run

_OUT_OF_REACH_DEG = 1e4
_DEVIATION_LAGS = 20
_SMALLEST_SHARE, _SMALLEST = 1e-12, 1e-100
"""Singular values below are as good as zero; the second keeps the inverse within the range of numbers."""
_WHITE = 1.6
"""Von Neumann's ratio above which the errors are as good as noise (2 for white noise)."""
_PARTS, _COMMON = 8, 3.5
"""Parts of the tests, whose disagreement shows what is not in the model (in a chirp each holds other frequencies), and
by how much their scatter is enlarged for what they have in common, which none shows: a dead zone of 1 deg within the
loop, which the model has before it, shifts the bandwidth by 2.4 to 6.7 standard deviations of the scatter (chirps of
4 deg, five servos), a limit of 120 deg/s by 2.3 and 5.2 (two). Chosen so that 95 % intervals hold these; not a law."""
_SLOWEST_DEG_S, _FASTEST_DEG_S = 1.0, 5000.0
"""Rate limits of servos; the fastest of the library, an S9256, has 1263 deg/s."""
_SMOOTH_STEP, _KINKED_STEP = 1e-6, 2e-3
"""Of derivatives, in the units of `ServoCandidate.vector`; rate limits and dead bands leave kinks in the motion."""


@dataclass(frozen=True, slots=True)
class ServoCandidate:
    """A servo with everything that a bench test can show.

    Parameters
    ----------
    linear : LinearServo
        Delay, dc gain, poles.
    rate_up_deg_s, rate_down_deg_s : float or None
        Rate limits [deg/s].
    dead_band_deg : float or None
        Full width of the zone in which the command may move without effect [deg].
    fixed_gain : bool
        True if the dc gain is known, and not fitted.
    """

    linear: LinearServo
    rate_up_deg_s: float | None = None
    rate_down_deg_s: float | None = None
    dead_band_deg: float | None = None
    fixed_gain: bool = False

    @property
    def model(self) -> ServoModel:
        """Model without the dead band."""
        effects: list[Effect] = [Delay(self.linear.delay_s), LinearDynamics(self.linear.transfer)]
        if self.rate_up_deg_s is not None:
            effects.append(RateLimit(self.rate_up_deg_s, self.rate_down_deg_s))
        return ServoModel(tuple(effects))

    def simulate(self, run: Run) -> FloatArray:
        """Position in a run [deg], shape (m,), without the offset of the measurement."""
        command_deg = run.command_deg
        if self.dead_band_deg is not None:
            command_deg = play(command_deg, self.dead_band_deg, float(command_deg[0]))
        return self.model.simulate(run.command_s, command_deg, run.measured_s)

    def vector(self) -> FloatArray:
        """Numbers to fit: logarithms of what must stay positive, milliseconds, degrees."""
        linear = self.linear
        numbers = [*linear.shape, 1e3 * linear.delay_s]
        numbers += [] if self.fixed_gain else [np.log(abs(linear.gain))]
        numbers += [np.log(r) for r in (self.rate_up_deg_s, self.rate_down_deg_s) if r is not None]
        return np.array(numbers + ([self.dead_band_deg] if self.dead_band_deg is not None else []))

    def with_vector(self, x: FloatArray) -> ServoCandidate:
        """The same kind of servo with other numbers."""
        n, gain = self.linear.order, self.linear.gain
        rest = [float(v) for v in x[n + 1 :]]
        if not self.fixed_gain:
            gain = float(np.sign(gain) * np.exp(rest.pop(0)))
        linear = LinearServo(tuple(float(v) for v in x[:n]), 1e-3 * float(x[n]), gain)
        up, down = self.rate_up_deg_s, self.rate_down_deg_s
        return replace(
            self,
            linear=linear,
            rate_up_deg_s=None if up is None else float(np.exp(rest.pop(0))),
            rate_down_deg_s=None if down is None else float(np.exp(rest.pop(0))),
            dead_band_deg=None if self.dead_band_deg is None else rest[0],
        )


@dataclass(frozen=True, slots=True, eq=False)
class MotionFit:
    """A servo fitted to its motion."""

    servo: ServoCandidate
    offsets_deg: FloatArray
    """Of the measurement, one for each servo, shape (servos,)."""
    errors_deg: tuple[FloatArray, ...]
    """Measured minus simulated position of each run [deg]."""
    covariance: FloatArray
    """Of `servo.vector()`."""

    @property
    def rms_deg(self) -> float:
        """Root mean square of all errors [deg]."""
        return float(np.sqrt(np.mean(np.concatenate(self.errors_deg) ** 2)))

    @property
    def bic(self) -> float:
        """Bayesian information criterion: a further parameter must pay for itself."""
        count = int(np.concatenate(self.errors_deg).size)
        parameters = int(self.covariance.shape[0] + self.offsets_deg.size)
        return 2.0 * count * float(np.log(max(self.rms_deg, 1e-12))) + parameters * float(np.log(count))

    @property
    def whiteness(self) -> float:
        """Von Neumann's ratio: 2 for errors without memory, near 0 where the servo does what the model does not."""
        return _von_neumann(self.errors_deg)

    @property
    def is_white(self) -> bool:
        """True if what the model leaves is as good as noise."""
        return self.whiteness > _WHITE

    def interval(self, quantity: Callable[[ServoCandidate], float]) -> Estimate:
        """95 % interval of anything that follows from the servo, from the linear part of its dependence.

        Examples
        --------
        >>> servo = ServoCandidate(LinearServo((3.4,), 0.004))
        >>> fit = MotionFit(servo, np.zeros(1), (np.ones(3),), np.diag([0.0, 1e-4, 0.0]))
        >>> fit.interval(lambda servo: servo.linear.delay_s).high.__round__(7)
        0.0040196
        """
        x = self.servo.vector()
        value = quantity(self.servo)
        scales = np.sqrt(np.diag(self.covariance))
        gradient = np.zeros(x.size)
        for k in range(x.size):
            step = np.zeros(x.size)
            step[k] = min(1e-2 * scales[k], 1e-3) or 1e-9
            gradient[k] = (quantity(self.servo.with_vector(x + step)) - quantity(self.servo.with_vector(x - step))) / (
                2.0 * step[k]
            )
        variance = float(gradient @ self.covariance @ gradient)
        return Estimate.of(value, float(np.sqrt(max(variance, 0.0))))


def fit_motion(runs: Sequence[Run], start: ServoCandidate, *, evaluations: int = 30) -> MotionFit:
    """Fit a servo to all runs at once: least squares of measured minus simulated position.

    The mean error of each servo is its offset. The covariance takes the memory of the errors into account, so that
    intervals stay honest where the model is not the whole truth.

    Parameters
    ----------
    start : ServoCandidate
        Where to begin; what is None in it is not fitted.
    evaluations : int
        Most simulations for the descent, those of derivatives not counted.

    Examples
    --------
    >>> from servofd.identification.records import prepared
    >>> from servofd.aircraft.segment import Segment
    >>> t = np.arange(500) / 100.0
    >>> truth = ServoCandidate(LinearServo((3.4,), 0.004))
    >>> command = np.sign(np.sin(3.0 * t**2))
    >>> measured = truth.simulate(prepared(Segment("x", t, command, t, 0.0 * t)))
    >>> fit = fit_motion([prepared(Segment("x", t, command, t, measured))], ServoCandidate(LinearServo((3.0,), 0.01)))
    >>> round(1e3 * fit.servo.linear.delay_s, 4)
    4.0
    """
    lower, upper = _bounds(runs, start)
    kinked = start.dead_band_deg is not None or start.rate_up_deg_s is not None
    step = _KINKED_STEP if kinked else _SMOOTH_STEP

    def errors(x: FloatArray) -> tuple[tuple[FloatArray, ...], FloatArray]:
        return evaluated(runs, start.with_vector(x))

    def joined(x: FloatArray) -> FloatArray:
        return np.concatenate(errors(x)[0])

    def slopes(x: FloatArray) -> FloatArray:
        here = joined(x)
        return np.column_stack([(joined(x + step * unit) - here) / step for unit in np.eye(x.size)])

    begin = np.clip(start.vector(), lower + 1e-3, upper - 1e-3)
    found, jacobian = descended(joined, slopes, begin, (lower, upper), evaluations=evaluations)
    parts, offsets_deg = errors(found)
    return MotionFit(start.with_vector(found), offsets_deg, parts, _covariance(jacobian, parts))


def _bounds(runs: Sequence[Run], start: ServoCandidate) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest `ServoCandidate.vector` that a servo in these tests can have."""
    sample_time_s = min(float(np.median(np.diff(run.measured_s))) for run in runs)
    slowest, fastest = shape_bounds(start.linear.order, sample_time_s)
    lower, upper = [*slowest, 0.0], [*fastest, 1e3 * LONGEST_DELAY_S]
    if not start.fixed_gain:
        lower, upper = [*lower, -LARGEST_LOG_GAIN], [*upper, LARGEST_LOG_GAIN]
    for _ in [rate for rate in (start.rate_up_deg_s, start.rate_down_deg_s) if rate is not None]:
        lower, upper = [*lower, np.log(_SLOWEST_DEG_S)], [*upper, np.log(_FASTEST_DEG_S)]
    if start.dead_band_deg is not None:
        lower, upper = [*lower, 0.0], [*upper, max(run.span_deg for run in runs)]
    return np.array(lower), np.array(upper)


def evaluated(runs: Sequence[Run], servo: ServoCandidate) -> tuple[tuple[FloatArray, ...], FloatArray]:
    """Errors of all runs, and the offset of each servo that was taken out of them [deg]."""
    try:
        errors = [run.measured_deg - servo.simulate(run) for run in runs]
    except DesignError:
        errors = [np.full(run.measured_deg.size, _OUT_OF_REACH_DEG) for run in runs]
        return tuple(errors), np.zeros(max(run.servo for run in runs) + 1)
    offsets = np.array(
        [
            np.concatenate([e for e, run in zip(errors, runs, strict=True) if run.servo == servo_]).mean()
            for servo_ in range(max(run.servo for run in runs) + 1)
        ]
    )
    return tuple(e - offsets[run.servo] for e, run in zip(errors, runs, strict=True)), offsets


def _covariance(jacobian: FloatArray, errors: Sequence[FloatArray]) -> FloatArray:
    """Of the parameters; larger by the memory of the errors, if they have any.

    Errors with a memory also come from what is not in the model, which no average makes smaller: then what each of
    `_PARTS` parts of the tests alone would change in the parameters counts in full, and for what they have in common.
    """
    every = np.concatenate(errors)
    variance = float(every @ every) / max(every.size - jacobian.shape[1] - 1, 1)
    # A pseudo-inverse that knows no small singular values: what is not identifiable must come out as wide.
    _, sizes, right = np.linalg.svd(jacobian, full_matrices=False)
    sizes = np.maximum(sizes, max(_SMALLEST_SHARE * sizes[0], _SMALLEST))
    inverse = (right.T / sizes) @ (right / sizes[:, np.newaxis])
    covariance: FloatArray = inverse * variance * memory(errors, _DEVIATION_LAGS)
    if _von_neumann(errors) > _WHITE:
        return covariance
    pulls = np.array([part.sum(axis=0) for part in np.array_split(jacobian * every[:, np.newaxis], _PARTS)])
    disagreement: FloatArray = _COMMON**2 * _PARTS * inverse @ (pulls.T @ pulls) @ inverse
    return covariance + disagreement


def _von_neumann(errors: Sequence[FloatArray]) -> float:
    long = [error for error in errors if error.size > 2]
    return float(sum(np.sum(np.diff(e) ** 2) for e in long) / max(sum(np.sum(e**2) for e in long), 1e-300))

"""Shape of an all-pole servo, in parameters that cannot go wrong, and its exact response to held commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from logparsers.units import MS_PER_S, S_PER_MS
from servofd.core.errors import DesignError, IdentificationError
from servofd.core.fitting import Noise, Problem, Solution, fit
from servofd.core.series import rms
from servofd.core.statistics import LEAST_DIVISOR, Estimate, correlation_factor
from servofd.core.types import ComplexArray, FloatArray
from servofd.identification.records import Run
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.loops import play
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction

LARGEST_LOG = 14.0
"""Logarithm: dc gains, whatever their units, poles and bandwidths are within 1e-6 and 1e6."""
LONGEST_DELAY_S = 0.2
"""Of a servo with its link: the slowest that was measured needs 0.06 s."""
_SLOWEST_RAD_S, _NYQUIST_FREQUENCIES = 0.01, 20.0
"""Poles that a test can show: a slower one does not move within it, a faster one has come to rest before the next
sample (the fastest of thesis Fig. 3.10, 5074 rad/s, is 16 times the Nyquist frequency of its 100 Hz)."""


@dataclass(frozen=True, slots=True)
class LinearServo:
    r"""Servo :math:`g\,a_0 e^{-\tau s} / (s^n + \dots + a_0)`, driven through a zero-order hold.

    `shape`: logarithms: of the pole p (order 1), of wn² and 2 zeta wn of a second-order factor (order 2), of all three
    (order 3). Every value is a stable servo; a real pair of poles needs no other form than a complex one. `delay_s`:
    transport delay without the hold [s]. `gain`: dc gain [deg/deg]; negative if the position runs against the command.
    """

    shape: tuple[float, ...]
    delay_s: float
    gain: float = 1.0

    @classmethod
    def of(cls, transfer: TransferFunction, delay_s: float) -> LinearServo:
        """From a transfer function without zeros, of order 1 to 3."""
        denominator = np.array(transfer.denominator) / transfer.denominator[0]
        order = denominator.size - 1
        if order == 3:
            real = float(min(transfer.poles_rad_s, key=lambda p: (abs(p.imag), abs(p))).real)
            (_, a1, a0), _ = np.polydiv(denominator, [1.0, -real])
            shape = (np.log(-real), np.log(a0), np.log(a1))
        else:
            shape = tuple(np.log(denominator[:0:-1]))
        return cls(tuple(float(value) for value in shape), delay_s, transfer.dc_gain)

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.shape)

    @property
    def transfer(self) -> TransferFunction:
        """Linear dynamics with the dc gain, without the delay."""
        values = np.exp(np.clip(self.shape, -LARGEST_LOG, 2.0 * LARGEST_LOG))
        if self.order == 1:
            denominator = np.array([1.0, values[0]])
        elif self.order == 2:
            denominator = np.array([1.0, values[1], values[0]])
        else:
            denominator = np.convolve([1.0, values[0]], [1.0, values[2], values[1]])
        return TransferFunction((self.gain * float(denominator[-1]),), tuple(denominator.tolist()))

    @property
    def poles_rad_s(self) -> ComplexArray:
        """Poles [rad/s], shape (order,)."""
        return self.transfer.poles_rad_s

    @property
    def lag_s(self) -> float:
        """Delay and a1/a0 together: how late a slow ramp is followed [s]; known even where its parts are not."""
        denominator = self.transfer.denominator
        return self.delay_s + denominator[-2] / denominator[-1]

    def sampled_response(self, frequency_rad_s: FloatArray, sample_time_s: float) -> ComplexArray:
        """Exact response of sampled position to sampled, held command."""
        b, a = self.transfer.sampled(self.delay_s, sample_time_s)
        inverse = np.exp(-1j * frequency_rad_s * sample_time_s)
        return np.asarray(np.polyval(b[::-1], inverse) / np.polyval(a[::-1], inverse))


_OUT_OF_REACH_DEG = 1e4
"""Error of a servo that cannot be simulated [deg]."""
_DEVIATION_LAGS = 20
"""Lags over which errors are correlated at most."""
_WHITE = 1.6
"""Von Neumann's ratio above which the errors are as good as noise (2 for white noise)."""
_PARTS, _LASTING, _OR_ELSEWHERE = 8, 5.0, 2.0
"""Parts of the tests, whose disagreement shows what is not in the model (in a chirp each holds other frequencies), by
how much it is enlarged for what they have in common, and by how much more where a dead band was found, which may act
elsewhere or be friction: chosen on even seeds of `benchmarks/intervals.py identify`."""
_SLOWEST_DEG_S, _FASTEST_DEG_S = 1.0, 5000.0
"""Rate limits of servos; the fastest of the library, an S9256, has 1263 deg/s."""
_SMOOTH_STEP, _KINKED_STEP = 1e-6, 2e-3
"""Of derivatives, in the units of `ServoCandidate.vector`; rate limits and dead bands leave kinks in the motion."""


@dataclass(frozen=True, slots=True)
class ServoCandidate:
    """A servo with everything that a bench test can show.

    `linear`: delay, dc gain, poles. `rate_up_deg_s`, `rate_down_deg_s`: rate limits [deg/s]. `dead_band_deg`: full
    width of the zone in which the command may move without effect [deg]. `fixed_gain`: true if the dc gain is known,
    and not fitted.
    """

    linear: LinearServo
    rate_up_deg_s: float | None = None
    rate_down_deg_s: float | None = None
    dead_band_deg: float | None = None
    fixed_gain: bool = False

    @property
    def model(self) -> ServoModel:
        """Model without the dead band."""
        model = ServoModel(self.linear.transfer) + Delay(self.linear.delay_s)
        return model if self.rate_up_deg_s is None else model + RateLimit(self.rate_up_deg_s, self.rate_down_deg_s)

    def simulate(self, run: Run) -> FloatArray:
        """Position in a run [deg], shape (m,), without the offset of the measurement."""
        command_deg = run.command_deg
        if self.dead_band_deg is not None:
            command_deg = play(command_deg, self.dead_band_deg, float(command_deg[0]))
        return self.model.simulate(run.command_s, command_deg, run.measured_s)

    def vector(self) -> FloatArray:
        """Numbers to fit: logarithms of what must stay positive, milliseconds, degrees."""
        linear = self.linear
        numbers = [*linear.shape, MS_PER_S * linear.delay_s]
        numbers += [] if self.fixed_gain else [np.log(abs(linear.gain))]
        numbers += [np.log(r) for r in (self.rate_up_deg_s, self.rate_down_deg_s) if r is not None]
        return np.array(numbers + ([self.dead_band_deg] if self.dead_band_deg is not None else []))

    def with_vector(self, x: FloatArray) -> ServoCandidate:
        """The same kind of servo with other numbers."""
        n, gain = self.linear.order, self.linear.gain
        rest = [float(v) for v in x[n + 1 :]]
        if not self.fixed_gain:
            gain = float(np.sign(gain) * np.exp(rest.pop(0)))
        linear = LinearServo(tuple(float(v) for v in x[:n]), S_PER_MS * float(x[n]), gain)
        up, down = self.rate_up_deg_s, self.rate_down_deg_s
        return replace(
            self,
            linear=linear,
            rate_up_deg_s=None if up is None else float(np.exp(rest.pop(0))),
            rate_down_deg_s=None if down is None else float(np.exp(rest.pop(0))),
            dead_band_deg=None if self.dead_band_deg is None else rest[0],
        )


@dataclass(frozen=True, eq=False)
class MotionFit:
    """A servo fitted to its motion."""

    servo: ServoCandidate
    offsets_deg: FloatArray
    """Of the measurement, one for each servo, shape (servos,)."""
    errors_deg: tuple[FloatArray, ...]
    """Measured minus simulated position of each run [deg]."""
    found: Solution
    """Of `servo.vector()`."""

    @cached_property
    def covariance(self) -> FloatArray:
        """Of `servo.vector()`; larger by the correlation of the errors, and by what is not in the model."""
        memory = correlation_factor(self.errors_deg, _DEVIATION_LAGS)
        lasting = _LASTING * (1.0 if self.servo.dead_band_deg is None else _OR_ELSEWHERE)
        return self.found.covariance(memory, _PARTS, lasting)

    @property
    def rms_deg(self) -> float:
        """Root mean square of all errors [deg]."""
        return rms(np.concatenate(self.errors_deg))

    @property
    def count(self) -> int:
        """Number of errors."""
        return sum(error.size for error in self.errors_deg)

    @property
    def bic(self) -> float:
        """Bayesian information criterion: a further parameter must pay for itself."""
        parameters = int(self.found.x.size + self.offsets_deg.size)
        return 2.0 * self.count * float(np.log(max(self.rms_deg, 1e-12))) + parameters * float(np.log(self.count))

    @property
    def whiteness(self) -> float:
        """Von Neumann's ratio: 2 for uncorrelated errors, near 0 where the servo does what the model does not."""
        long = [error for error in self.errors_deg if error.size > 2]
        return float(sum(np.sum(np.diff(e) ** 2) for e in long) / max(sum(np.sum(e**2) for e in long), LEAST_DIVISOR))

    @property
    def is_white(self) -> bool:
        """True if what the model leaves is as good as noise."""
        return self.whiteness > _WHITE

    def interval(self, quantity: Callable[[ServoCandidate], float]) -> Estimate:
        """95 % interval of anything that follows from the servo, from the linear part of its dependence."""
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


def fit_motion(runs: Sequence[Run], start: ServoCandidate, *, steps: int = 60) -> MotionFit:
    """Fit a servo to all runs at once: least squares of measured minus simulated position.

    The mean error of each servo is its offset. The covariance takes the correlation of the errors into account, so that
    intervals stay honest where the model is not the whole truth.
    """
    lower, upper = _bounds(runs, start)
    kinked = start.dead_band_deg is not None or start.rate_up_deg_s is not None

    def errors(x: FloatArray) -> FloatArray:
        return np.concatenate(evaluated(runs, start.with_vector(x))[0])

    problem = Problem(lower, upper, errors, Noise(), step=_KINKED_STEP if kinked else _SMOOTH_STEP)
    found = fit(problem, np.clip(start.vector(), lower + 1e-3, upper - 1e-3), steps=steps)
    parts, offsets_deg = evaluated(runs, start.with_vector(found.x))
    return MotionFit(start.with_vector(found.x), offsets_deg, parts, found)


def _bounds(runs: Sequence[Run], start: ServoCandidate) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest `ServoCandidate.vector` that a servo in these tests can have."""
    sample_time_s = min(float(np.median(np.diff(run.measured_s))) for run in runs)
    powers = np.array({1: [1.0], 2: [2.0, 1.0], 3: [1.0, 2.0, 1.0]}[start.linear.order])
    ends_rad_s = _SLOWEST_RAD_S, _NYQUIST_FREQUENCIES * np.pi / sample_time_s
    slowest, fastest = (powers * np.log(each) for each in ends_rad_s)
    lower, upper = [*slowest, 0.0], [*fastest, 1e3 * LONGEST_DELAY_S]
    if not start.fixed_gain:
        lower, upper = [*lower, -LARGEST_LOG], [*upper, LARGEST_LOG]
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
    of_servo: dict[int, list[FloatArray]] = {}
    for error, run in zip(errors, runs, strict=True):
        of_servo.setdefault(run.servo, []).append(error)
    offsets = np.zeros(max(of_servo) + 1)
    for servo_, those in of_servo.items():
        offsets[servo_] = np.concatenate(those).mean()
    return tuple(e - offsets[run.servo] for e, run in zip(errors, runs, strict=True)), offsets


_AT_LIMIT, _SATURATED_TIME, _DENSE_S = 0.97, 0.8, 2e-3
"""Share of the rate limit from which on a servo is at it, share of the time there at most, and step of the simulation
[s]."""


def check_saturation(run: Run, servo: ServoCandidate, label: str) -> None:
    """Refuse a servo that runs at its rate limit all the time: a triangle shows no dynamics."""
    if servo.rate_up_deg_s is None:
        return
    slowest_deg_s = min(servo.rate_up_deg_s, servo.rate_down_deg_s or servo.rate_up_deg_s)
    dense_s = np.arange(run.measured_s[0], run.measured_s[-1], _DENSE_S)
    speed_deg_s = np.abs(np.diff(servo.simulate(replace(run, measured_s=dense_s, measured_deg=dense_s)))) / _DENSE_S
    share = float(np.mean(speed_deg_s > _AT_LIMIT * slowest_deg_s))
    if share > _SATURATED_TIME:
        raise IdentificationError(
            f"{label}: the servo moves at its rate limit of about {slowest_deg_s:.0f} deg/s for {share:.0%} of the "
            "time, which hides its dynamics; use a smaller amplitude"
        )

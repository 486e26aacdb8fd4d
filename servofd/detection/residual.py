r"""Residuals of real logs: ``r = Qy (y - ŷ)`` on true time stamps.

With ŷ from the full servo model this is, on uniform samples and for a linear servo, the same residual as that
of the plant-first nullspace filter (`servofd.detection.pulse`); but it stays zero for a servo that runs into
its rate limit, and it needs no resampling.

``Qy`` is :math:`g\,a(z)/M_d(z)`. Written in the lag :math:`L = (1-q)/(1 - q z^{-1})`, :math:`q = e^{-|p|\Delta t}`,
it becomes a weighted sum of :math:`L \dots L^{n+1}` whose weights are closed-form functions of the step
:math:`\Delta t`: this form carries over to irregular steps, has the right dc gain on every one of them, and has
no step length at which it fails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.records import own
from servofd.core.errors import DesignError
from servofd.core.types import BoolArray, ComplexArray, FloatArray
from servofd.detection.pulse import fastest_pole_rad_s
from servofd.estimate.record import Record
from servofd.servo.context import NO_CONTEXT, Context
from servofd.servo.loops import compiled, fixed, inner
from servofd.servo.motion import started_anew

if TYPE_CHECKING:
    from servofd.aircraft.series import Series
    from servofd.servo.servo_model import ServoModel

_LARGEST_GAIN_ERROR = 1e-6
"""Relative error of the filter's dc gain above which too many digits are lost."""
_FORGOTTEN = 30.0
"""Time constants after which nothing is left of what the filter held (1e-13 of it): longer steps have no weights."""
_SAME_STEP_S = 1e-7
"""Steps this close share their weights: a filter changes by less than 1e-5 of its input."""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Residual of one surface; all arrays of shape (n,), one entry per measurement time."""

    time_s: FloatArray
    simulated_deg: FloatArray
    """Deflection of a healthy servo [deg]."""
    measured_deg: FloatArray
    """NaN where the deflection was not measured, or the command was missing."""
    residual_deg: FloatArray
    """NaN where `measured_deg` is."""
    settled: BoolArray
    """False where the command is not known, or what moved the servo before: no verdict may use these samples."""
    restart: NDArray[np.int8]
    """1 where model and filter started anew, else 0."""
    context: Context = NO_CONTEXT
    """Airspeed and supply."""

    def __post_init__(self) -> None:
        for name in ("time_s", "simulated_deg", "measured_deg", "residual_deg"):
            object.__setattr__(self, name, own(getattr(self, name)))

    @property
    def error_deg(self) -> FloatArray:
        """Simulation error, measured minus simulated [deg]."""
        return self.measured_deg - self.simulated_deg


ThresholdKind = Literal["constant", "interval"]


@dataclass(frozen=True, slots=True, eq=False)
class Threshold:
    """Level over time that the residual of a healthy servo stays below; arrays of shape (n,)."""

    kind: ThresholdKind
    level_deg: FloatArray
    sigma_deg: FloatArray
    """Standard deviation of a good servo's residual, as known at each instant: of a named one, from noise alone."""
    noise_deg: FloatArray
    """That of the positions from noise, and from commands that were lost."""

    @property
    def typical_deg(self) -> float:
        """Median level [deg]; of a constant threshold the level itself."""
        if self.kind == "constant" and self.level_deg.size:
            return float(np.min(self.level_deg))
        return float(np.median(self.level_deg)) if self.level_deg.size else float("nan")


@dataclass(frozen=True, slots=True)
class ResidualGenerator:
    """Healthy model and filter of one surface.

    Parameters
    ----------
    model : ServoModel
        Healthy servo.
    pole_rad_s : float
        Speed of the filter [rad/s].

    Examples
    --------
    A healthy servo has no residual, however irregular the samples:

    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.series import Series
    >>> from servofd.servo.library import servo_named
    >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> time_s = np.cumsum(np.random.default_rng(1).uniform(0.005, 0.015, 1000))
    >>> command_deg = 10.0 * np.sin(time_s)
    >>> measured_deg = model.simulate(time_s, command_deg, time_s)
    >>> residuals = ResidualGenerator(model, 50.0).run(
    ...     Series("elevator", time_s, command_deg, time_s, measured_deg))
    >>> bool(np.nanmax(np.abs(residuals.residual_deg)) < 1e-9)
    True
    """

    model: ServoModel
    pole_rad_s: float

    @classmethod
    def fitting(cls, model: ServoModel, period_s: float, pole_rad_s: float | None = None) -> ResidualGenerator:
        """Generator with the fastest pole that suits positions of a given period [s]."""
        generator = cls(model, pole_rad_s or fastest_pole_rad_s(model.transfer, period_s))
        generator.check(period_s)
        return generator

    def check(self, step_s: float) -> None:
        """Certify that the filter passes a constant error with the inverse dc gain, up to round-off.

        It does not if so many digits cancel that the order of the model is too high for this step.
        """
        parameters = self.filter_parameters()
        total = float(np.sum(lag_weights(parameters, step_s))) * parameters.dc_gain
        if not abs(total - 1.0) < _LARGEST_GAIN_ERROR:
            raise DesignError("the residual filter of this servo model loses all digits: use a model of lower order")

    def filter_parameters(self) -> FilterParameters:
        """The filter as the kernel sees it."""
        decay = self.model.transfer.modes().decay_rad_s
        pairs = decay[decay.imag != 0.0].conj()
        return FilterParameters(self.pole_rad_s, np.concatenate([decay, pairs]), self.model.transfer.dc_gain)

    def run(self, segment: Series) -> Residuals:
        """Residual of a whole segment."""
        model, record = self.model, Record.of(segment, at_once=True)
        received = record.commands.later(model.delay_s)
        begins, start_deg = np.isfinite(record.start_deg), np.nan_to_num(record.start_deg)
        simulated_deg = started_anew(model.servo(segment.context), received, record.time_s, start_deg, begins)
        anew = begins.astype(np.int8)
        residual_deg = self.filtered(record.time_s, record.measured_deg - simulated_deg, anew)
        return Residuals(
            record.time_s, simulated_deg, record.measured_deg, residual_deg, record.usable, anew, segment.context
        )

    def filtered(self, time_s: FloatArray, error_deg: FloatArray, restart: NDArray[np.int8]) -> FloatArray:
        """Residual of a simulation error [deg], shape (n,); anew where `restart` is not 0."""
        residual_deg, residual_filter = np.array(error_deg), self.filter_parameters()
        filter_in_place(residual_filter, FilterMemory.of(residual_filter, 1), time_s, residual_deg, restart)
        return residual_deg


CURVATURE_TO_SIGMA = float(np.sqrt(np.pi / 2.0 / 6.0))
"""Mean absolute second difference of white noise to its standard deviation. The median would fail on coarse steps."""
_MOST, _GLITCH = 90.0, 3.0
"""Second differences count as no more than this many times the ninth decile, 5 standard deviations of white noise."""


def noise_deg(error_deg: FloatArray) -> float:
    """Standard deviation of white measurement noise in a simulation error, whatever moves slowly in it [deg]."""
    curvature = np.diff(error_deg[np.isfinite(error_deg)], 2)
    if curvature.size == 0:
        return 0.0
    size_deg = np.abs(curvature)
    glitch_deg = _GLITCH * float(np.percentile(size_deg, _MOST))
    return CURVATURE_TO_SIGMA * float(np.mean(np.minimum(size_deg, glitch_deg)))


class FilterParameters(NamedTuple):
    """The measured branch ``Qy`` of a nullspace filter."""

    pole_rad_s: float
    decay_rad_s: ComplexArray
    """All poles of the servo, negated, both members of each pair, of shape (n,)."""
    dc_gain: float


class FilterMemory(NamedTuple):
    """What changes from sample to sample while several signals of the same instants are filtered."""

    lags: FloatArray
    """Of shape (r, n + 1): successive lags of each signal [deg]."""
    weights: FloatArray
    """Of shape (n + 1,): shares of the lags in the residual for the step length below."""
    step: FloatArray
    """Of shape (3,): step length [s] of the weights, its lag factor, time of the last filtered sample [s]."""
    polynomial: ComplexArray
    """Of shape (n + 1,): room for the calculation of the weights."""

    @classmethod
    def of(cls, residual_filter: FilterParameters, signals: int) -> FilterMemory:
        """Memory before the first sample."""
        lags = residual_filter.decay_rad_s.size + 1
        return cls(
            np.zeros((signals, lags)),
            np.zeros(lags),
            np.array([-1.0, 0.0, -np.inf]),
            np.zeros(lags, dtype=np.complex128),
        )


@inner
def _weigh_lags(residual_filter: FilterParameters, memory: FilterMemory, step_s: float) -> None:
    """Shares of the lags for this step length: the servo's characteristic polynomial written in the lag."""
    lag = math.exp(-residual_filter.pole_rad_s * step_s)
    order = residual_filter.decay_rad_s.size
    polynomial = memory.polynomial
    for i in range(order + 1):
        polynomial[i] = 1.0 if i == 0 else 0.0
    free = 1.0 + 0.0j
    for i in range(order):
        factor = np.exp(-residual_filter.decay_rad_s[i] * step_s)
        ratio = factor / lag
        for j in range(i + 1, 0, -1):
            polynomial[j] = (1.0 - ratio) * polynomial[j] + ratio * polynomial[j - 1]
        polynomial[0] *= 1.0 - ratio
        free *= 1.0 - factor
    scale = 1.0 / (residual_filter.dc_gain * free.real)
    for j in range(order + 1):
        # Entry j multiplies the lag of order n + 1 - j; the lags are stored by rising order.
        memory.weights[order - j] = polynomial[j].real * scale
        scale *= 1.0 - lag
    memory.step[0] = step_s
    memory.step[1] = lag


def lag_weights(residual_filter: FilterParameters, step_s: float) -> FloatArray:
    """Shares of the lags in the residual for one step length, of shape (n + 1,)."""
    memory = FilterMemory.of(residual_filter, 1)
    filter_in_place(residual_filter, memory, np.array([0.0, step_s]), np.zeros(2), np.array([1, 0], dtype=np.int8))
    return memory.weights


def filter_in_place(
    residual_filter: FilterParameters,
    memory: FilterMemory,
    time_s: FloatArray,
    error_deg: FloatArray,
    restart: NDArray[np.int8],
    others_deg: FloatArray | None = None,
) -> None:
    """Turn a simulation error [deg], shape (n,), into its residual, and so other signals of its instants, (r, n).

    The memory moves on. A sample that is NaN in the error is left out in all of them; the filter starts anew where
    `restart` is not 0. In place, because fresh pages of memory take longer than the filter.
    """
    others_deg = np.empty((0, time_s.size)) if others_deg is None else others_deg
    _filter(residual_filter, memory, fixed(time_s), error_deg, others_deg, fixed(restart))


@compiled
def _filter(
    residual_filter: FilterParameters,
    memory: FilterMemory,
    time_s: FloatArray,
    error_deg: FloatArray,
    others_deg: FloatArray,
    restart: NDArray[np.int8],
) -> None:
    lags, last_s = memory.lags, memory.step[2]
    for k in range(time_s.size):
        if math.isnan(error_deg[k]):
            for r in range(1, lags.shape[0]):
                others_deg[r - 1, k] = math.nan
            continue
        step_s, last_s = time_s[k] - last_s, time_s[k]
        begins = restart[k] != 0 or not residual_filter.pole_rad_s * step_s < _FORGOTTEN
        if not begins and abs(step_s - memory.step[0]) > _SAME_STEP_S:
            _weigh_lags(residual_filter, memory, step_s)
        lag = memory.step[1]
        for r in range(lags.shape[0]):
            value, residual = error_deg[k] if r == 0 else others_deg[r - 1, k], 0.0
            if begins:
                residual = value / residual_filter.dc_gain
            for j in range(lags.shape[1]):
                if not begins:
                    value = lag * lags[r, j] + (1.0 - lag) * value
                    residual += memory.weights[j] * value
                lags[r, j] = value
            if r == 0:
                error_deg[k] = residual
            else:
                others_deg[r - 1, k] = residual
    memory.step[2] = last_s

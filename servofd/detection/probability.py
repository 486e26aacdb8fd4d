"""What the watch over one surface is worth: false alarms, missed faults, delays, and what other thresholds would do."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import erfc, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from logparsers.records import own
from logparsers.units import S_PER_HOUR
from servofd.core.errors import DesignError, NoMeasurement
from servofd.core.numeric import root
from servofd.core.types import FloatArray

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.detection.pulse import PulseFilter

_NODES = 120
"""Nodes of the Gauss and Legendre sum."""
_REACH = 10.0
"""Standard deviations over which the integral reaches."""
_LOWEST_Z = 1.0
"""The rate falls with the threshold from here on: for white noise it is largest at 0.67, for any other below that."""
_HIGHEST_Z = 37.0
"""Beyond it the density of a Gaussian is no longer a normal floating-point number."""


def false_alarms_per_hour(threshold_deg: float, sigma_deg: float, correlation: float, sample_time_s: float) -> float:
    r"""Rate at which a healthy, Gaussian residual crosses its threshold from inside to outside.

    `correlation` is that of the residual with itself one sample later. With heavier tails than a Gaussian the truth
    is higher.

    Examples
    --------
    >>> rate = false_alarms_per_hour(5.0, 1.0, 0.62066, 0.01)
    >>> round(float(1.0 - np.exp(-rate)), 3)
    0.184
    """
    if sigma_deg <= 0.0:
        return 0.0
    z = threshold_deg / sigma_deg
    rho = min(max(correlation, -1.0 + 1e-9), 1.0 - 1e-9)
    spread = np.sqrt(1.0 - rho**2)
    nodes, weights = _gauss_legendre(_NODES)
    # The density falls by a factor e within 1/z of the threshold: integrate over ten such lengths.
    reach = _REACH * min(1.0, 4.0 / max(z, 1e-3))
    x = z + 0.5 * reach * (nodes + 1.0)
    # Relative to the tail at z, so that a threshold of many sigma does not underflow before the end.
    density = np.exp(-0.5 * (x - z) * (x + z))
    inside = _below((z - rho * x) / spread) - _below((-z - rho * x) / spread)
    tail = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    return float(S_PER_HOUR * 2.0 / sample_time_s * tail * 0.5 * reach * np.sum(weights * density * inside))


def _below(sigmas: FloatArray) -> FloatArray:
    """Probability of a standard Gaussian below each value; importing `scipy.special` for it takes 0.1 s."""
    return np.array([0.5 * erfc(-value * sqrt(0.5)) for value in sigmas.tolist()])


@cache
def _gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights; working them out takes a hundred times as long as using them."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return np.asarray(nodes, dtype=float), np.asarray(weights, dtype=float)


def threshold_for_rate_deg(rate_per_hour: float, sigma_deg: float, correlation: float, sample_time_s: float) -> float:
    """Threshold at which a healthy Gaussian residual gives the wanted rate of false alarms.

    Of this surface alone: for a fleet, divide the rate by the number of surfaces. Right to ten digits of the rate.
    """
    if not sigma_deg > 0.0:
        raise DesignError("a residual without noise needs no threshold: the standard deviation must be above zero")
    z = root_of_rate(lambda level: false_alarms_per_hour(level, 1.0, correlation, sample_time_s), rate_per_hour)
    return z * sigma_deg


def root_of_rate(rate: Callable[[float], float], wanted_per_hour: float) -> float:
    """Threshold in standard deviations at which a falling rate takes the wanted value."""
    most, least = rate(_LOWEST_Z), rate(_HIGHEST_Z)
    if not least <= wanted_per_hour <= most:
        raise DesignError(
            f"{wanted_per_hour:g} false alarms per hour: no threshold gives this rate; choose one between "
            f"{least:.1g} and {most:.2g}"
        )
    # Rates span hundreds of powers of ten: only their logarithm is near a straight line.
    tiny = np.finfo(float).tiny
    wanted = np.log(max(wanted_per_hour, tiny))
    return root(lambda level: float(np.log(max(rate(level), tiny)) - wanted), _LOWEST_Z, _HIGHEST_Z)


_FEWEST_SAMPLES = 100
"""Healthy samples that give the noise."""
_FEWEST_LAGS = 5
"""Lags of the autocorrelation that are kept at least."""
_AR_ORDER = 30
"""Largest order of the autoregressive model of the noise."""
_WARM_UP = 1000
"""Samples that are drawn and dropped before the noise is stationary."""
_WHITE_SHARE = 1e-9
"""White noise that is added to the autocorrelation, as a share, so that it can be solved."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Stationary noise of one residual."""

    sigma_deg: float
    """Standard deviation [deg], above zero."""
    autocorrelation: FloatArray
    """Correlation with itself after 0, 1, ... samples, until it has died out; starts with 1."""
    sample_time_s: float
    """Sample time [s]."""
    mean_deg: float = 0.0
    """Mean [deg]; it takes its size off the margin to the threshold."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "autocorrelation", own(self.autocorrelation))
        if not (self.sigma_deg > 0.0 and self.sample_time_s > 0.0 and self.autocorrelation.size > 1):
            raise ValueError("noise needs a standard deviation, a sample time and at least one lag")

    @classmethod
    def designed(cls, design: PulseFilter, noise_deg: float) -> Noise:
        """Noise of a residual whose measured deflection carries white noise of this standard deviation [deg]."""
        lags = design.impulse_response().size // 2
        return cls(design.noise_gain * noise_deg, design.autocorrelation(lags), design.sample_time_s)

    @classmethod
    def measured(cls, residual_deg: FloatArray, sample_time_s: float, lags: int) -> Noise:
        """Noise of a healthy residual as it was measured.

        The residual (n,) is NaN where it was not judged, and between one log and the next; `lags` is at least
        the time in which the filter forgets.
        """
        from scipy.signal import correlate

        known = np.isfinite(residual_deg)
        count = int(np.count_nonzero(known))
        if count < _FEWEST_SAMPLES:
            raise NoMeasurement(f"only {count} healthy samples; {_FEWEST_SAMPLES} are needed to tell the noise")
        mean = float(np.mean(residual_deg[known]))
        # Zeros for what is missing, and one divisor for all lags: the estimate stays positive definite.
        centred = np.where(known, residual_deg - mean, 0.0)
        power = float(centred @ centred)
        if not power > 0.0:
            raise NoMeasurement("the residual never changes: there is no noise to judge by")
        products = correlate(np.append(centred, np.zeros(lags)), centred, mode="valid", method="fft")
        scaled = products / power
        scaled[0] = 1.0
        # From the first correlation that is not positive on there is more estimation error than correlation.
        end = max(int(np.argmax(np.append(scaled, -1.0) <= 0.0)), _FEWEST_LAGS + 1)
        return cls(float(np.sqrt(power / count)), scaled[:end], sample_time_s, mean)

    @property
    def correlation(self) -> float:
        """Correlation of neighbouring samples."""
        return float(self.autocorrelation[1])

    @property
    def long_run_factor(self) -> float:
        """Variance of a long mean, relative to that of white noise: S = 1 + 2 sum of all correlations; at least 1."""
        return max(1.0, 1.0 + 2.0 * float(self.autocorrelation[1:].sum()))

    def margin_deg(self, threshold_deg: float) -> float:
        """What the mean leaves of a threshold, on the side where it leaves less [deg]."""
        return max(threshold_deg - abs(self.mean_deg), 0.0)

    @property
    def order(self) -> int:
        """Number of earlier samples that tell about the next one."""
        return min(_AR_ORDER, self.autocorrelation.size - 1)

    def prediction(self, known: int) -> tuple[FloatArray, float]:
        """Best forecast of a sample from those before it (Yule and Walker).

        Weights of the earlier samples, latest first, shape (known,), and the standard deviation of what remains
        as a share of `sigma_deg`.
        """
        from scipy.linalg import solve_toeplitz

        if known == 0:
            return np.empty(0), 1.0
        rho = self.autocorrelation[: known + 1]
        # A trace of white noise keeps the equations of a very smooth residual from being singular.
        weights: FloatArray = solve_toeplitz(np.append(1.0 + _WHITE_SHARE, rho[1:-1]), rho[1:])
        return weights, float(np.sqrt(max(1.0 - float(weights @ rho[1:]), 0.0)))

    def sample(self, shape: tuple[int, int], seed: int) -> FloatArray:
        """Gaussian noise of this size and colour, without mean [deg], shape (runs, samples)."""
        from scipy.signal import lfilter

        weights, spread = self.prediction(self.order)
        white = np.random.default_rng(seed).standard_normal((shape[0], shape[1] + _WARM_UP))
        coloured: FloatArray = lfilter([self.sigma_deg * spread], np.append(1.0, -weights), white)[:, _WARM_UP:]
        return coloured


_POINTS_LOG2 = 13
"""Logarithm to base 2 of the number of Sobol points."""
_TRACE_OF_WHITE = 1e-12
"""White noise that is added to a correlation, so that it can be factored."""
_TINY = np.finfo(float).tiny
_LARGEST_BELOW_ONE = float(np.nextafter(1.0, 0.0))


def persistent_false_alarms_per_hour(threshold_deg: float, noise: Noise, samples: int) -> float:
    r"""Rate of alarms that ask for several samples in a row over the threshold, all on one side; no more than lags.

    One alarm for each run of at least :math:`n` samples, counted where it has lasted :math:`n`:

    .. math:: \nu_n = \frac{2}{T}\,
              \left[P(r_1 > \tau, \dots, r_n > \tau) - P(r_1 > \tau, \dots, r_{n+1} > \tau)\right]

    (a run begun is a run ended, so "not before" may be read as "not after"). They are integrals, to 1e-3,
    over the Cholesky factor of the correlation, each variable drawn from its tail given those before it (A. Genz,
    1992), on a fixed low-discrepancy net: accurate relative to their own size, and smooth in the threshold.
    """
    return _rate_of(noise, samples)(noise.margin_deg(threshold_deg) / noise.sigma_deg)


def persistent_threshold_deg(rate_per_hour: float, noise: Noise, samples: int) -> float:
    """Threshold at which this many samples in a row give the wanted rate of false alarms [deg]."""
    return root_of_rate(_rate_of(noise, samples), rate_per_hour) * noise.sigma_deg + abs(noise.mean_deg)


def _rate_of(noise: Noise, samples: int) -> Callable[[float], float]:
    """Rate of alarms by the threshold in standard deviations."""
    if samples == 1:
        return lambda level: false_alarms_per_hour(level, 1.0, noise.correlation, noise.sample_time_s)
    factor = _factor(noise, samples)
    return lambda level: _rate(level, factor, noise.sample_time_s)


def _factor(noise: Noise, samples: int) -> FloatArray:
    from scipy.linalg import toeplitz

    if not 1 <= samples < noise.autocorrelation.size:
        raise ValueError(f"{samples} samples in a row: the colour is known for 1 to {noise.autocorrelation.size - 1}")
    correlation = toeplitz(noise.autocorrelation[: samples + 1])
    # A trace of white noise keeps the matrix of a very smooth residual from being singular.
    return np.asarray(np.linalg.cholesky(correlation + _TRACE_OF_WHITE * np.eye(samples + 1)), dtype=np.float64)


def _rate(z: float, factor: FloatArray, sample_time_s: float) -> float:
    """Runs of exactly the first n rows, the last row being inside again; both signs."""
    from scipy.special import ndtr, ndtri

    size = factor.shape[0]
    net = _net(size - 1)
    drawn = np.zeros((size, net.shape[0]))
    chance = np.ones(net.shape[0])
    for i in range(size):
        tail = ndtr(-(z - factor[i, :i] @ drawn[:i]) / factor[i, i])
        if i == size - 1:
            chance = chance * (1.0 - tail)
        else:
            chance = chance * tail
            drawn[i] = -ndtri(np.clip(net[:, i] * tail, _TINY, _LARGEST_BELOW_ONE))
    return float(S_PER_HOUR * 2.0 / sample_time_s * chance.mean())


@cache
def _net(dimensions: int) -> FloatArray:
    """Scrambled Sobol points, shape (8192, dimensions); always the same."""
    from scipy.stats.qmc import Sobol

    points: FloatArray = Sobol(dimensions, rng=np.random.default_rng(1)).random_base2(_POINTS_LOG2)
    return points


_MOST_DRAWS, _FEWEST_DRAWS, _NUMBERS = 4096, 256, 4_000_000
"""Draws at most and at least, and the numbers that they may hold."""
_ROUND_OFF = 1e-12
"""Share missed below which it is round-off."""
_RARE = 0.99
"""With more than this still missed at the end, alarms are too rare for draws: crossings of the settled mean count."""


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """Probability that an alarm has been raised by each sample after a fault; arrays of shape (n,)."""

    least: FloatArray
    """Largest marginal probability so far: the truth is never below it."""
    likely: FloatArray
    """The probability itself, with the colour of the noise; its numerical error is about 1 %."""
    most: FloatArray
    """As if the samples were independent."""
    steady_per_s: float
    """Rate of alarms at the end [1/s], once the response has settled."""
    sample_time_s: float

    @property
    def mean_delay_s(self) -> float:
        """Expected time from the fault to the alarm [s]; after the last sample alarms come at the steady rate."""
        missed = 1.0 - self.likely
        seen_s = self.sample_time_s * float(missed[:-1].sum())
        if missed[-1] == 0.0:
            return seen_s
        return seen_s + float(missed[-1]) / self.steady_per_s if self.steady_per_s > 0.0 else float("inf")

    def delay_s(self, probability: float) -> float:
        """Time by which an alarm has been raised with this probability [s]; infinite if not within the response."""
        reached = np.flatnonzero(self.likely >= probability)
        return float(reached[0]) * self.sample_time_s if reached.size else float("inf")


def detect(response_deg: FloatArray, threshold_deg: float, noise: Noise) -> Detection:
    r"""Probability that a fault has raised an alarm, sample by sample.

    `response_deg` (n,), two samples at least, is the mean residual from the sample at which the fault sets in until
    it has settled; the mean of the noise is added to it.
    """
    from scipy.special import ndtr

    # Seen from the side to which the fault pushes: small probabilities then keep their digits.
    mean_deg = response_deg + noise.mean_deg
    mean_deg = mean_deg * (1.0 if mean_deg[np.argmax(np.abs(mean_deg))] >= 0.0 else -1.0)
    lower, upper = (-threshold_deg - mean_deg) / noise.sigma_deg, (threshold_deg - mean_deg) / noise.sigma_deg
    seen = ndtr(-upper) + ndtr(lower)
    least = np.maximum.accumulate(seen)
    most = np.maximum(1.0 - np.cumprod(1.0 - seen), least)
    likely = np.maximum.accumulate(np.clip(1.0 - _never_outside(lower, upper, noise), least, most))
    steady_per_s = _steady_per_s(likely, float(mean_deg[-1]), threshold_deg, noise)
    return Detection(least, likely, most, steady_per_s, noise.sample_time_s)


def bias_response(design: PulseFilter, duration_s: float) -> FloatArray:
    """Residual after a step of 1 deg in the measured deflection, from the sample at which it sets in, shape (n,)."""
    from scipy.signal import lfilter

    count = int(duration_s / design.sample_time_s + 1e-9) + 1
    response: FloatArray = lfilter(design.g * design.a, design.md, np.ones(count))
    return response


def smallest_bias_deg(design: PulseFilter, threshold_deg: float, noise: Noise, within_s: float) -> float:
    """Smallest step of the measured deflection that is sure to be seen in time [deg].

    From the lower bound of the probability: the largest mean residual stands so far beyond the threshold that noise
    takes it back with the remaining probability only.
    """
    from scipy.special import ndtri

    reach = float(np.max(np.abs(bias_response(design, within_s))))
    # The mean of the noise may work against the fault.
    return (threshold_deg + abs(noise.mean_deg) + float(ndtri(0.99)) * noise.sigma_deg) / reach


def _never_outside(lower: FloatArray, upper: FloatArray, noise: Noise) -> FloatArray:
    """Probability of having stayed inside the limits [sigma] up to each sample, shape (n,)."""
    from scipy.special import ndtr, ndtri

    draws = max(_FEWEST_DRAWS, min(_MOST_DRAWS, _NUMBERS // upper.size))
    random = np.random.default_rng(1).random((upper.size, draws))
    drawn = np.empty((upper.size, draws))
    weight, stayed = np.ones(draws), np.empty(upper.size)
    forecasts = [noise.prediction(known) for known in range(min(noise.order, upper.size - 1) + 1)]
    for k in range(upper.size):
        weights, spread = forecasts[min(k, len(forecasts) - 1)]
        expected = weights @ drawn[k - weights.size : k][::-1]
        low, high = ndtr((lower[k] - expected) / spread), ndtr((upper[k] - expected) / spread)
        weight = weight * (high - low)
        stayed[k] = weight.mean()
        share = np.clip(low + random[k] * (high - low), _TINY, 1.0 - np.finfo(float).epsneg)
        drawn[k] = expected + spread * ndtri(share)
    return stayed


def _steady_per_s(likely: FloatArray, mean_deg: float, threshold_deg: float, noise: Noise) -> float:
    """Rate of alarms at the end of a response [1/s]."""
    missed = 1.0 - likely
    half = min(missed.size // 2, missed.size - 2)
    if missed[-1] > _RARE:
        near, far = threshold_deg - abs(mean_deg), threshold_deg + abs(mean_deg)
        both_sides = sum(
            false_alarms_per_hour(level, noise.sigma_deg, noise.correlation, noise.sample_time_s)
            for level in (near, far)
        )
        return 0.5 * both_sides / S_PER_HOUR
    if not missed[-1] > _ROUND_OFF:
        return float("inf")
    return float(np.log(missed[half] / missed[-1])) / ((missed.size - 1 - half) * noise.sample_time_s)


HOURS_FOR_TAIL = 2.0
"""With less healthy data the fitted tail says less than the assumption of a Gaussian one."""
_LEVEL_QUANTILE = 0.999
"""Quantile of the residual over which the tail is fitted."""
_FEWEST_PEAKS = 200
"""Samples over that level that are wanted."""
_MOST_EXCEEDANCES = 0.05
"""Share of the samples that may be over it."""
_EXTRAPOLATION = 10.0
"""Times the hours of data up to which a rate is extrapolated."""
_SERIES = 1e-4
"""Below this the derivative by xi is taken from its limit for xi = 0, before all digits cancel."""


class Quoted(NamedTuple):
    """A number, and whether it lies beyond what the data can vouch for."""

    value: float
    extrapolated: bool


@dataclass(frozen=True, slots=True)
class TailFit:
    """Generalised Pareto distribution of the peaks of the residual's size over a level."""

    level_deg: float
    """Level over which peaks were taken [deg]."""
    scale_deg: float
    """Scale beta [deg]."""
    index: float
    """Tail index xi: 0 for a Gaussian tail, far out; above 0 for heavier ones; below 0 the tail ends."""
    index_error: float
    """Standard error of xi."""
    peaks: int
    """Clusters of exceedances."""
    hours: float
    """Healthy data behind the fit [h]."""

    @property
    def peaks_per_hour(self) -> float:
        """Clusters over the level per hour."""
        return self.peaks / self.hours

    @property
    def lowest_rate_per_hour(self) -> float:
        """Rate below which every number is an extrapolation: one in ten times the hours of data."""
        return 1.0 / (_EXTRAPOLATION * self.hours)

    def false_alarms_per_hour(self, threshold_deg: float) -> Quoted:
        r"""Rate of alarms at a threshold.

        Below the level the fit says nothing; the rate at the level is given, and the truth is higher.

        .. math:: \nu(\tau) = \lambda \left(1 + \xi\,(\tau - u)/\beta\right)^{-1/\xi}
        """
        from scipy.stats import genpareto

        excess = max(threshold_deg - self.level_deg, 0.0)
        rate = self.peaks_per_hour * float(genpareto.sf(excess, self.index, scale=self.scale_deg))
        return Quoted(rate, rate < self.lowest_rate_per_hour)

    def log_rate_error(self, threshold_deg: float) -> float:
        r"""Standard error of the logarithm of the rate at a threshold: 0.4 means a factor of 1.5 either way.

        First-order propagation of the asymptotic covariance of the fit (R. L. Smith, 1987),

        .. math:: \frac{1+\xi}{n} \begin{pmatrix} 1+\xi & -\beta \\ -\beta & 2\beta^2 \end{pmatrix}

        and of the number of peaks. Beyond the end of a tail with xi < 0 it is infinite.
        """
        y = max(threshold_deg - self.level_deg, 0.0) / self.scale_deg
        stretch = 1.0 + self.index * y
        if stretch <= 0.0:
            return float("inf")
        by_scale = y / (self.scale_deg * stretch)
        by_index = y**2 / 2.0
        if abs(self.index) * y > _SERIES:
            by_index = (np.log(stretch) - self.index * y / stretch) / self.index**2
        gradient = np.array([by_index, by_scale])
        one = 1.0 + self.index
        covariance = one * np.array([[one, -self.scale_deg], [-self.scale_deg, 2.0 * self.scale_deg**2]])
        return float(np.sqrt((gradient @ covariance @ gradient + 1.0) / self.peaks))

    def threshold_deg(self, rate_per_hour: float) -> Quoted:
        """Threshold for a wanted rate [deg]; the level itself if more alarms are wanted than it has."""
        from scipy.stats import genpareto

        share = min(rate_per_hour / self.peaks_per_hour, 1.0)
        excess = float(genpareto.isf(share, self.index, scale=self.scale_deg))
        return Quoted(self.level_deg + excess, rate_per_hour < self.lowest_rate_per_hour)


def fit_tail(residual_deg: FloatArray, sample_time_s: float, apart_samples: int = 15) -> TailFit:
    r"""Fit the tail of a healthy residual.

    Of healthy residuals (n,), NaN where not judged and, for at least `apart_samples`, between one log and the next;
    exceedances that are closer belong to one peak: 15 at 100 Hz for a filter at 50 rad/s, 7.5 time constants, after
    which the residual has forgotten (its correlation is below 0.01). The level is the 99.9 % quantile of its size;
    lower if that leaves fewer than 200 exceedances, but never below 95 %.
    """
    from scipy.stats import genpareto

    size_deg = np.abs(residual_deg)
    known = size_deg[np.isfinite(size_deg)]
    hours = known.size * sample_time_s / S_PER_HOUR
    if hours < HOURS_FOR_TAIL:
        raise NoMeasurement(f"{hours:.2g} h of healthy data; a fit of the tail needs {HOURS_FOR_TAIL:g} h")
    share = min(max(1.0 - _LEVEL_QUANTILE, _FEWEST_PEAKS / known.size), _MOST_EXCEEDANCES)
    level_deg = float(np.quantile(known, 1.0 - share))
    excess = peaks(size_deg, level_deg, apart_samples) - level_deg
    mean, variance = (float(excess.mean()), float(excess.var())) if excess.size > 1 else (0.0, 0.0)
    if not variance > 0.0:
        raise NoMeasurement("the residual has no tail to fit: its peaks are all the same")
    # Start from the moments (J. R. M. Hosking and J. R. Wallis, 1987).
    start = min(0.5 * (1.0 - mean**2 / variance), 0.4)
    with np.errstate(all="ignore"):
        # In units of the mean: the search stops at an absolute tolerance.
        index, _, scale = genpareto.fit(excess / mean, start, floc=0.0, scale=1.0 - start)
    error = (1.0 + index) / np.sqrt(excess.size)
    return TailFit(level_deg, float(scale) * mean, float(index), float(error), excess.size, hours)


def peaks(size_deg: FloatArray, level_deg: float, apart_samples: int) -> FloatArray:
    """Largest value of each cluster of exceedances [deg]."""
    over = np.flatnonzero(size_deg > level_deg)  # a missing value is never over
    if over.size == 0:
        return np.empty(0)
    first = np.flatnonzero(np.diff(over, prepend=-apart_samples - 1) >= apart_samples)
    peaks: FloatArray = np.maximum.reduceat(size_deg[over], first)
    return peaks


IN_A_ROW = (2, 3, 5)
"""Persistences that are shown beside the single sample."""
WITHIN_S = (0.2, 1.0)
"""Times within which a fault is to be seen [s]."""
_SETTLED_TIME_CONSTANTS = 40.0
"""Time constants of the filter after which it has settled."""


@dataclass(frozen=True, slots=True)
class Wish:
    """What is asked of the watch."""

    false_alarms_per_hour: float = 1e-3
    """Of one surface, per flight hour."""
    fault_deg: float = 2.0
    """Step of the measured deflection whose delay is given [deg]."""


@dataclass(frozen=True, slots=True)
class Operating:
    """What one threshold does."""

    threshold_deg: float
    gaussian_per_hour: float
    """False alarms per hour if the residual is Gaussian."""
    tail_per_hour: Quoted | None
    """False alarms per hour by the measured tail; None if there is too little data to fit one."""
    in_a_row_per_hour: dict[int, float]
    """False alarms per hour if that many samples in a row are asked for (Gaussian)."""
    smallest_bias_deg: dict[float, float]
    """Step of the measured deflection seen within that time [s] with 99 % probability [deg]."""
    delay_s: float
    """Expected delay for the fault of the wish [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceOdds:
    """Odds of one surface."""

    surface: str
    servo: str
    design: PulseFilter
    noise: Noise
    hours: float
    """Healthy data behind the noise [h]; 0 if it comes from the design."""
    tail: TailFit | None
    notes: tuple[str, ...]
    wish: Wish
    in_force: Operating
    gaussian_threshold_deg: float
    """For the wished rate, if the residual is Gaussian [deg]."""
    tail_threshold_deg: Quoted | None
    """For the wished rate, by the measured tail [deg]."""
    wished: Operating
    """At the tail's threshold if there is one, else at the Gaussian."""
    in_a_row_threshold_deg: dict[int, float]


def surface_odds(
    surface: str,
    servo: str,
    design: PulseFilter,
    noise: Noise,
    threshold_deg: float,
    wish: Wish,
    *,
    tail: TailFit | None = None,
    hours: float = 0.0,
    notes: tuple[str, ...] = (),
) -> SurfaceOdds:
    """Work out the odds of one surface.

    The noise is that of its healthy residual, measured or designed; `hours` of healthy data stand behind it and the
    tail, and `notes` are what the reader must know.
    """
    wanted = wish.false_alarms_per_hour
    gaussian_deg = abs(noise.mean_deg) + threshold_for_rate_deg(
        wanted, noise.sigma_deg, noise.correlation, noise.sample_time_s
    )
    tail_deg = tail.threshold_deg(wanted) if tail else None
    response_deg = wish.fault_deg * settled_bias(design)
    rows = [n for n in IN_A_ROW if n <= noise.order]
    return SurfaceOdds(
        surface=surface,
        servo=servo,
        design=design,
        noise=noise,
        hours=hours,
        tail=tail,
        notes=notes,
        wish=wish,
        in_force=_operating(threshold_deg, design, noise, tail, response_deg),
        gaussian_threshold_deg=gaussian_deg,
        tail_threshold_deg=tail_deg,
        wished=_operating(tail_deg.value if tail_deg else gaussian_deg, design, noise, tail, response_deg),
        in_a_row_threshold_deg={n: persistent_threshold_deg(wanted, noise, n) for n in rows},
    )


def settled_bias(design: PulseFilter) -> FloatArray:
    """Residual after a step of 1 deg in the measured deflection, until it has settled, shape (n,)."""
    return bias_response(design, max(WITHIN_S[-1], _SETTLED_TIME_CONSTANTS / design.pole_rad_s))


def _operating(
    threshold_deg: float, design: PulseFilter, noise: Noise, tail: TailFit | None, response_deg: FloatArray
) -> Operating:
    margin_deg = noise.margin_deg(threshold_deg)
    detection = detect(response_deg, threshold_deg, noise)
    return Operating(
        threshold_deg=threshold_deg,
        gaussian_per_hour=false_alarms_per_hour(margin_deg, noise.sigma_deg, noise.correlation, noise.sample_time_s),
        tail_per_hour=tail.false_alarms_per_hour(threshold_deg) if tail else None,
        in_a_row_per_hour={
            n: persistent_false_alarms_per_hour(threshold_deg, noise, n) for n in IN_A_ROW if n <= noise.order
        },
        smallest_bias_deg={s: smallest_bias_deg(design, threshold_deg, noise, s) for s in WITHIN_S},
        delay_s=detection.mean_delay_s,
    )

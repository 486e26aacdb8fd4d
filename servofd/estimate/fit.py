"""A servo of the family fitted to good flights, and the noise that it leaves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.aircraft.calibrated import Noise
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.core.fitting import Noise as Scatter
from servofd.core.fitting import Problem, Solution
from servofd.core.fitting import fit as minimum
from servofd.core.statistics import MAD_TO_SIGMA, Estimate
from servofd.estimate.family import bent, middle_of, new_state, sensitivities, simulated, variants
from servofd.estimate.record import DELAY, LN_BANDWIDTH, LN_DAMPING, joined
from servofd.servo.loops import compiled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import BoolArray, FloatArray
    from servofd.estimate.record import Record

_HUBER: Final = 2.5
"""Standard deviations beyond which an error counts by its size, and not its square (Huber)."""
_DELAYS_S: Final = (0.01, 0.03, 0.06, 0.1)
"""Delays at which descents begin [s]: between them the misfit may have another valley."""
_SPEED_S, _FASTEST = 0.1, 0.99
"""Time over which speeds of a position are taken [s], and the share of them that are no larger than the top speed of a
servo that reaches it."""
_LONGEST_S: Final = 0.25
"""Between readings whose difference is a speed [s]."""
_FIRST_STEPS, _STEPS, _SOME = 2, 30, 2
"""Steps of the descents that are compared and of the one that is continued; pieces of a flight for the first."""
_KEPT, _KEPT_ROWS = 16, 2_000_000
"""Servos whose errors and slopes are kept, of those that descents begin with or end at; and rows of them at most, which
take 256 MB: of two hours at 100 Hz sixteen would take 1.5 GB."""
_FAR: Final = 0.8
"""Share of the errors with which a descent began, below which it ended elsewhere, and noise is estimated again."""
_CLOSE: Final = 0.5
"""Misfit, of which one standard deviation of a number makes 1 or more, by which a step must improve."""
_LOOSER_DEG: Final = 0.6
"""Play from which another descent begins, beyond what was found [deg]."""
_NEAR, _SHARE = 4.0, 5e-4
"""A descent whose misfit is larger by no more, in terms of samples that are not alike, may be the right one as well;
and the share of a misfit that counts like one of these, for no servo of two poles is right to it."""
_MOST_PRIOR: Final = 0.9
"""Largest ratio of a fitted variance to that of the prior that is taken out of a value."""
_FOLD_S: Final = 20.0
"""Length of the stretches that belong to one fold in turn [s]."""
_LAG_FLOOR_S: Final = 0.003
"""Time by which the model may be early or late even in a perfect fit [s]."""
_LAG_CAP_S: Final = 0.03
"""The most of it that is believed [s]."""
_QUIET_DEG_S: Final = 5.0
"""Speed below which a servo is slow at least [deg/s]."""
_FAST_DEG_S: Final = 20.0
"""Speed above which its lateness shows [deg/s]."""
LEAST_DEG: Final = 0.01
"""Smallest noise [deg]."""
_SELDOM: Final = 0.001
"""Share of the samples beyond either end of the travel that was seen."""

_RATE: Final = NAMES.index("ln_rate")
_FASTER: Final = float(np.log(2.0))

_VALUES = np.array([prior.value for prior in PRIORS])
_SIGMAS = np.array([prior.sigma for prior in PRIORS])
WIDTHS: Final = {"deadband_deg": 1.0, "friction_deg": 2.0, "play_deg": 1.0}
"""How much of a change of direction each takes, in times its size."""
EACH_WIDTH = np.array([WIDTHS.get(name, 0.0) for name in NAMES])
_SIZES = [NAMES.index(name) for name in (*WIDTHS, "hinge_deg")]
"""Numbers that can stand for each other."""
_OTHER_POLES: Final = 0.03
"""Standard deviation of the logarithm of a bandwidth for poles that are not two: fitted to the three of an HS-225BB
they have one that is lower by 1 to 10 % (32 simulated flights, poles scaled by 0.8 to 1.2)."""
_THIRD_POLE: Final = 0.6
"""The most that a third pole adds to a delay, times the bandwidth: 0.41 for the poles of an HS-225BB, and up to 0.6 on
even seeds of `benchmarks/intervals.py calibrate`."""
_PARTS, _LASTING = 8, 5.0
"""Parts of the flights whose disagreement shows the model's own error, and by how much it is enlarged for what they
have in common: chosen there too."""
_LOWS, _HIGHS = np.array([prior.low for prior in PRIORS]), np.array([prior.high for prior in PRIORS])


def predicted(
    theta: FloatArray, record: Record, reach_deg: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How parameters predict a record: reading (m,) [deg], sensitivities (m, parameters), top speed (m,) [deg/s]."""
    position_deg, speed_deg_s = _moved(theta, record, reach_deg, slice(None))
    reading_deg, slopes = sensitivities(position_deg, speed_deg_s, theta, reach_deg)
    return reading_deg, slopes, peaks(speed_deg_s, record.time_s)


def reading(theta: FloatArray, record: Record, reach_deg: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Reading of one servo (m,) [deg], and its speeds (m, 2) [deg/s]."""
    position_deg, speed_deg_s = _moved(theta, record, reach_deg, slice(1))
    return position_deg[:, 0] + bent(position_deg[:, 0], theta, reach_deg)[0], speed_deg_s


def _moved(
    theta: FloatArray, record: Record, reach_deg: tuple[float, float], which: slice
) -> tuple[FloatArray, FloatArray]:
    """Positions (m, V) [deg] of some of the servo's variants, and speeds (m, 2) [deg/s]."""
    table = variants(theta, patterns=False, middle_deg=middle_of(reach_deg))[which]
    around = record.load, record.power, record.start_deg
    return simulated(table, new_state(table.shape[0]), record.commands, record.time_s, *around)


def peaks(speed_deg_s: FloatArray, time_s: FloatArray, memory: FloatArray | None = None) -> FloatArray:
    """Largest speed, or speed aimed at, until now, slowly forgotten; shape (m,) [deg/s].

    `memory` is carried on: the last of them, and its time.
    """
    memory = np.array([0.0, np.nan]) if memory is None else memory
    out = np.empty(time_s.size)
    _hold(np.abs(speed_deg_s).max(axis=1, initial=0.0), time_s, memory, out)
    return out


@compiled
def _hold(top: FloatArray, time_s: FloatArray, memory: FloatArray, out: FloatArray) -> None:
    for k in range(top.size):
        kept = memory[0] * np.exp(-(time_s[k] - memory[1]) / 0.15) if memory[1] == memory[1] else 0.0
        memory[0] = max(top[k], kept)
        memory[1] = time_s[k]
        out[k] = memory[0]


def bandwidth(theta: FloatArray) -> tuple[float, dict[str, float]]:
    """Logarithm of the -3 dB bandwidth of a servo (13,) [rad/s], and its slopes over those of frequency and damping.

    Of two poles, omega^2 / (s^2 + 2 zeta omega s + omega^2), it is omega sqrt(a + sqrt(a^2 + 1)), a = 1 - 2 zeta^2.
    """
    damped = 1.0 - 2.0 * float(np.exp(2.0 * theta[LN_DAMPING]))
    root = float(np.hypot(damped, 1.0))
    value = float(theta[LN_BANDWIDTH]) + 0.5 * float(np.log(damped + root))
    return value, {"ln_bandwidth": 1.0, "ln_damping": (damped - 1.0) / root}


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Parameters, noise, and how sure they are."""

    theta: FloatArray
    covariance: FloatArray
    noise: Noise
    reach_deg: tuple[float, float]
    held_out_deg: tuple[FloatArray, ...]
    """Of each record: reading of a servo fitted to the other folds (m,) [deg]."""
    held_out_rms_deg: float
    explained_share: float
    sigma_deg: FloatArray
    """Of the noise, in the usable samples of all records."""
    estimates: FloatArray
    """What the flights alone say of each parameter, and how sure that is; shape (13, 2)."""
    scatter: FloatArray
    """Covariance with what is not in the model, as parts of the flights disagree, shape (13, 13)."""

    @property
    def offset_deg(self) -> float:
        """Position at a command of 0 [deg]."""
        gain, bias_deg = self.theta[:2].tolist()
        return float(bias_deg + middle_of(self.reach_deg) * (1.0 - gain))

    @property
    def bandwidth_rad_s(self) -> Estimate:
        """Frequency at which the fitted servo's gain is 3 dB below that at rest [rad/s]."""
        value, slopes = bandwidth(self.theta)
        slope = np.array([slopes.get(name, 0.0) for name in NAMES])
        deviation = float(np.sqrt(slope @ self.scatter @ slope + _OTHER_POLES**2))
        return Estimate(*np.exp(Estimate.of(value, deviation)).tolist())

    @property
    def delay_s(self) -> Estimate:
        """Transport delay [s], or less: a third pole, which these servos have not, passes for a part of it."""
        value, low, high = Estimate.of(float(self.theta[DELAY]), float(np.sqrt(self.scatter[DELAY, DELAY])))
        by_pole_s = _THIRD_POLE / self.bandwidth_rad_s.value
        return Estimate(value, max(value - float(np.hypot(value - low, by_pole_s)), 0.0), high)


def fit(
    records: Sequence[Record],
    *,
    start: FloatArray | None = None,
    reach_deg: tuple[float, float] | None = None,
    is_alone: bool = False,
) -> Fit:
    """Fit one servo to records of it.

    It begins at `start` (13,); else some delays are tried. Alone, it may also begin at the top speed that the positions
    show; a largest speed that was calibrated so other flights may exceed. `reach_deg` are the deflections that it can
    take, those of the records if left out. Servos that move alike are tried as well if neither is given nor it is
    alone, freely and with what they differ in held: what play, friction and dead band are apart matters to whoever
    reads them, and to no verdict on the log they are fitted to.
    """
    flights = _Flights(records, reach_of(records) if reach_deg is None else reach_deg)
    begin = _delayed(records, flights.reach_deg, is_alone) if start is None else np.clip(start, _LOWS, _HIGHS)
    if is_alone:
        likely = begin, _as_fast_as_seen(begin, records)
        begin = min(likely, key=lambda theta: float(np.abs(flights.left(theta)[0]).mean()))
    if start is None or is_alone:  # another part of the log may have begun with a fault
        begin = minimum(flights.problem(_rough_sigma(flights, begin)), begin, steps=_STEPS, close=_CLOSE).x
    sigma = flights.sigma(begin)
    best = minimum(flights.problem(sigma), begin, steps=_STEPS, close=_CLOSE)
    if best.error.std() < _FAR * flights.left(begin)[0].std():  # what counts as noise where it began does not here
        sigma = flights.sigma(best.x)
        best = minimum(flights.problem(sigma), best.x, steps=_STEPS, close=_CLOSE)
    others = [] if is_alone or start is not None else _alike(begin)
    tried = [minimum(best.problem, each, steps=_STEPS, close=_CLOSE) for each in others]
    tried += [minimum(flights.problem(sigma, each), each, steps=_FIRST_STEPS, close=_CLOSE) for each in others]
    if (other := _best_of([best, *tried])) is not best:
        best = minimum(best.problem, other.x, steps=_STEPS, close=_CLOSE)
    return _finished(flights, best, tried)


def _delayed(records: Sequence[Record], reach_deg: tuple[float, float], is_alone: bool) -> FloatArray:
    """Where a descent begins of which nothing is known: near the delay that explains some of the records best."""
    some = _Flights(records[:: max(len(records) // _SOME, 1)], reach_deg)
    begins = [np.where(np.arange(_VALUES.size) == DELAY, delay_s, _VALUES) for delay_s in _DELAYS_S]
    problem = some.problem(_rough_sigma(some, begins[0]))
    tried = [minimum(problem, each, steps=_FIRST_STEPS, close=_CLOSE) for each in begins]
    if is_alone:
        likely = _as_fast_as_seen(begins[tried.index(_best_of(tried))], records)
        tried.append(minimum(problem, likely, steps=_FIRST_STEPS, close=_CLOSE))
    return _best_of(tried).x


def _as_fast_as_seen(theta: FloatArray, records: Sequence[Record]) -> FloatArray:
    """The same servo (13,) with the top speed of its positions: no slope leads to a speed that is never reached."""
    speeds = [_speeds(record) for record in records]
    fast = theta.copy()
    if sum(each.size for each in speeds):
        top_deg_s = float(np.quantile(np.concatenate(speeds), _FASTEST))
        fast[_RATE] = np.clip(np.log(max(top_deg_s, 1.0)), _LOWS[_RATE], _HIGHS[_RATE])
    return fast


def _speeds(record: Record) -> FloatArray:
    """Speeds of a position over `_SPEED_S` [deg/s]: in both halves of it, so that one reading that jumps makes none."""
    time_s, measured_deg = record.time_s[record.usable], record.measured_deg[record.usable]
    middle = np.searchsorted(time_s, time_s + 0.5 * _SPEED_S)
    middle = middle[middle < time_s.size]
    end = np.searchsorted(time_s, time_s[middle] + 0.5 * _SPEED_S)
    end = end[end < time_s.size]
    places = np.stack([np.arange(end.size), middle[: end.size], end])
    step_s, step_deg = np.diff(time_s[places], axis=0), np.diff(measured_deg[places], axis=0)
    known = (step_s < _LONGEST_S).all(axis=0)
    first, second = step_deg[:, known] / step_s[:, known]
    return np.where(first * second > 0.0, np.minimum(np.abs(first), np.abs(second)), 0.0)


def top_speed(record: Record, seconds: float) -> float:
    """Speed that a position exceeds for so long in all [deg/s]."""
    speeds = np.sort(_speeds(record))[::-1]
    place = int(np.ceil(seconds / record.period_s))
    return float(speeds[place]) if place < speeds.size else 0.0


def reach_of(records: Sequence[Record]) -> tuple[float, float]:
    """Deflections that some records show, but for one sample in a thousand on each side [deg]."""
    seen_deg = np.concatenate([r.measured_deg[r.usable] for r in records])
    return float(np.quantile(seen_deg, _SELDOM)), float(np.quantile(seen_deg, 1.0 - _SELDOM))


def residual(
    measured_deg: FloatArray, reading_deg: FloatArray, reach_deg: tuple[float, float]
) -> tuple[FloatArray, BoolArray]:
    """Position less prediction (m,) [deg], and where it depends on the prediction.

    Beyond the deflections that good flights showed, the surface may as well stay there: there may be a stop.

    Examples
    --------
    >>> residual(np.array([1.0, 20.5, 18.0]), np.array([0.5, 24.0, 24.0]), (-20.0, 20.0))
    (array([ 0.5,  0. , -2. ]), array([ True, False, False]))
    """
    lower, upper = np.minimum(reading_deg, reach_deg[1]), np.maximum(reading_deg, reach_deg[0])
    error = np.minimum(measured_deg - lower, 0.0) + np.maximum(measured_deg - upper, 0.0)
    inside: BoolArray = (lower == upper) | (error == measured_deg - reading_deg)
    return error, inside


def _alike(theta: FloatArray) -> list[FloatArray]:
    """Servos that move much like this one: dead band, friction and play in place of each other, air that turned."""
    dead, friction, play, pushed = theta[_SIZES]
    found = {
        (0.0, friction + 0.5 * dead, play, pushed),
        (dead + 2.0 * friction, 0.0, play, pushed),
        (dead, friction, play + _LOOSER_DEG, pushed),
        (dead, max(friction - 0.5 * _LOOSER_DEG, 0.0), play + _LOOSER_DEG, -pushed),
        (0.0, 0.0, play + dead + 2.0 * friction, pushed),
    } - {(dead, friction, play, pushed)}
    others = []
    for sizes in sorted(found):
        others.append(theta.copy())
        others[-1][_SIZES] = sizes
    return others


class _Flights:
    """Records that are fitted together, simulated as one; descents that follow each other begin where one ended."""

    def __init__(self, records: Sequence[Record], reach_deg: tuple[float, float]) -> None:
        self.records, self.whole, self.reach_deg = records, joined(records), reach_deg
        kept = min(_KEPT, _KEPT_ROWS // max(self.whole.time_s.size, 1))
        self._left = lru_cache(maxsize=kept)(self._left_by)
        self._slopes = lru_cache(maxsize=kept)(self._slopes_by)

    def left(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors [deg] and largest speeds [deg/s] in the usable rows of all records, shape (n,)."""
        return self._left(theta.tobytes())

    def slopes(self, theta: FloatArray) -> FloatArray:
        """Derivatives of the errors, shape (n, parameters)."""
        return self._slopes(theta.tobytes())

    def _left_by(self, theta: bytes) -> tuple[FloatArray, FloatArray]:
        with np.errstate(over="ignore", invalid="ignore"):  # a servo that runs away is none, and its misfit says so
            reading_deg, speed_deg_s = reading(np.frombuffer(theta), self.whole, self.reach_deg)
        error_deg = residual(self.whole.measured_deg, reading_deg, self.reach_deg)[0]
        speed_deg_s = peaks(speed_deg_s, self.whole.time_s)
        return error_deg[self.whole.usable], speed_deg_s[self.whole.usable]

    def _slopes_by(self, theta: bytes) -> FloatArray:
        with np.errstate(over="ignore", invalid="ignore"):
            reading_deg, slopes, _ = predicted(np.frombuffer(theta), self.whole, self.reach_deg)
        inside = residual(self.whole.measured_deg, reading_deg, self.reach_deg)[1]
        return (-slopes * inside[:, None])[self.whole.usable]

    def sigma(self, theta: FloatArray) -> FloatArray:
        """Standard deviation of the noise that a servo leaves, in the usable rows (n,) [deg]."""
        error, speed = self.left(theta)
        return _noise(error, speed, self.records).sigma_deg(speed)

    def problem(self, sigma: FloatArray, held: FloatArray | None = None) -> Problem:
        """The servo of these flights; of `held` (13,) it has dead band, friction, play and trim under load."""
        noise = Scatter(huber=_HUBER, sigma=sigma, is_known=True)
        low, high = _LOWS.copy(), _HIGHS.copy()
        if held is not None:
            low[_SIZES] = high[_SIZES] = held[_SIZES]
        return Problem(
            low, high, lambda theta: self.left(theta)[0], noise, 1.0 / _SIGMAS, _VALUES, derivatives=self.slopes
        )


def _rough_sigma(flights: _Flights, theta: FloatArray) -> FloatArray:
    """Standard deviation of each usable sample, as the errors of a servo that is only near tell it [deg]."""
    error, speed = flights.left(theta)
    spread = max(MAD_TO_SIGMA * float(np.median(np.abs(error - np.median(error)))), 0.03)
    return np.sqrt(spread**2 + (0.01 * speed) ** 2)


def _finished(flights: _Flights, best: Solution, others: Sequence[Solution]) -> Fit:
    """Noise and covariance of the best servo, beside some others, and what the folds left out say."""
    records, theta = flights.records, best.x
    error, speed = flights.left(theta)
    noise = _noise(error, speed, records)
    sigma, (first, second) = noise.sigma_deg(speed), noise.colour
    # How many samples of coloured noise tell as much as one of white noise.
    kappa = float(np.clip(noise.innovation**2 / (1.0 - first - second) ** 2, 1.0, 50.0))
    alike = kappa + _SHARE * best.misfit
    near = np.array([theta, *(each.x for each in others if each.misfit - best.misfit < _NEAR * alike)])
    # With the noise that it left, and a prior that is content with it.
    weighed = replace(best.problem.noise, sigma=sigma, kappa=np.array([kappa]))
    best = replace(best, problem=replace(best.problem, noise=weighed, centre=theta))
    fold = np.concatenate([(np.floor(r.time_s[r.usable] / _FOLD_S).astype(int) + k) % 2 for k, r in enumerate(records)])
    parts = [np.flatnonzero(fold == k) for k in (0, 1)]
    changes, left_deg, most_deg = best.changes(parts), best.error.copy(), 6.0 * sigma
    for part, change in zip(parts, changes, strict=True):
        left_deg[part] += best.slopes[part] @ change
    rms_deg = float(np.sqrt(np.mean(np.clip(left_deg, -most_deg, most_deg) ** 2)))
    covariance = best.covariance()
    unseen = _unseen_speed(best)
    covariance[_RATE, _RATE] = max(covariance[_RATE, _RATE], min(unseen, float(_SIGMAS[_RATE]) ** 2))
    apart = np.hypot(np.abs(near - theta).max(axis=0) / np.sqrt(2.0), 0.5 * (changes[0] - changes[1]))
    scatter = best.covariance(count=_PARTS, lasting=_LASTING, least=_LASTING)
    estimates = _unshrunk(theta, np.diag(covariance), alike / kappa, np.hypot(apart, np.sqrt(np.diag(scatter))))
    power = float(np.var(flights.whole.measured_deg[flights.whole.usable]))
    share = 1.0 - float(np.mean(left_deg**2)) / power if power > 0.0 else 0.0
    whole = np.full(flights.whole.time_s.size, np.nan)
    whole[flights.whole.usable] = left_deg
    held_out_deg = tuple(np.split(whole, np.cumsum([record.time_s.size for record in records])[:-1]))
    return Fit(theta, covariance, noise, flights.reach_deg, held_out_deg, rms_deg, share, sigma, estimates, scatter)


def _best_of(tried: Sequence[Solution]) -> Solution:
    return min(tried, key=lambda each: each.misfit)


def _unshrunk(theta: FloatArray, variance: FloatArray, wider: float, apart: FloatArray) -> FloatArray:
    """Values and standard deviations without what was known before.

    Variances of noise alone are so many times as wide for the model's own error; `apart` is what like fits and halves
    differ by.
    """
    share = np.minimum(variance / _SIGMAS**2, _MOST_PRIOR)
    value = np.clip(theta + (theta - _VALUES) * share / (1.0 - share), _LOWS, _HIGHS)
    return np.stack([value, np.hypot(np.sqrt(wider * variance / (1.0 - share)), apart)], axis=1)


def _unseen_speed(fitted: Solution) -> float:
    """Variance of the logarithm of the largest speed, by how much worse a faster servo explains the flights.

    Where they hardly reach that speed, its slope tells of a few moments only, and nothing of a servo that never does.
    """
    faster = fitted.x.copy()
    faster[_RATE] += _FASTER
    noise = fitted.problem.noise
    worse = noise.misfit(fitted.problem.residual(faster)) - noise.misfit(fitted.error)
    return _FASTER**2 / max(worse, 1e-9)


def _noise(error: FloatArray, speed: FloatArray, records: Sequence[Record]) -> Noise:
    """Noise that some errors (n,) [deg] of all records are, at some speeds (n,) [deg/s]."""
    slow = speed <= max(float(np.quantile(speed, 0.3)), _QUIET_DEG_S)
    still = max(MAD_TO_SIGMA * float(np.median(np.abs(error[slow]))), LEAST_DEG, _step_deg(records) / np.sqrt(12.0))
    fast = speed > _FAST_DEG_S
    lag = _LAG_FLOOR_S
    if np.count_nonzero(fast) > 30:
        lag = MAD_TO_SIGMA * float(np.median(np.sqrt(np.maximum(error[fast] ** 2 - still**2, 0.0)) / speed[fast]))
    lag = float(np.clip(lag, _LAG_FLOOR_S, _LAG_CAP_S))
    ratio = error / np.sqrt(still**2 + (lag * speed) ** 2)
    inflation = float(np.sqrt(np.mean(np.minimum(ratio**2, 9.0))))
    inflation = max(inflation, 0.7)
    scaled = np.clip(ratio / inflation, -3.0, 3.0)
    r0, r1, r2 = (float(scaled[late:] @ scaled[: scaled.size - late]) for late in range(3))
    first, second = _ar2(r1 / max(r0, 1e-12), r2 / max(r0, 1e-12))
    rho1, rho2 = first / (1.0 - second), first**2 / (1.0 - second) + second
    new = float(np.sqrt(max(1.0 - first * rho1 - second * rho2, 0.02)))
    still, lag = still * inflation, lag * inflation
    return Noise(still_deg=still, lag_s=lag, colour=(first, second), innovation=new, period_s=records[0].period_s)


def _ar2(rho1: float, rho2: float) -> tuple[float, float]:
    """Coefficients of an AR(2) process with these correlations, within what is stable."""
    rho1 = float(np.clip(rho1, -0.5, 0.97))
    rho2 = float(np.clip(rho2, max(2.0 * rho1**2 - 1.0 + 0.02, -0.5), 0.95))
    second = (rho2 - rho1**2) / (1.0 - rho1**2)
    second = float(np.clip(second, -0.5, 0.6))
    first = rho1 * (1.0 - second)
    return first, second


def _step_deg(records: Sequence[Record]) -> float:
    """Smallest step of the reading [deg]."""
    steps = []
    for record in records:
        size = np.abs(np.diff(record.measured_deg[record.usable]))
        size = size[size > 1e-9]
        if size.size:
            steps.append(float(np.quantile(size, 0.02)))
    return min(steps, default=0.0)

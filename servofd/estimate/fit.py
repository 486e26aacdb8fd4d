"""A servo of the family fitted to good flights, and the noise that it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.noise import Noise
from servofd.aircraft.priors import FITTED, NAMES, PRIORS
from servofd.core.statistics import MAD_TO_SIGMA, Estimate
from servofd.estimate.family import new_state, sensitivities, simulated, variants
from servofd.servo.loops import compiled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import BoolArray, FloatArray
    from servofd.estimate.record import Record

_HUBER: Final = 2.5
"""Standard deviations beyond which an error counts by its size, and not its square (Huber)."""
_DELAYS_S: Final = (0.01, 0.03, 0.06, 0.1)
"""Delays at which descents begin [s]: between them the cost may have another valley."""
_FIRST_STEPS, _STEPS = 4, 12
"""Steps of the descents that are compared, and of the one that is continued."""
_CLOSE: Final = 1e-3
"""Share of the cost that a step must gain for the descent to go on."""
_LOOSER_DEG: Final = 0.6
"""Play from which another descent begins, beyond what was found [deg]."""
_NEAR: Final = 2.0
"""A descent whose cost is larger by no more, in terms of samples that are not alike, may be the right one as well;
and no cost is known better than to the share at which a descent ends."""
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
_LEAST_DEG: Final = 0.01
"""Smallest noise [deg]."""
_SELDOM: Final = 0.001
"""Share of the samples beyond either end of the travel that was seen."""

_RATE: Final = NAMES.index("ln_rate")
_FASTER: Final = float(np.log(2.0))

_VALUES = np.array([prior.value for prior in PRIORS])
_SIGMAS = np.array([prior.sigma for prior in PRIORS])
WIDTHS: Final = {"deadband_deg": 1.0, "friction_deg": 2.0, "play_deg": 1.0}
"""How much of a change of direction each takes, in times its size."""
_WIDTHS = np.array([WIDTHS.get(name, 0.0) for name in NAMES])
_LN_BANDWIDTH, _LN_DAMPING = NAMES.index("ln_bandwidth"), NAMES.index("ln_damping")
_OTHER_POLES: Final = 0.03
"""Standard deviation of the logarithm of a bandwidth for poles that are not two: fitted to the three of an HS-225BB
they have one that is lower by 1 to 10 % (32 simulated flights, poles scaled by 0.8 to 1.2)."""
_NONE_HELD: Final = np.zeros(FITTED, dtype=bool)
_LOWS, _HIGHS = np.array([prior.low for prior in PRIORS]), np.array([prior.high for prior in PRIORS])


def predicted(
    theta: FloatArray, record: Record, reach_deg: tuple[float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How well parameters predict a record: reading (m,) [deg], sensitivities (m, 13), largest speed (m,) [deg/s]."""
    table = variants(theta, patterns=False)
    state = new_state(table.shape[0])
    position_deg, speed_deg_s = simulated(
        table, state, record.commands, record.time_s, record.load, record.power, record.start_deg
    )
    reading_deg, slopes = sensitivities(position_deg, speed_deg_s, theta, reach_deg)
    return reading_deg, slopes, peaks(speed_deg_s, record.time_s)


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


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Parameters, noise, and how sure they are."""

    theta: FloatArray
    covariance: FloatArray
    noise: Noise
    reach_deg: tuple[float, float]
    held_out_deg: tuple[FloatArray, ...]
    """Of each record: reading of a servo fitted to the other folds (m,) [deg]."""
    error_deg: tuple[FloatArray, ...]
    held_out_rms_deg: float
    explained_share: float
    usable: tuple[BoolArray, ...]
    sigma_deg: FloatArray
    """Of the noise, in the usable samples of all records."""
    estimates: FloatArray
    """What the flights alone say of each parameter, and how sure that is; shape (13, 2)."""
    halves: FloatArray
    """By how much the parameters of one half of the flights differ from those of the other, shape (13,)."""

    @property
    def bandwidth_rad_s(self) -> Estimate:
        """Frequency at which the fitted servo's gain is 3 dB below that at rest [rad/s].

        Of two poles, omega^2 / (s^2 + 2 zeta omega s + omega^2), it is omega sqrt(a + sqrt(a^2 + 1)), a = 1 - 2 zeta^2.
        """
        theta = self.theta[[_LN_BANDWIDTH, _LN_DAMPING]]
        damped = 1.0 - 2.0 * float(np.exp(2.0 * theta[1]))
        root = float(np.hypot(damped, 1.0))
        slope = np.array([1.0, (damped - 1.0) / root])  # of its logarithm, over those of omega and zeta
        pair = np.ix_([_LN_BANDWIDTH, _LN_DAMPING], [_LN_BANDWIDTH, _LN_DAMPING])
        apart = 0.5 * float(slope @ self.halves[[_LN_BANDWIDTH, _LN_DAMPING]])
        deviation = float(np.sqrt(slope @ self.covariance[pair] @ slope + apart**2 + _OTHER_POLES**2))
        value = float(theta[0]) + 0.5 * float(np.log(damped + root))
        return Estimate(*np.exp(Estimate.of(value, deviation)).tolist())


def fit(
    records: Sequence[Record], *, start: FloatArray | None = None, reach_deg: tuple[float, float] | None = None
) -> Fit:
    """Fit one servo to records of it.

    It begins at `start` (13,); else some delays are tried. `reach_deg` are the deflections that it can take, those of
    the records if left out.
    """
    reach_deg = reach_of(records) if reach_deg is None else reach_deg
    if start is not None:
        begun = np.clip(start, _LOWS, _HIGHS)
    else:
        is_delay = np.array([name == "delay_s" for name in NAMES])
        begins = [np.where(is_delay, delay_s, _VALUES) for delay_s in _DELAYS_S]
        tried = [_descended(records, begin, _NONE_HELD, reach_deg, _FIRST_STEPS) for begin in begins]
        begun = min(tried, key=lambda each: each[1])[0]
    theta, _ = _descended(records, begun, _NONE_HELD, reach_deg, _STEPS)
    errors, _, speeds = _evaluated(records, theta, reach_deg)
    sigma = _noise(errors, speeds, records).sigma_deg(np.concatenate(speeds))
    again = [theta, begun] if start is not None else [theta, *_alike(theta)]
    return _finished(
        records, [_descended(records, each, _NONE_HELD, reach_deg, _STEPS, sigma) for each in again], reach_deg
    )


def reach_of(records: Sequence[Record]) -> tuple[float, float]:
    """Deflections that some records show, but for one sample in a thousand on each side [deg]."""
    seen_deg = np.concatenate([r.measured_deg[r.usable] for r in records])
    return float(np.quantile(seen_deg, _SELDOM)), float(np.quantile(seen_deg, 1.0 - _SELDOM))


def worse_without(fitted: Fit, records: Sequence[Record], effects: Sequence[str]) -> float:
    """By how many times a servo without some effects, fitted to the same records, predicts unseen data worse.

    Dead band, friction and play that are left may take over the width of those that are not.
    """
    held = np.array([name in effects for name in NAMES])
    width_deg = float((_WIDTHS * fitted.theta)[held].sum())
    begins = [np.where(held, 0.0, fitted.theta)]
    for place in np.flatnonzero((_WIDTHS > 0.0) & ~held) if width_deg > 0.0 else ():
        begins.append(begins[0].copy())
        begins[-1][place] += width_deg / _WIDTHS[place]
    tried = [_descended(records, each, held, fitted.reach_deg, _FIRST_STEPS, fitted.sigma_deg) for each in begins]
    theta = min(tried, key=lambda each: each[1])[0]
    errors, slopes, speeds = _evaluated(records, theta, fitted.reach_deg)
    noise = _noise(errors, speeds, records)
    sigma = noise.sigma_deg(np.concatenate(speeds))
    left = _left_out(records, np.concatenate(errors), np.concatenate(slopes), sigma, noise, ~held)
    return left.rms_deg / fitted.held_out_rms_deg


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
    """Servos that move much like this one: dead band, friction and play in place of each other."""
    dead, friction, play = (NAMES.index(name) for name in ("deadband_deg", "friction_deg", "play_deg"))
    out = []
    for width, rub, loose in (
        (0.0, theta[friction] + 0.5 * theta[dead], theta[play]),
        (theta[dead] + 2.0 * theta[friction], 0.0, theta[play]),
        (theta[dead], theta[friction], theta[play] + _LOOSER_DEG),
        (0.0, 0.0, theta[play] + theta[dead] + 2.0 * theta[friction]),
    ):
        other = theta.copy()
        other[[dead, friction, play]] = width, rub, loose
        out.append(other)
    return out


def _evaluated(
    records: Sequence[Record], theta: FloatArray, reach_deg: tuple[float, float]
) -> tuple[list[FloatArray], list[FloatArray], list[FloatArray]]:
    """Errors, sensitivities and largest speeds of each record, in usable rows."""
    errors, slopes, speeds = [], [], []
    for record in records:
        with np.errstate(over="ignore", invalid="ignore"):  # a servo that runs away is none, and its cost says so
            reading_deg, slope, speed = predicted(theta, record, reach_deg)
            error, inside = residual(record.measured_deg, reading_deg, reach_deg)
            slopes.append((slope * inside[:, None])[record.usable])
        errors.append(error[record.usable])
        speeds.append(speed[record.usable])
    return errors, slopes, speeds


def _descended(
    records: Sequence[Record], theta: FloatArray, held: BoolArray, reach_deg: tuple[float, float], steps: int,
    sigma: FloatArray | None = None,
) -> tuple[FloatArray, float]:  # fmt: skip
    """Levenberg-Marquardt on Huber's loss with a ridge to the prior; parameters and their cost.

    Without `sigma` (of each usable sample) the errors of the first parameters tell it.
    """
    damping, best, known = 1e-2, np.inf, theta
    normal: tuple[FloatArray, FloatArray] | None = None
    for _ in range(steps + 1):
        errors, slopes, speeds = _evaluated(records, theta, reach_deg)
        error, slope, speed = np.concatenate(errors), np.concatenate(slopes), np.concatenate(speeds)
        if sigma is None:
            spread = max(MAD_TO_SIGMA * float(np.median(np.abs(error - np.median(error)))), 0.03)
            sigma = np.sqrt(spread**2 + (0.01 * speed) ** 2)
        ratio = np.abs(error) / sigma
        apart = (theta - _VALUES) / _SIGMAS
        cost = float(_huber(ratio).sum()) + 0.5 * float((apart[~held] ** 2).sum())
        if cost < best:
            gained = best - cost
            best, known = cost, theta
            weight = _weight(error, sigma)
            curvature = (slope * weight[:, None]).T @ slope + np.diag(_SIGMAS**-2.0)
            pull = slope.T @ (weight * error) - apart / _SIGMAS
            normal = curvature, pull
            damping = max(damping / 5.0, 1e-6)
            if gained < _CLOSE * max(best, 1.0):
                break
        else:
            damping *= 8.0
        curvature, pull = normal if normal is not None else (np.eye(FITTED), np.zeros(FITTED))
        theta = _stepped(known, curvature, pull, held, damping)
    return known, best


def _stepped(theta: FloatArray, curvature: FloatArray, pull: FloatArray, held: BoolArray, damping: float) -> FloatArray:
    """One damped step that stays within the bounds; parameters at a bound that would pass it are held there."""
    still = held.copy()
    for _ in range(4):
        free = ~still
        block = curvature[np.ix_(free, free)]
        block = block + damping * np.diag(np.diag(block))
        step = np.zeros(FITTED)
        step[free] = np.linalg.solve(block, pull[free])
        step = np.clip(step, -2.0 * _SIGMAS, 2.0 * _SIGMAS)
        outside = (~still) & (((theta <= _LOWS) & (step < 0.0)) | ((theta >= _HIGHS) & (step > 0.0)))
        if not outside.any():
            break
        still |= outside
    return np.where(held, theta, np.clip(theta + step, _LOWS, _HIGHS))


def _finished(
    records: Sequence[Record], tried: Sequence[tuple[FloatArray, float]], reach_deg: tuple[float, float]
) -> Fit:
    """Noise and covariance of the best of some descents, and what the folds left out say."""
    theta, cost = min(tried, key=lambda each: each[1])
    errors, slopes, speeds = _evaluated(records, theta, reach_deg)
    error, slope = np.concatenate(errors), np.concatenate(slopes)
    noise = _noise(errors, speeds, records)
    sigma = noise.sigma_deg(np.concatenate(speeds))
    left = _left_out(records, error, slope, sigma, noise, ~_NONE_HELD)
    lengthened = _colour_length(noise)
    curvature = (slope * (_weight(error, sigma) / lengthened)[:, None]).T @ slope + np.diag(_SIGMAS**-2.0)
    covariance = np.asarray(np.linalg.inv(curvature), dtype=np.float64)
    unseen = lengthened * _unseen_speed(records, theta, reach_deg, error, sigma)
    covariance[_RATE, _RATE] = max(covariance[_RATE, _RATE], min(unseen, float(_SIGMAS[_RATE]) ** 2))
    near = np.array([each for each, its in tried if its - cost < _NEAR * lengthened + _CLOSE * cost])
    other = np.abs(near - theta).max(axis=0) / np.sqrt(2.0)  # two servos that are equally likely, about one of them
    apart: FloatArray = np.hypot(other, 0.5 * (left.changes[0] - left.changes[1]))
    cuts = np.cumsum([e.size for e in errors])[:-1]
    power = float(np.var(np.concatenate([r.measured_deg[r.usable] for r in records])))
    share = 1.0 - float(np.mean(left.error_deg**2)) / power if power > 0.0 else 0.0
    whole = []
    for part, record in zip(np.split(left.error_deg, cuts), records, strict=True):
        full = np.full(record.time_s.size, np.nan)
        full[record.usable] = part
        whole.append(full)
    return Fit(
        theta, covariance, noise, reach_deg, tuple(whole), tuple(errors), left.rms_deg, share,
        tuple(r.usable for r in records), sigma, _unshrunk(theta, np.diag(covariance), apart),
        left.changes[0] - left.changes[1],
    )  # fmt: skip


class _LeftOut(NamedTuple):
    """What a servo that was fitted to every other fold leaves."""

    error_deg: FloatArray
    changes: FloatArray
    """Of the parameters, from all records to each half of them; shape (2, 13)."""
    rms_deg: float


def _left_out(
    records: Sequence[Record], error: FloatArray, slope: FloatArray, sigma: FloatArray, noise: Noise, free: BoolArray
) -> _LeftOut:
    weight = _weight(error, sigma) / _colour_length(noise)
    fold = np.concatenate([(np.floor(r.time_s[r.usable] / _FOLD_S).astype(int) + k) % 2 for k, r in enumerate(records)])
    ridge = np.diag(_SIGMAS[free] ** -2.0)
    left, changes = np.zeros(error.size), np.zeros((2, FITTED))
    folds = [np.flatnonzero(fold == k) for k in (0, 1)]
    for place, (mine, other) in enumerate((folds, folds[::-1])):
        weighted = slope[np.ix_(other, free)] * weight[other, None]
        change = np.linalg.solve(weighted.T @ slope[np.ix_(other, free)] + ridge, weighted.T @ error[other])
        left[mine] = error[mine] - slope[np.ix_(mine, free)] @ change
        changes[place, free] = change
    return _LeftOut(left, changes, float(np.sqrt(np.mean(np.clip(left, -6.0 * sigma, 6.0 * sigma) ** 2))))


def _unshrunk(theta: FloatArray, variance: FloatArray, apart: FloatArray) -> FloatArray:
    """Values and standard deviations without what was known before; `apart` is what like fits and halves differ by."""
    share = np.minimum(variance / _SIGMAS**2, _MOST_PRIOR)
    value = np.clip(theta + (theta - _VALUES) * share / (1.0 - share), _LOWS, _HIGHS)
    return np.stack([value, np.hypot(np.sqrt(variance / (1.0 - share)), apart)], axis=1)


def _weight(error: FloatArray, sigma: FloatArray) -> FloatArray:
    """Weight of each error, less for those that are out of the ordinary."""
    return np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(error), 1e-12)) / sigma**2


def _unseen_speed(
    records: Sequence[Record], theta: FloatArray, reach_deg: tuple[float, float], error: FloatArray, sigma: FloatArray
) -> float:
    """Variance of the logarithm of the largest speed, by how much worse a faster servo explains the flights.

    Where they hardly reach that speed, its slope tells of a few moments only, and nothing of a servo that never does.
    """
    faster = theta.copy()
    faster[_RATE] += _FASTER
    errors, _, _ = _evaluated(records, faster, reach_deg)
    worse = float((_huber(np.abs(np.concatenate(errors)) / sigma) - _huber(np.abs(error) / sigma)).sum())
    return 0.5 * _FASTER**2 / max(worse, 1e-9)


def _huber(ratio: FloatArray) -> FloatArray:
    return np.where(ratio < _HUBER, 0.5 * ratio**2, _HUBER * (ratio - 0.5 * _HUBER))


def _colour_length(noise: Noise) -> float:
    """How many samples of coloured noise tell as much as one of white noise."""
    first, second = noise.colour
    return float(np.clip(noise.innovation**2 / (1.0 - first - second) ** 2, 1.0, 50.0))


def _noise(errors: Sequence[FloatArray], speeds: Sequence[FloatArray], records: Sequence[Record]) -> Noise:
    error, speed = np.concatenate(errors), np.concatenate(speeds)
    slow = speed <= max(float(np.quantile(speed, 0.3)), _QUIET_DEG_S)
    still = max(MAD_TO_SIGMA * float(np.median(np.abs(error[slow]))), _LEAST_DEG, _step_deg(records) / np.sqrt(12.0))
    fast = speed > _FAST_DEG_S
    lag = _LAG_FLOOR_S
    if np.count_nonzero(fast) > 30:
        lag = MAD_TO_SIGMA * float(np.median(np.sqrt(np.maximum(error[fast] ** 2 - still**2, 0.0)) / speed[fast]))
    lag = float(np.clip(lag, _LAG_FLOOR_S, _LAG_CAP_S))
    ratio = error / np.sqrt(still**2 + (lag * speed) ** 2)
    inflation = float(np.sqrt(np.mean(np.minimum(ratio**2, 9.0))))
    inflation = max(inflation, 0.7)
    scaled = [
        np.clip(e / (inflation * np.sqrt(still**2 + (lag * v) ** 2)), -3.0, 3.0)
        for e, v in zip(errors, speeds, strict=True)
    ]
    r0 = sum(float(s @ s) for s in scaled)
    r1 = sum(float(s[1:] @ s[:-1]) for s in scaled)
    r2 = sum(float(s[2:] @ s[:-2]) for s in scaled)
    first, second = _ar2(r1 / max(r0, 1e-12), r2 / max(r0, 1e-12))
    rho1, rho2 = first / (1.0 - second), first**2 / (1.0 - second) + second
    new = float(np.sqrt(max(1.0 - first * rho1 - second * rho2, 0.02)))
    return Noise(still * inflation, lag * inflation, (first, second), new, records[0].period_s)


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

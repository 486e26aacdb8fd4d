"""The verdict on a surface whose servo was fitted to good flights.

An alarm is raised where a statistic stays above its threshold twice in a row or passes it by far, or three residuals in
a row on one side pass theirs. Each fault is refitted to what the surface did since, the other parameters free as they
are between flights; the tests begin anew where it ended.

A hypothesis is a servo of the family with one thing changed, or no servo at all. Its misfit is what of the whitened
residual no allowed change of the other parameters explains; the best size is found on a grid and refined by the linear
estimate around it. The family is not the servo: where even the best hypothesis leaves more than the noise, that is
taken for noise of unknown size (n ln misfit), and every other sample counts. Probabilities follow from this, from how
far the other parameters had to go, and from the number of free sizes (BIC).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.priors import FITTED, NAMES, PRIORS
from servofd.aircraft.series import Series
from servofd.core.statistics import Estimate
from servofd.detection.changes import (
    STATISTICS,
    Memory,
    exceeded,
    follow,
    thresholds_of,
    watched,
)
from servofd.detection.residual import Residuals
from servofd.detection.verdict import WORTH_TELLING, Fault
from servofd.estimate.family import new_state, sensitivities, simulated, variants
from servofd.estimate.fit import residual
from servofd.estimate.record import Record

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.changes import Watched
    from servofd.detection.residual import Commands
    from servofd.detection.verdict import Fault

_WINDOW_S, _SHORTEST_WINDOW_S = 20.0, 5.0
_SETTLING_S: Final = 0.5
_LEAD_S: Final = 1.0
_BEFORE_S: Final = 62.0
_LATELY_S: Final = 1.5
_FEWEST: Final = 12
_COUNTED: Final = 0.5
_ALARMED: Final = 3.0
"""Logarithm of how much less likely a good servo is to be looked at than a faulty one: an alarm was raised."""
_SCALES = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.93)
_SPEEDS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_FINER = 0.35
"""By so much, in the logarithm, a speed may be from the nearest of them: half of the largest ratio of two."""
_WIDTHS_DEG = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0)
_LEAST_LOSS: Final = 0.95
_FLAT = 1e-8
_LOST_GAIN = 0.12
_AT_STOP_DEG = 1.5
_RAN_DEG = 2.0
"""What stays at an end of the travel ran there if it was further away, and else stopped there."""
_SURE = 0.3
LOUD: Final = 1.5
"""A good servo that passes its thresholds by so much is none."""
_TWINS: Final = (
    ("stuck", "floating", 0.1),
    ("floating", "stuck", 0.3),
    ("bias", "deadband", 0.25),
    ("loss_of_effectiveness", "deadband", 0.1),
)
"""Faults that look like others: a geared servo without power stays where it is, air pushes play to one side, or back by
more the further the surface is out."""
_FLYING: Final = 0.1
_WIDEST_PLAY_DEG: Final = 8.0
_USUAL_WIDTH_DEG: Final = 2.0
"""Wider play is rarer, by e for each of these: a surface that never moved is stuck, not loose by all that was asked."""
_USUAL_BIAS_DEG: Final = 3.0
_MOVING, _MOVING_DEG = 3.0, 0.3
"""A surface that moves by so many sigma of the reading, and so much, is not stuck."""
_AT_REST: Final = 6
"""So many readings in a row that stay where they are come to rest, after motion."""
_LOOSE: Final = 0.3
_LEAST_STILL_DEG: Final = 0.05
_STRANGE, _UNEXPLAINED = 2.0, 0.55
"""Misfit for each sample, and the share of what a good servo does not do, that no hypothesis may leave."""
_NOTHING: Final = 0.1
"""A hypothesis that explains less of that is no name, however loud the alarm: readings that jump at random."""
_ENDED = 1.0
"""Seconds of one standard deviation by which the healthy servo must explain better what comes after an end."""
_AFTER_END_S = 1.5
_ELSEWHERE: Final = 9.0
"""Misfit of a sample that neither the fault nor the healthy servo explains: the fault does what no hypothesis says."""
_SURELY_ENDED, _SOON_S = 5.0, 0.5
"""So much better it need do for no longer than this."""
_LOG_CLIP = 25.0
_SWINGS = 1.5
"""Standard deviations that an oscillation is taken to leave."""
_NO_NEWS = 0.01
"""By so little a fault may explain a sample better, and yet not have begun."""


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    """What one hypothesis makes of the window."""

    kind: str
    cost: tuple[float, float]
    """Misfit, and how far the other parameters had to go."""
    freedom: int
    parameters: dict[str, Estimate] = field(default_factory=dict)
    theta: FloatArray | None = None
    power: float = 0.0
    added: tuple[str, FloatArray] | None = None
    place: int | None = None
    """Of the parameter that was changed, where its size is an estimate around the value tried."""
    behind: bool = False
    """Whether a named servo lost its travel behind its play, and not before it."""


class _Window:
    """Samples of a stretch, and what servos of the family do there."""

    def __init__(self, watched: Watched, from_s: float, to_s: float) -> None:
        record, known = watched.record, watched.known
        first, last = np.searchsorted(record.time_s, (from_s - _LEAD_S, to_s))
        self.rows = slice(int(first), int(last))
        self.time_s = record.time_s[self.rows]
        self.measured_deg = record.measured_deg[self.rows]
        self.used: BoolArray = watched.judged[self.rows] & (self.time_s >= from_s)
        self.sigma_deg = watched.noise_deg[self.rows]
        self.total_deg = watched.sigma_deg[self.rows]
        self.record, self.known, self.theta = record, known, known.theta
        self.own, self.ends_deg = watched.own, watched.ends_deg
        self.precision = np.linalg.inv(known.covariance)
        self.noise = watched.noise
        start_deg = record.start_deg[self.rows].copy()
        good = np.flatnonzero(np.isfinite(self.measured_deg))
        if good.size and not np.isfinite(start_deg[0]):
            start_deg[0] = self.measured_deg[good[0]]
        self.start_deg = start_deg

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.used))

    def reading(self, theta: FloatArray, power: float = 0.0, *, behind: bool = False) -> tuple[FloatArray, FloatArray]:
        """Reading and sensitivities of a servo, shapes (m,) and (m, 13)."""
        table = variants(theta, patterns=False)
        table[:, FITTED] = power
        record = self.record
        position_deg, speed_deg_s = simulated(
            table, new_state(table.shape[0]), record.commands, self.time_s, record.load[self.rows],
            record.power[self.rows], self.start_deg,
        )  # fmt: skip
        reading_deg, slopes = sensitivities(position_deg, speed_deg_s, theta, self.known.reach_deg)
        if self.own is not None and self.time_s.size:
            reading_deg = self.own(theta, self.rows, float(np.nan_to_num(self.start_deg[0])), behind=behind)
        return reading_deg, slopes

    def slope(
        self, theta: FloatArray, place: int, reading_deg: FloatArray, slopes: FloatArray, *, behind: bool
    ) -> FloatArray:
        """What a unit of one parameter adds to a reading, shape (m, 1)."""
        if self.own is None or not self.time_s.size:
            return slopes[:, [place]]
        other, step = theta.copy(), PRIORS[place].step
        other[place] += step
        start_deg = float(np.nan_to_num(self.start_deg[0]))
        return ((self.own(other, self.rows, start_deg, behind=behind) - reading_deg) / step)[:, None]

    def whitened(self, values: FloatArray) -> FloatArray:
        """Rows over the noise's sigma, without its colour; shape (k, ...) of used rows."""
        scaled = values[self.used] / (self.sigma_deg[self.used, None] if values.ndim > 1 else self.sigma_deg[self.used])
        first, second = self.noise.colour
        out: FloatArray = (scaled[2:] - first * scaled[1:-1] - second * scaled[:-2]) / self.noise.innovation
        return out

    def reduced(
        self, error_deg: FloatArray, slopes: FloatArray, free: FloatArray | None = None
    ) -> tuple[tuple[float, float], FloatArray, FloatArray]:
        """Costs of an error once parameters (and free columns) have done their best; these, and their covariance.

        The costs are its misfit, and how far the parameters had to go for it: sums of squares over their variances.
        """
        columns = slopes if free is None else np.concatenate([slopes, free], axis=1)
        precision = np.full(columns.shape[1], _FLAT)
        w, e = self.whitened(columns), self.whitened(error_deg)
        block = w.T @ w
        block[:FITTED, :FITTED] += self.precision
        block[np.diag_indices(columns.shape[1])] += np.where(np.arange(columns.shape[1]) < FITTED, 0.0, precision)
        covariance: FloatArray = np.asarray(np.linalg.inv(block), dtype=np.float64)
        best = covariance @ (w.T @ e)
        apart = best[:FITTED]
        left = e - w @ best
        return (float(left @ left), float(apart @ self.precision @ apart)), best, covariance


class Named(NamedTuple):
    """Hypotheses fitted to a window, the best one first."""

    known: int
    """How many samples there were when they were."""
    window: _Window
    guesses: list[_Guess]


_GROWN: Final = 1.3
"""A window that has grown by less since its hypotheses were fitted tells no more."""


def named(
    watched: Watched, alarm_s: float, ratio: float, *, earliest_s: float, names: dict[float, Named]
) -> tuple[Fault, _Guess | None]:
    """Name what an alarm stands for, `healthy` if a working servo explains it after all; and the hypothesis behind it.

    `ratio` is the largest statistic over its threshold at or after the alarm; `names` holds what was fitted to alarms
    when less was known of them, and is kept up to date.
    """
    window = _Window(watched, alarm_s + _SETTLING_S, alarm_s + _WINDOW_S)
    if window.count < max(_FEWEST, 1.5 / watched.record.period_s):
        # An alarm of a moment ago: since the healthy servo was last right, if that is enough.
        from_s = max(alarm_s - _LATELY_S, earliest_s)
        lately = slice(*np.searchsorted(watched.record.time_s, (from_s, alarm_s)).tolist())
        window = _Window(watched, from_s, alarm_s + _WINDOW_S)
        right = np.flatnonzero(np.abs(watched.error_deg[lately]) < watched.sigma_deg[lately])
        if right.size:
            since = _Window(watched, float(watched.record.time_s[lately][right[-1]]) + 1e-9, alarm_s + _WINDOW_S)
            window = since if since.count >= _FEWEST else window
    if window.count < _FEWEST:
        return Fault("unknown", alarm_s, alarm_s, None, {}, 0.5, ()), None
    before, count = names.get(alarm_s), window.count
    if before is not None and (
        count < _GROWN * before.known or _end_s(watched, before.guesses[0], alarm_s) is not None
    ):
        _, window, guesses = before
    else:
        window, guesses = _explained(watched, window, alarm_s)
        names[alarm_s] = Named(count, window, guesses)
    end_s = _end_s(watched, guesses[0], alarm_s)
    if end_s is not None and alarm_s + 1.5 < end_s < alarm_s + _WINDOW_S - 2.0:
        settling_s = min(_SETTLING_S, 0.2 * (end_s - alarm_s))
        shorter = _Window(watched, alarm_s + settling_s, end_s - settling_s)
        if shorter.count >= _FEWEST:
            window, guesses = shorter, _ranked(shorter)
            end_s = _end_s(watched, guesses[0], alarm_s)
    kind, probability, alternatives, parameters = _verdict(window, guesses, ratio)
    # It began when the fault became the better explanation.
    time_s, healthy, other = _misfits(watched, guesses[0], max(alarm_s - _BEFORE_S, earliest_s), alarm_s + 1.0)
    better = np.cumsum((healthy - other - _NO_NEWS)[::-1])[::-1]
    began = time_s.size > 0 and better.max() > 0.0
    start_s = float(min(time_s[int(np.argmax(better))], alarm_s)) if began else alarm_s
    if kind == "hardover":
        there = min(int(np.searchsorted(watched.record.time_s, start_s)), watched.reading_deg.size - 1)
        if abs(watched.reading_deg[there] - parameters["position_deg"].value) < _RAN_DEG:  # it stopped where it was
            kind, alternatives = "stuck", ("hardover", *(other for other in alternatives if other != "stuck"))
    fault = Fault(
        kind, start_s, alarm_s, end_s, parameters, probability, alternatives,
        named_s=float(min(window.time_s[-1], alarm_s + _WINDOW_S)),
    )  # fmt: skip
    return fault, guesses[0]


def _explained(watched: Watched, window: _Window, alarm_s: float) -> tuple[_Window, list[_Guess]]:
    """The window, shorter by halves where it holds the end of a fault, so that no hypothesis explains it."""
    guesses = _ranked(window)
    length_s = _WINDOW_S
    while _is_strange(window, guesses) and length_s > _SHORTEST_WINDOW_S:
        length_s *= 0.5
        shorter = _Window(watched, alarm_s + _SETTLING_S, alarm_s + length_s)
        if shorter.count < _FEWEST:
            break
        tried = _ranked(shorter)
        if not _is_strange(shorter, tried):
            return shorter, tried
    return window, guesses


def _is_strange(window: _Window, guesses: list[_Guess]) -> bool:
    """Whether even the best hypothesis leaves much, and most of what a good servo does not do."""
    best = guesses[0]
    healthy = next(guess for guess in guesses if guess.kind == "healthy")
    excess, gained = sum(healthy.cost) - window.count, sum(healthy.cost) - sum(best.cost)
    is_much = best.cost[0] > _STRANGE * window.count
    return best.kind != "healthy" and is_much and gained < (1.0 - _UNEXPLAINED) * excess


def _ranked(window: _Window) -> list[_Guess]:
    """The best guess of each kind, the likeliest first."""
    best: dict[str, _Guess] = {}
    guesses = sorted(_guesses(window), key=lambda each: _score(window, each))
    first = guesses[0]
    if first.place is not None and first.theta is not None:  # its size was estimated from another one: once more
        size = dict.fromkeys(first.parameters, (1.0 if first.kind == "deadband" else window.theta[first.place], 0.0))
        again = _sized(window, first.kind, first.theta, first.place, size, behind=first.behind)
        guesses = [again if _score(window, again) < _score(window, first) else first, *guesses[1:]]
    for guess in guesses:
        best.setdefault(guess.kind, guess)
    return list(best.values())


def _score(window: _Window, guess: _Guess) -> float:
    """Minus the logarithm of how likely it is."""
    counted = max(_COUNTED * window.count, 2.0)
    misfit, apart = guess.cost
    doubt = _ALARMED if guess.kind == "healthy" else 0.0
    if guess.kind == "deadband":
        doubt = guess.parameters["width_deg"].value / _USUAL_WIDTH_DEG
    if guess.kind == "bias":
        doubt = abs(guess.parameters["bias_deg"].value) / _USUAL_BIAS_DEG
    each = max(misfit / max(window.count - 2, 1), 1.0)
    return 0.5 * (counted * float(np.log(each)) + apart) + 0.5 * guess.freedom * float(np.log(counted)) + doubt


def _guesses(window: _Window) -> Iterator[_Guess]:
    theta = window.theta
    nominal_deg, slopes = window.reading(theta)
    error_deg, _ = residual(window.measured_deg, nominal_deg, window.known.reach_deg)
    cost, _, _ = window.reduced(error_deg, slopes)
    yield _Guess("healthy", cost, 0, theta=theta)
    one = np.ones((error_deg.size, 1))
    cost, best, covariance = window.reduced(error_deg, slopes, one)
    bias = Estimate.of(best[FITTED], float(np.sqrt(covariance[FITTED, FITTED])))
    yield _Guess("bias", cost, 1, {"bias_deg": bias}, _with(theta, bias_deg=theta[1] + best[FITTED]))
    for scale in _SCALES:
        lost = _with(theta, gain=theta[0] * scale)
        for behind in (False, True) if window.own is not None else (False,):
            yield _sized(window, "loss_of_effectiveness", lost, 0, {"gain": (theta[0], 0.0)}, behind=behind)
    for speed in _SPEEDS:
        share, less = {"bandwidth_scale": (speed, 0.1 * speed)}, float(np.log(speed))
        yield _sized(window, "slow", theta, None, share, less)
        slower = _with(theta, ln_bandwidth=theta[3] + less, ln_rate=theta[5] + less)
        yield _sized(window, "slow", slower, None, share)
    yield from _rate_limited(window)
    for width in _WIDTHS_DEG:
        for name in ("deadband_deg", "play_deg"):
            place = NAMES.index(name)
            yield _sized(
                window, "deadband", _with(theta, **{name: theta[place] + width}), place, {"width_deg": (1.0, 0.0)}
            )
        if width <= 4.0:
            sticking = _with(theta, friction_deg=theta[NAMES.index("friction_deg")] + 0.5 * width)
            yield _sized(window, "deadband", sticking, None, {"width_deg": (width, 0.25 * width)})
    yield from _oscillating(window, error_deg, slopes)
    yield from _immobile(window)


def _with(theta: FloatArray, **changes: float) -> FloatArray:
    """The same servo with some parameters changed, by their names."""
    changed = theta.copy()
    changed[[NAMES.index(name) for name in changes]] = list(changes.values())
    return changed


def _sized(
    window: _Window, kind: str, theta: FloatArray, place: int | None, size: dict[str, tuple[float, float]],
    power: float = 0.0, *, behind: bool = False,
) -> _Guess:  # fmt: skip
    """A servo with one parameter changed; that one is free around its new value."""
    reading_deg, slopes = window.reading(theta, power, behind=behind)
    error_deg, _ = residual(window.measured_deg, reading_deg, window.known.reach_deg)
    name, (reference, spread) = next(iter(size.items()))
    if place is None:
        cost, _, _ = window.reduced(error_deg, slopes)
        return _Guess(kind, cost, 1, {name: Estimate.of(reference, spread)}, theta, power)
    cost, best, covariance = window.reduced(
        error_deg, slopes, window.slope(theta, place, reading_deg, slopes, behind=behind)
    )
    moved = theta.copy()
    allowed = 0.35 * abs(theta[place]) + 0.3 * (kind == "deadband")
    change = float(np.clip(best[FITTED], -allowed, allowed))
    moved[place] += change
    if change != best[FITTED]:
        cost, *_ = window.reduced(error_deg - change * slopes[:, place], slopes)
    if kind == "loss_of_effectiveness" and moved[place] > _LEAST_LOSS * window.theta[place]:
        moved = theta
        cost, *_ = window.reduced(error_deg, slopes)
    deviation = float(np.sqrt(covariance[FITTED, FITTED]))
    if kind == "deadband":
        value = moved[place] - window.theta[place]
        return _Guess(kind, cost, 1, {name: Estimate.of(max(value, 0.0), deviation)}, moved, place=place)
    estimate = Estimate.of(moved[place] / reference, deviation / abs(reference))
    return _Guess(kind, cost, 1, {name: estimate}, moved, place=place, behind=behind)


def _rate_limited(window: _Window) -> Iterator[_Guess]:
    """A servo that is as quick as ever in small motion, and turns no faster than so much."""
    place = NAMES.index("ln_rate")
    nominal = window.theta[place]
    for speed in _SPEEDS:
        limited = _with(window.theta, ln_rate=nominal + float(np.log(speed)))
        reading_deg, slopes = window.reading(limited)
        error_deg, _ = residual(window.measured_deg, reading_deg, window.known.reach_deg)
        _, best, _ = window.reduced(error_deg, slopes, slopes[:, [place]])
        less = float(np.log(speed) + np.clip(best[FITTED], -_FINER, _FINER))
        limited = _with(window.theta, ln_rate=nominal + less)
        share = float(np.exp(less))
        yield _sized(window, "slow", limited, None, {"bandwidth_scale": (share, 0.1 * share)})


def _oscillating(window: _Window, error_deg: FloatArray, slopes: FloatArray) -> Iterator[_Guess]:
    """A sine at the strongest frequency, on the healthy servo, and on one that it keeps from sticking."""
    used = window.used
    t = window.time_s - window.time_s[0]
    span_s = max(float(np.ptp(window.time_s)), 1.0)
    free = _with(window.theta, deadband_deg=0.0, friction_deg=0.0)
    reading_deg, free_slopes = window.reading(free)
    kinds = ((error_deg, slopes), (residual(window.measured_deg, reading_deg, window.known.reach_deg)[0], free_slopes))
    best: _Guess | None = None
    for left_deg, columns in kinds:
        scaled = (left_deg[used] - np.median(left_deg[used])) / window.total_deg[used]
        hz = np.arange(0.5, min(12.0, 0.4 / window.record.period_s), 0.2 / span_s)
        for _ in range(2):
            power = np.abs(np.exp(-2j * np.pi * np.outer(hz, t[used])) @ scaled)
            middle = float(hz[np.argmax(power)])
            hz = middle + np.linspace(-0.2, 0.2, 17) / span_s
        waves = np.stack([np.cos(2.0 * np.pi * middle * t), np.sin(2.0 * np.pi * middle * t)], axis=1)
        cost, found, covariance = window.reduced(left_deg, columns, waves)
        size = float(np.hypot(*found[FITTED:]))
        deviation = float(np.sqrt(np.trace(covariance[FITTED:, FITTED:]) / 2.0))
        parameters = {
            "amplitude_deg": Estimate.of(size, deviation),
            "frequency_hz": Estimate.of(middle, 0.1 / span_s),
        }
        if size > 0.0 and (best is None or sum(cost) < sum(best.cost)):
            best = _Guess("oscillation", cost, 3, parameters, window.theta)
    if best is not None:
        yield best


def _immobile(window: _Window) -> Iterator[_Guess]:
    """The command means nothing: at rest, at an end, or moved by the air alone."""
    used = window.used
    measured_deg = window.measured_deg
    known = window.known
    value = float(np.median(measured_deg[used]))
    still = np.hypot(known.noise.still_deg, _LOOSE * known.parameters["play_deg"])
    ratio = float(np.median(window.sigma_deg[used])) / float(np.hypot(still, _LEAST_STILL_DEG))
    low, high = window.ends_deg
    at_stop = value > high - _AT_STOP_DEG or value < low + _AT_STOP_DEG
    rest = window.whitened(measured_deg - value) * min(ratio, 1.0)
    moved = {"position_deg": Estimate.of(value, float(still) / np.sqrt(window.count) / window.noise.innovation)}
    constant = ("constant", np.array([value]))
    if at_stop or float(np.std(measured_deg[used])) < _MOVING * float(still) + _MOVING_DEG:
        yield _Guess("hardover" if at_stop else "stuck", (float(rest @ rest), 0.0), 1, moved, added=constant)
    yield from _come_to_rest(window, float(np.hypot(still, _LEAST_STILL_DEG)))
    span_s = max(float(np.ptp(window.time_s)), 1.0)
    share = (window.time_s - window.time_s.mean()) / span_s
    basis = np.stack([np.ones(share.size), share, share**2, share**3, window.record.load[window.rows]], axis=1)
    best = np.linalg.lstsq(basis[used], measured_deg[used], rcond=None)[0]
    rest = window.whitened(measured_deg - basis @ best) * min(ratio, 1.0)
    amplitude = max(1.4 * float(np.std(measured_deg[used])), float(still))
    size = {"amplitude_deg": Estimate.of(amplitude, 0.3 * amplitude)}
    if at_stop and amplitude < _AT_STOP_DEG:  # the air does not hold a surface at its stop
        yield _Guess("hardover", (float(rest @ rest), 0.0), 5, moved, added=constant)
    else:
        yield _Guess("floating", (float(rest @ rest), 0.0), 5, size, added=constant)


def _come_to_rest(window: _Window, still_deg: float) -> Iterator[_Guess]:
    """Jammed within a short window, and well before: an alarm of a moment ago shows motion first, and then rest."""
    rows = np.flatnonzero(window.used)
    measured_deg = window.measured_deg[rows]
    value = float(np.median(measured_deg[-_AT_REST:]))
    moving = np.flatnonzero(np.abs(measured_deg - value) > _MOVING * still_deg)
    resting = measured_deg.size - 1 - moving[-1] if moving.size else 0
    if window.time_s[-1] - window.time_s[rows[0]] > _SHORTEST_WINDOW_S or resting < _AT_REST:
        return
    nominal_deg, slopes = window.reading(window.theta)
    error_deg, _ = residual(window.measured_deg, nominal_deg, window.known.reach_deg)
    jammed = np.arange(error_deg.size) > rows[moving[-1]]
    error_deg = np.where(jammed, window.measured_deg - value, error_deg)
    cost, _, _ = window.reduced(error_deg, np.where(jammed[:, None], 0.0, slopes))
    moved = {"position_deg": Estimate.of(value, still_deg / np.sqrt(resting))}
    yield _Guess("stuck", cost, 2, moved, added=("constant", np.array([value])))


def _verdict(
    window: _Window, guesses: list[_Guess], ratio: float
) -> tuple[str, float, tuple[str, ...], dict[str, Estimate]]:
    """Kind, probability, alternatives and sizes."""
    scores = np.array([_score(window, guess) for guess in guesses])
    odds = np.exp(-(scores - scores.min()))
    shares = {guess.kind: float(share) for guess, share in zip(guesses, odds / odds.sum(), strict=True)}
    best = guesses[0]
    kind = best.kind
    if kind == "loss_of_effectiveness" and "floating" in shares and best.parameters["gain"].value < _LOST_GAIN:
        half = 0.5 * shares.pop(kind)
        shares["floating"], shares["stuck"] = shares["floating"] + half, shares.get("stuck", 0.0) + half
        kind = "floating"
    for one, twin, share in _TWINS:
        if one == kind and (twin != "deadband" or _may_be_play(window, best)) and not _is_moved(kind, best):
            given = share * shares[one]
            shares[one] -= given
            shares[twin] = shares.get(twin, 0.0) + given
    healthy = next(guess for guess in guesses if guess.kind == "healthy")
    alternatives = tuple(
        name
        for name, share in sorted(shares.items(), key=lambda item: -item[1])
        if share > WORTH_TELLING and name not in (kind, "healthy")
    )[:3]
    probability = shares[kind]
    excess = sum(healthy.cost) - window.count
    gained = sum(healthy.cost) - sum(best.cost)
    if _is_strange(window, guesses):
        if ratio < LOUD or gained < _NOTHING * excess:
            return "unknown", max(0.5, 1.0 - probability), (kind, *alternatives)[:3], {}
        probability = min(probability, 0.5)
    if kind == "healthy":
        return "healthy" if ratio < LOUD else "unknown", probability, alternatives, {}
    if probability < _SURE:
        return "unknown", probability, (kind, *alternatives)[:3], {}
    sizes = next(guess.parameters for guess in guesses if guess.kind == kind)
    return kind, probability, alternatives, sizes


def _is_moved(kind: str, guess: _Guess) -> bool:
    """Whether a floating surface moves by more than play lets a jammed one: no gear holds it."""
    return (
        kind == "floating"
        and "amplitude_deg" in guess.parameters
        and (guess.parameters["amplitude_deg"].value > 0.5 * _WIDEST_PLAY_DEG)
    )


def _may_be_play(window: _Window, guess: _Guess) -> bool:
    """Whether an offset, or what is lost of the travel, may be play that the air pushes: in flight, up to so much."""
    pushed = float(np.median(window.record.load[window.rows])) > _FLYING
    if guess.kind == "bias":
        away_deg = abs(guess.parameters["bias_deg"].value)
    else:
        travel_deg = 0.5 * float(np.ptp(np.quantile(window.measured_deg[window.used], (0.02, 0.98))))
        gain = guess.parameters["gain"].value
        away_deg = travel_deg * (1.0 / max(gain, _LOST_GAIN) - 1.0)
    return pushed and 2.0 * away_deg < _WIDEST_PLAY_DEG


def _error_deg(stretch: _Window, guess: _Guess) -> FloatArray:
    """What a hypothesis leaves of the positions of a stretch, shape (m,) [deg]."""
    if guess.added is not None:
        away: FloatArray = stretch.measured_deg - guess.added[1][0]
        return away
    if guess.theta is not None and guess.kind != "oscillation":
        return stretch.measured_deg - stretch.reading(guess.theta, guess.power, behind=guess.behind)[0]
    return np.full(stretch.time_s.size, _SWINGS) * stretch.total_deg


def _misfits(watched: Watched, guess: _Guess, from_s: float, to_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sample times, and the squares of what the healthy servo and the guess leave of each, over its variance."""
    stretch = _Window(watched, from_s, to_s)
    used, total_deg = stretch.used, stretch.total_deg
    healthy, other = (
        np.minimum((error_deg / total_deg) ** 2, _LOG_CLIP)[used]
        for error_deg in (watched.error_deg[stretch.rows], _error_deg(stretch, guess))
    )
    return stretch.time_s[used], healthy, other


def _end_s(watched: Watched, guess: _Guess, alarm_s: float) -> float | None:
    """When the healthy servo became the better explanation again; None if it never did."""
    last_s = float(watched.record.time_s[-1])
    time_s, healthy, other = _misfits(watched, guess, alarm_s, last_s + 1.0)
    if time_s.size < _FEWEST:
        return None
    so_far = np.cumsum(healthy - np.minimum(other, _ELSEWHERE)) * watched.record.period_s
    best = np.maximum.accumulate(so_far)
    top_s = time_s[np.searchsorted(best, best)]  # when it was best so far
    fell, after_s = best - so_far, time_s - top_s
    ended = ((fell > _ENDED) & (after_s > _AFTER_END_S)) | ((fell > _SURELY_ENDED) & (after_s > _SOON_S))
    return float(top_s[np.argmax(ended)]) if ended.any() else None


_MOST_FAULTS: Final = 20
_RESIDUALS: Final = STATISTICS.index("left_2s")
"""So many statistics are of the residual over its total sigma, not of what is left of it."""
AGAIN_S: Final = 1.0
"""After a fault has ended the tests begin anew."""
_SOON_AFTER_S: Final = 5.0
"""For so long after an alarm its size counts."""
_STILL_FAST: Final = 0.69
"""Speed goes with the supply, and friction with the temperature: a fifth each, between good flights."""
_STILL_ALL: Final = 0.93
_LASTING: Final = ("slow", "loss_of_effectiveness", "bias", "deadband")
_TOLD_BEFORE: Final = ("slow", "loss_of_effectiveness", "bias")
_NONE: Final = (("bias_deg", 0.0), ("gain", 1.0), ("bandwidth_scale", 1.0))
"""What a healthy servo has."""
_LEAST_DEG: Final = {"oscillation": ("amplitude_deg", 0.2), "deadband": ("width_deg", 0.2)}
"""What the narrow-band test counts as an oscillation, and less play than any servo has."""
_SHORTEST_WEAR_S: Final = 2.0
SAME_S: Final = 5.0
"""What is raised so soon after the end of a fault belongs to it."""


class Found(NamedTuple):
    """What became of a flight."""

    faults: tuple[Fault, ...]
    suspicions: tuple[Fault, ...]
    left_deg: FloatArray
    """What the healthy servo, or a fault, leaves of each position [deg], (m,); NaN where none is judged."""


def judged(flight: Watched, names: dict[float, Named] | None = None) -> Found:
    """Find and name the faults of a flight; `names` are those of earlier looks at it, see `named`."""
    names = {} if names is None else names
    limits = thresholds_of(flight.known)
    time_s, error_deg = flight.record.time_s, flight.error_deg
    faults: list[Fault] = []
    suspicions: list[Fault] = []
    left_deg = error_deg.copy()
    begin, earliest_s = 0, float(time_s[0]) if time_s.size else 0.0
    for _ in range(_MOST_FAULTS):
        rows = (time_s[begin:], error_deg[begin:], flight.slopes[begin:], flight.noise_deg[begin:])
        tested = follow(flight.tests, Memory(flight.tests), *rows) if begin else flight.tested
        _, triple, grid_s, statistics = tested
        passed = triple / limits[0] if flight.passed is None else flight.passed[begin:]
        if flight.alone:
            grid_s, statistics = grid_s[:0], statistics[:0]
        raised_s, ratio, is_far = _alarm(limits, rows[0], passed, grid_s, statistics[:, : len(STATISTICS)])
        if not np.isfinite(raised_s):
            break
        fault, guess = named(flight, raised_s, ratio, earliest_s=earliest_s, names=names)
        fault = _weighed(fault, ratio, is_far=is_far)
        if guess is not None and fault.kind != "healthy":
            there = _Window(flight, fault.start_s, float(time_s[-1]) if fault.end_s is None else fault.end_s)
            explained = 1.0 / _SWINGS if guess.kind == "oscillation" else 1.0
            left_deg[there.rows][there.used] = explained * _error_deg(there, guess)[there.used]
        if faults and fault.kind != "healthy" and raised_s - (faults[-1].end_s or raised_s) < SAME_S:
            fault = _joined(faults.pop(), fault)
        (suspicions if fault.kind == "healthy" else faults).append(fault)
        if fault.end_s is None:
            if fault.kind != "healthy":
                break
            earliest_s = raised_s + 20.0
        else:
            earliest_s = max(fault.end_s, raised_s)
        begin = int(np.searchsorted(time_s, earliest_s + AGAIN_S))
        if begin >= time_s.size - 2:
            break
    return Found(tuple(faults), tuple(suspicions), left_deg)


def _weighed(fault: Fault, ratio: float, *, is_far: bool) -> Fault:
    """The same fault, or none: what barely passes its threshold has to be one that servos have.

    A servo that is a little slow is still a good one, on a cold day or a low supply; and none is worn, weak or bent for
    a moment only, nor is an offset one that may as well be none. Where the residual itself stays within what good
    flights do, wear of no size is none, and what raised the alarm has to tell of it before.
    """
    speed, gain = fault.parameters.get("bandwidth_scale"), fault.parameters.get("gain")
    still_fast = fault.kind == "slow" and speed is not None and speed.value >= _STILL_FAST
    short = fault.kind in _LASTING and fault.end_s is not None and fault.end_s - fault.start_s < _SHORTEST_WEAR_S
    little = fault.kind == "loss_of_effectiveness" and gain is not None and gain.value >= _STILL_ALL
    nothing = any(
        fault.parameters[key].low <= none <= fault.parameters[key].high
        for key, none in _NONE
        if key in fault.parameters
    )
    size, least = _LEAST_DEG.get(fault.kind, ("", 0.0))
    tiny = size in fault.parameters and fault.parameters[size].value < least
    untold = fault.kind in _TOLD_BEFORE and fault.start_s >= fault.alarm_s
    if (
        still_fast
        or tiny
        or (not is_far and untold)
        or (ratio < LOUD and (short or little or nothing or fault.kind == "unknown"))
    ):
        own = () if fault.kind == "unknown" else (fault.kind,)
        return replace(fault, kind="healthy", parameters={}, alternatives=(*own, *fault.alternatives)[:3])
    return fault


def _joined(first: Fault, then: Fault) -> Fault:
    """One fault of two that follow each other at once; named as the longer one is."""
    end_s, begun_s = first.end_s or first.alarm_s, then.alarm_s
    lasted_s = (np.inf if then.end_s is None else then.end_s) - begun_s
    longer = then if lasted_s >= end_s - first.alarm_s else first
    return replace(longer, start_s=first.start_s, alarm_s=first.alarm_s, end_s=then.end_s)


def _alarm(
    limits: FloatArray, time_s: FloatArray, passed: FloatArray, grid_s: FloatArray, statistics: FloatArray
) -> tuple[float, float, bool]:
    """When the first alarm is raised [s], infinite if never, and the largest statistic over its threshold then.

    `passed` is the fast test over its threshold. Last whether the residual itself passes a threshold, not only a test
    of what it may mean.
    """
    direct = np.flatnonzero(passed >= 1.0)
    first_s = float(time_s[direct[0]]) if direct.size else np.inf
    ratios = exceeded(limits, np.zeros(limits.size), statistics)
    raised = np.flatnonzero(ratios >= 1.0)
    second_s = float(grid_s[raised[0]]) if raised.size else np.inf
    at_s = min(first_s, second_s)
    if not np.isfinite(at_s):
        return np.inf, float(ratios.max(initial=0.0)), False
    soon = statistics[(grid_s >= at_s) & (grid_s <= at_s + _SOON_AFTER_S)] / limits
    fast = float(passed[(time_s >= at_s) & (time_s <= at_s + _SOON_AFTER_S)].max(initial=1.0))
    is_far = fast > 1.0 or soon[:, :_RESIDUALS].max(initial=0.0) >= 1.0
    return at_s, float(soon.max(initial=fast)), bool(is_far)


def judge_stretch(
    known: CalibratedServo,
    residuals: Residuals,
    commands: Commands,
    sent_period_s: float | None,
    names: dict[float, Named],
) -> Found:
    """Judge what a stream remembers of a surface."""
    segment = Series("", commands.effective_s, commands.command_deg, residuals.time_s, residuals.measured_deg)
    segment = replace(segment, sent_period_s=sent_period_s, context=residuals.context)
    return judged(watched_calibrated(known, segment), names)


def watched_calibrated(known: CalibratedServo, segment: Series) -> Watched:
    """What the detector needs of a flight of a servo that was fitted to good flights."""
    has_airspeed = segment.context.airspeed_s.size > 0
    record = Record.of(segment, known.supply_v, known.airspeed_m_s)
    return watched(known if has_airspeed else known.without_airspeed(), record)

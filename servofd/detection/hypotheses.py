"""The ways in which a servo may behave for a while: well, altered, or not at all; and which of them it is.

A hypothesis is a servo with one thing changed, or no servo at all. Its misfit is what of the whitened residual no
allowed change of the other parameters explains; the best size is found on a grid and refined by the linear estimate
around it. The model is not the servo: where even the best hypothesis leaves more than the noise, that is taken for
noise of unknown size (n ln misfit), and every other sample counts. Probabilities follow from this, from how far the
other parameters had to go, and from the number of free sizes (BIC).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from servofd.aircraft.priors import FITTED, NAMES, PRIORS
from servofd.core.statistics import Estimate
from servofd.detection.outages import Outage, held, outages_in
from servofd.detection.verdict import WORTH_TELLING
from servofd.estimate.family import bent, new_state, sensitivities, simulated, variants
from servofd.estimate.fit import residual

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.moving import OtherMotion, Watched

WINDOW_S, SHORTEST_WINDOW_S = 20.0, 5.0
"""Longest window that is explained, and the one below which it is not halved any more [s]."""
_LEAD_S: Final = 1.0
"""Before a window begins, so much is simulated, so that its servo is where it should be [s]."""
_IN_FORCE_S: Final = 1.0
"""For so long before a stretch commands are on their way to the servo, or move it still."""
_COUNTED: Final = 0.5
"""Share of the readings of a window that tell something of their own: what a model lacks lasts."""
_ALARMED: Final = 3.0
"""Logarithm of how much less likely a good servo is judged here than a faulty one: an alarm was raised."""
_SCALES = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85)
"""Shares of the travel that are tried for a loss."""
_SPEEDS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Shares of the speed that are tried for a slow servo."""
_FINER = 0.35
"""By so much, in the logarithm, a speed may be from the nearest of them: half of the largest ratio of two."""
_WIDTHS_DEG = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0)
"""Widths of play and dead band that are tried [deg]."""
_STICKING_DEG = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
"""The same of friction."""
_LEAST_LOSS: Final = 0.95
"""Share of the gain above which nothing is lost."""
_FLAT = 1e-8
"""Precision of a number of which nothing is known before."""
_LOST_GAIN = 0.12
"""Gain below which a loss may as well be a floating surface."""
_AT_STOP_DEG = 1.5
"""Distance from the end of the travel within which a surface is at its stop [deg]."""
_SURE = 0.3
"""Probability below which the name is `unknown`."""
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
"""Median dynamic pressure, over its unit in the model, above which the aircraft flies."""
_WIDEST_PLAY_DEG: Final = 8.0
"""Widest play that a linkage may have [deg]."""
_LN_RATE: Final = NAMES.index("ln_rate")
_USUAL_WIDTH_DEG: Final = 2.0
"""Wider play is rarer, by e for each of these: a surface that never moved is stuck, not loose by all that was asked."""
_USUAL_BIAS_DEG: Final = 3.0
"""Larger offsets are rarer, by e for each of these [deg]."""
_MOVING, _MOVING_DEG = 3.0, 0.3
"""A surface that moves by so many sigma of the reading, and so much, is not stuck."""
_ADDED: Final = ("_deg", "_s")
"""Units of sizes that tell what came on top of what the servo had; one without a unit is the share that is left."""
_AT_REST: Final = 6
"""So many readings in a row that stay where they are come to rest, after motion."""
_FEWEST_OUTAGES: Final = 2
"""Of a contact that comes and goes."""
_LOOSE: Final = 0.3
"""Share of its play by which a loose surface moves although it rests."""
_LEAST_STILL_DEG: Final = 0.05
"""Smallest deviation of the readings of a surface at rest [deg]."""
_STRANGE, _UNEXPLAINED = 2.0, 0.55
"""Misfit for each sample, and the share of what a good servo does not do, that no hypothesis may leave."""
_NOTHING: Final = 0.1
"""Share of what a good servo does not do, that a hypothesis must explain to be a name, however loud the alarm: readings
may jump at random."""
_SLOWEST_HZ, _QUICKEST_HZ = 0.5, 12.0
"""Frequencies between which an oscillation is looked for."""
_LINES: Final = 0.2
"""Distance of two lines of its spectrum, over the inverse of the window's length."""
_QUARTERS: Final = 0.25
"""Length of the slots that times are held to while it is looked for, over the period of the readings."""
_BETWEEN_LINES = np.linspace(-1.0, 1.0, 17)
"""Where its frequency is looked for about the strongest line, in distances of two."""
SWINGS = 1.5
"""Standard deviations that an oscillation is taken to leave."""


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """What one hypothesis makes of the window."""

    kind: str
    cost: tuple[float, float]
    """Misfit, and how far the other parameters had to go."""
    freedom: int
    parameters: dict[str, Estimate] = field(default_factory=dict)
    theta: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Of the servo; empty where it means nothing."""
    power: float = 0.0
    rests_deg: float | None = None
    """Where it stays, or about where, whatever is asked."""
    place: int | None = None
    """Index among `NAMES` of the parameter that was changed, where its size is fitted around the value tried."""
    behind: bool = False
    """Whether a named servo lost its travel behind its play, and not before it."""
    outages: tuple[Outage, ...] = ()
    """Moments in which no command arrives."""


class Window:
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
        command_s, command_deg, slope_deg_s = record.commands
        span = slice(None)
        if self.time_s.size:  # what was commanded long before, or after, moves nothing here
            begin, end = np.searchsorted(command_s, (self.time_s[0] - _IN_FORCE_S, self.time_s[-1])).tolist()
            span = slice(max(begin - 1, 0), end + 1)
        self.commands = command_s[span], command_deg[span], slope_deg_s[span]
        start_deg = record.start_deg[self.rows].copy()
        good = np.flatnonzero(np.isfinite(self.measured_deg))
        if good.size and not np.isfinite(start_deg[0]):
            start_deg[0] = self.measured_deg[good[0]]
        self.start_deg = start_deg

    @property
    def count(self) -> int:
        """How many samples are used."""
        return int(np.count_nonzero(self.used))

    def reading(
        self, theta: FloatArray, power: float = 0.0, *, behind: bool = False, outages: tuple[Outage, ...] = ()
    ) -> tuple[FloatArray, FloatArray]:
        """Reading and sensitivities of a servo, shapes (m,) and (m, parameters)."""
        table = variants(theta, patterns=False, middle_deg=self.known.middle_deg)
        table[:, FITTED] = power
        position_deg, speed_deg_s = self._simulated(table, outages)
        reading_deg, slopes = sensitivities(position_deg, speed_deg_s, theta, self.known.reach_deg)
        if self.own is not None and self.time_s.size:
            reading_deg = self._by_own(self.own, theta, behind=behind, outages=outages)
        return reading_deg, slopes

    def reading_alone(self, theta: FloatArray, power: float = 0.0, *, behind: bool = False) -> FloatArray:
        """Reading of a servo, shape (m,), in a tenth of the time."""
        if self.own is not None and self.time_s.size:
            return self._by_own(self.own, theta, behind=behind)
        table = variants(theta, patterns=False, middle_deg=self.known.middle_deg)[:1]
        table[:, FITTED] = power
        position_deg, _ = self._simulated(table)
        return position_deg[:, 0] + bent(position_deg[:, 0], theta, self.known.reach_deg)[0]

    def _simulated(self, table: FloatArray, outages: tuple[Outage, ...] = ()) -> tuple[FloatArray, FloatArray]:
        """Positions of the servos of a table, and speeds of the first."""
        load, power = self.record.load[self.rows], self.record.power[self.rows]
        commands = held(self.commands, outages)
        return simulated(table, new_state(table.shape[0]), commands, self.time_s, load, power, self.start_deg)

    def _by_own(
        self, own: OtherMotion, theta: FloatArray, *, behind: bool, outages: tuple[Outage, ...] = ()
    ) -> FloatArray:
        """Reading of a named servo with other parameters."""
        start_deg = float(np.nan_to_num(self.start_deg[0]))
        return own(self.record, theta, self.rows, start_deg, behind=behind, outages=outages)

    def slope(
        self, theta: FloatArray, place: int, reading_deg: FloatArray, slopes: FloatArray, *, behind: bool
    ) -> FloatArray:
        """What a unit of one parameter adds to a reading, shape (m, 1)."""
        if self.own is None or not self.time_s.size:
            return slopes[:, [place]]
        other, step = theta.copy(), PRIORS[place].step
        other[place] += step
        return ((self._by_own(self.own, other, behind=behind) - reading_deg) / step)[:, None]

    def whitened(self, values: FloatArray) -> FloatArray:
        """Rows over the noise's sigma, without its colour; shape (k, ...) of used rows."""
        scaled = values[self.used] / (self.sigma_deg[self.used, None] if values.ndim > 1 else self.sigma_deg[self.used])
        first, second = self.noise.colour
        return (scaled[2:] - first * scaled[1:-1] - second * scaled[:-2]) / self.noise.innovation

    def reduced(
        self, error_deg: FloatArray, slopes: FloatArray, free: FloatArray | None = None
    ) -> tuple[tuple[float, float], FloatArray, FloatArray]:
        """Costs of an error once parameters (and free columns) have done their best; these, and their covariance.

        `free` (n, k) become the columns from `FITTED` on, and are fitted without a prior. The costs are its misfit, and
        how far the parameters had to go for it: sums of squares over their variances.
        """
        columns = slopes if free is None else np.concatenate([slopes, free], axis=1)
        w, e = self.whitened(columns), self.whitened(error_deg)
        block = w.T @ w
        block[:FITTED, :FITTED] += self.precision
        unknown = np.arange(FITTED, columns.shape[1])
        block[unknown, unknown] += _FLAT
        covariance: FloatArray = np.asarray(np.linalg.inv(block), dtype=np.float64)
        best = covariance @ (w.T @ e)
        apart = best[:FITTED]
        left = e - w @ best
        return (float(left @ left), float(apart @ self.precision @ apart)), best, covariance


def is_strange(window: Window, guesses: list[Guess]) -> bool:
    """Whether even the best hypothesis leaves much, and most of what a good servo does not do."""
    best = guesses[0]
    healthy = next(guess for guess in guesses if guess.kind == "healthy")
    excess, gained = sum(healthy.cost) - window.count, sum(healthy.cost) - sum(best.cost)
    is_much = best.cost[0] > _STRANGE * window.count
    return best.kind != "healthy" and is_much and gained < (1.0 - _UNEXPLAINED) * excess


def ranked(window: Window) -> list[Guess]:
    """The best guess of each kind, the likeliest first."""
    best: dict[str, Guess] = {}
    guesses = sorted(_guesses(window), key=lambda each: _score(window, each))
    first = guesses[0]
    if first.place is not None:  # its size was estimated from another one: once more
        again = _sized(window, first)
        guesses = [again if _score(window, again) < _score(window, first) else first, *guesses[1:]]
    for guess in guesses:
        best.setdefault(guess.kind, guess)
    return list(best.values())


def _score(window: Window, guess: Guess) -> float:
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


def _guesses(window: Window) -> Iterator[Guess]:
    theta = window.theta
    nominal_deg, slopes = window.reading(theta)
    error_deg, _ = residual(window.measured_deg, nominal_deg, window.known.reach_deg)
    cost, _, _ = window.reduced(error_deg, slopes)
    yield Guess("healthy", cost, 0, theta=theta)
    one = np.ones((error_deg.size, 1))
    cost, best, covariance = window.reduced(error_deg, slopes, one)
    bias = Estimate.of(best[FITTED], float(np.sqrt(covariance[FITTED, FITTED])))
    yield Guess("bias", cost, 1, {"bias_deg": bias}, _with(theta, bias_deg=theta[1] + best[FITTED]))
    for tries in _tries(window):
        yield _sized(window, _likeliest(window, slopes, tries))
    limited = _likeliest(window, slopes, [_rate_limited(theta, speed) for speed in _SPEEDS])
    yield _sized(window, _finer(window, limited))
    yield from _oscillating(window, error_deg, slopes)
    yield from _intermittent(window, error_deg)
    yield from _immobile(window)


def _with(theta: FloatArray, **changes: float) -> FloatArray:
    """The same servo with some parameters changed, by their names."""
    changed = theta.copy()
    changed[[NAMES.index(name) for name in changes]] = list(changes.values())
    return changed


def _tried(kind: str, theta: FloatArray, name: str, size: float, share: float = 0.0, **changed: Any) -> Guess:  # noqa: ANN401 - fields
    """A servo with one thing changed, by its size, of which a share is its deviation."""
    return Guess(kind, (0.0, 0.0), 1, {name: Estimate.of(size, share * size)}, theta, **changed)


def _tries(window: Window) -> Iterator[list[Guess]]:
    """Servos with one thing changed: by little and by much, in order, of each kind."""
    theta = window.theta
    for behind in (False, True) if window.own is not None else (False,):
        gains = ((share, _with(theta, gain=theta[0] * share)) for share in _SCALES)
        yield [_tried("loss_of_effectiveness", lost, "gain", share, place=0, behind=behind) for share, lost in gains]
    yield [_slow(theta, speed, power=float(np.log(speed))) for speed in _SPEEDS]
    less = ((speed, float(np.log(speed))) for speed in _SPEEDS)
    yield [_slow(_with(theta, ln_bandwidth=theta[3] + ln, ln_rate=theta[_LN_RATE] + ln), speed) for speed, ln in less]
    for name in ("deadband_deg", "play_deg"):
        place = NAMES.index(name)
        loose = ((width_deg, _with(theta, **{name: theta[place] + width_deg})) for width_deg in _WIDTHS_DEG)
        yield [_tried("deadband", more, "width_deg", width_deg, place=place) for width_deg, more in loose]
    friction_deg = theta[NAMES.index("friction_deg")]
    sticking = ((width_deg, _with(theta, friction_deg=friction_deg + 0.5 * width_deg)) for width_deg in _STICKING_DEG)
    yield [_tried("deadband", more, "width_deg", width_deg, 0.25) for width_deg, more in sticking]


def _slow(theta: FloatArray, speed: float, power: float = 0.0) -> Guess:
    return _tried("slow", theta, "bandwidth_scale", speed, 0.1, power=power)


def _rate_limited(theta: FloatArray, speed: float) -> Guess:
    """A servo that is as quick as ever in small motion, and turns no faster than a share of its speed."""
    return _slow(_with(theta, ln_rate=theta[_LN_RATE] + float(np.log(speed))), speed)


def _sized(window: Window, tried: Guess) -> Guess:
    """What a servo with one thing changed makes of the window; its size is fitted where it is one parameter's."""
    kind, theta, place = tried.kind, tried.theta, tried.place
    reading_deg, slopes = window.reading(theta, tried.power, behind=tried.behind)
    error_deg, _ = residual(window.measured_deg, reading_deg, window.known.reach_deg)
    if place is None:
        return replace(tried, cost=window.reduced(error_deg, slopes)[0])
    cost, best, covariance = window.reduced(
        error_deg, slopes, window.slope(theta, place, reading_deg, slopes, behind=tried.behind)
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
    if next(iter(tried.parameters)).endswith(_ADDED):
        estimate = Estimate.of(max(moved[place] - window.theta[place], 0.0), deviation)
    else:
        estimate = Estimate.of(moved[place] / window.theta[place], deviation / abs(window.theta[place]))
    return replace(tried, cost=cost, parameters=dict.fromkeys(tried.parameters, estimate), theta=moved)


def _likeliest(window: Window, slopes: FloatArray, tries: list[Guess]) -> Guess:
    """The likeliest of these: of every second one, and of the neighbours of the best of them.

    They are compared by the sensitivities of the healthy servo (m, parameters): those of each take ten times as long.
    """

    def score(place: int) -> float:
        tried = tries[place]
        reading_deg = window.reading_alone(tried.theta, tried.power, behind=tried.behind)
        error_deg, _ = residual(window.measured_deg, reading_deg, window.known.reach_deg)
        return _score(window, replace(tried, cost=window.reduced(error_deg, slopes)[0]))

    scores = {place: score(place) for place in range(0, len(tries), 2)}
    best = min(scores, key=lambda place: scores[place])
    scores |= {place: score(place) for place in (best - 1, best + 1) if 0 <= place < len(tries)}
    return tries[min(scores, key=lambda place: scores[place])]


def _finer(window: Window, limited: Guess) -> Guess:
    """The same with the speed that explains most, near the one that was tried."""
    reading_deg, slopes = window.reading(limited.theta)
    error_deg, _ = residual(window.measured_deg, reading_deg, window.known.reach_deg)
    _, best, _ = window.reduced(error_deg, slopes, slopes[:, [_LN_RATE]])
    less = limited.theta[_LN_RATE] - window.theta[_LN_RATE] + float(np.clip(best[FITTED], -_FINER, _FINER))
    return _rate_limited(window.theta, float(np.exp(less)))


def _oscillating(window: Window, error_deg: FloatArray, slopes: FloatArray) -> Iterator[Guess]:
    """A sine at the strongest frequency, on the healthy servo, and on one that it keeps from sticking."""
    used = window.used
    t = window.time_s - window.time_s[0]
    span_s = max(float(np.ptp(window.time_s)), 1.0)
    free = _with(window.theta, deadband_deg=0.0, friction_deg=0.0)
    reading_deg, free_slopes = window.reading(free)
    kinds = ((error_deg, slopes), (residual(window.measured_deg, reading_deg, window.known.reach_deg)[0], free_slopes))
    swinging = []
    quickest_hz = min(_QUICKEST_HZ, 0.4 / window.record.period_s)
    for left_deg, columns in kinds:
        scaled = (left_deg[used] - np.median(left_deg[used])) / window.total_deg[used]
        about_hz = _strongest_hz(t[used], scaled, _QUARTERS * window.record.period_s, _LINES / span_s, quickest_hz)
        near_hz = about_hz + _LINES / span_s * _BETWEEN_LINES
        turns = np.exp(-2j * np.pi * near_hz[:, None] * t[used])
        middle = float(near_hz[np.argmax(np.abs(turns @ scaled))])
        waves = np.stack([np.cos(2.0 * np.pi * middle * t), np.sin(2.0 * np.pi * middle * t)], axis=1)
        cost, found, covariance = window.reduced(left_deg, columns, waves)
        size = float(np.hypot(*found[FITTED:]))
        deviation = float(np.sqrt(np.trace(covariance[FITTED:, FITTED:]) / 2.0))
        parameters = {"amplitude_deg": Estimate.of(size, deviation), "frequency_hz": Estimate.of(middle, 0.1 / span_s)}
        swinging.append(Guess("oscillation", cost, 3, parameters, window.theta))
    yield min(swinging, key=lambda guess: sum(guess.cost))


def _strongest_hz(time_s: FloatArray, values: FloatArray, slot_s: float, apart_hz: float, quickest_hz: float) -> float:
    """The frequency of which there is most in some values, to `apart_hz`; times are held to slots."""
    slot = np.rint(time_s / slot_s).astype(int)
    least = max(int(np.ceil(1.0 / (apart_hz * slot_s))), int(slot.max(initial=0)) + 1)
    count = 1 << (least - 1).bit_length()  # of a power of two the transform is quick
    much = np.abs(np.fft.rfft(np.bincount(slot, weights=values, minlength=count)))
    first, last = np.searchsorted(np.fft.rfftfreq(count, slot_s), (_SLOWEST_HZ, quickest_hz)).tolist()
    return float((first + np.argmax(much[first : max(last, first + 1)])) / (count * slot_s))


def _intermittent(window: Window, error_deg: FloatArray) -> Iterator[Guess]:
    """A servo that gets no command for some moments."""
    used = np.flatnonzero(window.used | (window.time_s < window.time_s[0] + _LEAD_S))
    used = used[np.isfinite(window.measured_deg[used])]
    command_s, command_deg, _ = window.commands
    theta = window.theta
    found = outages_in(
        window.time_s[used], window.measured_deg[used], error_deg[used], window.total_deg[used],
        _MOVING * float(np.hypot(window.known.noise.still_deg, _LEAST_STILL_DEG)),
        (command_s, theta[0] * command_deg + window.known.offset_deg), theta[NAMES.index("delay_s")],
    )  # fmt: skip
    if len(found) < _FEWEST_OUTAGES:
        return
    reading_deg, slopes = window.reading(theta, outages=found)
    left_deg, _ = residual(window.measured_deg, reading_deg, window.known.reach_deg)
    cost, _, _ = window.reduced(left_deg, slopes)
    lengths_s = np.array([to_s - from_s for from_s, to_s in found])
    size = {"outage_s": Estimate.of(float(np.median(lengths_s)), float(np.std(lengths_s)))}
    yield Guess("intermittent", cost, 2 * len(found), size, theta, outages=found)


def _immobile(window: Window) -> Iterator[Guess]:
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
    if at_stop or float(np.std(measured_deg[used])) < _MOVING * float(still) + _MOVING_DEG:
        yield Guess("hardover" if at_stop else "stuck", (float(rest @ rest), 0.0), 1, moved, rests_deg=value)
    yield from _come_to_rest(window, float(np.hypot(still, _LEAST_STILL_DEG)))
    span_s = max(float(np.ptp(window.time_s)), 1.0)
    share = (window.time_s - window.time_s.mean()) / span_s
    basis = np.stack([np.ones(share.size), share, share**2, share**3, window.record.load[window.rows]], axis=1)
    best = np.linalg.lstsq(basis[used], measured_deg[used], rcond=None)[0]
    rest = window.whitened(measured_deg - basis @ best) * min(ratio, 1.0)
    amplitude = max(1.4 * float(np.std(measured_deg[used])), float(still))
    size = {"amplitude_deg": Estimate.of(amplitude, 0.3 * amplitude)}
    if at_stop and amplitude < _AT_STOP_DEG:  # the air does not hold a surface at its stop
        yield Guess("hardover", (float(rest @ rest), 0.0), 5, moved, rests_deg=value)
    else:
        yield Guess("floating", (float(rest @ rest), 0.0), 5, size, rests_deg=value)


def _come_to_rest(window: Window, still_deg: float) -> Iterator[Guess]:
    """Jammed within a short window, and well before: an alarm of a moment ago shows motion first, and then rest."""
    rows = np.flatnonzero(window.used)
    measured_deg = window.measured_deg[rows]
    value = float(np.median(measured_deg[-_AT_REST:]))
    moving = np.flatnonzero(np.abs(measured_deg - value) > _MOVING * still_deg)
    resting = measured_deg.size - 1 - moving[-1] if moving.size else 0
    if window.time_s[-1] - window.time_s[rows[0]] > SHORTEST_WINDOW_S or resting < _AT_REST:
        return
    nominal_deg, slopes = window.reading(window.theta)
    error_deg, _ = residual(window.measured_deg, nominal_deg, window.known.reach_deg)
    jammed = np.arange(error_deg.size) > rows[moving[-1]]
    error_deg = np.where(jammed, window.measured_deg - value, error_deg)
    cost, _, _ = window.reduced(error_deg, np.where(jammed[:, None], 0.0, slopes))
    moved = {"position_deg": Estimate.of(value, still_deg / np.sqrt(resting))}
    yield Guess("stuck", cost, 2, moved, rests_deg=value)


def concluded(
    window: Window, guesses: list[Guess], ratio: float
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
    if is_strange(window, guesses):
        if ratio < LOUD or gained < _NOTHING * excess:
            return "unknown", max(0.5, 1.0 - probability), (kind, *alternatives)[:3], {}
        probability = min(probability, 0.5)
    if kind == "healthy":
        return "healthy" if ratio < LOUD else "unknown", probability, alternatives, {}
    if probability < _SURE:
        return "unknown", probability, (kind, *alternatives)[:3], {}
    sizes = next(guess.parameters for guess in guesses if guess.kind == kind)
    return kind, probability, alternatives, sizes


def _is_moved(kind: str, guess: Guess) -> bool:
    """Whether a floating surface moves by more than play lets a jammed one: no gear holds it."""
    return (
        kind == "floating"
        and "amplitude_deg" in guess.parameters
        and (guess.parameters["amplitude_deg"].value > 0.5 * _WIDEST_PLAY_DEG)
    )


def _may_be_play(window: Window, guess: Guess) -> bool:
    """Whether an offset, or what is lost of the travel, may be play that the air pushes: in flight, up to so much."""
    pushed = float(np.median(window.record.load[window.rows])) > _FLYING
    if guess.kind == "bias":
        away_deg = abs(guess.parameters["bias_deg"].value)
    else:
        travel_deg = 0.5 * float(np.ptp(np.quantile(window.measured_deg[window.used], (0.02, 0.98))))
        gain = guess.parameters["gain"].value
        away_deg = travel_deg * (1.0 / max(gain, _LOST_GAIN) - 1.0)
    return pushed and 2.0 * away_deg < _WIDEST_PLAY_DEG


def unexplained_deg(stretch: Window, guess: Guess) -> FloatArray:
    """What a hypothesis leaves of the positions of a stretch, shape (m,) [deg]."""
    if guess.rests_deg is not None:
        return stretch.measured_deg - guess.rests_deg
    if guess.kind != "oscillation":
        reading_deg, _ = stretch.reading(guess.theta, guess.power, behind=guess.behind, outages=guess.outages)
        return stretch.measured_deg - reading_deg
    return np.full(stretch.time_s.size, SWINGS) * stretch.total_deg

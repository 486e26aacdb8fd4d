"""What contradicts any servo: all that a model fitted to the very log may accuse a surface of.

A servo whose numbers were fitted to the log that is judged may be off by what nobody knows; but no servo rests while it
is asked to move by degrees, stays far from where it is asked to be, moves without being asked, or falls behind by more
than its own lag in part of a flight.

Beside it, what a log tells before it is judged: the step of its reading, sign and scale, and how wide tolerances have
to be.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.core.statistics import Estimate
from servofd.detection.residual import noise_deg
from servofd.detection.verdict import Fault
from servofd.servo.loops import compiled

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servofd.core.types import BoolArray, FloatArray, IntArray
    from servofd.detection.residual import ResidualGenerator, Residuals

_WIDTH_DEG, _WIDTH_SIGMAS, _WIDTH_STEPS, _WIDEST_DEG = 0.4, 6.0, 2.0, 2.0
"""A surface at rest reads within so much: play that the air takes up, noise, steps of the reading."""
_MISSED_WIDTHS, _LEAST_MISSED_DEG, _MISSED_DEG, _ASKED_DEG, _MISSED_S = 2.0, 1.5, 2.5, 4.0, 0.5
"""A jammed surface is so far from where it should be, by the width within which it rests and between two limits, while
that moves by so much, for so long beyond its lag."""
_SCALE = 0.05
"""Share by which a fitted scale is off far from the usual deflections: 3.6 % in a flight of an ArduPlane whose servos
went to ±80 deg on the ground and to ±15 in the air; a linkage bends by 3.4 %."""
_USUAL = 75.0
"""Percentile of deflections that are the usual ones."""
_ONE_SIDED_S = 5.0
_LEAST_TRAVEL, _LEAST_TRAVEL_DEG = 1.0 / 3.0, 10.0
"""Between its stops a surface has such a share of the travel that is asked for, and so much."""
_BEFORE_S, _LEAST_SIGMA_DEG, _ALIKE = 2.0, 0.05, 4.0
"""Healthy time before a jam that tells its offset, least noise, and squared deviations that tell instants apart."""
_FAR_DEG, _FAR_SHARE, _FAR_S = 6.0, 0.3, 1.5
"""So far from the command, and by such a share of its travel, nothing rests that is well."""
_WINDOW_S, _HOP_S = 3.0, 0.5
_WRONG_DEG = 1.4
"""Windows whose motion is off by less than this (rms) are not looked at again [deg]."""
_LINE_DEG, _LINE_SHARE, _NOT_ASKED = 2.0, 0.6, 0.5
"""Amplitude of an oscillation, its share of the error's power, and of the command's amplitude there to its own."""
_SLOWEST_HZ = 1.2
"""Fewer periods in a window are no oscillation: positions that came late to the log look like that as well."""
_SAMPLES, _FASTEST_HZ = 3.0, 12.0
"""In each period; with fewer, commands and positions that were read at other times than stamped look like a wave."""
_TURNS = 1.0
"""Of two in each period: a single jerk that the model does not follow has a line as well."""
_FOLLOWS = 0.3
"""Slope of the position over the healthy deflection below which it does not follow."""
_BRISK_DEG = 1.4
_LAG_SHARE, _LAG_S, _LAG_DEG, _LAG_EXPLAINS = 1.0, 0.03, 1.0, 0.5
"""Lag beyond its own by this share and this time [s], which moves it by so much (rms) and explains its error."""
_LAGS_S = (-0.1, 0.0, 0.1, 0.2, 0.35, 0.5)
"""Lags at which the position may follow the healthy deflection."""
_LATE_SHARE, _LATE_S = 0.7, 6.0
_ARRIVED_S = 1.0
_FEWEST_SAMPLES = 30
_JOINED_S = 6.0
_SEEN_SAMPLES = 5
"""What a window shows in its last samples alone may be a reading that jumped."""
_FLOATS_S, _WAVE_SAMPLES = 4.0, 40
"""A motion that is strange for less may be a load, and two jerks between two rows of a slow log look like a wave."""
_FOLLOWED_S, _AROUND_S, _MOSTLY, _NEAR_DEG, _ALONG = 10.0, 1.0, 95.0, 1.25, 0.4
"""For so long, but around where it rests, and for so many of 100 samples, a surface is where it is asked, half of
`_MISSED_DEG`, and moves as it is asked (correlation), or nobody knows that command and position belong together."""
_KINDS = ("stuck", "hardover", "oscillation", "floating", "slow")


class _Stretch(NamedTuple):
    kind: str
    start_s: float
    seen_s: float
    end_s: float
    parameters: dict[str, float]


class _Flight:
    """Judged samples of a surface, all arrays of shape (n,)."""

    def __init__(self, generator: ResidualGenerator, residuals: Residuals, earlier_deg: FloatArray | None) -> None:
        use = residuals.settled & np.isfinite(residuals.measured_deg) & np.isfinite(residuals.simulated_deg)
        self.time_s, self.healthy_deg = residuals.time_s[use], residuals.simulated_deg[use]
        self.measured_deg = self.reached_deg = residuals.measured_deg[use]
        self.is_enough = self.time_s.size >= _FEWEST_SAMPLES
        if not self.is_enough:
            return
        self.last_s = float(residuals.time_s[-1])
        if earlier_deg is not None:  # it was seen there before these samples
            self.reached_deg = np.concatenate([earlier_deg[np.isfinite(earlier_deg)], self.measured_deg])
        self.error_deg = self.measured_deg - self.healthy_deg
        self.noise_deg, self.step_deg = noise_deg(self.error_deg), step_deg(self.measured_deg)
        self.lag_s = float(np.sum(1.0 / generator.filter_parameters().decay_rad_s).real)  # without its delay
        self.delay_s, self.usual_s = generator.model.delay_s, float(np.median(np.diff(self.time_s)))
        self.width_deg = resting_width_deg(self.noise_deg, self.step_deg)
        self.missed_deg = min(max(_MISSED_WIDTHS * self.width_deg, _LEAST_MISSED_DEG), _MISSED_DEG)
        """How far from where it should be a jam shows."""
        low_deg, high_deg = np.percentile(self.reached_deg, [2.0, 98.0])
        self.travel_deg = float(high_deg - low_deg)


def contradictions(
    generator: ResidualGenerator, residuals: Residuals, earlier_deg: FloatArray | None = None
) -> tuple[Fault, ...]:
    """Find what no servo does, whatever its numbers, in order of time.

    `earlier_deg` are positions before those of the residuals, which tell how far the surface can go.

    Examples
    --------
    >>> from servofd.detection.residual import ResidualGenerator
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.series import Series
    >>> from servofd.servo.library import servo_named
    >>> model, time_s = ServoModel.of(servo_named("hs225bb-eq31")), np.arange(0.0, 40.0, 0.02)
    >>> command_deg = 10.0 * np.sin(2.0 * time_s)
    >>> jammed_deg = np.where(time_s < 20.0, model.simulate(time_s, command_deg, time_s), 3.0)
    >>> generator = ResidualGenerator(model, 30.0)
    >>> (found,) = contradictions(generator, generator.run(Series("x", time_s, command_deg, time_s, jammed_deg)))
    >>> found.kind, round(found.start_s), found.end_s
    ('stuck', 20, None)
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        flight = _Flight(generator, residuals, earlier_deg)
        return _as_faults(flight, [*_resting(flight), *_moving(flight)]) if flight.is_enough else ()


def unanswered(generator: ResidualGenerator, residuals: Residuals) -> tuple[Fault, ...]:
    """Find where a surface did not answer its command at all, which needs no model; elsewhere it goes where asked."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        flight = _Flight(generator, residuals, None)
        found = list(_resting(flight)) if flight.is_enough else []
    elsewhere = np.ones(flight.time_s.size, dtype=bool)
    for stretch in found:
        elsewhere &= (flight.time_s < stretch.start_s - _AROUND_S) | (flight.time_s > stretch.end_s + _AROUND_S)
    if not found or np.count_nonzero(elsewhere) * flight.usual_s < _FOLLOWED_S:
        return ()
    error_deg, asked, moved = (x[elsewhere] for x in (flight.error_deg, flight.healthy_deg, flight.measured_deg))
    near = float(np.percentile(np.abs(error_deg), _MOSTLY)) <= _NEAR_DEG
    common = float(np.cov(asked, moved)[0, 1])
    follows = common >= _ALONG * max(float(np.std(asked) * np.std(moved)), 1e-12)
    return _as_faults(flight, found) if near and follows else ()


def resting_width_deg(noise: float, step: float) -> float:
    """Within how much a surface at rest reads, by its noise and the step of its reading [deg]."""
    return min(_WIDTH_DEG + _WIDTH_SIGMAS * noise + _WIDTH_STEPS * step, _WIDEST_DEG)


def resting_runs(measured_deg: FloatArray, width_deg: float) -> IntArray:
    """Label of the run to which each sample belongs, shape (n,): samples of one run lie within a width [deg]."""
    labels = np.zeros(measured_deg.size, dtype=np.int64)
    _label(measured_deg, width_deg, labels)
    return labels


@compiled
def _label(measured_deg: FloatArray, width_deg: float, labels: IntArray) -> None:
    low = high = measured_deg[0]
    label = 0
    for k in range(measured_deg.size):
        value = measured_deg[k]
        low, high = min(low, value), max(high, value)
        if high - low > width_deg:
            label += 1
            low = high = value
        labels[k] = label


def _resting(flight: _Flight) -> Iterator[_Stretch]:
    """Jammed, at an end of the travel or anywhere else."""
    width_deg, missed_deg = flight.width_deg, flight.missed_deg
    labels = resting_runs(flight.measured_deg, width_deg)
    begins = np.flatnonzero(np.diff(labels, prepend=-1))
    ends = np.append(begins[1:], labels.size)
    time_s, step_s = flight.time_s, np.diff(flight.time_s, append=flight.time_s[-1])
    usual_s = float(np.median(step_s))
    step_s = np.minimum(step_s, 3.0 * usual_s)
    low_deg, high_deg = float(flight.reached_deg.min()), float(flight.reached_deg.max())
    usual_deg = float(np.percentile(np.abs(flight.healthy_deg), _USUAL))
    stops = high_deg - low_deg >= max(_LEAST_TRAVEL * float(np.ptp(flight.healthy_deg)), _LEAST_TRAVEL_DEG)
    late_s = _MISSED_S + 2.0 * (flight.lag_s + flight.delay_s)
    largest_deg = np.maximum.reduceat(np.abs(flight.error_deg), begins)
    may_be = (time_s[ends - 1] - time_s[begins] >= late_s) & ~(largest_deg <= missed_deg)
    for begin, end in zip(begins[may_be].tolist(), ends[may_be].tolist(), strict=True):
        rows = slice(begin, end)
        at_deg = float(np.median(flight.measured_deg[rows]))
        # Beyond a stop nobody expects it; what rests elsewhere is not held by one.
        asked_deg = np.clip(
            flight.healthy_deg[rows],
            low_deg if stops and at_deg <= low_deg + width_deg else -np.inf,
            high_deg if stops and at_deg >= high_deg - width_deg else np.inf,
        )
        beyond_deg = asked_deg - flight.measured_deg[rows]
        off_deg = np.abs(beyond_deg)
        missed = off_deg > missed_deg + _SCALE * np.maximum(np.abs(asked_deg) - usual_deg, 0.0)
        missed_s = np.cumsum(step_s[rows] * missed)
        far = off_deg > max(_FAR_DEG, _FAR_SHARE * flight.travel_deg)
        far_s = np.cumsum(step_s[rows] * far)
        # What is held up from one side may be a load, or an obstacle: a jam is on the wrong side of some commands.
        both = beyond_deg.max() > 1.0 and beyond_deg.min() < -1.0
        long_s = late_s if both else max(late_s, _ONE_SIDED_S)
        jammed = missed_s[-1] >= long_s and float(np.ptp(asked_deg)) >= _ASKED_DEG
        if not jammed and far_s[-1] < _FAR_S + long_s:
            continue
        seen = int(np.searchsorted(missed_s, long_s) if jammed else np.searchsorted(far_s, _FAR_S + long_s))
        seen_s = float(time_s[min(begin + seen, end - 1)])
        hard = off_deg[0] >= _FAR_DEG
        latest = begin + int(missed.argmax())
        yield _Stretch(
            "hardover" if hard else "stuck",
            _onset_s(flight, begin, latest) if hard else _stopped_s(flight, begin, latest, at_deg, width_deg),
            seen_s,
            float(time_s[end - 1]),
            {"position_deg": at_deg},
        )


def _onset_s(flight: _Flight, earliest: int, latest: int) -> float:
    """Last instant at which the position was where it should be, before it clearly was not [s]."""
    near_deg = max(4.0 * flight.noise_deg, 2.0 * flight.step_deg, 0.6)
    near = np.flatnonzero(np.abs(flight.error_deg[: latest + 1]) <= near_deg)
    return float(flight.time_s[max(int(near[-1]), earliest - 1, 0)] if near.size else flight.time_s[earliest])


def _stopped_s(flight: _Flight, begin: int, latest: int, at_deg: float, width_deg: float) -> float:
    """When the surface stopped [s]: before, it is where the servo is but for an offset; after, where it rests.

    Of the instants that suit nearly as well as the best, the last: nobody sees a jam while nothing is asked.
    """
    measured_deg, error_deg = flight.measured_deg, flight.error_deg
    elsewhere = np.flatnonzero(np.abs(measured_deg[:begin] - at_deg) > width_deg)
    earliest = int(elsewhere[-1]) + 1 if elsewhere.size else 0
    if latest <= earliest:
        return float(flight.time_s[earliest])
    before = int(np.searchsorted(flight.time_s, flight.time_s[earliest] - _BEFORE_S))
    moves = error_deg[before : latest + 1] - error_deg[before]
    rests = (measured_deg[before : latest + 1] - at_deg) ** 2
    count = np.arange(moves.size)
    total, power = (np.concatenate([[0.0], np.cumsum(x)[:-1]]) for x in (moves, moves**2))
    cost = power - total**2 / np.maximum(count, 1) + np.cumsum(rests[::-1])[::-1]
    cost = cost[earliest - before :]
    usual_deg = 1.5 * float(np.median(np.abs(error_deg)))  # what the fitted servo lacks
    sigma_deg = max(flight.noise_deg, flight.step_deg, usual_deg, _LEAST_SIGMA_DEG)
    alike = np.flatnonzero(cost <= cost.min() + _ALIKE * sigma_deg**2)
    return float(flight.time_s[earliest + int(alike[-1])])


def _moving(flight: _Flight) -> Iterator[_Stretch]:
    """Windows in which it moves as nobody asked it to, or far too late."""
    time_s = flight.time_s
    hops = np.floor((time_s - time_s[0]) / _HOP_S)
    hops = hops[np.diff(hops, prepend=-1.0) > 0.0]  # a damaged clock leaves more silence than can be counted
    if hops[-1] >= hops.size:
        hops = np.unique(hops[:, None] - np.arange(round(_WINDOW_S / _HOP_S)))
    starts = time_s[0] + _HOP_S * hops[hops >= 0.0]
    starts = starts[starts <= time_s[-1] - _WINDOW_S]
    firsts = np.searchsorted(time_s, starts)
    lasts = np.searchsorted(time_s, starts + _WINDOW_S)
    enough = lasts - firsts >= max(0.6 * _WINDOW_S / max(float(np.median(np.diff(time_s))), 1e-9), 2.0)
    firsts, lasts = firsts[enough], lasts[enough]
    power, common, error_power = _spread_of_rate(flight, firsts, lasts)
    brisk: list[_Stretch] = []
    for k in range(firsts.size):
        rows = slice(int(firsts[k]), int(lasts[k]))
        found = _strange(flight, rows) if error_power[k] > _WRONG_DEG**2 else None
        if found is not None:
            yield found
            continue
        behind = _behind(flight, rows, float(power[k]), float(common[k]), float(error_power[k]))
        if behind is not None:
            brisk.append(behind)
    yield from _lasting(brisk)


def _strange(flight: _Flight, rows: slice) -> _Stretch | None:
    """A window whose motion the command does not explain."""
    time_s, error, asked = flight.time_s[rows], flight.error_deg[rows], flight.healthy_deg[rows]
    span = (_left_s(flight, rows), float(time_s[-1]), float(time_s[-1]))
    line = _line(time_s, error, asked)
    if line is not None:
        frequency_hz, amplitude_deg = line
        return _Stretch("oscillation", *span, {"amplitude_deg": amplitude_deg, "frequency_hz": frequency_hz})
    moved = flight.measured_deg[rows]
    held_up = float(error.min()) > 1.0 or float(error.max()) < -1.0  # from one side, by a load or an obstacle
    if held_up or span[1] - span[0] < _SEEN_SAMPLES * flight.usual_s:  # the next window tells
        return None
    asked_deg, moved_deg = float(np.std(asked)), float(np.std(moved))
    slope, explained = _best_slope(flight, rows)
    amplitude_deg = float(np.ptp(moved)) / 2.0
    if asked_deg >= _BRISK_DEG and abs(slope) < _FOLLOWS:
        if 2.0 * amplitude_deg <= flight.width_deg:
            # A model that comes late to where the surface rests already tells nothing of it.
            arrived = np.abs(error[time_s >= time_s[-1] - _ARRIVED_S]).max() <= flight.missed_deg
            return None if arrived else _Stretch("stuck", *span, {"position_deg": float(np.median(moved))})
        return _Stretch("floating", *span, {"amplitude_deg": amplitude_deg})
    # An offset that comes at once is no motion of its own.
    halves_deg = [float(np.std(half)) for half in np.array_split(moved, 2)]
    if min(moved_deg / 1.5, *halves_deg) >= _WRONG_DEG and explained < _FOLLOWS:
        return _Stretch("floating", *span, {"amplitude_deg": amplitude_deg})
    return None


def _left_s(flight: _Flight, rows: slice) -> float:
    """When the error of a window leaves what it is as a rule [s]."""
    size_deg = np.abs(flight.error_deg[rows])
    off = size_deg > max(6.0 * flight.noise_deg, 0.5 * float(size_deg.max()))
    return float(flight.time_s[rows][int(off.argmax())])


def _best_slope(flight: _Flight, rows: slice) -> tuple[float, float]:
    """Slope and share of the position's variance explained by the healthy deflection, at the lag that suits it best.

    An offset that comes within the window is left out of account.
    """
    time_s = flight.time_s[rows]
    after = time_s >= _left_s(flight, rows)
    asked_deg = [np.interp(time_s - lag_s, flight.time_s, flight.healthy_deg) for lag_s in _LAGS_S]
    best = (0.0, 0.0)
    for later in (after,) if after.all() else (after, np.ones(time_s.size, dtype=bool)):
        moved = _about_means(flight.measured_deg[rows], later)
        for late_deg in asked_deg:
            asked = _about_means(late_deg, later)
            common, asked2, moved2 = float(asked @ moved), float(asked @ asked), float(moved @ moved)
            explained = common**2 / max(asked2 * moved2, 1e-300)
            if explained > best[1]:
                best = (common / max(asked2, 1e-300), explained)
    return best


def _about_means(values: FloatArray, later: BoolArray) -> FloatArray:
    """Values about their mean before, and about their mean after."""
    result = values.copy()
    for part in (later, ~later):
        if part.any():
            result[part] -= result[part].mean()
    return result


def _line(time_s: FloatArray, error: FloatArray, asked: FloatArray) -> tuple[float, float] | None:
    """Frequency [Hz] and amplitude [deg] of an oscillation of the error that the command has no part in."""
    step_s = float(np.median(np.diff(time_s)))
    frequencies = np.arange(_SLOWEST_HZ, min(1.0 / (_SAMPLES * step_s), _FASTEST_HZ), 0.25 / _WINDOW_S)
    if frequencies.size == 0:
        return None
    taper = np.hanning(time_s.size)
    since_s = time_s - time_s[0]
    turns = np.empty((frequencies.size, time_s.size), dtype=np.complex128)
    turns[0] = np.exp(-2j * np.pi * frequencies[0] * since_s)
    turns[1:] = np.exp(-0.5j * np.pi / _WINDOW_S * since_s)  # from each frequency to the next
    waves = np.multiply.accumulate(turns)
    scale = 2.0 / taper.sum()
    # Without BLAS, whose threads wait for each other longer than so small a product takes.
    amplitude = np.abs(np.einsum("ij,j->i", waves, taper * (error - error.mean()))) * scale
    best = int(np.argmax(amplitude))
    size_deg = float(amplitude[best])
    own_deg = float(np.abs(waves[best] @ (taper * (asked - asked.mean()))) * scale)
    share = 0.5 * size_deg**2 / max(float(np.var(error)), 1e-12)
    if size_deg < _LINE_DEG or share < _LINE_SHARE or own_deg > _NOT_ASKED * size_deg:
        return None
    away = error - error.mean()
    crossed = np.count_nonzero(np.diff(np.sign(away[np.abs(away) >= 0.5 * size_deg])))  # from one side to the other
    if crossed < _TURNS * frequencies[best] * (time_s[-1] - time_s[0]):
        return None
    return float(frequencies[best]), size_deg


def _behind(flight: _Flight, rows: slice, power: float, common: float, error_power: float) -> _Stretch | None:
    """A window brisk enough to tell whether it lags behind more than it does as a rule; its scale is 1 where not."""
    enough_s = max(_LAG_SHARE * flight.lag_s, _LAG_S)
    brisk = enough_s * np.sqrt(power) >= _LAG_DEG
    if not brisk:
        return None
    lag_s = -common / power
    explained = lag_s**2 * power / max(error_power, 1e-12)
    late = lag_s >= enough_s and explained >= _LAG_EXPLAINS
    scale = flight.lag_s / (flight.lag_s + lag_s) if late else 1.0
    first_s, last_s = float(flight.time_s[rows.start]), float(flight.time_s[rows.stop - 1])
    return _Stretch("slow", first_s, last_s, last_s, {"bandwidth_scale": scale})


def _spread_of_rate(flight: _Flight, firsts: IntArray, lasts: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each window: variance of the healthy rate, its covariance with the error, and the error's variance.

    A rate is that of the parabola through three points, and at the ends of a window that of a line.
    """
    if not firsts.size:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    error, rate = flight.error_deg, np.gradient(flight.healthy_deg, flight.time_s)
    straight = np.diff(flight.healthy_deg) / np.diff(flight.time_s)
    ends = ((firsts, straight[firsts]), (lasts - 1, straight[lasts - 2]))
    edges, count = np.stack([firsts, lasts], axis=1).ravel(), lasts - firsts

    def mean(values: FloatArray, power: int, weight: FloatArray) -> FloatArray:
        """Of a power of the rate, weighted."""
        total = np.add.reduceat(np.append(values**power * weight, 0.0), edges)[::2]
        if power:
            total = total + sum((own**power - values[at] ** power) * weight[at] for at, own in ends)
        return np.asarray(total / count, dtype=np.float64)

    one = np.ones(error.size)
    mean_rate, mean_error = mean(rate, 1, one), mean(rate, 0, error)
    variance = mean(rate, 0, error**2) - mean_error**2
    return mean(rate, 2, one) - mean_rate**2, mean(rate, 1, error) - mean_rate * mean_error, variance


def _lasting(brisk: list[_Stretch]) -> Iterator[_Stretch]:
    """A lag that is there in most of what can tell, from some time on."""
    late = [s.parameters["bandwidth_scale"] < 1.0 for s in brisk]
    for k in np.flatnonzero(late).tolist():
        rest = [s for s, is_late in zip(brisk[k:], late[k:], strict=True) if is_late]
        if len(rest) < _LATE_SHARE * (len(brisk) - k) or _union_s(rest) < _LATE_S:
            continue
        scale = float(np.median([s.parameters["bandwidth_scale"] for s in rest]))
        seen_s = next(s.seen_s for j, s in enumerate(rest) if _union_s(rest[: j + 1]) >= _LATE_S)
        yield _Stretch("slow", rest[0].start_s, seen_s, rest[-1].end_s, {"bandwidth_scale": scale})
        return


def _as_faults(flight: _Flight, found: list[_Stretch]) -> tuple[Fault, ...]:
    """Stretches that belong together joined, the plainest kind first."""
    joined: list[list[_Stretch]] = []
    for stretch in sorted(found, key=lambda s: s.start_s):
        if joined and stretch.start_s - max(s.end_s for s in joined[-1]) <= _JOINED_S:
            joined[-1].append(stretch)
        else:
            joined.append([stretch])
    faults = [(_as_fault(group, flight.last_s), _union_s(group)) for group in joined]
    least_s = {"floating": _FLOATS_S, "oscillation": _WAVE_SAMPLES * flight.usual_s}
    return tuple(fault for fault, lasted_s in faults if lasted_s >= least_s.get(fault.kind, 0.0))


def _union_s(stretches: list[_Stretch]) -> float:
    """How long they last together, what they share counted once [s]."""
    total_s, until_s = 0.0, -np.inf
    for stretch in sorted(stretches, key=lambda s: s.start_s):
        total_s += max(stretch.end_s - max(stretch.start_s, until_s), 0.0)
        until_s = max(until_s, stretch.end_s)
    return total_s


def _as_fault(group: list[_Stretch], end_s: float) -> Fault:
    lasted = {kind: _union_s([s for s in group if s.kind == kind]) for kind in _KINDS}
    kind = max((s.kind for s in group), key=lambda kind: (lasted[kind], -_KINDS.index(kind)))
    owner = max((s for s in group if s.kind == kind), key=lambda s: s.end_s - s.start_s)
    others = tuple(k for k in _KINDS if k != kind and lasted[k] > 0.0)
    last_s = max(s.end_s for s in group)
    parameters = {name: Estimate(value, value, value) for name, value in owner.parameters.items()}
    return Fault(
        kind,
        min(s.start_s for s in group),
        min(s.seen_s for s in group),
        None if last_s >= end_s - _WINDOW_S else last_s,
        parameters,
        0.99 if not others else 0.9,
        others,
        named_s=owner.seen_s,
    )


_DECIMALS = 6
_FEW_VALUES = 0.5
"""Values that come again and again, fewer than this share of all, are steps; others are as fine as they can be."""
_SMALL_STEP = 10.0


def step_deg(values_deg: FloatArray) -> float:
    """Smallest step in which a stream comes [deg]; 0 if it is finer than it is noisy."""
    given = values_deg[np.isfinite(values_deg)]
    moved = given[1:][np.diff(given) != 0.0] if given.size > 1 else given
    values = np.unique(np.round(moved, _DECIMALS))
    if values.size < 2 or values.size > _FEW_VALUES * moved.size:
        return 0.0
    return float(np.percentile(np.diff(values), _SMALL_STEP))


_FIT = 0.9
"""Share of the position's variance that a line through the healthy deflection has to explain."""
_SAME_SLOPE = 0.15
_SMALLEST_GAIN, _LARGEST_GAIN = 0.1, 1.3
ENOUGH_MOTION_DEG = 1.0
_PARTS = 3


def wiring_problem(residuals: Residuals) -> str:
    """That position follows the command with a gain that no servo has, from the first to the last third.

    Empty if sign and scale are plausible, or it does not follow at all.
    """
    parts = [_gain(residuals, part) for part in np.array_split(np.flatnonzero(residuals.settled), _PARTS)]
    gains = [gain for gain in parts if gain is not None]
    if not gains or not all(gains):
        return ""
    gain = float(np.median(gains))
    if _SMALLEST_GAIN <= gain <= _LARGEST_GAIN or max(abs(g - gain) for g in gains) > _SAME_SLOPE * abs(gain):
        return ""
    what = "sign" if gain < 0.0 else "scale"
    return f"position is {gain:.2f}x the command throughout: check the {what} of the calibration"


def _gain(residuals: Residuals, part: IntArray) -> float | None:
    """Slope of the position over the healthy deflection; 0 if it does not follow, None without motion."""
    asked, measured = residuals.simulated_deg[part], residuals.measured_deg[part]
    if part.size < 2 or np.std(asked) < ENOUGH_MOTION_DEG / 2.0:
        return None
    spread = np.cov(asked, measured)
    slope = spread[0, 1] / spread[0, 0]
    explained = spread[0, 1] ** 2 / max(spread[0, 0] * spread[1, 1], 1e-300)
    return float(slope) if explained >= _FIT else 0.0

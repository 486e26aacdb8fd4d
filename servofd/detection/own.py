"""The servo that a log shows by itself: fitted to the part of it that explains the whole best.

Neither the servo nor the part of the log that is good is known. The whole log is fitted; unless it moves alike and
leaves no fault, so are its thirds, each by itself, what came before a fault that was there from the first motion on and
mended itself, then the log's first and last sixths and twelfths if none of them is like a sound servo. A part counts if
its servo explains what the surface does there and stays below its own limits; of those that count, the one is taken
that explains the whole log best, with the faults that it sees there, and that is most like a sound servo. A servo that
was faulty throughout is what was fitted, and only what sound servos are like can tell.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.aircraft.calibrated import CalibratedServo, lower_triangle
from servofd.aircraft.priors import NAMES
from servofd.core.evidence import ModelOrigin
from servofd.detection.changes import FLOORS, MARGIN, SQUARES, STATISTICS
from servofd.detection.faults import judged
from servofd.detection.flights import busiest, cropped
from servofd.detection.known import constant_deg, hardly_moved, known_servo, linear_servo, tolerance_of
from servofd.detection.lasting import lasting
from servofd.detection.moving import statistics_of, watched
from servofd.estimate.fit import LEAST_DEG, fit, reach_of, top_speed
from servofd.estimate.record import Record, usual_airspeed_m_s, usual_supply_v

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servofd.aircraft.series import Series
    from servofd.core.tolerance import Tolerance
    from servofd.core.types import FloatArray
    from servofd.detection.lasting import Lasting
    from servofd.estimate.fit import Fit
    from servofd.servo.library import Servo

_PARTS: Final = (1, 3, 6, 12)
"""Into how many parts a log is cut, one after the other."""
_MOST_SAMPLES: Final = 3_000
"""Of a part that are fitted: a minute at 50 Hz."""
_EXPLAINS: Final = 0.3
"""Share of the motion, held out, that the servo of a part explains there, or it is none."""
_SHORT_EXPLAINS, _FAR_EXPLAINS, _NOISE_DEG = 0.6, 0.95, 0.5
"""The same of less than a third of the log, and of a servo that is like no sound one or leaves more than noise [deg]:
some motion goes with some command by chance."""
_LARGE_PARTS: Final = 3
"""So many or fewer are large, and all of them are tried."""
_SHORTEST_S: Final = 4.0
"""Of a part: what a servo does in less is no measure of the rest. A third of the cycles of a test stand lasts 4.3 s."""
_TELLING_S: Final = 5.0
"""Length of a part that can show a fault which ends: a gripper was held for 2 s by its load, beside a part of 4 s.
What happens so soon in a log happens at its beginning."""
_OWN_LIMITS: Final = 2.8
"""Times the usual limits that the part itself may reach: 2.2 in a good third with a rough landing."""
_WHOLE_LIMITS: Final = 1.15
"""The same of the whole log."""
_OWN_MARGIN: Final = 1.6
"""Times what the part itself reaches where it was left out of the fit."""
_ALIKE_S, _LEAST_FREEDOM, _RARE_SIGMAS = 0.6, 2.0, 4.0
"""Time within which samples are alike, least degrees of freedom, and how rare a good servo passes a limit."""
_PUSHED: Final = 0.5
"""Share of what the usual air does to a servo by which its parts may differ, where no airspeed was logged."""
_APART: Final = 0.5
"""Parts of one flight differ by so much of what flights differ by: one supply, one day, one zero of the sensor."""
_HELD_OUT_S, _MOST_SIGMAS = 30.0, 6.0
"""Shortest part of which samples are held out (they are in stretches of 20 s), and deviations that an error counts."""
_SOUND_ENOUGH: Final = 2.5
"""Nats below which no shorter part is tried: one fault of a servo that is one deviation from a sound one."""
_EACH_FAULT: Final = 2.0
"""Nats: one surface in some has a fault."""
_MENDED, _MOVES_DEG = 20.0, 1.0
"""Nats: servos break and stay so; none is at fault from its first motion on, by so much [deg], and mends itself."""
_FASTER, _FASTER_S, _NEVER_FASTER = 1.2, 0.2, 50.0
"""Times its largest speed a position moves for so long in all [s], beyond what noise makes of it: no servo was ever
faster than it can be, whatever its fault, and one that was is less likely by so many nats."""
_MOST_MISFIT: Final = 25.0
"""Squared standard deviations that one reading counts for, as where a fault is timed."""
_WINDOW_S: Final = 5.0
"""What one stretch leaves unexplained is no better for the others that are at rest."""
_CONTRADICT: Final = 4.0
"""Standard deviations between two parts of which one servo is no account."""
_GAIN, _BIAS_DEG, _REST_DEG, _SLOWEST_DEG_S, _SPEED = 0.15, 2.0, 1.5, 60.0, 0.3
"""What sound servos are like whose command and position are in one unit: standard deviations of their gain and offset,
width of dead band, friction and play together, and the speed below which they are slow, with its logarithm's."""
_SLOWEST_RAD_S, _BANDWIDTH, _LEAST_DAMPING, _DAMPING = 20.0, 0.3, 0.37, 0.21
"""The bandwidth and damping below which they are rare, and deviations of their logarithms: of 138 sound surfaces (24
aircraft of even seed, 6 simulated, 4 flights in wind) 137 have more than 18 rad/s and 133 more than .31. A flight that
swings through its autopilot is explained by a servo of 9 to 16 rad/s that rings."""
_UNUSUAL: Final = 3.0
"""Deviations from a sound servo beyond which a log is not cleared."""
_CAUGHT_UP_S, _LASTS_S = 2.0, 3
"""After so long even a slow servo is where it was asked to be, and so many seconds in a row are no passing thing."""
_TURNS_DEG: Final = 180.0
"""No surface is further from its command: a reading that is has another unit, or is none."""
_SPEED_NOISE_S: Final = 80.0
"""Speed that noise makes over a twentieth of a second, three deviations of two readings, over that noise [1/s]."""
_LN_BANDWIDTH, _LN_DAMPING, _DEADBAND, _FRICTION, _PLAY, _RATE = (
    NAMES.index(name) for name in ("ln_bandwidth", "ln_damping", "deadband_deg", "friction_deg", "play_deg", "ln_rate")
)


@dataclass(frozen=True, slots=True, eq=False)
class OwnServo:
    """The servo of one surface, as its log shows it."""

    known: CalibratedServo
    linear: Servo
    """Its linear part."""
    tolerance: Tolerance
    """How far a good one strays from the linear part."""
    threshold_deg: float
    """Constant threshold that the part stayed below, with a margin."""
    origin: ModelOrigin
    lasting: Lasting
    """How sure it has changed since each instant of the log."""

    def with_own_scale(self) -> OwnServo:
        """The same servo for a command that is scaled and shifted until it has neither a gain nor an offset."""
        gain = self.known.parameters["gain"]
        scales = np.where(np.array(NAMES) == "gain", gain, 1.0)
        known = self.known.model_copy(
            update={
                "parameters": {**self.known.parameters, "gain": 1.0, "bias_deg": 0.0},
                "between": lower_triangle(self.known.covariance / np.outer(scales, scales)),
            }
        )
        return replace(self, known=known.model_copy(update={"doubt": unusual(known.theta)}))


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A part of the log and the servo fitted to it."""

    between_s: tuple[float, float]
    fitted: Fit
    known: CalibratedServo
    sigma_deg: FloatArray
    """Of the whole log, as far as this servo knows, shape (m,)."""
    left_deg: FloatArray
    """What it and its faults leave of the whole log, shape (m,)."""
    apart: float
    """Half of the squared deviations from a sound servo, and what its faults cost [nats]."""
    time_s: FloatArray
    """Of the whole log, shape (m,)."""
    fitted_s: FloatArray
    """Times of the samples that were fitted, shape (n,)."""
    period_s: float
    is_whole: bool
    lasting: Lasting
    """How sure it has changed since each instant of the whole log."""
    explains_all: bool
    """Whether it is like a sound servo, and no fault and no change is left in the log."""
    mended_s: float
    """When a fault that was there from its first motion on was over [s]; NaN without one."""


def own_servo(segment: Series, source: str = "the log", *, before_s: float = np.inf) -> OwnServo | ModelOrigin:
    """Return the servo that a log shows by itself; where it shows none, how well the best one explains it.

    `source` names the log; what comes before a time [s] is the part that is sound, if that is known.
    """
    usual = usual_supply_v(segment.context), usual_airspeed_m_s([segment.context])
    segment = segment.coarser()
    segment = segment.at(np.isfinite(segment.measured_deg))
    whole = Record.of(segment, *usual)
    if not whole.usable.any():
        return ModelOrigin(origin="none")
    reach_deg = reach_of([whole])
    found: list[_Part] = []
    share: float | None = None
    start: FloatArray | None = None
    for count in _PARTS if np.isinf(before_s) else _PARTS[1:2]:
        for between_s, part in _parts(segment, count, found, before_s):
            records = _records(part, usual)
            if not records:
                continue
            fitted = fit(records, start=start, reach_deg=reach_deg, is_alone=True)
            if count == 1:
                share = fitted.explained_share
            if fitted.explained_share >= _least_share(count, fitted):
                start = fitted.theta if start is None else start
                one = _judged(between_s, fitted, records, whole, usual, is_whole=count == 1)
                found += [one] if one is not None else []
        if found and (_is_settled(_best(found), whole) if count > 1 else found[0].explains_all):
            break
    if not found:
        return ModelOrigin(origin="none", explained_share=share)
    return _own(_best(found), found, source)


def fitted_to(segment: Series) -> Fit | None:
    """The servo that explains the busiest minute of a log; None where no sample of it counts."""
    usual = usual_supply_v(segment.context), usual_airspeed_m_s([segment.context])
    records = _records(segment.coarser(), usual)
    return fit(records, is_alone=True) if records else None


def _records(part: Series, usual: tuple[float, float]) -> list[Record]:
    """What is fitted of a part of a log."""
    pieces = (Record.of(each, *usual) for each in busiest(part, _MOST_SAMPLES))
    return [record for record in pieces if record.usable.any()]


def _is_settled(best: _Part, whole: Record) -> bool:
    """Whether no shorter part need be tried: it is like a sound servo, from the log's beginning on."""
    return best.apart < _SOUND_ENOUGH and best.between_s[0] - whole.time_s[0] < _TELLING_S


def _best(found: list[_Part]) -> _Part:
    """The part whose servo, and faults, tell most of the whole log and are most likely to begin with."""
    costs = _costs(found)
    return found[costs.index(min(costs))]


def _costs(found: list[_Part]) -> list[float]:
    """How unlikely each part and what it makes of the log is, beside the others [nats]."""
    sharpest = _sharpest(found)

    def cost(part: _Part) -> float:
        unknown = 0.5 * float(np.log(np.nanmean(part.sigma_deg**2) / np.nanmean(sharpest.sigma_deg**2)))
        two = sum(_better(other, part) for other in found) if part.is_whole else 0.0
        return _unexplained(part, sharpest) + part.apart + unknown + two

    return [cost(part) for part in found]


def _sharpest(found: list[_Part]) -> _Part:
    """The part whose servo knows best where it stands."""
    return min(found, key=lambda each: float(np.nanmean(each.sigma_deg**2)))


def _unexplained(part: _Part, sharpest: _Part) -> float:
    """What a part and its faults leave of the log, over the sigma of the sharpest [nats]."""
    squares = np.minimum((part.left_deg / sharpest.sigma_deg) ** 2, _MOST_MISFIT)
    known = np.isfinite(squares)
    window = np.floor(part.time_s[known] / _WINDOW_S).astype(int)
    first = np.flatnonzero(np.diff(window, prepend=window[:1] - 1))
    count = np.diff(first, append=window.size)
    misfit = np.maximum(np.add.reduceat(squares[known], first) / count, 1.0) if first.size else np.zeros(0)
    return 0.5 * _WINDOW_S / _ALIKE_S * float(np.log(misfit).sum())


def _better(part: _Part, whole: _Part) -> float:
    """By how much a part predicts itself, held out, better than the whole does [nats]: the mean of two servos is none.

    A part that is too short to be held out tells nothing.
    """
    if part.is_whole or part.between_s[1] - part.between_s[0] < _HELD_OUT_S:
        return 0.0
    rows = np.searchsorted(whole.time_s, part.fitted_s)
    held_out_deg = np.concatenate([each[np.isfinite(each)] for each in part.fitted.held_out_deg])
    known = np.isfinite(whole.left_deg[rows])
    if not known.any():
        return 0.0
    errors_deg = np.stack([whole.left_deg[rows], held_out_deg])[:, known]
    most_deg = _MOST_SIGMAS * float(np.median(part.fitted.sigma_deg))
    squares = np.mean(np.minimum(np.abs(errors_deg), most_deg) ** 2, axis=1) + LEAST_DEG**2
    alike = part.fitted_s.size * part.period_s / _ALIKE_S
    return max(0.5 * alike * float(np.log(squares[0] / squares[1])), 0.0)


def _least_share(count: int, fitted: Fit) -> float:
    """Share of the motion that the servo of one of so many parts has to explain."""
    is_unusual, is_large = bool(unusual(fitted.theta)), count <= _LARGE_PARTS
    if is_unusual and not is_large:
        return np.inf
    if is_unusual or fitted.held_out_rms_deg > _NOISE_DEG:
        return _FAR_EXPLAINS
    return _EXPLAINS if is_large else _SHORT_EXPLAINS


def parts_of(segment: Series, count: int) -> Iterator[tuple[tuple[float, float], Series]]:
    """Yield from when to when each of so many parts of a log lasts [s], and it, where enough moves; small ones at ends.

    A short part in the middle may go with the command by chance.
    """
    edges_s = np.linspace(segment.measured_s[0], segment.measured_s[-1], count + 1).tolist()
    parts = list(itertools.pairwise(edges_s))
    for from_s, to_s in parts if count <= _LARGE_PARTS else (parts[0], parts[-1]):
        if to_s - from_s >= _SHORTEST_S or count == 1:
            yield from _between(segment, from_s, to_s)


def _parts(
    segment: Series, count: int, found: list[_Part], before_s: float
) -> Iterator[tuple[tuple[float, float], Series]]:
    """Parts of a log that are tried when so many are: what comes before a time [s] alone, if that is known."""
    if np.isfinite(before_s):
        yield from _between(segment, float(segment.measured_s[0]), before_s)
        return
    yield from parts_of(segment, count)
    if count > 1:
        yield from _before_mended(segment, found)


def _before_mended(segment: Series, found: list[_Part]) -> Iterator[tuple[tuple[float, float], Series]]:
    """What came before a fault that mended itself: it may be what is sound, and the rest at fault."""
    from_s, tried_s = float(segment.measured_s[0]), {each.between_s[1] for each in found}
    for to_s in sorted({each.mended_s for each in found if each.mended_s - from_s >= _SHORTEST_S} - tried_s):
        yield from _between(segment, from_s, to_s)


def _between(segment: Series, from_s: float, to_s: float) -> Iterator[tuple[tuple[float, float], Series]]:
    """One part of a log, if enough moves in it."""
    part = cropped(segment, ((from_s, to_s),))
    if not hardly_moved([part]):
        yield (from_s, to_s), part


def _judged(
    between_s: tuple[float, float],
    fitted: Fit,
    records: list[Record],
    whole: Record,
    usual: tuple[float, float],
    *,
    is_whole: bool,
) -> _Part | None:
    """The part, if its servo stays below the usual limits there; a part may reach some times as much."""
    known = known_servo(fitted, records, *usual, pushed=_PUSHED, apart=_APART)
    usually = MARGIN * np.array([FLOORS[name] for name in STATISTICS])
    times = _times_as_wide(whole.period_s * sum(float(np.count_nonzero(record.usable)) for record in records))
    is_short = between_s[1] - between_s[0] < _TELLING_S
    if is_short:  # statistics count six standard deviations at most, and must be able to pass their limits
        known = _less_sure(known, times)
    else:
        usually *= np.where(SQUARES, times**2, times)
    largest = np.zeros(len(STATISTICS))
    for record, left_deg in zip(records, fitted.held_out_deg, strict=True):
        largest = np.maximum(largest, statistics_of(known, record, left_deg))
    if (largest > (_WHOLE_LIMITS if is_whole else _OWN_LIMITS) * usually).any():
        return None
    limits = np.maximum(usually, _OWN_MARGIN * largest)
    thresholds = {name: float(f"{limit:.3g}") for name, limit in zip(STATISTICS, limits.tolist(), strict=True)}
    known = known.model_copy(update={"thresholds": thresholds})
    flight = watched(known, whole)
    if not flight.judged.any():
        return None
    story = judged(flight)
    seen = len(story.faults) + len(story.suspicions)
    mended = [fault for fault in story.faults if fault.end_s is not None]
    if mended and is_short:
        return None
    moved = np.abs(whole.measured_deg - whole.measured_deg[0]) > _MOVES_DEG
    first_s = whole.time_s[np.argmax(moved)] + _TELLING_S
    mended_s = max((fault.end_s for fault in mended if fault.end_s and fault.start_s < first_s), default=np.nan)
    seen_deg_s = top_speed(whole, _FASTER_S) - _SPEED_NOISE_S * known.noise.still_deg
    was_faster = seen_deg_s > _FASTER * float(np.exp(fitted.theta[_RATE]))
    apart = 0.5 * sum(each**2 for each in _deviations(fitted.theta).values()) + _EACH_FAULT * seen
    apart += _MENDED * np.isfinite(mended_s) + _NEVER_FASTER * was_faster
    over_all = lasting(flight)
    is_sound = not seen and apart < _SOUND_ENOUGH and fitted.held_out_rms_deg < _NOISE_DEG
    explains_all = is_sound and over_all.shows_none()
    sigma_deg = np.where(flight.judged, flight.sigma_deg, np.nan)
    if np.nanmean(sigma_deg**2) > np.ptp(whole.measured_deg[flight.judged]) ** 2:  # a servo that could be anywhere
        return None
    fitted_s = np.concatenate([record.time_s[record.usable] for record in records])
    return _Part(
        between_s, fitted, known, sigma_deg, story.left_deg, apart, whole.time_s, fitted_s, whole.period_s, is_whole,
        over_all, explains_all, mended_s,
    )  # fmt: skip


def _times_as_wide(seconds: float) -> float:
    """How many times as far a fit to so little may err: Student's law in Gauss' place."""
    from scipy.special import ndtr, stdtrit  # takes longer to load than a named servo to judge

    freedom = max(seconds / _ALIKE_S, _LEAST_FREEDOM)
    return float(stdtrit(freedom, float(ndtr(_RARE_SIGMAS)))) / _RARE_SIGMAS


def _less_sure(known: CalibratedServo, times: float) -> CalibratedServo:
    """The same servo with so many times the noise and deviations."""
    wider = {name: float(f"{times * getattr(known.noise, name):.4g}") for name in ("still_deg", "lag_s")}
    noise = known.noise.model_copy(update=wider)
    return known.model_copy(update={"between": lower_triangle(times**2 * known.covariance), "noise": noise})


def _deviations(theta: FloatArray) -> dict[str, float]:
    """By how many deviations it differs from a sound servo, and how, in words."""
    rest_deg = theta[_DEADBAND] + 2.0 * theta[_FRICTION] + theta[_PLAY]
    slow = max(float(np.log(_SLOWEST_DEG_S)) - theta[_RATE], 0.0)
    late = max(float(np.log(_SLOWEST_RAD_S)) - theta[_LN_BANDWIDTH], 0.0)
    rings = max(float(np.log(_LEAST_DAMPING)) - theta[_LN_DAMPING], 0.0)
    return {
        f"its position moves by {theta[0]:.2f} times its command": abs(theta[0] - 1.0) / _GAIN,
        f"it stands off by {theta[1]:+.1f} deg": abs(theta[1]) / _BIAS_DEG,
        f"it rests within {rest_deg:.1f} deg of where it is asked to be": rest_deg / _REST_DEG,
        f"it is no faster than {float(np.exp(theta[_RATE])):.0f} deg/s": slow / _SPEED,
        f"it follows nothing quicker than {float(np.exp(theta[_LN_BANDWIDTH])) / math.tau:.1f} Hz": late / _BANDWIDTH,
        f"it rings, with a damping of {float(np.exp(theta[_LN_DAMPING])):.2f}": rings / _DAMPING,
    }


def _own(part: _Part, others: list[_Part], source: str) -> OwnServo:
    fitted, (from_s, to_s) = part.fitted, part.between_s
    doubt = unusual(fitted.theta) or _contradicted(part, others)
    known = part.known.model_copy(update={"doubt": doubt})
    return OwnServo(
        known,
        linear_servo(fitted.theta, f"fitted to {from_s:.0f} to {to_s:.0f} s of {source}"),
        tolerance_of(known),
        constant_deg(fitted),
        ModelOrigin(
            origin="fitted",
            held_out_rms_deg=float(f"{fitted.held_out_rms_deg:.4g}"),
            explained_share=round(fitted.explained_share, 4),
            fitted_between_s=(round(from_s, 3), round(to_s, 3)),
        ),
        part.lasting,
    )


def _contradicted(part: _Part, others: list[_Part]) -> str:
    """Which other part moves otherwise, in words; nothing if none does for sure."""
    for other in () if part.is_whole else others:  # of which the whole is an account
        spread = np.hypot(_sure(part), _sure(other))
        change = other.fitted.theta - part.fitted.theta
        changes = {
            f"moves by {other.fitted.theta[0] / part.fitted.theta[0]:.2f} times as much as": abs(change[0]) / spread[0],
            f"stands {change[1]:+.2g} deg off where it stood": abs(change[1]) / spread[1],
        }
        worst = max(changes, key=lambda text: changes[text])
        if changes[worst] > _CONTRADICT:
            (own_from_s, own_to_s), (from_s, to_s) = part.between_s, other.between_s
            return f"from {from_s:.0f} to {to_s:.0f} s it {worst} from {own_from_s:.0f} to {own_to_s:.0f} s"
    return ""


def _sure(part: _Part) -> FloatArray:
    """Standard deviations of the parameters of a part, shape (13,), by what its eighths disagree in as well."""
    return np.sqrt(np.maximum(np.diag(part.known.covariance), np.diag(part.fitted.scatter)))


def departed(segment: Series) -> str:
    """When a position stood where no sound servo would, of a log that no servo predicts; nothing if it never did.

    Before, it stood where one would, so that it is no matter of trim or scale; and it left once: what comes and goes
    has little to do with its command.

    Examples
    --------
    >>> from servofd.aircraft.series import Series
    >>> t = np.arange(0.0, 60.0, 0.1)
    >>> departed(Series("rudder", t, np.sin(t), t, np.where(t < 40.0, 0.0, -24.0)))
    'it stands 23 deg from all that it is asked for since 40 s'
    >>> departed(Series("rudder", t, np.sin(t), t, np.full(t.size, -24.0)))
    ''
    """
    known = np.isfinite(segment.measured_deg)
    time_s, measured_deg = segment.measured_s[known], segment.measured_deg[known]
    seconds = np.unique(np.floor(time_s))  # a clock may jump by years
    away_deg, at_deg = np.zeros((2, seconds.size))
    for k, from_s in enumerate(seconds):
        here = measured_deg[slice(*np.searchsorted(time_s, (from_s, from_s + 1.0)))]
        first, last = np.searchsorted(segment.command_s, (from_s - _CAUGHT_UP_S, from_s + 1.0)).tolist()
        asked_deg = segment.command_deg[max(first - 1, 0) : last]
        if here.size and asked_deg.size:
            at_deg[k] = at = float(np.median(here))
            allowed_deg = _UNUSUAL * (_BIAS_DEG + _GAIN * float(np.abs(asked_deg).max()))
            beyond = max(at - float(asked_deg.max()), float(asked_deg.min()) - at)
            away_deg[k] = beyond if allowed_deg < beyond < _TURNS_DEG else 0.0
    is_away = away_deg > 0.0
    if is_away.any():  # a command that goes there for a moment does not bring it back
        is_there = np.abs(at_deg - np.median(at_deg[is_away])) < _UNUSUAL * _BIAS_DEG
        is_away |= is_there & (seconds > seconds[np.argmax(is_away)])
    away = np.flatnonzero(is_away)
    if away.size < _LASTS_S or away[0] < _TELLING_S or np.ptp(away) >= away.size:
        return ""
    if np.abs(np.median(at_deg[: away[0]]) - np.median(at_deg[away])) < _UNUSUAL * _BIAS_DEG:
        return ""  # its command left, and it stayed
    begun_s, over_s = f"{seconds[away[0]]:.0f}", f"{seconds[away[-1]] + 1.0:.0f}"
    when = f"since {begun_s} s" if away[-1] == seconds.size - 1 else f"from {begun_s} to {over_s} s"
    return f"it stands {np.median(away_deg[away_deg > 0.0]):.0f} deg from all that it is asked for {when}"


def unusual(theta: FloatArray) -> str:
    """What about a servo no sound one is like, in words; nothing if there is nothing.

    Examples
    --------
    >>> from servofd.aircraft.priors import PRIORS
    >>> theta = np.array([prior.value for prior in PRIORS])
    >>> unusual(theta), unusual(theta - 0.6 * (np.arange(theta.size) == 0))
    ('', 'its position moves by 0.40 times its command from the beginning on, or its trim or scale is unusual')
    """
    found = ", ".join(text for text, deviations in _deviations(theta).items() if deviations > _UNUSUAL)
    return f"{found} from the beginning on, or its trim or scale is unusual" if found else ""

"""Whether an axis stopped answering as it did in the same flight before.

The reference is the flight's own past. An axis obeys one of the forms of `servofd.axes.model`, linear in its unknowns;
every second they are fitted to all that was flown before a trailing window, and what the window leaves,

    e = lambda x1 + beta x2 + A c,     x1 = -K F(g u),  x2 = K F(g),

is a lost share of the command's effect and an offset, beside what the fit does not know: A are its columns, and c has
its covariance (a short past extrapolates). The windows are those of `servofd.core.windows`; healthy ones differ by
S0, of other aircraft, and, with every window that passes, by what this flight showed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from servofd.aircraft.series import FLIES_M_S
from servofd.axes.model import DELAYS_S, FORMS, Filtered, Form, Regression
from servofd.axes.motion import Motion
from servofd.axes.verdict import excludes_none, left_out, named
from servofd.core.series import rms
from servofd.core.statistics import LEAST_DIVISOR, Estimate
from servofd.core.types import BoolArray, FloatArray, IntArray
from servofd.core.windows import Sizes, Sums, distance, fitted, lasting, least, split

Status = Literal["ok", "look", "unknown"]
"""Of a check on one flight, which never is a fault."""

WINDOWS_S = (5, 10, 20)
"""Lengths of the windows that are judged [s]."""
LEAST_PAST_S = 35
"""Flown before the first window that is judged: seven unknowns that were fitted to less extrapolate."""
_COLOUR_S = 1.0
"""Residuals less than a second apart count as one: gusts pass a small aeroplane in as much."""
_DELAY_FROM_S = 40
"""Flight from which the delay is found [s]."""
_RIDGE = 1e-3
"""Ridge of the regression, in units of its scaled diagonal."""
_LEAST_VARIANCE = 1e-12
"""Of a residual, in the square of its unit: a form that fits to the last digit has been fed with a constant."""
_PRIOR_WINDOWS = 8.0
"""What other aircraft's flights are worth, in windows of this one."""
_ENOUGH = 0.8
"""Share of a window that must be usable."""
_SLOW_HZ = 15.0
"""At lower rates an axis is seen in balance with its command; at higher ones its acceleration tells sooner."""
_FEIGNED, _AS_CALM = 0.5, 1.25
"""Loss that gusts may feign where nothing as calm was flown before, and how much more a command may move in a window
that was: in six gentle flights of PX4 at 10 Hz they feign 0.8, and all six looked wrong."""
_HELD_S = 3
"""Windows in a row, one a second, that must be over the threshold [s]."""
_LEAST_EXPLAINED = 0.5
"""Share of an axis' answer that a form explains in healthy flights: 0.75 to 0.99 in all that were measured."""
_AIRBORNE = 0.6
"""Share of the median airspeed above which an aircraft flies."""
_AFTER_TAKEOFF_S, _BEFORE_LANDING_S = 5.0, 3.0
"""Flight after take-off and before landing that is not judged [s]."""
_SLOWER, _IDLER = 0.95, 0.05
"""An aircraft that is slower, or asks for less of its engine, than it ever was before is not judged: there the fit
extrapolates, and a failed engine would be called an elevator."""
_REGIME_S, _REGIME_PAST_S = 5, 30
"""Length of the pieces whose regime is compared with the past, and past that is needed [s]."""
_LEAST_LOSS, _MOST_LOSS, _LEAST_US, _LEAST_GAIN = 0.3, 1.4, 25.0, -0.4
"""Sizes that mean something: a third of the effect, and no more than all of it; or an offset that a pilot trims."""


class Look(NamedTuple):
    """Forms and filters by which an axis is judged.

    `slow`, `fast`: form and corner [Hz] of its filter. `spread`: S0 for the windows of each length, as variance of
    lambda, covariance [us] and variance of beta [us2]. `limit`: J that healthy flights do not pass. Both were measured
    by benchmarks/one_flight.py on the healthy time of two aircraft, no flight with a surface fault among it: ALFA
    (10 Hz) and ArduPlane in wind (25 Hz). The limit is 1.25 times their largest J that was held and of a size that
    counts, before what gusts feign was left out (since then 9.3 for pitch).
    """

    slow: tuple[str, float]
    fast: tuple[str, float]
    spread: tuple[tuple[float, float, float], ...]
    limit: float


LOOKS = {
    "roll": Look(
        ("roll_rate", 1.0),
        ("roll_acceleration", 2.5),
        ((0.029**2, -0.001, 1.0), (0.036**2, -0.017, 1.0), (0.045**2, -0.027, 1.0)),
        10.2,
    ),
    "pitch": Look(
        ("pitch_inverse", 0.4),
        ("pitch_inverse", 1.0),
        ((0.097**2, 0.087, 3.3**2), (0.084**2, 0.032, 3.8**2), (0.088**2, 0.026, 3.7**2)),
        12.2,
    ),
}
"""The side axis is left out: its sizes made no sense in healthy flights (lambda from -1.3 to 5.8)."""
_THRUST_FORM, _THRUST_HZ, _THRUST_S = "specific_thrust", 0.4, 5
"""Form and corner [Hz] by which thrust is judged, and the length of its windows [s]."""
_THRUST_M_S2, _THRUST_SIGMAS, _THRUST_SPREAD_M_S2 = 1.5, 8.0, 0.1
"""Acceleration that is missing for what the throttle asks: the same healthy flights stay above -1.3 m/s2, a stopped
engine of ArduPlane leaves -11 m/s2."""


@dataclass(frozen=True, eq=False)
class Seconds:
    """A form's columns, with their products summed up to each second.

    `sums` is of what is known (the command of a forward form, others, offset), and last of what it answers: the motion,
    or of an inverse form the command.
    """

    form: Form
    sums: Sums
    rate_hz: float

    @classmethod
    def of(cls, form: Form, columns: Regression, usable: BoolArray, motion: Motion) -> Seconds:
        """Of one flight."""
        rows = [columns.others, columns.offset, columns.command]
        if not form.inverse:
            rows = [columns.command, columns.others, columns.offset, columns.answer]
        second = np.floor(motion.time_s - motion.time_s[0] + 1e-6).astype(int)
        edges = np.searchsorted(second, np.arange(second[-1] + 1))
        return cls(form, Sums.of(np.vstack(rows), usable, edges), motion.rate_hz)

    def fitted(self, upto: IntArray) -> Past:
        """The form as it was up to some seconds, shape (k,)."""
        past = Sums(self.sums.products[:, upto], self.sums.samples[upto])
        normal = past.table[:-1, :-1]
        ridge = np.eye(len(normal))[..., None] * (_RIDGE * normal + LEAST_DIVISOR)
        found = fitted(past, len(normal), ridge)
        variance = np.maximum(found.left / np.maximum(past.samples, 1.0), _LEAST_VARIANCE)
        return Past(found.sizes.value, normal + ridge, variance)

    @property
    def explained(self) -> float:
        """Share of the answer (of an inverse form, of the command) that the form explains over the flight."""
        last = np.array([self.sums.samples.size - 1])
        variance = float(self.fitted(last).variance[0])
        gram, count = self.sums.table[..., -1], max(float(self.sums.samples[-1]), 1.0)
        mean = gram[-1, -2] / max(gram[-2, -2], LEAST_DIVISOR)
        power = gram[-1, -1] / count - mean**2 * gram[-2, -2] / count
        return float(1.0 - variance / max(power, LEAST_DIVISOR))

    def compared(self, past: Past, begins: IntArray, ends: IntArray, patterns: int = 2) -> tuple[Sizes, FloatArray]:
        """Lost share and offset [us] in some windows, or the offset alone, and what they explain; shape (k,)."""
        window = self.sums.between(begins, ends)
        q, k = window.width, begins.size
        sign = -1.0 if self.form.inverse else 1.0
        gain = past.coefficients[0] if self.form.command != "throttle" and not self.form.inverse else np.ones(k)
        into = np.zeros((k, q + 2, q))
        into[:, : q - 1, : q - 1] = np.eye(q - 1)
        into[:, q - 1, -1 if self.form.inverse else 0] = -gain
        into[:, q, q - 2] = gain
        into[:, q + 1, :-1], into[:, q + 1, -1] = -sign * past.coefficients.T, sign
        products = into @ np.moveaxis(window.table, 2, 0) @ into.transpose(0, 2, 1)
        columns = [*range(q - 1), *range(q + 1 - patterns, q + 2)]
        precision = np.zeros((q - 1 + patterns, q - 1 + patterns, k))
        precision[: q - 1, : q - 1] = past.precision
        packed = np.moveaxis(products, 0, 2)[np.triu_indices(q + 2)]
        found = fitted(Sums(packed, window.samples), patterns, precision, columns)
        noise = np.fmax(found.left / window.samples, past.variance) * _COLOUR_S * self.rate_hz
        return found.scaled(noise), found.explained


class Past(NamedTuple):
    """A form as fitted to what was flown up to some seconds: what it knows of its columns, shapes (q, k), (q, q, k).

    `precision`: inverse covariance of the coefficients, times the `variance` (k,) of what they leave.
    """

    coefficients: FloatArray
    precision: FloatArray
    variance: FloatArray


def _windows(seconds: Seconds, length_s: int) -> tuple[IntArray, IntArray]:
    """Begins and ends of the windows of a length that hold enough, and have enough flight before them."""
    ends = np.arange(length_s, seconds.sums.samples.size)
    begins, so_far = ends - length_s, seconds.sums.samples
    good = (so_far[ends] - so_far[begins] >= _ENOUGH * length_s * seconds.rate_hz) & (
        so_far[begins] >= LEAST_PAST_S * seconds.rate_hz
    )
    return begins[good], ends[good]


def windows(seconds: Seconds, length_s: int) -> Sizes:
    """Lost share and offset [us] in the window that ends with each second, by a fit to what came before; n of them."""
    n = seconds.sums.samples.size - 1
    found = Sizes(np.full((2, n), np.nan), np.full((2, 2, n), np.nan))
    begins, ends = _windows(seconds, length_s)
    if ends.size:
        sizes, _ = seconds.compared(seconds.fitted(begins), begins, ends)
        found.value[:, ends - 1], found.covariance[..., ends - 1] = sizes
        found.covariance[..., ends - 1] += of_gusts(seconds, length_s, begins, ends, sizes.value[0])
    return found


def of_gusts(seconds: Seconds, length_s: int, begins: IntArray, ends: IntArray, loss: FloatArray) -> FloatArray:
    """Covariance of what gusts alone may feign in some windows that showed some loss, shape (2, 2, k).

    An autopilot's command has a part that answers gusts, and to this part alone an axis seems not to answer: a loss of
    what the command moves about its mean. Where it moves less than it did in the flight before, up to so much of it may
    have become that part; windows before that were as calm show how much of the answer was missing then.
    """
    last = np.arange(length_s, seconds.sums.samples.size)
    each = seconds.sums.between(last - length_s, last)
    command, offset = each.width - 1 if seconds.form.inverse else 0, each.width - 2
    mean_us = each.table[command, offset] / np.maximum(each.table[offset, offset], LEAST_DIVISOR)
    moves = each.table[command, command] - mean_us * each.table[command, offset]
    enough = each.samples >= _ENOUGH * length_s * seconds.rate_hz
    power = np.where(enough, moves / np.maximum(each.samples, 1.0), 0.0)
    before = np.cumsum(power)[begins - length_s] / np.maximum(np.cumsum(enough)[begins - length_s], 1.0)
    now, seen = power[ends - length_s], np.full(ends.size, _FEIGNED)
    for k, so_far in enumerate(np.searchsorted(ends, begins, side="right")):
        as_calm = loss[:so_far][now[:so_far] <= _AS_CALM * now[k]]
        if as_calm.size:
            seen[k] = min(rms(as_calm), _FEIGNED)
    share = seen * np.clip(1.0 - now / np.maximum(before, LEAST_DIVISOR), 0.0, 1.0)
    feigned = np.array([share, share * mean_us[ends - length_s]])
    return np.asarray(feigned[:, None] * feigned[None, :])


def expected(found: Sizes, length_s: int, spread: FloatArray) -> Sizes:
    """What windows of this flight may differ by: S0, and what the windows before showed, each by what it can tell."""
    seen = found.known
    sigma, theta = np.moveaxis(found.covariance[..., seen], 2, 0), found.value[:, seen].T
    gain = spread @ np.linalg.inv(spread + sigma)
    mean = np.einsum("kij,kj->ki", gain, theta)
    each = np.zeros((seen.size + 1, 2, 2))
    each[1:][seen] = mean[:, :, None] * mean[:, None, :] + spread - gain @ spread
    before = np.maximum(np.arange(1, seen.size + 1) - length_s, 0)
    total = np.cumsum(each, axis=0)[before] / length_s
    count = np.concatenate([[0.0], np.cumsum(seen)])[before] / length_s
    s = (_PRIOR_WINDOWS * spread + total) / (_PRIOR_WINDOWS + count)[:, None, None]
    return Sizes(np.zeros((2, seen.size)), np.moveaxis(s, 0, 2))


def regressed(form: Form, motion: Motion, usable: BoolArray, corner_hz: float, reference_m_s: float) -> Seconds:
    """Products of a form's columns, with the delay of the command that explains the first of the flight best."""
    filtered = Filtered(motion, corner_hz=corner_hz, reference_m_s=reference_m_s)
    columns = form.regression(filtered)
    first = usable & (np.cumsum(usable) <= _DELAY_FROM_S * motion.rate_hz)
    delays = (0.0,) if form.command == "throttle" else DELAYS_S
    best = max(delays, key=lambda d: Seconds.of(form, columns.delayed(d, motion.rate_hz), first, motion).explained)
    return Seconds.of(form, columns.delayed(best, motion.rate_hz), usable, motion)


def airborne(motion: Motion) -> tuple[BoolArray, float]:
    """Where an aircraft surely flies, and its usual airspeed [m/s]: not soon after a take-off, nor before a landing."""
    from scipy import ndimage

    flies, usual_m_s = _flying(motion)
    after, before = (round(s * motion.rate_hz) for s in (_AFTER_TAKEOFF_S, _BEFORE_LANDING_S))
    # Erosion by a window that reaches so far back and ahead of each sample.
    window = np.ones(after + before + 1, dtype=bool)
    sure = ndimage.binary_erosion(flies, window, origin=(after - before) // 2, border_value=0)
    return sure, usual_m_s


def _flying(motion: Motion) -> tuple[BoolArray, float]:
    """Where an aircraft is about as fast as it usually is, and how fast that is [m/s]."""
    moving = motion.present & (motion.airspeed_m_s > FLIES_M_S)
    if not moving.any():
        return moving, 1.0
    usual_m_s = float(np.median(motion.airspeed_m_s[moving]))
    return motion.present & (motion.airspeed_m_s > _AIRBORNE * usual_m_s), usual_m_s


_TURNING = {"roll": ("roll_acceleration", 2.5), "pitch": ("pitch_acceleration", 2.5)}
"""Form and corner [Hz] by which the way an axis turns is seen."""
_FIRST_S = (5, 10, 20, 40)
"""Flight after which it is asked which way the axes turn [s]."""
_SURE_SIGMAS, _OWN_SIGMAS = 5.0, 2.0
"""Of an effect that is there, and below which it may be none. In ten healthy flights of ArduPlane at 25 Hz an axis has
+2 to +30 on its own command and -1.6 to +2.2 on the other's. Slower logs do not tell cause from answer: ALFA, at 10 Hz
and with commands at 3 Hz, has -5 to +5."""


def first_turns(motion: Motion) -> list[tuple[str, str, float]]:
    """Axes that turn against their command, or with another's, from the first turns on.

    Result: axis, the command that turns it, and how much flight it took to be sure [s].
    """
    flies, usual_m_s = _flying(motion)
    if motion.rate_hz < _SLOW_HZ or not flies.any():
        return []
    enough = np.searchsorted(np.cumsum(flies), (_FIRST_S[-1] + 1) * motion.rate_hz)
    first = motion.until(float(motion.time_s[min(int(enough), motion.time_s.size - 1)]))
    flies, found = flies[: first.time_s.size], []
    asked = [axis for axis in _TURNING if np.any(np.ptp(first.commands_us.get(axis, np.zeros(1))))]
    for axis in asked:
        form_name, corner_hz = _TURNING[axis]
        effects = {
            by: effect_of(regressed(replace(FORMS[form_name], command=by), first, flies, corner_hz, usual_m_s))
            for by in asked
        }
        for flown_s, *at in zip(_FIRST_S, *effects.values(), strict=True):
            now = dict(zip(effects, at, strict=True))
            other = max(now, key=lambda by: abs(now[by]) if by != axis else 0.0)
            if now[axis] < -_SURE_SIGMAS:
                found.append((axis, axis, float(flown_s)))
            elif other != axis and abs(now[other]) > _SURE_SIGMAS and now[axis] < _OWN_SIGMAS:
                found.append((axis, other, float(flown_s)))
            else:
                continue
            break
    return found


def effect_of(seconds: Seconds) -> list[float]:
    """Effect of a form's command in its standard deviations, after so much flight as `first_turns` asks for."""
    last = seconds.sums.samples.size - 1
    upto = np.minimum(np.searchsorted(seconds.sums.samples, np.array(_FIRST_S) * seconds.rate_hz), last)
    past = seconds.fitted(upto)
    inverse = np.linalg.inv(np.moveaxis(past.precision, 2, 0))[:, 0, 0]
    variance = inverse * past.variance * _COLOUR_S * seconds.rate_hz
    return [float(each) for each in past.coefficients[0] / np.sqrt(np.maximum(variance, _LEAST_VARIANCE))]


def as_flown_before(motion: Motion, flies: BoolArray) -> BoolArray:
    """Where airspeed and throttle are what the flight had before, as far as it was known a window ago."""
    second = np.floor(motion.time_s - motion.time_s[0] + 1e-6).astype(int)
    edges = np.searchsorted(second, np.arange(second[-1] + 1))
    count = np.add.reduceat(flies.astype(float), edges)
    speed, throttle = (
        np.add.reduceat(np.where(flies, values, 0.0), edges) / np.maximum(count, 1.0)
        for values in (motion.airspeed_m_s, motion.throttle)
    )
    flown = count > 0.5 * motion.rate_hz
    inside = np.ones(count.size, dtype=bool)
    for begin in range(0, count.size, _REGIME_S):
        past = np.flatnonzero(flown[: max(begin - WINDOWS_S[-1], 0)])
        if past.size >= _REGIME_PAST_S:
            slowest, least = _SLOWER * np.quantile(speed[past], 0.02), np.quantile(throttle[past], 0.1) - _IDLER
            now = slice(begin, begin + _REGIME_S)
            inside[now] = (speed[now] >= slowest) & (throttle[now] >= least)
    usable: BoolArray = flies & inside[second]
    return usable


@dataclass(frozen=True, slots=True, eq=False)
class AxisChange:
    """What one flight says of one axis, against its own past."""

    axis: str
    status: Status
    text: str
    """One sentence."""
    members: tuple[str, ...] = ()
    since_s: float | None = None
    """Best estimate of when it changed [s]."""
    alarm_s: float | None = None
    """When it could have been reported in flight [s]."""
    lost_share: Estimate | None = None
    offset_us: Estimate | None = None
    """Of the axis' command, once it was reported [us]."""
    explained_share: float | None = None
    """Of its answer by the command and the rest of the motion, over the whole flight."""
    judged_share: float = 0.0
    """Share of the time in the air."""
    judged_from_s: float | None = None
    judged_until_s: float | None = None
    time_s: tuple[float, ...] = ()
    score: tuple[float, ...] = ()
    """J over its limit at each second; NaN where nothing was judged."""


@dataclass(frozen=True, eq=False)
class Compared:
    """An axis, window by window, against what was flown before each.

    `found`, `away`: estimates, and how far beyond what is expected, for the windows of each length. `shares`, `held`
    (shape (3, n)): J over its limit, of the sizes that mean something, before and after persistence.
    """

    seconds: Seconds
    found: tuple[Sizes, ...]
    away: tuple[Sizes, ...]
    shares: FloatArray
    held: FloatArray

    @classmethod
    def of(cls, seconds: Seconds, look: Look) -> Compared:
        """Of one axis."""
        found = [windows(seconds, length_s) for length_s in WINDOWS_S]
        spreads = [np.array([[v, c], [c, o]]) for v, c, o in look.spread]
        away = [
            one.beyond(expected(one, length_s, spread), np.zeros((2, 2)))
            for one, length_s, spread in zip(found, WINDOWS_S, spreads, strict=True)
        ]
        shares = np.array([counted(one, far) for one, far in zip(found, away, strict=True)])
        shares /= look.limit
        return cls(seconds, tuple(found), tuple(away), shares, lasting(shares, _HELD_S))

    @property
    def judged(self) -> BoolArray:
        """Seconds with a window that ends there."""
        judged: BoolArray = np.any([one.known for one in self.found], axis=0)
        return judged

    def shown_loss(self, look: Look) -> float:
        """Loss that half of the judged seconds would have shown."""
        return float(np.median(np.min([least(one.only(0), look.limit) for one in self.away], axis=0)[self.judged]))


def counted(found: Sizes, away: Sizes) -> FloatArray:
    """J of the sizes that mean something, whatever the other is: a small offset is no reason to believe a loss."""
    loss, offset = found.value
    lost = (loss >= _LEAST_LOSS) & (loss <= _MOST_LOSS)
    stands_away = (np.abs(offset) >= _LEAST_US) & (loss > _LEAST_GAIN) & (loss <= _MOST_LOSS)
    of_loss, of_offset = distance(away.only(0)), distance(away.only(1), None)
    return np.select([lost & stands_away, lost, stands_away], [distance(away), of_loss, of_offset], 0.0)


def judge_axis(name: str, motion: Motion, flies: BoolArray, usable: BoolArray, reference_m_s: float) -> AxisChange:
    """Compare an axis with itself."""
    look = LOOKS[name]
    form_name, corner_hz = look.slow if motion.rate_hz < _SLOW_HZ else look.fast
    form = FORMS[form_name]
    members = motion.members.get(name, ())
    if form.command not in motion.commands_us or np.ptp(motion.commands_us[form.command]) == 0.0:
        return AxisChange(name, "unknown", f"{name}: no command of it moves in this log", members)
    compared = Compared.of(regressed(form, motion, usable, corner_hz, reference_m_s), look)
    judged = compared.judged
    second_s = motion.time_s[0] + np.arange(1, judged.size + 1)
    air_s = float(flies.sum()) / motion.rate_hz
    if not judged.any():
        text = f"{name}: {air_s:.0f} s in the air; {LEAST_PAST_S + WINDOWS_S[0]} s are needed"
        if not flies.any():
            flew = np.any(motion.present & (motion.airspeed_m_s > FLIES_M_S))
            least_s = _AFTER_TAKEOFF_S + _BEFORE_LANDING_S
            broken = f"it never flew for {least_s:.0f} s at a stretch with all that it needs in the log"
            text = f"{name}: {broken if flew else 'it never flew'}{left_out(motion.lifted_share)}"
        return AxisChange(name, "unknown", text, members)
    from_s = float(second_s[judged][0]) - WINDOWS_S[0]
    until_s = min(float(second_s[judged][-1]), float(motion.time_s[usable][-1]))
    known = AxisChange(
        name,
        "unknown",
        f"{name}: too little motion: a stuck surface would have looked the same in most of the flight",
        members,
        explained_share=compared.seconds.explained,
        judged_share=min(float(judged.sum()) / air_s, 1.0),
        judged_from_s=from_s,
        judged_until_s=until_s,
        time_s=tuple(second_s.tolist()),
        score=tuple(np.where(judged, np.max(compared.shares, axis=0), np.nan).tolist()),
    )
    reported = np.flatnonzero(compared.held.max(axis=0) > 1.0)
    if reported.size:
        return _changed(known, compared, int(reported[0]), float(motion.time_s[0]))
    if compared.seconds.explained < _LEAST_EXPLAINED:
        text = f"{name}: command and motion explain {compared.seconds.explained:.0%} of it only, too little to compare"
        return replace(known, text=text)
    shown = max(compared.shown_loss(look), _LEAST_LOSS)
    if not shown <= max(1.0 / max(len(members), 1), _LEAST_LOSS):  # one of them that stands still
        return known
    text = (
        f"{name} answered from {from_s:.0f} to {until_s:.0f} s as it had before; the loss of {shown:.0%} of its effect "
        "would have shown in half of that time"
    )
    return replace(known, status="ok", text=text)


def _changed(known: AxisChange, compared: Compared, at: int, begin_s: float) -> AxisChange:
    """An axis that stopped answering as before, as it could be reported at a second.

    Its sizes are of the window that showed it, without what came before the change.
    """
    since = onset(compared.seconds, at + 1)
    length_s = WINDOWS_S[int(np.argmax(compared.held[:, at]))]
    begin, end = np.array([max(int(since), at + 1 - length_s)]), np.array([at + 1])
    window, _ = compared.seconds.compared(compared.seconds.fitted(np.array([int(since)])), begin, end)
    lost, offset = (
        Estimate.of(float(window.value[k, 0]), math.sqrt(float(window.covariance[k, k, 0]))) for k in range(2)
    )
    since_s, alarm_s = begin_s + since, begin_s + at + 1.0
    loss = f"lost {lost.value:.0%} [{lost.low:.0%}, {lost.high:.0%}] of its effect"
    away = f"acts as if {offset.value:+.0f} us [{offset.low:+.0f}, {offset.high:+.0f}] away"
    sure = [text for text, is_sure in ((loss, lost.low > 0.0), (away, excludes_none(offset))) if is_sure]
    what = " and ".join(sure) or f"{loss}, or {away} (this motion hardly tells which)"
    text = (
        f"{known.axis} {what} since about {since_s:.0f} s, as was clear at {alarm_s:.0f} s: look at the "
        f"{named(known.members, known.axis)}{_OR_ELSE[known.axis]}"
    )
    return replace(known, status="look", text=text, since_s=since_s, alarm_s=alarm_s, lost_share=lost, offset_us=offset)


_OR_ELSE = {
    "roll": "; a rudder, a flap or damage to a wing may do the same",
    "pitch": "; a rudder hard over, a payload that moved or lost thrust may do the same",
}


def onset(seconds: Seconds, reported: int) -> float:
    """Since when what follows fits worst to what came before [s after the first sample]: the likeliest of the last 20.

    Of the windows that end where it was reported, the one whose loss and offset explain most.
    """
    begins = np.arange(max(reported - WINDOWS_S[-1], 0), reported - _HELD_S + 1)
    past = seconds.fitted(np.repeat(begins[:1], begins.size))
    return float(begins[split(seconds.compared(past, begins, np.full(begins.size, reported))[1])])


def thrust_missing_s(motion: Motion, usable: BoolArray, reference_m_s: float) -> float | None:
    """From when on the aircraft accelerated less than its throttle asks for, by its own past [s]; None if never."""
    if np.ptp(motion.throttle) == 0.0:
        return None
    seconds = regressed(FORMS[_THRUST_FORM], motion, usable, _THRUST_HZ, reference_m_s)
    begins, ends = _windows(seconds, _THRUST_S)
    if not ends.size:
        return None
    missing, _ = seconds.compared(seconds.fitted(begins), begins, ends, patterns=1)
    deviation = np.sqrt(missing.covariance[0, 0] + _THRUST_SPREAD_M_S2**2)
    reported = np.flatnonzero(missing.value[0] < -np.maximum(_THRUST_M_S2, _THRUST_SIGMAS * deviation))
    return float(motion.time_s[0] + begins[reported[0]]) if reported.size else None


def judge_motion_alone(motion: Motion) -> dict[str, AxisChange]:
    """Roll and pitch of one flight against their own past; the engine is asked before the elevator."""
    flies, reference_m_s = airborne(motion)
    usable = as_flown_before(motion, flies)
    axes = {name: judge_axis(name, motion, flies, usable, reference_m_s) for name in LOOKS}
    pitch = axes["pitch"]
    if pitch.status == "look" and pitch.alarm_s is not None:
        since_s = thrust_missing_s(motion, flies, reference_m_s)
        if since_s is not None and since_s < pitch.alarm_s:
            text = f"pitch: engine or elevator: thrust is missing from {since_s:.0f} s on, which moves pitch as well"
            axes["pitch"] = replace(pitch, status="unknown", text=text, since_s=None, alarm_s=None)
    if "yaw" in motion.commands_us:
        text = f"side: one flight alone says nothing of the {named(motion.members.get('side', ()), 'side')}"
        axes["side"] = AxisChange("side", "unknown", text, motion.members.get("side", ()))
    return axes

"""Models of axes from healthy flights: form, gains, spread between days, and thresholds by leaving a day out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.units import S_PER_HOUR
from servofd.aircraft.axes import AXES, SURFACE_AXES, AxisModel, MotionModel, Regime, Spread
from servofd.axes.model import (
    DELAYS_S,
    FORMS,
    Filtered,
    Form,
    Inputs,
    Regression,
    covered,
    flown_of,
    residual_of,
    settled,
    whitened,
)
from servofd.axes.windows import LAG, SIZES, Windows, part, sliding
from servofd.core.errors import CalibrationError
from servofd.core.statistics import LEAST_DIVISOR
from servofd.core.types import BoolArray, FloatArray
from servofd.core.windows import Sizes

if TYPE_CHECKING:
    from servofd.axes.motion import Motion

_WINDOWS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
"""Lengths of windows that are tried [s]."""
_CORNERS_HZ = (0.4, 1.0, 2.5)
"""Corners of the axes' filter that are tried [Hz]."""
_CORNER_PER_RATE = 0.11
"""Corners above this share of the sampling rate are not tried."""
_FAST_HZ = (6.0,)
"""Corner that is tried where slow motion explains little [Hz]."""
_FAST_PER_RATE = 0.25
"""Of the corner that is tried where the autopilot answers gusts, so that slow motion tells less of its command."""
_MOSTLY_EXPLAINED = 0.75
"""Share of the motion that the best form explains, below which the fast corner is tried."""
_WINDOW_PER_CORNER = 1.0
"""Windows shorter than so many periods of the filter's corner hold no more than one ripple."""
_WHITENINGS = (0, 2)
_WELL_EXPLAINED = 0.5
"""Share of the command's effect from which on a form is judged by how soon it shows a loss; a worse one measures
gusts that the autopilot answers."""
_USUAL = 0.99
"""Share of the lift that counts as flown."""
_LEAST_SECONDS = 60.0
"""Flight that a calibration needs [s]."""
_LEAST_OF_A_FLIGHT_S = 15.0
"""Of steady flight: a log with less tells less than one window of how its flight differs from the others."""
_COLOUR_SAMPLES = 30
"""Sums over so many samples tell what the colour of the residual makes of its variance."""
_OWN_SHARE = 0.05
"""A command of which other commands explain all but this share is a copy."""


def calibrate_motion(flights: Sequence[Motion], *, false_alarms_per_hour: float = 1.0) -> MotionModel:
    """Fit the axes of an aircraft to healthy flights.

    `flights`: healthy, of one aircraft and one rate of samples; the more days, the better.
    """

    def again(others: Sequence[Motion], *left_out: str) -> MotionModel:
        model = calibrate_motion(others, false_alarms_per_hour=false_alarms_per_hour)
        return model.model_copy(update={"left_out": (*left_out, *model.left_out)})

    flights = [flight for flight in flights if flight.present.any()]
    if not flights:
        raise CalibrationError(
            "no flight to calibrate motion from: commands and motion are never there together, or "
            "motors carry the aircraft all the time"
        )
    other = next((flight for flight in flights if flight.asked != flights[0].asked), None)
    if other is not None:
        raise CalibrationError(
            f"{other.name}: commands {', '.join(sorted(other.asked))}, {flights[0].name} "
            f"{', '.join(sorted(flights[0].asked))}: calibrate on flights of one aircraft"
        )
    reference_m_s = float(np.median(np.concatenate([f.airspeed_m_s[f.present] for f in flights])))
    regime = _regime(flights, reference_m_s)
    usable = [
        f.present & np.logical_and.reduce(list(covered(regime, flown_of(f, reference_m_s)).values())) for f in flights
    ]
    steady_s = [float(good.sum()) / f.rate_hz for f, good in zip(flights, usable, strict=True)]
    kept = [f for f, long_s in zip(flights, steady_s, strict=True) if long_s >= _LEAST_OF_A_FLIGHT_S]
    if kept and len(kept) < len(flights):
        short = tuple(
            f"{f.name}: {long_s:.0f} s of steady flight, at least {_LEAST_OF_A_FLIGHT_S:.0f} s are needed"
            for f, long_s in zip(flights, steady_s, strict=True)
            if long_s < _LEAST_OF_A_FLIGHT_S
        )
        return again(kept, *short)
    seconds = sum(steady_s)
    if seconds < _LEAST_SECONDS:
        raise CalibrationError(
            f"{seconds:.0f} s of steady flight in {len(flights)} log{'s' * (len(flights) > 1)}; at least "
            f"{_LEAST_SECONDS:.0f} s are needed to fit how the aircraft answers, and flights of three days to know how "
            "it differs from day to day"
        )
    if len(flights) == 1:  # each half is judged by the other
        model = again(_halves(flights[0], usable[0]))
        of_one = {name: axis.model_copy(update={"flights": 1}) for name, axis in model.axes.items()}
        return model.model_copy(update={"flights": 1, "axes": of_one})
    groups = _groups(flights)
    per_hour = false_alarms_per_hour / len(SURFACE_AXES)  # lost thrust accuses no surface
    setting = _Setting(flights, usable, groups, reference_m_s)
    axes = {name: best for name in AXES if (best := setting.best(name, per_hour)) is not None}
    if not axes:
        raise CalibrationError("no axis answers its command: are these flights of a fixed wing, with commands logged?")
    group, why = _another_aircraft(axes, groups, flights)
    if group:
        others = [f for f, of in zip(flights, groups, strict=True) if of != group]
        return again(others, why)
    return MotionModel(
        rate_hz=round(flights[0].rate_hz, 6),
        reference_m_s=reference_m_s,
        regime=regime,
        days=len({f.day for f in flights}),
        flights=len(flights),
        hours=seconds / S_PER_HOUR,
        axes={name: _with_levels(trial, setting.unseen_tail(trial), per_hour) for name, trial in axes.items()},
        parameters=dict(flights[0].parameters),
    )


_GROUPS_TO_COMPARE = 4
"""Days among which one that differs shows: of three, two may be the other aircraft."""
_OTHER_SHARE, _AGREE = 0.25, 0.25
"""Difference of a command's effect from what other days show, and by what share of it those differ among themselves.
Days of one aeroplane (ALFA) fill the range between; a smaller wing stood 0.40 from three that agreed within 0.03."""


def _another_aircraft(axes: Mapping[str, _Trial], groups: Sequence[str], flights: Sequence[Motion]) -> tuple[str, str]:
    """Day whose command has another effect on which all other days agree, and a sentence; empty if there is none.

    Kept, it would make of what aircraft differ by what this one differs by from day to day, and hide the loss of half
    an elevator.
    """
    names = list(dict.fromkeys(groups))
    if len(names) < _GROUPS_TO_COMPARE:
        return "", ""
    for name in ("roll", "pitch"):
        trial = axes.get(name)
        if trial is None or not trial.model.own_command:
            continue
        found = [part(one, 0, one.usable.size, trial.model.noise_var).value[0, 0] for one in trial.inputs]
        lost = np.array(
            [np.nanmean([x for x, of in zip(found, groups, strict=True) if of == group]) for group in names]
        )
        for k, group in enumerate(names):
            rest = np.delete(lost, k)
            away = float(lost[k] - np.median(rest))
            if abs(away) > _OTHER_SHARE and np.ptp(rest) < _AGREE * abs(away):
                flight = flights[groups.index(group)].name
                than = f"{abs(away):.0%} {'less' if away > 0.0 else 'more'} effect"
                return group, (
                    f"{flight}: {name} has {than} than on the other days, which agree within {np.ptp(rest):.0%}: "
                    "another aircraft, load or airspeed sensor"
                )
    return "", ""


def _with_levels(trial: _Trial, tail: Tail, per_hour: float) -> AxisModel:
    level = tail.level(per_hour)
    return trial.model.model_copy(
        update={
            "flights": len(trial.inputs),
            "suspect": level,
            "fault": None if tail.days < _LEAST_DAYS else tail.level(_FAULT_PER_HOUR),
            "false_alarms_per_hour": tail.per_hour(level),
        }
    )


def _drives(flights: Sequence[Motion], form: Form) -> bool:
    """Whether the command of a form exists and ever moved."""
    is_throttle = form.command == "throttle"
    asked = (flight.throttle if is_throttle else flight.commands_us.get(form.command) for flight in flights)
    return any(one is not None and np.std(one) > 0.0 for one in asked)


def _regime(flights: Sequence[Motion], reference_m_s: float) -> Regime:
    """Bounds of what was flown: all but its rarest percents, and of lift what a second day bears out.

    A wing near its stall is not linear: with one aerobatic flight beside eight others half an elevator was found after
    20 s or never, for 2 s without it (simulated, benchmarks/motion_simulated.py's aeroplane banked by 80 deg).
    """
    flown = [flown_of(flight, reference_m_s) for flight in flights]
    good = [flight.present & (one.speed_m_s > 0.5 * reference_m_s) for flight, one in zip(flights, flown, strict=True)]
    speed, throttle = (
        np.concatenate([getattr(one, name)[chosen] for one, chosen in zip(flown, good, strict=True)])
        for name in ("speed_m_s", "throttle")
    )
    return Regime(
        airspeed_low_m_s=float(np.quantile(speed, 0.01)),
        airspeed_high_m_s=float(1.05 * np.max(speed)),
        throttle_low=float(np.quantile(throttle, 0.05)),
        lift_high_m_s2=_borne_out(flights, [one.lift_m_s2[chosen] for one, chosen in zip(flown, good, strict=True)]),
    )


def _borne_out(flights: Sequence[Motion], lifts_m_s2: Sequence[FloatArray]) -> float:
    """Highest lift that two days flew; of the pooled flights, where that is less or there is one day."""
    pooled = float(np.quantile(np.concatenate(lifts_m_s2), _USUAL))
    groups = _groups(flights)
    days = [
        np.concatenate([lift for lift, of in zip(lifts_m_s2, groups, strict=True) if of == group])
        for group in dict.fromkeys(groups)
    ]
    highest = sorted(float(np.quantile(lift, _USUAL)) for lift in days if lift.size)
    return min(pooled, highest[-2]) if len(highest) > 1 else pooled


def _halves(flight: Motion, usable: BoolArray) -> list[Motion]:
    """A flight in two parts with as much steady flight in each."""
    middle_s = float(flight.time_s[usable][np.count_nonzero(usable) // 2])
    return [flight.within([(-math.inf, middle_s)]), flight.within([(middle_s, math.inf)])]


def _groups(flights: Sequence[Motion]) -> list[str]:
    """What is left out together: a day; a flight where all are of one day."""
    days = [flight.day for flight in flights]
    return days if len(set(days)) > 1 else [f"{flight.name}#{i}" for i, flight in enumerate(flights)]


@dataclass(frozen=True)
class _Trial:
    """A form with its settings, fitted and scored."""

    model: AxisModel
    tail: Tail
    losses: tuple[FloatArray, ...]
    """Of each flight, J / scale in the windows of each length if half of the axis were lost; shape (k, n)."""
    inputs: tuple[Inputs, ...]

    def delay_s(self, level: float) -> float:
        """Mean length of the shortest window in which the loss of half an axis exceeds a level."""
        lengths_s = [spread.window_s for spread in self.model.spreads]
        delays_s = [
            np.min(np.where(shares > level, np.array(lengths_s)[:, np.newaxis], _NEVER_S), axis=0)
            for shares in self.losses
        ]
        return float(np.mean(np.concatenate(delays_s))) if delays_s else _NEVER_S


_AWAY_US = 100.0
"""A fifth of the usual travel."""
_NEVER_S = 60.0
"""What is not seen within the longest window counts as twice that window."""


@dataclass(frozen=True)
class _Setting:
    flights: Sequence[Motion]
    usable: Sequence[BoolArray]
    groups: Sequence[str]
    reference_m_s: float

    def best(self, name: str, per_hour: float) -> _Trial | None:
        """The form and its settings by which the loss of half an axis is seen soonest; None if none explains it."""
        forms = [form for form in FORMS.values() if form.axis == name and _drives(self.flights, form)]
        tried = [trial for form in forms for trial in self.trials(form, _CORNERS_HZ, _CORNER_PER_RATE)]
        if max((trial.model.explained for trial in tried), default=0.0) < _MOSTLY_EXPLAINED:
            tried += [trial for form in forms for trial in self.trials(form, _FAST_HZ, _FAST_PER_RATE)]
        tells = [trial for trial in tried if trial.model.explained > 0.0]
        well = [trial for trial in tells if trial.model.explained >= _WELL_EXPLAINED] or tells
        best = min(well, key=lambda trial: trial.delay_s(trial.tail.level(per_hour)), default=None)
        return None if best is None else self.learning(best, per_hour)

    def trials(self, form: Form, corners_hz: Sequence[float], per_rate: float) -> list[_Trial]:
        """All settings of a form, with the corners that are below a share of the rate."""
        rate_hz = self.flights[0].rate_hz
        found = []
        for corner_hz in (c for c in corners_hz if c <= per_rate * rate_hz):
            columns = [
                form.regression(Filtered(flight, corner_hz=corner_hz, reference_m_s=self.reference_m_s))
                for flight in self.flights
            ]
            delays = (0.0,) if form.command == "throttle" else DELAYS_S
            late = {d: [column.delayed(d, rate_hz) for column in columns] for d in delays}
            delay_s = max(delays, key=lambda d: self._fit(form, late[d])["explained"])
            for order in _WHITENINGS:
                trial = self._trial(form, late[delay_s], corner_hz, delay_s, order)
                if trial is not None:
                    found.append(trial)
        return found

    def _fit(self, form: Form, columns: Sequence[Regression], without: str = "") -> dict[str, Any]:
        """Fields of an `AxisModel` by pooled least squares; each flight has an offset, whose mean over days it has."""
        members = [i for i, group in enumerate(self.groups) if group != without]
        drive = 0 if form.inverse else 1
        shared = drive + columns[0].others.shape[0]
        normal = np.zeros((shared + len(members), shared + len(members)))
        right = np.zeros(shared + len(members))
        power, count = 0.0, 0
        for place, i in enumerate(members):
            good, column = self.usable[i], columns[i]
            rows = np.vstack([column.command[np.newaxis, good]] * drive + [column.others[:, good], column.offset[good]])
            answer = (column.command if form.inverse else column.answer)[good]
            where = [*range(shared), shared + place]
            normal[np.ix_(where, where)] += rows @ rows.T
            right[where] += rows @ answer
            power += float(answer @ answer)
            count += answer.size
        scale = np.sqrt(np.diag(normal)) + LEAST_DIVISOR
        scaled = normal / np.outer(scale, scale)
        solved = np.linalg.solve(scaled + 1e-9 * np.eye(scale.size), right / scale) / scale
        offsets = solved[shared:]
        groups = np.array([self.groups[i] for i in members])
        offset = float(np.mean([offsets[groups == group].mean() for group in dict.fromkeys(groups)]))
        explained = 1.0 - (power - float(solved @ right)) / max(power, LEAST_DIVISOR)
        gain, others = 1.0 if form.inverse else float(solved[0]), tuple(solved[drive:shared].tolist())
        return {"gain": gain, "offset": offset, "others": others, "explained": explained}

    def learning(self, trial: _Trial, per_hour: float) -> _Trial:
        """The same with more of what windows differ by learned from the flight itself, if it finds losses sooner."""
        learned = trial.model.own_command  # where lambda is free, what was learned early would hide an offset
        found = _with_spreads(trial.model, trial.inputs, _MOST_OF_FLIGHT) if learned else None
        if found is None:
            return trial
        more = self._scored(*found)
        return min(trial, more, key=lambda one: one.delay_s(one.tail.level(per_hour)))

    def _trial(
        self, form: Form, columns: Sequence[Regression], corner_hz: float, delay_s: float, order: int
    ) -> _Trial | None:
        own = self._own(form)
        nothing = Spread.of(1.0, np.zeros((2, 2)))

        def model(without: str) -> AxisModel:
            return AxisModel(
                form=form.name,
                corner_hz=corner_hz,
                delay_s=delay_s,
                noise_var=1.0,
                spreads=(nothing,),
                own_command=own,
                **self._fit(form, columns, without),
            )

        held = {group: model(group) for group in dict.fromkeys(self.groups)}
        plain = [self._inputs(held[group], columns[i], i) for i, group in enumerate(self.groups)]
        whitening = _autoregression([_centred(inputs) for inputs in plain], order)
        inputs = [whitened(one, whitening) for one in plain]
        residual_var, noise_var = _variances(inputs)
        residual_var *= own  # what jumps in a window is no turbulence
        inputs = [replace(one, variance=residual_var) for one in inputs]
        fitted = model("").model_copy(
            update={
                "whitening": whitening,
                "noise_var": noise_var,
                "residual_var": residual_var,
                "explained": _explained(plain, columns, own=own),
            }
        )
        whole = _with_spreads(fitted, inputs, _OF_FLIGHT)
        return None if whole is None else self._scored(*whole)

    def unseen_tail(self, trial: _Trial) -> Tail:
        """Tail of flights of which neither the model, nor the covariances, nor the largest J have seen the day.

        A covariance that has seen a strange day calls it usual: the tail by which trials are compared is too short.
        Of fewer days than four too few are left to tell what days differ by, and of fewer flights than eight how
        steeply the tail falls: then it is the one there is.
        """
        if trial.tail.days < _DAYS_TO_LEAVE_OUT or len(self.flights) < _FLIGHTS_TO_LEAVE_OUT:
            return trial.tail
        tops = np.zeros(len(self.flights))
        for group in dict.fromkeys(self.groups):
            seen = [one for one, of in zip(trial.inputs, self.groups, strict=True) if of != group]
            found = _with_spreads(trial.model, seen, trial.model.of_flight)
            if found is None:
                return trial.tail
            for i, one in enumerate(trial.inputs):
                if self.groups[i] == group:
                    tops[i] = Windows.of(found[0], one).statistic().max()
        hours = np.array([one.usable_s / S_PER_HOUR for one in trial.inputs])
        return tail_of(tops, hours, days=trial.tail.days)

    def _scored(self, whole: AxisModel, flights: Sequence[Windows]) -> _Trial:
        tops = np.array([float(one.statistic().max()) for one in flights])
        hours = np.array([one.inputs.usable_s / S_PER_HOUR for one in flights])
        tail = tail_of(tops, hours, days=len({flight.day for flight in self.flights}))
        return _Trial(whole, tail, tuple(_lost_half(one) for one in flights), tuple(one.inputs for one in flights))

    def _inputs(self, model: AxisModel, columns: Regression, i: int) -> Inputs:
        flight = self.flights[i]
        return residual_of(model, columns, settled(model, flight, self.usable[i]), flight.rate_hz)

    def _own(self, form: Form) -> bool:
        """Whether a command ever moved on its own."""
        rivals = [name for name in self.flights[0].commands_us if name != form.command]
        if form.command != "yaw" or not rivals:
            return True
        asked, *beside = (
            np.concatenate([f.commands_us[name][good] for f, good in zip(self.flights, self.usable, strict=True)])
            for name in (form.command, *rivals)
        )
        others = np.vstack([*beside, np.ones(asked.size)])
        left = asked - np.linalg.lstsq(others.T, asked, rcond=None)[0] @ others
        return bool(np.var(left) > _OWN_SHARE * np.var(asked))


def _centred(inputs: Inputs) -> FloatArray:
    """Residual of one flight without the flight's own offset, where it is usable."""
    e, x = inputs.residual[inputs.usable], inputs.offset[inputs.usable]
    return np.asarray(e - x * (e @ x) / max(float(x @ x), LEAST_DIVISOR))


def _explained(flights: Sequence[Inputs], columns: Sequence[Regression], *, own: bool) -> float:
    """Share of the command's effect (of the motion, if the command is a copy) explained on days not seen."""
    left = np.concatenate([_centred(one) for one in flights])
    if own:
        effect = np.concatenate([_centred(Inputs(one.loss, one.loss, one.offset, one.usable)) for one in flights])
    else:
        effect = np.concatenate([column.answer[one.usable] for one, column in zip(flights, columns, strict=True)])
    return 1.0 - float(np.var(left) / max(np.var(effect), LEAST_DIVISOR))


_OF_FLIGHT, _MOST_OF_FLIGHT = 0.5, 0.9
"""Shares of what healthy windows differ by that may be the flight's own; taken is the one that finds a loss sooner. On
the latest of three days of a real aircraft half a share parted healthy flights (up to 1.3) from a lost aileron (3.2 and
more) better than none (2.5 and 3.2)."""


_ROUNDS = 60
"""Rounds of expectation and maximization."""


def spread_between(flights: Sequence[Sizes], start: FloatArray) -> FloatArray:
    """Covariance of lambda and beta between healthy flights, or windows, beyond the noise of each.

    Maximum likelihood by expectation and maximization (Dempster, Laird and Rubin 1977), theta around zero; each
    flight has the same weight, however long it is.

    From the windows of each healthy flight, or that flight as one, with a model that has not seen its day.
    """
    between = start
    seen = [found for found in flights if found.known.size]
    if not seen:
        return np.zeros((2, 2))
    theta = np.hstack([found.value for found in seen])
    noise = np.concatenate([found.covariance for found in seen], axis=2)
    weights = np.concatenate([np.full(found.known.size, 1.0 / (found.known.size * len(seen))) for found in seen])
    for _ in range(_ROUNDS):
        gain = np.moveaxis(between @ np.linalg.inv(np.moveaxis(noise + between[..., None], 2, 0)), 0, 2)
        mean = np.einsum("ijn,jn->in", gain, theta)
        renewed = between + (mean * weights) @ mean.T - (gain @ weights) @ between
        settled = np.allclose(renewed, between, rtol=1e-3)
        between = (renewed + renewed.T) / 2.0
        if settled:
            break
    return between


def _with_spreads(model: AxisModel, flights: Sequence[Inputs], share: float) -> tuple[AxisModel, list[Windows]] | None:
    """What flights and windows differ by, the largest J that each window length reached, and these windows."""
    start = np.diag([0.05**2, 10.0**2])
    spreads = []
    for window_s in (w for w in _WINDOWS_S if w >= _WINDOW_PER_CORNER / model.corner_hz):
        length = max(4, round(window_s * flights[0].rate_hz))
        apart, late = (
            [one.at(np.flatnonzero(one.known)[:: max(1, length // 10)]) for one in found]
            for found in ([sliding(one, length, model.noise_var, asked) for one in flights] for asked in (SIZES, LAG))
        )
        if any(one.known.size for one in apart):
            spread = Spread.of(window_s, (1.0 - share) * (spread_between(apart, start) + _LEAST_SPREAD))
            strays = {"lag_var_s2": (1.0 - share) * _stray_s2(late), "lag_scale": 1.0}
            spreads.append(spread.model_copy(update=strays))
    if not spreads:
        return None
    model = model.model_copy(update={"spreads": tuple(spreads), "of_flight": share})
    windows = [Windows.of(model, one) for one in flights]
    scales = np.max([[float(j.max()) for j in one.distances()] for one in windows], axis=0)
    lag_scales = np.max([[float(j.max()) for j in one.late] for one in windows], axis=0)
    kept = [k for k, scale in enumerate(scales) if scale > 0.0]
    if not kept:
        return None
    found = []
    for k in kept:
        scale, lag_scale = float(scales[k]), float(lag_scales[k])
        least = _by_chance(flights, spreads[k])
        update = {"scale": scale, "lag_scale": max(lag_scale, least) if lag_scale > 0.0 else None}
        found.append(spreads[k].model_copy(update=update))
    model = model.model_copy(update={"spreads": tuple(found)})
    return model, [one.scaled(model, kept) for one in windows]


def _stray_s2(flights: Sequence[Sizes]) -> float:
    """Variance of the lag of healthy windows beyond their noise."""
    lag_s = np.concatenate([one.value[0] for one in flights])
    var_s2 = np.concatenate([one.covariance[0, 0] for one in flights])
    weights = 1.0 / var_s2
    excess = float(weights @ (lag_s**2 - var_s2) / weights.sum()) if lag_s.size else 0.0
    return max(excess, _LEAST_LAG_S**2)


def _by_chance(flights: Sequence[Inputs], spread: Spread) -> float:
    """Largest statistic of a lag that chance alone lets expect in windows of one length of these flights.

    It is a chi-square. A largest one below this tells that windows were few, or that the variance has seen them, and
    not that the next flights will stay below it.
    """
    from scipy import special  # takes longer to load than a flight to judge

    windows = sum(float(one.usable.sum()) for one in flights) / spread.samples(flights[0].rate_hz)
    return float(special.chdtri(1.0, min(1.0 / windows, 0.5)))


_LEAST_SPREAD = np.diag([0.03**2, 5.0**2])
"""Healthy flights differ by no less than 3 % of their effect (air density: 10 degC or 300 m) and 5 us, however alike
those of the calibration were."""
_LEAST_LAG_S = 0.02
"""Nor than by the period of a servo's pulses, which are not locked to the autopilot."""


def _autoregression(residuals: Sequence[FloatArray], order: int) -> tuple[float, ...]:
    """Coefficients that predict a residual from its past, pooled over flights."""
    long = [e for e in residuals if e.size > 10 * order]
    if order == 0 or not long:
        return ()
    past = np.concatenate([np.column_stack([e[order - 1 - k : e.size - 1 - k] for k in range(order)]) for e in long])
    now = np.concatenate([e[order:] for e in long])
    return tuple(float(c) for c in np.linalg.lstsq(past, now, rcond=None)[0])


def _variances(flights: Sequence[Inputs]) -> tuple[float, float]:
    """Variance of the residual, and that times what its colour makes of sums over a few seconds."""
    pieces, length = [_centred(one) for one in flights], _COLOUR_SAMPLES
    variance = float(np.var(np.concatenate(pieces)))
    sums = np.concatenate([e[: e.size // length * length].reshape(-1, length).sum(axis=1) for e in pieces])
    return variance, max(variance, float(np.sum(sums**2)) / max(sums.size, 1) / length)


def _lost_half(windows: Windows) -> FloatArray:
    """J / scale if half of the axis were lost (if a copied command: if it stood far away), where it is judged."""
    change = (0.5, 0.0) if windows.axis.own_command else (0.0, _AWAY_US)
    return np.asarray(windows.shifted(np.array(change)).shares()[:, windows.inputs.usable])


_PRIOR_INDEX, _PRIOR_WEIGHT = 2.5, 4.0
"""Index of the tail before any flight is seen, and the largest statistics that it counts as."""
_FAULT_PER_HOUR = 0.01
"""Once in a hundred hours is called a fault wrongly."""


@dataclass(frozen=True, slots=True)
class Tail:
    """Power law of the largest statistic of a flight (Hill 1975) above the median flight's.

    `base`: statistic of the median flight. `index`: how steeply the rate falls. `rate_per_hour`: how often a flight
    exceeds `base`. `days`: calibrated.
    """

    base: float
    index: float
    rate_per_hour: float
    days: int

    def per_hour(self, level: float) -> float:
        """False alarms an hour at a level."""
        return self.rate_per_hour * min(1.0, math.pow(level / self.base, -self.index))

    def level(self, per_hour: float) -> float:
        """Level for a rate; never below what calibration flights reached."""
        return max(1.0, self.base * math.pow(self.rate_per_hour / per_hour, 1.0 / self.index))


_LEAST_DAYS = 2
"""Of fewer days no level of a fault is known."""
_DAYS_TO_LEAVE_OUT = 4
"""With three days of the test aeroplane, judged by two, the level for one false alarm in three hours was 30 times the
calibration's largest statistic, and hid a trim that changed by 60 us."""
_FLIGHTS_TO_LEAVE_OUT = 8
"""As many as the rate was measured with: 4 false alarms in 6 h where 6 were predicted. With four flights of aeroplanes
that differ two of four jams were no longer found."""
_FEW_DAYS = {1: 17.0, 2: 6.0, 3: 1.5}
"""Flights of one day tell too little of the next: false alarms at the same multiple of the calibration's largest
statistic, over those after four days. Measured on five days of a real aircraft (ALFA): 35.6, 12.1, 3.1 and 2.1 an hour
after one to four."""


def tail_of(tops: FloatArray, hours: FloatArray, *, days: int) -> Tail:
    """Tail from the largest statistic of each flight."""
    seen = tops[tops > 0.0]
    base = float(np.median(seen)) if seen.size else 1.0
    above = seen[seen >= base]
    logs = float(np.sum(np.log(above / base)))
    index = (above.size + _PRIOR_WEIGHT) / (logs + _PRIOR_WEIGHT / _PRIOR_INDEX)
    total = float(hours.sum())
    return Tail(base, index, _FEW_DAYS.get(days, 1.0) * above.size / max(total, 1e-9), days)

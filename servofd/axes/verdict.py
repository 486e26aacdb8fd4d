"""Verdict on an axis, and what motion can and cannot tell of it in one sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from servofd.aircraft.axes import MOST_OF_THE_FLIGHT
from servofd.core.series import outline
from servofd.core.statistics import Estimate
from servofd.core.types import FloatArray

if TYPE_CHECKING:
    from servofd.aircraft.axes import AxisModel, MotionModel, Regime
    from servofd.axes.model import Inputs

AxisStatus = Literal["healthy", "suspect", "fault", "unknown"]


@dataclass(frozen=True, slots=True)
class AxisEvent:
    """A time in which an axis did not answer as it should."""

    start_s: float
    alarm_s: float
    """Best estimate of the onset, and when it would have been reported in flight [s]."""
    end_s: float | None
    """When the axis answered again [s]; None if it never did."""
    score: float
    """Largest statistic, as a multiple of the calibration flights' largest."""
    lost_share: Estimate
    """lambda."""
    offset_us: Estimate
    """beta [us]."""
    cause: str = ""
    """Another axis whose event explains this one; empty if this is the cause."""
    lag_s: Estimate | None = None
    """tau [s], if the axis answers late rather than too little."""
    from_start: bool = False
    """Whether the flight differed from its first judged seconds on: another trim, payload or aircraft, or a failure
    before take-off. What comes later is judged beyond it."""
    known_s: float = math.inf
    """From when on what the axis became is known, and what comes is judged beyond it; inf if it never was [s]."""

    @property
    def is_own(self) -> bool:
        """Whether something happened to this axis in flight."""
        return not self.cause and not self.from_start

    @property
    def model_holds(self) -> bool:
        """Whether its lost share is one that an axis can lose: outside, something else moved the aircraft."""
        return _LEAST_SHARE <= self.lost_share.value <= _MOST_SHARE

    @property
    def is_nothing(self) -> bool:
        """Whether it is not late, no loss is known nor likely large, and the offset is next to none as well."""
        lost, away = self.lost_share, self.offset_us
        small = not excludes_none(away) or (away.low > -_SMALL_US and away.high < _SMALL_US)
        no_offset = small and abs(away.value) < _SMALL_US
        no_loss = self.model_holds and lost.low <= 0.0 and lost.value < _SMALL_SHARE
        return self.lag_s is None and no_loss and no_offset


class AxisDetectable(NamedTuple):
    """Smallest fault of an axis that most of a flight would have shown; inf where none would."""

    loss: float
    """Share of its effect."""
    offset_us: float


@dataclass(frozen=True, slots=True, eq=False)
class AxisAudit:
    """Verdict on one axis."""

    axis: str
    """``"roll"``, ``"pitch"``, ``"side"`` or ``"thrust"``."""
    status: AxisStatus
    """`fault` only beyond the multiple of the threshold that the calibrated hours support."""
    reason: str
    """One sentence."""
    members: tuple[str, ...]
    """Surfaces that serve it; which of them failed is not known."""
    lost_share: Estimate | None
    offset_us: Estimate | None
    """Of the worst event; of the whole flight without one; None if nothing could be estimated, or where the command
    never moved on its own, which tells nothing of its effect."""
    events: tuple[AxisEvent, ...]
    """In order of time."""
    identifiable: float
    """Share of the flight in which lambda was known to less than +-0.3."""
    detectable: AxisDetectable
    """What would have been shown."""
    judged_share: float
    """Share of the flight inside the calibrated regime."""
    false_alarms_per_hour: float
    """To expect of this axis at its threshold."""
    time_s: FloatArray
    score: FloatArray
    """Statistic over its threshold."""
    inputs: Inputs
    """Residual, and what a loss and an offset would leave in it."""
    model: AxisModel
    """By which it was judged."""

    @property
    def is_expected(self) -> bool:
        """Whether a verdict can be expected: not of a command that copies another, nor of the engine."""
        return self.axis != "thrust" and self.model.own_command

    @property
    def was_tried(self) -> bool:
        """Whether it was asked to move enough to show a jam, where it was judged at all."""
        calm = self.judged_share >= MOST_OF_THE_FLIGHT > self.identifiable
        return self.status != "unknown" or bool(self.events) or not calm

    @property
    def is_weaker(self) -> bool:
        """Whether it surely lost some of its effect (95 %), though it raised no alarm."""
        return (
            self.status == "unknown" and not self.events and self.lost_share is not None and self.lost_share.low > 0.0
        )

    @property
    def asked(self) -> FloatArray:
        """Effect of the command that the model expects, in the unit of its form."""
        return -self.inputs.loss

    @property
    def shown(self) -> FloatArray:
        """What the motion shows of it."""
        return self.inputs.residual - self.inputs.loss

    @property
    def outline(self) -> tuple[float | None, ...]:
        """Largest distance from healthy over its threshold in each of equal parts of the flight."""
        distance = np.where(self.inputs.usable, np.sqrt(np.maximum(self.score, 0.0)), np.nan)
        return outline(self.time_s, distance, np.ones(distance.size))

    @property
    def since_s(self) -> float | None:
        """Onset of the first event that is the axis' own [s]."""
        return next((event.start_s for event in self.events if event.is_own), None)


_LEAST_SHARE, _MOST_SHARE = -0.5, 1.5
"""Of the effect that an axis can lose, with what a short window gets wrong."""
_SMALL_SHARE, _SMALL_US = 0.3, 25.0
"""What no pilot notices: a third of an axis' effect, and the offset that one click of trim takes away."""

_SURFACES = {"roll": "ailerons", "pitch": "elevator", "side": "rudder", "thrust": "engine"}
_OUTSIDE = {
    "airspeed": "outside the calibrated airspeed ({low:.0f} to {high:.0f} m/s)",
    "throttle": "at less throttle than the calibration flights",
    "stall": "nearer to the stall than the calibration flights",
}
_HALF = 0.75
"""Lost share above which more than one surface failed."""
_ALL = 0.25
"""Lost share that, if the interval stays below it, makes an offset of the fault."""
_OFTEN = 0.25
"""Share of the flight outside the calibrated regime that is given as the reason."""
KNOWN_WITHIN = 0.3
"""Half width of the 95 % interval of lambda beyond which an axis is never called healthy."""
_ENOUGH_DAYS = 3
"""From which on another day changes the rate of false alarms by less than a half."""


def named(members: Sequence[str], axis: str) -> str:
    """Members of an axis as one would say them.

    Examples
    --------
    >>> named(("aileron_left", "aileron_right"), "roll")
    'ailerons left and right'
    >>> named(("elevator_2", "elevator_10"), "pitch")
    'elevators on outputs 2 and 10'
    >>> named((), "pitch")
    'elevator'
    """
    if not members:
        return _SURFACES[axis]
    stems = {member.rsplit("_", 1)[0] for member in members}
    if len(members) > 1 and len(stems) == 1 and all("_" in member for member in members):
        which = [member.rsplit("_", 1)[1] for member in members]
        place = "on outputs " if all(one.isdecimal() for one in which) else ""
        return f"{stems.pop().replace('_', ' ')}s {place}{' and '.join(which)}"
    return " or ".join(member.replace("_", " ") for member in members)


def shown(smallest: AxisDetectable) -> str:
    """Smallest faults that most of a flight would have shown; empty if none.

    Examples
    --------
    >>> shown(AxisDetectable(0.31, 44.2)), shown(AxisDetectable(math.inf, 44.2))
    ('a loss of 31% of its effect, or 44 us away', '44 us away')
    """
    loss = [f"a loss of {smallest.loss:.0%} of its effect"] if math.isfinite(smallest.loss) else []
    return ", or ".join([*loss, *([f"{smallest.offset_us:.0f} us away"] if math.isfinite(smallest.offset_us) else [])])


def left_out(lifted_share: float) -> str:
    """What is said of a VTOL aircraft."""
    return f"; left out: {lifted_share:.0%} of the log, while motors lifted it" if lifted_share > 0.0 else ""


def reason_of(audit: AxisAudit, model: MotionModel, worst: AxisEvent | None, outside: Mapping[str, float]) -> str:
    """One sentence for the verdict on an axis, without that of its audit.

    `worst`: event for which it is accused. `outside`: share of the flight for each reason not to judge it.
    """
    lost = audit.lost_share
    caused = next((event for event in audit.events if event.cause), None)
    at_once = next((event for event in audit.events if event.from_start), None)
    odd = next((event for event in audit.events if event.is_own), None)
    if worst is not None:
        text = _failed(audit, worst)
    elif caused is not None:
        text = _moved(audit.axis, caused)
    elif at_once is not None:
        text = _differs(audit, at_once)
    elif odd is not None:
        text = _unexplained(odd)
    elif lost is not None and (audit.status == "healthy" or excludes_none(lost)):
        seen = shown(audit.detectable)
        text = f"{_share_left(lost)}{_unusual(lost)}{f'; {seen} would have been seen' if seen else ''}"
    else:
        text = _not_judged(audit, model.regime, outside)
    if model.days >= _ENOUGH_DAYS:
        return text
    days = "one day" if model.days == 1 else f"{model.days} days"
    return f"{text}; calibrated on {days}: about {audit.false_alarms_per_hour:.2g} false alarms an hour of this axis"


def _share_left(lost: Estimate) -> str:
    """How much effect an axis had, with a 95 % interval."""
    low, value, high = (f"{100.0 * (1.0 - share):z.0f}" for share in (lost.high, lost.value, lost.low))
    return f"had {value}% of its effect ({low} to {high}%)"


def excludes_none(lost: Estimate) -> bool:
    """Whether an interval says that an axis was not as in its good flights."""
    return not lost.low <= 0.0 <= lost.high


def _unexplained(event: AxisEvent) -> str:
    """What is said where the model does not hold."""
    lost, away = event.lost_share, event.offset_us
    if not event.model_holds:
        return (
            f"the model does not hold from {event.start_s:.1f} s on: to lose {lost.value:.0%} of an effect is "
            "impossible, so that something else moved the aircraft"
        )
    return (
        f"moved otherwise from {event.start_s:.1f} s on, and neither by a loss ([{lost.low:.0%}, {lost.high:.0%}]) "
        f"nor by an offset ([{away.low:+.0f}, {away.high:+.0f}] us) of its command"
    )


def _unusual(lost: Estimate) -> str:
    """That zero lies outside a 95 % interval, which is no alarm: one healthy flight in forty is so on each side."""
    if not excludes_none(lost):
        return ""
    than = "weaker" if lost.low > 0.0 else "stronger"
    return (
        f"; {than} than in its good flights, as one healthy flight in 40 seems: look whether the next ones are as well"
    )


def _failed(audit: AxisAudit, worst: AxisEvent) -> str:
    last_s = math.inf if worst.end_s is None else worst.end_s
    times_s = [event.start_s for event in audit.events if event.is_own and worst.start_s < event.start_s < last_s]
    again = f"; it changed again at {', '.join(f'{time_s:.1f}' for time_s in times_s)} s" if times_s else ""
    ended = "" if worst.end_s is None else f" until {worst.end_s:.1f} s"
    since = "from the first judged second on" if worst.from_start else f"since {worst.start_s:.1f} s"
    return f"{_loss(audit, worst)}, {since}{ended}{again}"


def _differs(audit: AxisAudit, event: AxisEvent) -> str:
    sizes = f" (lost share {event.lost_share.value:+.2f}, offset {event.offset_us.value:+.0f} us)"
    return (
        f"{named(audit.members, audit.axis)} differed from calibration from the first judged second on"
        f"{sizes if audit.model.own_command else ''}: another trim, payload or aircraft, or a failure before take-off; "
        "what came later was judged beyond that"
    )


def _moved(name: str, event: AxisEvent) -> str:
    if {name, event.cause} == {"pitch", "thrust"}:
        return f"engine or elevator since {event.start_s:.1f} s: the energy balance shows lost thrust as well"
    return f"not judged from {event.start_s:.1f} s on: what happened to {event.cause} moves this axis too"


def _not_judged(audit: AxisAudit, regime: Regime, outside: Mapping[str, float]) -> str:
    lost, unseen = audit.lost_share, 1.0 - audit.identifiable
    if not outside:
        return "the aircraft never flew"
    most = max(outside, key=lambda reason: outside[reason])
    if outside[most] > max(_OFTEN, 0.5 * unseen):
        low, high = regime.airspeed_low_m_s, regime.airspeed_high_m_s
        return f"{outside[most]:.0%} of the flight was {_OUTSIDE[most].format(low=low, high=high)}"
    if not audit.model.own_command:
        which = named(audit.members, audit.axis)
        return f"{which} never moved on its own: a surface that does not move would look the same"
    half = (lost.high - lost.low) / 2.0 if lost is not None else 0.0
    one = 1.0 / max(len(audit.members), 1)
    is_loose = audit.detectable.loss < one and half > KNOWN_WITHIN  # one that got stuck would have shown
    if lost is not None and (is_loose or audit.identifiable >= MOST_OF_THE_FLIGHT):
        return f"had {1.0 - lost.value:.0%} of its effect, known to ±{half:.0%} only: healthy flights differ as much"
    if audit.axis == "thrust":
        return f"too little change of throttle: in {unseen:.0%} of the flight lost thrust would not show"
    return f"too little motion: in {unseen:.0%} of the flight a stuck surface would have looked the same"


def _loss(audit: AxisAudit, event: AxisEvent) -> str:
    surfaces, lost = named(audit.members, audit.axis), event.lost_share
    if audit.axis == "thrust":
        return f"thrust is missing ({lost.value:.0%} [{lost.low:.0%}, {lost.high:.0%}])"
    share = f"lost {lost.value:.0%} [{lost.low:.0%}, {lost.high:.0%}] of the effect"
    if not audit.model.own_command:
        return f"{surfaces} did not stand where asked, or did not move"
    if event.lag_s is not None:
        late = event.lag_s
        text = f"answered {late.value:.2f} s [{late.low:.2f}, {late.high:.2f}] later than calibrated: slow"
    elif lost.high < _ALL or (lost.low <= 0.0 and lost.value < _ALL and excludes_none(event.offset_us)):
        text = f"acted as if {event.offset_us.value:+.0f} us away"
    elif lost.low <= 0.0:
        away = event.offset_us
        text = (
            f"did not answer as calibrated: {away.value:+.0f} us [{away.low:+.0f}, {away.high:+.0f}] away, or "
            f"{lost.value:.0%} [{lost.low:.0%}, {lost.high:.0%}] of the effect lost (this motion hardly tells which)"
        )
    elif lost.value > _HALF or len(audit.members) == 1:
        text = f"{share}, offset {event.offset_us.value:+.0f} us"
    else:
        which = (
            "one of them, or both at half effect" if audit.axis == "roll" else "one half, or all at part of the effect"
        )
        text = f"{share}: {which}; offset {event.offset_us.value:+.0f} us"
    return f"{surfaces} {text}"

"""One surface beside its healthy servo: what is shown of it, what was found, and what a reader has to know.

A healthy servo is calibrated on good flights, fitted to a part of the log, or named. The first two are judged by the
error of the prediction; a named one by the residual of the nullspace filter, and both by the same windows.
Whoever judges asks `Healthy`, not where it came from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import numpy as np

from servofd.aircraft.pace import SLOWEST_LEFT_HZ, SLOWEST_RATE_HZ, TOO_MANY_LOST, pace_steps, sent_period_s
from servofd.core.errors import ServofdError
from servofd.detection.changes import detectable
from servofd.detection.evidence import passing, too_short
from servofd.detection.faults import as_raised, changed, watched_segment
from servofd.detection.lasting import NOTHING_LASTS, Lasting, lasting
from servofd.detection.moving import Moving
from servofd.detection.named import NamedMoving, found_of, with_hold
from servofd.detection.probability import Noise
from servofd.detection.residual import ResidualGenerator
from servofd.detection.stream import Following, Stream
from servofd.detection.verdict import two_digits
from servofd.estimate.record import load_at

if TYPE_CHECKING:
    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.aircraft.schema import Surface
    from servofd.aircraft.series import Series
    from servofd.core.evidence import Detectable, ModelOrigin
    from servofd.core.types import FloatArray
    from servofd.detection.faults import Found, Named
    from servofd.detection.moving import Watched
    from servofd.detection.residual import Residuals, Threshold
    from servofd.servo.servo_model import ServoModel

_LITTLE_KNOWN: Final = 5.0
"""Times its usual deviation a residual may reach where a servo moves as it never did in its good flights."""
_OFTEN_BEYOND: Final = 0.2
"""Share of the flight faster than its good flights from which on a note says so."""
FALSE_ALARMS_PER_HOUR: Final = 0.05
"""Of one surface: 2 faults in 41 h of healthy flight of 31 simulated aircraft of even seed; 2 in 49 h of 37 of odd seed
confirm it (`benchmarks/calibration_campaign.py`). The rate of a rarer alarm has not been measured."""


_SECONDS_FOR_ODDS: Final = 10.0
"""Judged time that gives the odds of a false alarm [s]."""
_CLEAR_SIGMAS: Final = 4.0
"""A threshold of less is crossed by noise alone, once in some thousand samples."""


class TooShortError(ServofdError):
    """So little of a log can be judged that there is no verdict."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One surface of a log beside its healthy servo."""

    segment: Series
    flight: Watched
    found: Found
    judged_s: float
    like: str
    """As what it moved, if it is healthy."""
    notes: tuple[str, ...] = ()
    """What a reader has to know beside the verdict."""
    lasting: Lasting = NOTHING_LASTS
    """How sure it has changed since each instant."""
    doubt: str = ""
    """What about its servo is like no sound one."""
    beyond: str = ""
    """What part of the flight its good flights tell nothing of."""
    level: tuple[ResidualGenerator, int] | None = None
    """Filter and persistence, where the level that is shown is the only test."""

    @property
    def residuals(self) -> Residuals:
        """What is shown of the flight."""
        return self.flight.shown.residuals

    @property
    def threshold(self) -> Threshold:
        """Threshold of what is shown."""
        return self.flight.shown.threshold

    def detectable(self) -> Detectable:
        """The smallest faults that would have shown."""
        if self.level is not None:
            generator, persistence = self.level
            return passing(generator, self.residuals, self.threshold, persistence)
        return detectable([self.flight.looked])

    def well(self, largest_deg: float) -> str:
        """Sentence on a healthy surface, with its largest residual [deg]."""
        return self.like.format(largest=f"{largest_deg:.2f}")

    def false_alarms_per_hour(self) -> float | None:
        """How often a healthy residual alarms; None if the flight is too short to tell."""
        if self.flight.own is None:
            return FALSE_ALARMS_PER_HOUR
        first_s = min((fault.start_s for fault in (*self.found.faults, *self.found.suspicions)), default=np.inf)
        return odds(self.residuals, first_s, self.segment.period_s, self.threshold.typical_deg)


class Pace(NamedTuple):
    """How commands and positions of a stream come."""

    period_s: float
    """Between two positions."""
    command_s: FloatArray
    """When the first commands came, shape (n,) [s]."""
    sent_s: float | None
    """Between two commands as they were sent on a link, of which some are lost; None where that is not known."""


class HealthyStream(Protocol):
    """What a healthy servo does, its position or its current, beside which a stream of it is seen."""

    @property
    def stands_loss(self) -> bool:
        """Whether it is judged where a link loses most of what is sent: its delay is known from good flights."""
        ...

    @property
    def slowest_hz(self) -> float:
        """Rate below which readings are too far apart, where a link loses nothing [Hz]."""
        ...

    @property
    def needs(self) -> frozenset[str]:
        """What acts on it beside the command, by the names of `servofd.aircraft.series.SURROUNDINGS`."""
        ...

    def stream(self, pace: Pace) -> Following:
        """See a stream beside it."""
        ...


def least_rate_hz(healthy: HealthyStream, command_s: FloatArray, *, is_link: bool) -> float:
    """Rate below which positions are too far apart [Hz], by the times of the first commands [s]; a link loses some."""
    is_lossy = is_link and sent_period_s(command_s) is not None
    return min(SLOWEST_LEFT_HZ, healthy.slowest_hz) if is_lossy and healthy.stands_loss else healthy.slowest_hz


def too_few(
    healthy: HealthyStream, period_s: float, command_s: FloatArray, measured_s: FloatArray, *, is_link: bool
) -> str:
    """Why positions of a period [s], and first commands and positions at these times [s], are too few to judge by.

    Empty if they are not. Of a link commands and positions get lost.
    """
    least_hz = least_rate_hz(healthy, command_s, is_link=is_link)
    if 1.0 / period_s < least_hz:
        return f"position comes at {1.0 / period_s:.2g} Hz; a servo cannot be judged below {least_hz:g} Hz"
    both = is_link and all(sent_period_s(time_s) is not None for time_s in (command_s, measured_s))
    return TOO_MANY_LOST if both and not healthy.stands_loss else ""


@dataclass(frozen=True, slots=True)
class Healthy:
    """The healthy servo of a surface, beside which a log or a stream of it is seen.

    `asked`: the user named the level, which alone counts for a named servo.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> aircraft = plain_aircraft(["rudder"], "hs225bb-eq31")
    >>> Healthy(aircraft.surfaces["rudder"], aircraft.model("rudder")).stands_loss
    False
    """

    surface: Surface
    model: ServoModel
    asked: bool = False

    @property
    def known(self) -> CalibratedServo | None:
        """As fitted to good flights, or to a part of the log; None of a servo that is named."""
        return None if self.surface.threshold == "constant" else self.surface.calibrated

    @property
    def stands_loss(self) -> bool:
        """Whether it is judged where a link loses most of what is sent: its delay is known from good flights."""
        return self.known is not None

    @property
    def slowest_hz(self) -> float:
        """That of positions."""
        return SLOWEST_RATE_HZ

    @property
    def needs(self) -> frozenset[str]:
        """What its effects depend on, and airspeed and supply where its flights showed what they do."""
        if self.known is None:
            return self.model.physics.needs
        acting = {"airspeed_m_s": self.known.airspeed_m_s != 0.0, "servo_voltage_v": self.known.supply_v > 0.0}
        return self.model.physics.needs | {need for need, acts in acting.items() if acts}

    def stream(self, pace: Pace) -> Stream:
        """See a stream beside it.

        Raises
        ------
        DesignError
            If no residual filter suits the servo at this pace.
        """
        period_s = pace.period_s

        def judge(segment: Series, noise_deg: FloatArray, names: dict[float, Named]) -> Found:
            return found_of(self._watched(segment, period_s, noise_deg), surface, names, asked=self.asked)

        known, surface = self.known, self.surface
        moving = NamedMoving(surface, self.model, period_s) if known is None else Moving(known, period_s)
        return Stream(moving, surface, *pace, judge)

    def _watched(self, segment: Series, period_s: float, noise_deg: FloatArray | None = None) -> Watched:
        """A log beside it; a named servo is judged at the pace of the whole."""
        if self.known is not None:
            return watched_segment(self.known, segment, noise_deg=noise_deg)
        moving = NamedMoving(self.surface, self.model, period_s, segment.context)
        return watched_segment(moving.known, segment, moving, noise_deg)

    def beside(self, segment: Series, slow_since_s: float = np.inf) -> Seen:
        """See a log beside it; since when the servos of the log are slower together [s], if they are."""
        segment, hold = with_hold(self.model, segment) if self.known is None else (segment.coarser(), ())
        time_s, period_s, surface = segment.measured_s, segment.period_s, self.surface
        flight = self._watched(segment, period_s)
        judged_s, beyond = _judged_s(flight), _beyond(flight)
        if too_short(judged_s):
            raise TooShortError(beyond or too_short(judged_s))
        if not np.isfinite(flight.shown.residuals.residual_deg[flight.judged]).all():
            raise TooShortError("the residual is not a number: check model and units")

        def look(from_s: float, to_s: float) -> Found:
            near = segment.at((time_s >= from_s) & (time_s <= to_s))
            return found_of(self._watched(near, period_s), surface, asked=self.asked)

        found, doubt, level = as_raised(flight, found_of(flight, surface, asked=self.asked), look), "", None
        over_all = lasting(flight) if self.known is not None else NOTHING_LASTS
        found = found._replace(faults=changed(found.faults, over_all, flight, slow_since_s))
        if self.known is not None:
            doubt, (like, notes) = self.known.doubt, _as_in_good_flights(self.known, flight, segment, surface.model)
            if found.faults or found.suspicions:
                found = found._replace(against=_unasked(surface.model, segment))
        else:
            reservations = [*hold, *_reservations(self.model, segment, surface)]
            like, notes = _as_its_model(flight, reservations, is_fault=bool(found.faults))
            if flight.alone and not surface.tells_small_faults:
                generator = ResidualGenerator.fitting(self.model, period_s, surface.filter_pole_rad_s)
                level = generator, surface.persistence
        return Seen(segment, flight, found, judged_s, like, tuple(notes), over_all, doubt, beyond, level)


def _as_in_good_flights(
    known: CalibratedServo, flight: Watched, segment: Series, model: ModelOrigin
) -> tuple[str, list[str]]:
    """As what a servo moves that was fitted, and what a reader has to know beside the verdict."""
    rows = flight.judged
    peak = np.flatnonzero(rows)[np.argmax(np.abs(flight.error_deg[rows]))]
    is_unknown = flight.sigma_deg[peak] > _LITTLE_KNOWN * float(np.median(flight.sigma_deg[rows]))
    where = ", in motion faster than there" if is_unknown else ""
    own_s = model.fitted_between_s
    like = "in its good flights" if own_s is None else f"it did from {own_s[0]:.0f} to {own_s[1]:.0f} s"
    notes = []
    if known.airspeed_m_s and not segment.context.airspeed_s.size:
        notes.append(f"no airspeed in this log: taken to be about {known.airspeed_m_s:.0f} m/s, as in the good flights")
    if not known.airspeed_m_s and segment.context.airspeed_s.size:
        notes.append("its good flights hold no airspeed: calibrate it on logs that do, for fewer false alarms")
    return f"moves as {like} (largest residual {{largest}} deg{where})", notes


def _as_its_model(flight: Watched, reservations: list[str], *, is_fault: bool) -> tuple[str, list[str]]:
    """The same of a servo that is named."""
    (residuals, threshold, _), rows = flight.shown, flight.judged
    level_deg, sigma_deg = threshold.typical_deg, float(np.median(threshold.sigma_deg))
    limit, noise = (f"{two_digits(each)} deg" for each in (level_deg, sigma_deg))
    if is_fault and level_deg < _CLEAR_SIGMAS * sigma_deg:
        reservations.insert(0, f"the threshold of {limit} lies within the residual's noise of {noise}")
    above = (np.abs(residuals.residual_deg[rows]) > threshold.level_deg[rows]).any()
    passed = ", which single readings passed" if above else ""
    like = f"followed its command as its servo should, within {{largest}} deg (threshold {limit}{passed})"
    return like, reservations


_LACKING = {
    "airspeed_m_s": "the log holds no airspeed: the load of the air is left out of the model",
    "servo_voltage_v": "the log holds no supply voltage: the rate that it limits is left out of the model",
    "servo_load": "the log holds no load: the model takes nothing to push the servo from outside",
    "servo_current_a": "the log holds no servo current: the reading is taken not to move with it",
}


def _reservations(model: ServoModel, segment: Series, surface: Surface) -> list[str]:
    """What a reader has to know of a model: effects that want data, another scale, a calibration on other times."""
    notes = [_LACKING[need] for need in sorted(model.physics.needs - segment.context.logged)]
    if surface.by_other_messages:
        notes.append("calibrated on other messages than this log has: judged within wide tolerances")
    return notes


_RARELY_S: Final = 0.14
"""Commands that are logged more rarely (7 Hz) may hide others: of 10 Hz 0 of 48 healthy surfaces were at fault [s]."""
_SURELY_ASKED: Final = 0.995
"""Share of the motion that the servo of a log explains where each of its commands held until the next: 0.9997 and more
of simulated servos that were asked once a second, up to 0.994 of healthy ones that were asked at 50 Hz and accused."""


def _unasked(model: ModelOrigin, segment: Series) -> str:
    """Why nothing is concluded from a log that may lack most of what its servo was asked, by the servo fitted to it."""
    share = model.explained_share
    return "" if model.fitted_between_s is None or share is None or share >= _SURELY_ASKED else rarely_asked(segment)


def rarely_asked(segment: Series) -> str:
    """What a log lacks whose commands are so few that others may lie between them, in words; else nothing."""
    steps_s = pace_steps(segment.command_s)
    every_s = float(np.median(steps_s)) if steps_s.size else 0.0
    if every_s <= _RARELY_S:
        return ""
    return (
        f"commands come at {two_digits(1.0 / every_s)} Hz, and what the servo was asked between them is not known: log "
        "them at 10 Hz or more"
    )


def _judged_s(flight: Watched) -> float:
    """Time covered by judged samples, short pauses between them included [s]."""
    steps_s = np.diff(flight.record.time_s, append=np.nan)
    return float(np.nansum(np.minimum(steps_s, 3.0 * flight.record.period_s)[flight.judged]))


def odds(residuals: Residuals, first_s: float, period_s: float, threshold_deg: float) -> float | None:
    """False alarms per hour, from the residual before the first fault [s]; None if that is too short."""
    healthy = residuals.settled & (residuals.time_s < first_s)
    residual = residuals.residual_deg[healthy]
    if residual.size * period_s < _SECONDS_FOR_ODDS:
        return None
    return Noise.measured(residual, period_s).false_alarms_per_hour(threshold_deg)


def _beyond(flight: Watched) -> str:
    """That much of a flight was faster than what was calibrated, and is not judged; nothing if little was."""
    last_m_s = flight.known.last_judged_m_s
    share = float(np.mean(flight.record.load > load_at(last_m_s))) if flight.record.load.size else 0.0
    if share < _OFTEN_BEYOND:
        return ""
    return (
        f"{share:.0%} of it flown at more than {last_m_s:.0f} m/s, of which the flights of its calibration (up to "
        f"{flight.known.fastest_m_s:.0f} m/s) show nothing: calibrate it on one that is as fast"
    )

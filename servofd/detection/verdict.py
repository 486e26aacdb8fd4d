"""Verdicts on the surfaces and axes of a log: what was found, and what to say of it.

In words: what it is, what it means for the people around the aircraft, and what they can do next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from servofd.core.evidence import NAMED, NOTHING_DETECTABLE, Detectable, ModelOrigin
from servofd.detection.kinds import KINDS, filled

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft
    from servofd.aircraft.series import Series
    from servofd.axes.verdict import AxisAudit
    from servofd.core.statistics import Estimate
    from servofd.core.types import FloatArray
    from servofd.detection.lasting import Lasting
    from servofd.detection.residual import Residuals, Threshold, ThresholdKind

Level = Literal["suspect", "fault"]


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of one surface."""

    kind: str
    """`unknown` if no hypothesis explains it, or several do alike."""
    start_s: float
    """Best estimate of the onset [s]."""
    alarm_s: float
    """When the alarm would have been raised in flight [s]."""
    end_s: float | None
    """When it was last seen [s]; None if it lasts to the end of the log."""
    parameters: Mapping[str, Estimate]
    probability: float
    """Of that kind; of the likeliest alternative if several do alike."""
    alternatives: tuple[str, ...]
    level: Level = "fault"
    named_s: float | None = None
    """End of the window that this name rests on [s]."""
    witness: Literal["position", "current", "motion"] = "position"
    """What tells of it."""
    confirmed_by: Fault | None = None
    """The same event as another witness tells it."""
    is_of_sensor: bool = False
    """Whether another witness says that the servo moves, whose position stands still."""

    @property
    def other(self) -> str:
        """What another witness says of it: its name for it, `sensor` where it denies it, nothing if it is silent."""
        return "sensor" if self.is_of_sensor else self.confirmed_by.kind if self.confirmed_by is not None else ""


@dataclass(frozen=True, slots=True)
class Statistics:
    """Size of the residual while it was judged [deg]."""

    mean_deg: float
    std_deg: float
    max_abs_deg: float
    simulation_error_rms_deg: float

    @classmethod
    def of(cls, residual_deg: FloatArray, error_deg: FloatArray) -> Statistics:
        """Of the residual and of the error of the simulation at the samples that were judged, shape (n,) each.

        Infinite where squares are no numbers any more: such positions are wrong, and their verdict needs no more.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return cls(
                mean_deg=float(np.mean(residual_deg)),
                std_deg=float(np.std(residual_deg)),
                max_abs_deg=float(np.max(np.abs(residual_deg))),
                simulation_error_rms_deg=float(np.sqrt(np.mean(error_deg**2))),
            )


Status = Literal["healthy", "suspect", "fault", "no_data", "unknown"]


WITHIN_SIGMAS = 3.0
"""Half width of the band in which a healthy current stays, in standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class CurrentAudit:
    """What the current of one surface tells; arrays of shape (m,)."""

    status: Status
    reason: str
    explained_share: float | None = None
    """Of the current, by the motion that was asked for."""
    ratio_to_good: float | None = None
    """Current in motion over that of a good servo, since the first fault or throughout."""
    faults: tuple[Fault, ...] = ()
    suspicions: tuple[Fault, ...] = ()
    time_s: FloatArray | None = None
    current_a: FloatArray | None = None
    healthy_a: FloatArray | None = None
    """Of a good servo on the same commands."""
    sigma_a: FloatArray | None = None
    """By which good servos differ from it."""
    command: tuple[FloatArray, FloatArray] | None = None
    """What was asked: times [s] and deflections [deg], shape (n,) each."""
    judged_share: float = 0.0
    asked: bool = False
    """Whether it was asked to move enough to show that it stands still."""

    @property
    def since_s(self) -> float | None:
        """When the first fault or suspicion began [s]."""
        return min((fault.start_s for fault in self.faults or self.suspicions), default=None)


@dataclass(frozen=True, slots=True)
class SurfaceAudit:
    """Verdict on one surface."""

    surface: str
    status: Status
    reason: str
    servo: str
    threshold_kind: ThresholdKind
    threshold_deg: float
    """Of an interval threshold the median level."""
    expected: bool
    """False if the aircraft file names no measured channel, or the log knows nothing of this surface."""
    faults: tuple[Fault, ...] = ()
    suspicions: tuple[Fault, ...] = ()
    """What only a cumulative sum noticed, or the tolerances of a working servo explain."""
    statistics: Statistics | None = None
    false_alarms_per_hour: float | None = None
    segment: Series | None = None
    residuals: Residuals | None = None
    threshold: Threshold | None = None
    model: ModelOrigin = NAMED
    """Where the healthy model comes from, and how well it predicts."""
    detectable: Detectable = NOTHING_DETECTABLE
    """The smallest faults that this log would have shown."""
    judged_share: float = 0.0
    """Share of the log for which this surface was judged."""
    outline: tuple[float | None, ...] = ()
    """Largest residual over its threshold in each of equal parts of the flight; None where nothing was judged."""
    lasting: Lasting | None = None
    """How sure its servo has changed since each instant."""
    tried: bool = True
    """False if it was not asked to move enough to show a jam."""
    current: CurrentAudit | None = None
    """What its current tells, if the log holds it."""

    @property
    def feedback(self) -> Literal["position", "current", "both", "none"]:
        """What the log holds of it beside its commands."""
        by_current = self.current is not None and self.current.time_s is not None
        if by_current:
            return "current" if self.segment is None and self.statistics is None else "both"
        return "position" if self.expected else "none"

    @property
    def is_judged(self) -> bool:
        """True if the data decided whether this surface is well."""
        return self.status not in ("no_data", "unknown")


@dataclass(frozen=True, slots=True)
class CommonCause:
    """What befell several surfaces in one instant."""

    kind: Literal["supply", "bus", "clock", "servo_type", "unknown"]
    since_s: float
    end_s: float | None
    """None if it lasts to the end of the log."""
    surfaces: tuple[str, ...]
    text: str
    """One sentence."""


@dataclass(frozen=True, slots=True)
class LogAudit:
    """Verdict on all surfaces of one log."""

    log: FlightLog
    aircraft: Aircraft
    surfaces: tuple[SurfaceAudit, ...]
    axes: tuple[AxisAudit, ...] = ()
    """What the aircraft's motion tells, if it was calibrated."""
    common_causes: tuple[CommonCause, ...] = ()
    """What befell several surfaces at once."""

    @property
    def has_fault(self) -> bool:
        """True if any surface or axis is at fault."""
        return "fault" in {*(s.status for s in self.surfaces), *(a.status for a in self.axes)}

    @property
    def unjudged(self) -> tuple[SurfaceAudit, ...]:
        """Surfaces that were expected to be judged and could not be.

        One that was not asked to move enough to show a jam does not keep the others from being cleared, if they are at
        least half.
        """
        expected = [s for s in self.surfaces if s.expected]
        missing = tuple(s for s in expected if not s.is_judged)
        untried = sum(not s.tried for s in missing)
        return missing if 2 * untried > len(expected) else tuple(s for s in missing if s.tried)

    @property
    def not_judged(self) -> str:
        """Why there is no verdict on the log as a whole, in one line; empty if there is one.

        Axes that could not be judged matter where no surface was: feedback tells more than motion. As with surfaces,
        at most half of them may have been asked too little to show a jam.
        """
        if self.has_fault:
            return ""
        suspects = [(s.surface, s.reason) for s in self.surfaces if s.status == "suspect"]
        suspects += [(a.axis, a.reason) for a in self.axes if a.status == "suspect"]
        if suspects:
            return "not cleared: " + "; ".join(f"{name}: {reason}" for name, reason in suspects)
        if any(s.is_judged for s in self.surfaces):
            missing = self.unjudged
            return f"could not judge {_by_reason(missing)}" if missing else ""
        if self.axes:
            known = [a for a in self.axes if a.is_expected or any(event.is_own for event in a.events)]
            dark = [axis for axis in known if axis.status != "healthy"]
            if known and 2 * sum(not axis.was_tried for axis in known) <= len(known):
                dark = [axis for axis in dark if axis.was_tried]
            text = "; ".join(f"{axis.axis}: {axis.reason}" for axis in (dark if known else self.axes))
            return f"could not judge {text}" if text else ""
        silent = self.unjudged or self.surfaces
        if silent and all(s.status == "no_data" for s in silent):
            return f"no measured deflection to judge: {silent[0].surface}: {silent[0].reason}"
        return f"could not judge {_by_reason(silent)}"


def _by_reason(surfaces: Sequence[SurfaceAudit]) -> str:
    """Each reason once, after the surfaces it is that of."""
    named: dict[str, list[str]] = {}
    for one in surfaces:
        named.setdefault(one.reason, []).append(one.surface)
    return "; ".join(f"{', '.join(names)}: {reason}" for reason, names in named.items())


_SAMPLES_PER_PERIOD = 4.0
"""Of the servo's bandwidth; twice what the sampling theorem asks for."""
SURE, WORTH_TELLING = 0.95, 0.02
"""Probabilities from which a name counts as certain, and an alternative is worth mentioning."""
SERVO_OR_SENSOR = "servo or its feedback: "
"""What a position alone tells is of one of these."""
EVEN = 0.5
"""Probability below which all other kinds together are likelier: of sound surfaces in calm air three were at fault with
.28 to .48, for jams and play of at most 1 deg (even seeds of `benchmarks/jsbsim_flights.py`)."""
OF_SENSOR = "the position stands still, the current says that it moves: its sensor is at fault"
"""What two witnesses tell that disagree."""
EXPLAINED = "the tolerances of a working servo explain it"
"""Why an alarm is taken back."""


def two_digits(value: float) -> str:
    """A size with as many digits as are of use, and no exponent.

    Examples
    --------
    >>> two_digits(0.0312), two_digits(246.4)
    ('0.031', '250')
    """
    return f"{float(f'{value:.2g}'):g}"


def accusation(faults: Sequence[Fault], who: str = SERVO_OR_SENSOR) -> str:
    """With what the reason of a surface at fault begins: `who` it may be, and what it does."""
    return f"{who}{'; then '.join(map(describe, faults))}"


def describe(fault: Fault) -> str:
    """One clause: what, since when, until when, how sure.

    Examples
    --------
    >>> from servofd.core.statistics import Estimate
    >>> from servofd.detection.verdict import Fault
    >>> describe(Fault("stuck", 10.0, 10.4, None, {"position_deg": Estimate(3.1, 3.0, 3.2)}, 0.8, ("deadband",)))
    'stuck at 3.1 deg since 10.00 s, perhaps a dead band (alarm at 10.40 s)'
    >>> describe(Fault("healthy", 45.9, 52.2, None, {}, 0.4, ("deadband",)))
    'crossed the threshold by too little to tell what it is since 45.90 s, perhaps a dead band (alarm at 52.20 s)'
    """
    values = {name: estimate.value for name, estimate in fault.parameters.items()}
    text = filled(KINDS[fault.kind].clause, values)
    since = (
        f"from {fault.start_s:.2f} to {fault.end_s:.2f} s"
        if fault.end_s is not None
        else f"since {fault.start_s:.2f} s"
    )
    doubt = ""
    if fault.kind == "unknown" and fault.alternatives:
        text, doubt = "at fault, and which fault it is cannot be said", _perhaps(fault)
    elif fault.probability < SURE and fault.alternatives and fault.kind != "healthy":
        doubt = _perhaps(fault)
    if fault.kind == "healthy" and fault.level == "fault":
        text = "crossed the threshold, but the tolerances of a working servo explain it"
        if fault.probability < EVEN and fault.alternatives:
            text, doubt = "crossed the threshold by too little to tell what it is", _perhaps(fault)
    confirmed = "" if fault.confirmed_by is None else f", and {_confirmation(fault.confirmed_by)}"
    sensor = f"; {OF_SENSOR}" * fault.is_of_sensor
    return f"{text} {since}{doubt}{confirmed}{sensor} (alarm at {fault.alarm_s:.2f} s)"


def _confirmation(other: Fault) -> str:
    """What another witness says of the same event."""
    values = {name: estimate.value for name, estimate in other.parameters.items()}
    return f"by its {other.witness} {filled(KINDS[other.kind].clause, values)}"


def _perhaps(fault: Fault) -> str:
    """What else it may be."""
    return f", perhaps {' or '.join(KINDS[kind].perhaps for kind in fault.alternatives)}"


def too_slow(bandwidth_rad_s: float, position_period_s: float, command_period_s: float) -> str:
    """What comes too slowly for the bandwidth of a servo, in words; empty if nothing does or periods are NaN."""
    bandwidth_hz = bandwidth_rad_s / (2.0 * math.pi)
    enough_hz = _SAMPLES_PER_PERIOD * bandwidth_hz
    periods_s = {"position": position_period_s, "command": command_period_s}
    slow = [f"{what} at {1.0 / s:.3g} Hz" for what, s in periods_s.items() if s * enough_hz > 1.0]
    if not slow:
        return ""
    return (
        f"{' and '.join(slow)}: slow for a servo whose bandwidth is {bandwidth_hz:.2g} Hz: {enough_hz:.2g} Hz would do"
    )


def meaning(fault: Fault) -> str:
    """What may have happened to the aircraft, in a sentence."""
    return KINDS[(fault.confirmed_by or fault).kind].meaning


def check(fault: Fault) -> str:
    """What to do about it on the ground."""
    return KINDS[(fault.confirmed_by or fault).kind].check


def gravest(faults: Sequence[Fault]) -> Fault:
    """The fault that may do most to the aircraft, in the order of `servofd.detection.kinds.KINDS`.

    A fault whose name is less likely than all others together comes after those whose names are not. Of two of one
    kind, one that lasts comes first, then the likelier one, then the earlier one.

    Examples
    --------
    >>> play = Fault("deadband", 5.0, 6.0, None, {}, 0.99, ())
    >>> jam, guess = (Fault("stuck", 20.0, 20.4, 28.0, {}, probability, ()) for probability in (0.9, 0.3))
    >>> gravest([play, jam]).kind, gravest([play, guess]).kind
    ('stuck', 'deadband')
    """
    return by_gravity(faults)[0]


def by_gravity(faults: Sequence[Fault]) -> list[Fault]:
    """Faults in that order."""
    order = list(KINDS)
    return sorted(
        faults,
        key=lambda one: (
            one.probability < EVEN,
            order.index(one.kind),
            one.end_s is not None,
            -one.probability,
            one.start_s,
        ),
    )


def next_step(surface: SurfaceAudit) -> str:
    """What to do about a verdict, in a sentence; empty if there is nothing to do."""
    if surface.status == "fault":
        worst = gravest(surface.faults)
        by_position = worst.witness == "position" and worst.confirmed_by is None
        sensor = "; if it moves as asked, its position sensor is at fault" if by_position else ""
        return f"do not fly; on the ground, {check(worst)}{sensor}"
    if surface.status == "suspect":
        look = check(gravest(surface.suspicions)) if surface.suspicions else KINDS["unknown"].check
        return (
            f"look at another flight; if it happens again, on the ground, {look}; 'servofd explain' says what the "
            "model lacks"
        )
    if surface.status == "unknown":
        return "no verdict: before the next flight, move it from stop to stop and watch that it follows"
    if surface.status == "no_data" and surface.expected:
        return "log its measured position; 'servofd info' says what this log holds and what is missing"
    return ""

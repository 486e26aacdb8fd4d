"""One flight of the fleet, judged: what was found, when, and when it could have been found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bound import Health, log_likelihood_ratio
from fleet import FleetFlight, flight
from servofd.aircraft.priors import FITTED
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.detection.residual import ResidualGenerator
from servofd.detection.seen import Healthy, Seen

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.verdict import Fault

__all__ = ["CONSTANT_DEG", "MOVING_DEG_S", "Case", "Found", "Judged", "Trial", "judged", "trial"]

CONSTANT_DEG = 1.5
"""Thesis Figs 4.1 and 4.2."""
MOVING_DEG_S = 5.0
"""A healthy surface moves while it turns faster: less than the noise of a cheap converter (0.2 deg) in 40 ms."""
_ENOUGH_S, _ENOUGH_DEG = 2.0, 4.0
"""Enough motion after the onset: so long faster than `MOVING_DEG_S`, over so wide a range."""
_SEEN_ONLY_IN_MOTION = ("stuck", "deadband", "slow", "loss_of_effectiveness")
_ROC_WINDOW_S = 1.0
_AIRCRAFT = plain_aircraft(["x"], "hs225bb-eq31")
_SURFACE = _AIRCRAFT.surfaces["x"].model_copy(update={"threshold": "interval"})


class Case(NamedTuple):
    """What is flown; `kind` is None in a healthy flight."""

    seed: int
    style: str
    kind: str | None
    size: str


class Found(NamedTuple):
    """A fault that was reported."""

    kind: str
    start_s: float
    alarm_s: float
    probability: float
    alternatives: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Trial:
    """What detectors made of one flight; times since the fault [s] are infinite where it was missed."""

    case: Case
    start_s: float
    """Of the fault; infinite in a healthy flight."""
    motion_wait_s: float
    """Time from there to what a fault needs to be seen: motion, or nothing."""
    enough_motion: bool
    alarms: int
    """Number of faults named by the bank before the true one, or at all in a healthy flight."""
    suspicions: int
    """What is not called a fault, at any time."""
    found: Found | None
    """First fault named since the onset; in a healthy flight the first."""
    suspected: str
    """Kind of the first suspicion since the onset, or nothing."""
    constant_delay_s: float
    interval_delay_s: float
    bank_delay_s: float
    constant_peak: float
    """Largest |residual| over the constant threshold: of a healthy flight, of others until 1 s after it can be seen."""
    interval_peak: float
    evidence: FloatArray
    """Log-likelihood ratio of the true fault since its onset, of shape (n,); empty in a healthy flight."""
    evidence_s: FloatArray
    """Time since the onset, of shape (n,)."""
    healthy_evidence: float
    """The largest that the same detector gets from the same flight without the fault."""
    step_sigmas: float
    """Size of a step [standard deviations of the residual]; infinite for other faults."""

    @property
    def name(self) -> str:
        """What the fault was called."""
        if self.found is not None:
            return self.found.kind
        if self.suspected == "healthy":
            return "healthy"
        return "suspect" if self.suspected else "none"

    @property
    def right(self) -> bool:
        """Whether that is what it was."""
        return self.name == self.case.kind

    @property
    def among_named(self) -> bool:
        """Whether the true kind is the name or one of its alternatives."""
        return self.found is not None and self.case.kind in (self.found.kind, *self.found.alternatives)

    @property
    def probability(self) -> float:
        """Of the name; 0 without one."""
        return self.found.probability if self.found is not None else 0.0

    @property
    def onset_error_s(self) -> float:
        """Named onset minus the true one."""
        return self.found.start_s - self.start_s if self.found is not None else float("nan")

    def bound_delay_s(self, limit: float) -> float:
        """When the evidence reaches a limit."""
        reached = np.flatnonzero(self.evidence >= limit)
        return float(self.evidence_s[reached[0]]) if reached.size else float("inf")


class Judged(NamedTuple):
    """A flight with all that servofd makes of it."""

    flight: FleetFlight
    segment: Series
    generator: ResidualGenerator
    seen: Seen


def judged(one: FleetFlight) -> Judged:
    """Judge one flight against the interval threshold."""
    segment = Series("x", one.time_s, one.command_deg, one.time_s, one.measured_deg)
    generator = ResidualGenerator.fitting(_AIRCRAFT.model("x"), segment.period_s)
    return Judged(one, segment, generator, Healthy(_SURFACE, _AIRCRAFT.model("x")).beside(segment))


def trial(case: Case) -> Trial:
    """Fly and judge one case, and its healthy twin."""
    log = judged(flight(case.seed, case.style, case.kind, case.size or "medium"))
    residuals, (faults, suspicions, *_) = log.seen.residuals, log.seen.found
    settled = residuals.settled
    time_s, size_deg = residuals.time_s[settled], np.abs(residuals.residual_deg[settled])
    level_deg = log.seen.threshold.level_deg[settled]
    truth, passed = log.flight.truth, log.seen.flight.shown.passed
    if truth is None:
        found = _found(faults[0]) if faults else None
        return Trial(
            case, np.inf, 0.0, False, len(faults), len(suspicions), found, "",
            np.inf, np.inf, np.inf, float(np.max(size_deg)) / CONSTANT_DEG, float(np.max(size_deg / level_deg)),
            np.empty(0), np.empty(0), 0.0, np.inf,
        )  # fmt: skip
    since = [fault for fault in faults if fault.alarm_s >= truth.start_s]
    doubts = [doubt for doubt in suspicions if doubt.alarm_s >= truth.start_s]
    twin = flight(case.seed, case.style)
    moving_s = _moving_s(twin, truth.start_s)
    wait_s = (float(moving_s[0]) if moving_s.size else np.inf) if case.kind in _SEEN_ONLY_IN_MOTION else 0.0
    after = time_s >= truth.start_s
    soon = after & (time_s <= truth.start_s + wait_s + _ROC_WINDOW_S)
    evidence_s, evidence, healthy = _evidence(log, twin)
    step_deg = abs(truth.parameters["bias_deg"]) if truth.kind == "bias" else np.inf
    return Trial(
        case=case,
        start_s=truth.start_s,
        motion_wait_s=wait_s,
        enough_motion=_enough(twin, truth.start_s, moving_s),
        alarms=len(faults) - len(since),
        suspicions=len(suspicions),
        found=_found(since[0]) if since else None,
        suspected=doubts[0].kind if doubts else "",
        constant_delay_s=_first(time_s, after & (size_deg >= CONSTANT_DEG)) - truth.start_s,
        interval_delay_s=_first(time_s, after & (passed[settled] >= 1.0)) - truth.start_s,
        bank_delay_s=since[0].alarm_s - truth.start_s if since else np.inf,
        constant_peak=float(np.max(size_deg[soon], initial=0.0)) / CONSTANT_DEG,
        interval_peak=float(np.max((size_deg / level_deg)[soon], initial=0.0)),
        evidence=evidence,
        evidence_s=evidence_s,
        healthy_evidence=healthy,
        step_sigmas=step_deg / float(np.median(log.seen.threshold.sigma_deg)),
    )


def _found(fault: Fault) -> Found:
    return Found(fault.kind, fault.start_s, fault.alarm_s, fault.probability, fault.alternatives)


def _first(time_s: FloatArray, flags: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> float:
    return float(time_s[np.argmax(flags)]) if flags.any() else float("inf")


def _moving_s(twin: FleetFlight, start_s: float) -> FloatArray:
    """Times since the onset at which the healthy surface moves."""
    speed_deg_s = np.abs(np.gradient(twin.moved_deg, twin.time_s))
    moving_s: FloatArray = twin.time_s[(speed_deg_s >= MOVING_DEG_S) & (twin.time_s >= start_s)] - start_s
    return moving_s


def _enough(twin: FleetFlight, start_s: float, moving_s: FloatArray) -> bool:
    """Whether the healthy surface moves long and far enough after the onset for the fault to be told from others."""
    period_s = float(np.median(np.diff(twin.time_s)))
    range_deg = float(np.ptp(twin.moved_deg[twin.time_s >= start_s]))
    return moving_s.size * period_s >= _ENOUGH_S and range_deg >= _ENOUGH_DEG


def _evidence(log: Judged, twin: FleetFlight) -> tuple[FloatArray, FloatArray, float]:
    """Time since the onset, evidence for the true fault, and the most that the healthy twin gives."""
    truth, residuals = log.flight.truth, log.seen.residuals
    assert truth is not None  # noqa: S101 - the caller has looked
    start_s = truth.start_s
    noise_deg = float(np.hypot(log.flight.servo.noise_deg, log.flight.servo.step_deg / np.sqrt(12.0)))
    watched = log.seen.flight
    used = np.isfinite(residuals.measured_deg) & (residuals.time_s >= residuals.time_s[np.argmax(residuals.settled)])
    spread = np.sqrt(np.diag(watched.known.covariance))
    health = Health(noise_deg, spread, watched.slopes[used][:, :FITTED])
    time_s = residuals.time_s[used]
    usable = np.isin(log.flight.time_s, time_s)
    signature_deg = (log.flight.moved_deg - twin.moved_deg)[usable]
    since = time_s >= start_s
    faulty, healthy = (
        log_likelihood_ratio(health, read_deg[usable] - residuals.simulated_deg[used], signature_deg)[since]
        for read_deg in (log.flight.measured_deg, twin.measured_deg)
    )
    return time_s[since] - start_s, np.maximum.accumulate(faulty), float(np.max(healthy, initial=0.0))

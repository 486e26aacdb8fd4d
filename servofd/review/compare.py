"""Two recordings of the same log: what changed, and where."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.errors import RecordingError
from servofd.outputs.recording.clock import microseconds

if TYPE_CHECKING:
    from servofd.detection.bank.flight import Fault
    from servofd.detection.verdict import SurfaceAudit
    from servofd.outputs.recording.content import Recording, Trace

_CURVES = (("simulated", "simulated_deg"), ("residual", "residual_deg"), ("threshold", "threshold_deg"))
_SAME_FAULT_S = 1.0


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that is not the same in two recordings."""

    surface: str
    what: str
    before: str
    after: str
    from_s: float | None = None
    """Where it begins [s], if it has a place."""
    to_s: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def compared(before: Recording, after: Recording) -> list[Change]:
    """Everything in which two recordings of the same log differ; empty if they agree to the last bit.

    Parameters
    ----------
    before, after : Recording
        Two audits of one log: by other thresholds, models, or versions of servofd.

    Examples
    --------
    >>> from servofd.outputs.recording.write import recording_of
    >>> from servofd.review.rejudge import rejudged
    >>> from servofd.workflow import audit
    >>> (found,) = audit("sample_logs/faser_stuck_flight.mat", surfaces=("rudder",))
    >>> one = recording_of(found)
    >>> compared(one, one), [c.what for c in compared(one, rejudged(one, threshold_deg=2.0))]
    ([], ['threshold', 'reason', 'threshold curve'])
    """
    first, second = ({s.surface: s for s in r.audit.surfaces} for r in (before, after))
    changes = [Change(name, "surface", "recorded", "not recorded") for name in first if name not in second]
    changes += [Change(name, "surface", "not recorded", "recorded") for name in second if name not in first]
    for name in (name for name in first if name in second):
        changes += _verdicts(first[name], second[name])
        if name in before.traces and name in after.traces:
            changes += _curves(name, before.traces[name], after.traces[name])
    return changes


def _verdicts(before: SurfaceAudit, after: SurfaceAudit) -> list[Change]:
    name = before.surface
    pairs = (
        ("status", before.status, after.status),
        ("servo", before.servo, after.servo),
        ("threshold", _threshold(before), _threshold(after)),
        ("reason", before.reason, after.reason),
    )
    changes = [Change(name, what, old, new) for what, old, new in pairs if old != new]
    left = list(after.faults)
    for fault in before.faults:
        same = next((f for f in left if _is_same(f, fault)), None)
        if same is None:
            changes.append(Change(name, "fault", _fault(fault), "none", fault.start_s, fault.end_s))
            continue
        left.remove(same)
        if _fault(same) != _fault(fault):
            changes.append(Change(name, "fault", _fault(fault), _fault(same), fault.start_s, fault.end_s))
    return changes + [Change(name, "fault", "none", _fault(f), f.start_s, f.end_s) for f in left]


def _curves(name: str, before: Trace, after: Trace) -> list[Change]:
    """Which curves differ, by how much at most, and from when to when."""
    _, mine, theirs = np.intersect1d(
        microseconds(before.time_s), microseconds(after.time_s), assume_unique=True, return_indices=True
    )
    if not mine.size:
        raise RecordingError(f"{name}: the two recordings have no time in common: not the same log")
    gap_deg = np.abs(before.measured_deg[mine] - after.measured_deg[theirs])
    if np.any(gap_deg > 0.0):
        raise RecordingError(f"{name}: the measured deflections differ: not two recordings of the same log")
    time_s = before.time_s[mine]
    changes = []
    if before.time_s.size != after.time_s.size:
        changes.append(Change(name, "length", _length(before), _length(after)))
    for what, attribute in _CURVES:
        old, new = getattr(before, attribute)[mine], getattr(after, attribute)[theirs]
        differs = (old != new) & ~(np.isnan(old) & np.isnan(new))
        if differs.any():
            where = np.flatnonzero(differs)
            known = np.abs(np.where(differs, new - old, 0.0))
            worst = int(np.nanargmax(known)) if np.isfinite(known).any() else int(where[0])
            changes.append(
                Change(
                    name,
                    f"{what} curve",
                    f"{old[worst]:.4g} deg at {time_s[worst]:.2f} s",
                    f"{new[worst]:.4g} deg",
                    float(time_s[where[0]]),
                    float(time_s[where[-1]]),
                )
            )
    return changes


def _length(trace: Trace) -> str:
    return f"{trace.time_s.size} samples"


def _is_same(one: Fault, other: Fault) -> bool:
    """Whether two findings overlap in time."""
    ends_s = [np.inf if f.end_s is None else f.end_s + _SAME_FAULT_S for f in (one, other)]
    return one.start_s <= ends_s[1] and other.start_s <= ends_s[0]


def _threshold(surface: SurfaceAudit) -> str:
    return f"{surface.threshold_kind}, {surface.threshold_deg:.4g} deg"


def _fault(fault: Fault) -> str:
    end = "" if fault.end_s is None else f" to {fault.end_s:.2f} s"
    return f"{fault.kind} from {fault.start_s:.2f} s{end}, alarm {fault.alarm_s:.2f} s"

"""Several surfaces that leave their models at once have one cause, and it is not their servos."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.detection.bank.flight import Fault
    from servofd.detection.verdict import SurfaceAudit

_TOGETHER_S = 0.5
_FEWEST, _MOST_SHARE = 3, 0.6
"""So many surfaces, and such a share of those that were judged, do not fail in one instant."""
_FROZEN = ("stuck", "hardover", "deadband", "floating")
_AT_START_S = 5.0
_FROZEN_SAMPLES = 5


def with_common_causes(surfaces: Sequence[SurfaceAudit]) -> tuple[SurfaceAudit, ...]:
    """Return the same verdicts; faults that most surfaces share from one instant on become one suspicion of them all.

    Examples
    --------
    >>> from servofd.detection.verdict import SurfaceAudit
    >>> with_common_causes([SurfaceAudit("rudder", "healthy", "", "s9254", "constant", 1.5, True)])[0].status
    'healthy'
    """
    judged = [s for s in surfaces if s.is_judged]
    instants_s = sorted(_since_s(s, fault) for s in judged for fault in s.faults)
    result = list(surfaces)
    for at_s in instants_s:
        together = [s for s in result if any(_is_at(_since_s(s, fault), at_s) for fault in s.faults)]
        if len(together) < _FEWEST or len(together) < _MOST_SHARE * len(judged):
            continue
        text = _sentence(together, at_s)
        result = [_shared(s, at_s, text) if s in together else s for s in result]
    return tuple(result)


def _since_s(surface: SurfaceAudit, fault: Fault) -> float:
    """When a fault began; or when its reading froze to the last bit, if that was before it showed [s]."""
    if surface.residuals is None:
        return fault.start_s
    measured_deg, time_s = surface.residuals.measured_deg, surface.residuals.time_s
    seen = np.flatnonzero(np.isfinite(measured_deg) & (time_s <= fault.alarm_s))
    if seen.size == 0:
        return fault.start_s
    other = np.flatnonzero(measured_deg[seen] != measured_deg[seen[-1]])
    first = int(other[-1]) + 1 if other.size else 0
    frozen = seen.size - first >= _FROZEN_SAMPLES
    return min(fault.start_s, float(time_s[seen[first]])) if frozen else fault.start_s


def _is_at(start_s: float, at_s: float) -> bool:
    return 0.0 <= start_s - at_s <= _TOGETHER_S


def _sentence(together: Sequence[SurfaceAudit], at_s: float) -> str:
    """What happened to all of them, and what to look at."""
    kinds = [fault.kind for s in together for fault in s.faults if _is_at(_since_s(s, fault), at_s)]
    ends = [fault.end_s for s in together for fault in s.faults if _is_at(_since_s(s, fault), at_s)]
    first_s = min(float(s.residuals.time_s[0]) for s in together if s.residuals is not None)
    start = f"{len(together)} surfaces left their models together at {at_s:.2f} s, which is one cause and no servo's:"
    if at_s - first_s <= _AT_START_S:
        return f"{start} look for a wrong servo type, calibration or pairing (--servo unknown fits servos to this log)"
    if sum(kind in _FROZEN for kind in kinds) > 0.5 * len(kinds):
        lasted = [end_s - at_s for end_s in ends if end_s is not None]
        until = f", for {float(np.median(lasted)):.1f} s" if len(lasted) == len(ends) else ""
        return (
            f"{start} their positions stand still{until}; look for a frozen or late servo bus, or a supply that failed"
        )
    return f"{start} look at the servo supply, the bus and the clocks of the log"


def _shared(surface: SurfaceAudit, at_s: float, text: str) -> SurfaceAudit:
    """The surface without the faults of this instant, and with the sentence."""
    shared = [fault for fault in surface.faults if _is_at(_since_s(surface, fault), at_s)]
    own = tuple(fault for fault in surface.faults if fault not in shared)
    common = tuple(replace(fault, level="suspect") for fault in shared)
    suspicions = tuple(sorted((*surface.suspicions, *common), key=lambda fault: fault.start_s))
    if own:
        return replace(surface, faults=own, suspicions=suspicions, reason=f"{surface.reason}; {text}")
    return replace(surface, status="suspect", faults=(), suspicions=suspicions, reason=text)

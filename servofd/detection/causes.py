"""What befalls most surfaces in one instant is one cause: a supply, a bus, the wrong servo type."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.detection.kinds import STANDS_STILL
from servofd.detection.verdict import CommonCause, SurfaceAudit, accusation, describe, two_digits
from servofd.servo.context import Context

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from servofd.core.types import FloatArray
    from servofd.detection.verdict import Fault

_TOGETHER_S, _STILL_TOGETHER_S = 1.0, 0.5
_FEWEST, _MOST_SHARE = 3, 0.5
"""So many surfaces, and this share of those that were judged, do not fail in one instant."""
_FEWEST_SLOW: Final = 2
"""So many, and that share, do not lose speed in one instant: no two of 28 healthy flights did."""
_WHILE_IT_FALLS, _WITH_IT_S = 2, 5.0
"""So many do not while their supply falls, within so much of each other: onsets of currents are less sharp [s]."""
AROUND_S: Final = 15.0
"""Time before and after an instant in which volts and amperes are compared; by then it is known if they return [s]."""
_SHARP_S: Final = 1.0
"""Time to either side of an instant in which a supply falls [s]."""
FALLEN, _UNDER_LOAD = 0.9, 0.1
"""Share of its volts below which a supply has fallen, each taken as those that it is below for a tenth of the time: the
rail of the simulated motors sags by 5 % under load."""
_SAGGED: Final = 0.8
"""Share of its usual volts below which a supply gave way though servos follow: starts of motors and gusts take less."""
_DEAD: Final = 0.3
"""Share of its usual volts on which no servo moves: less, though all servos follow, is no reading of their supply."""
_EMPTY, _FULL = 0.75, 0.95
"""Share of its highest volts at which a battery is empty (3.2 of 4.2 V a cell), and below which one is passed by for
glitches: a share of its readings."""
_FROZEN = (*STANDS_STILL, "deadband")
_AT_START_S = 5.0
"""Time after the first sample within which a fault was there from the beginning [s]."""
_FROZEN_SAMPLES = 5
"""Equal readings of a position that froze."""
_ASKED_DEG = 0.5
"""Readings of a servo that is asked to move so far change: none is coarser."""
_OF_NO_SERVO = ("bus", "servo_type")
"""Causes that are no fault of any servo."""


def with_common_causes(
    surfaces: Sequence[SurfaceAudit], volts: Sequence[tuple[FloatArray, FloatArray]] = ()
) -> tuple[tuple[SurfaceAudit, ...], tuple[CommonCause, ...]]:
    """Return the verdicts, and what befell most surfaces in one instant.

    Its members keep their own faults; where a supply gave way, who was only suspected of being slow is at fault with
    them: what several show at once is no chance. A bus that stands still or a wrong servo type is no fault of any
    servo, and becomes a suspicion. `volts` are times [s] and readings [V] of the supplies of servos: whether they
    fell at that instant tells a supply from a bus, and two servos are enough then.
    """
    judged = [s for s in surfaces if s.is_judged]
    result = list(surfaces)
    causes: list[CommonCause] = []
    suspected = (fault.start_s for s in judged for fault in s.suspicions if _fell(volts, fault.start_s))
    begun_s = [_since_s(s, fault) for s in judged for fault in s.faults]
    for at_s in sorted([*begun_s, *suspected]):
        if any(0.0 <= at_s - one.since_s <= (_WITH_IT_S if one.kind == "supply" else _TOGETHER_S) for one in causes):
            continue
        fell = _fell(volts, at_s)
        fewest, within_s = (_WHILE_IT_FALLS, _WITH_IT_S) if fell else (_FEWEST, _TOGETHER_S)
        struck = {s.surface: fault for s in result if (fault := _struck(s, at_s, within_s)) is not None}
        still = [s.surface for s in result if s.surface not in struck and _stands_still(s, at_s)]
        slow = sum(fault.kind == "slow" and fault.level == "fault" for fault in struck.values())
        most = _MOST_SHARE * len(judged)
        are_slow = len(judged) >= _FEWEST and slow >= max(_FEWEST_SLOW, most)
        is_common = are_slow or len(struck) + len(still) >= max(fewest, most)
        if not is_common or not (fell or any(fault.level == "fault" for fault in struck.values())):
            continue
        cause = _cause(list(struck.items()), still, at_s, _first_s(result))
        if fell and cause.kind != "servo_type":
            cause = replace(cause, kind="supply", text=f"{cause.text}; {fell}{_rose(result, cause)}")
        causes.append(cause)
        result = [_answers_for(s, struck.get(s.surface), cause, at_s, is_fallen=bool(fell)) for s in result]
    return tuple(result), (*causes, *_of_volts_alone(result, causes, volts))


def _answers_for(
    surface: SurfaceAudit, given: Fault | None, cause: CommonCause, at_s: float, *, is_fallen: bool
) -> SurfaceAudit:
    """The verdict on a surface beside a cause that befell it at a time, if it did."""
    if given is None or cause.kind not in (*_OF_NO_SERVO, "supply"):
        return surface
    if cause.kind == "supply":
        return _convicted(surface, given, is_fallen=is_fallen)
    return _excused(surface, at_s, cause)


def cause_of_alarms(
    faults: Mapping[str, Fault], watched: int, first_s: float, fall: tuple[float, str]
) -> CommonCause | None:
    """What the alarms that stand have in common; None if it may be chance.

    `faults` are those of each surface that has an alarm, `watched` is how many are watched since `first_s` [s], and
    `fall` says when [s] and by how much their supply fell, if it did. Two of two that never followed are no chance
    either.
    """
    for at_s in sorted(fault.start_s for fault in faults.values()):
        fell = fall[1] if abs(at_s - fall[0]) <= AROUND_S else ""
        fewest, within_s = (_WHILE_IT_FALLS, _WITH_IT_S) if fell else (_FEWEST, _TOGETHER_S)
        struck = [(name, fault) for name, fault in faults.items() if _is_at(fault.start_s, at_s, within_s)]
        is_first = at_s - first_s <= _AT_START_S
        if len(struck) >= max(min(fewest, watched) if is_first and watched > 1 else fewest, _MOST_SHARE * watched):
            cause = _cause(struck, (), at_s, first_s)
            return replace(cause, kind="supply", text=f"{cause.text}; {fell}") if fell and not is_first else cause
    return None


def _first_s(surfaces: Sequence[SurfaceAudit]) -> float:
    """When the first surface is seen [s]."""
    seen = (s.residuals or s.current for s in surfaces)
    begun_s = [float(one.time_s[0]) for one in seen if one is not None and one.time_s is not None and one.time_s.size]
    return min(begun_s, default=0.0)


def _around(time_s: FloatArray, volts_v: FloatArray, at_s: float, apart_s: float = 0.0) -> list[float]:
    """Volts for `AROUND_S` before an instant, usually and under load, and after it, under load and without any [V].

    Without so much next to it [s]; NaN where nothing was read.
    """
    first, falls, fell, last = np.searchsorted(time_s, at_s + np.array([-AROUND_S, -apart_s, apart_s, AROUND_S]))
    if first == falls or fell == last:
        return [np.nan] * 4
    before, after = volts_v[first:falls], volts_v[fell:last]
    return [*np.quantile(before, (0.5, _UNDER_LOAD)), *np.quantile(after, (_UNDER_LOAD, 1.0 - _UNDER_LOAD))]


def _fell(volts: Sequence[tuple[FloatArray, FloatArray]], at_s: float) -> str:
    """By how much the supply of most servos fell at a time, in words; empty if it did not, or is not known."""
    known = [each for each in (_around(*one, at_s) for one in volts) if np.isfinite(each[0])]
    fallen = [(usual_v, low_v) for usual_v, loaded_v, low_v, _ in known if max(low_v, 0.0) < FALLEN * loaded_v]
    if 2 * len(fallen) <= len(known):
        return ""
    return fell_from(*np.median(fallen, axis=0).tolist())


def _of_volts_alone(
    surfaces: Sequence[SurfaceAudit], causes: Sequence[CommonCause], volts: Sequence[tuple[FloatArray, FloatArray]]
) -> Iterator[CommonCause]:
    """A supply that gave way, where servos do not say so themselves."""
    follow = any(s.status == "healthy" for s in surfaces) and not any(s.faults for s in surfaces)
    sagged = _sagged([_above(_DEAD, *one) for one in volts] if follow else volts)
    if sagged is not None and all(one.kind != "supply" for one in causes):
        at_s, text = sagged
        names = [s.surface for s in surfaces if any(-_WITH_IT_S <= f.start_s - at_s <= AROUND_S for f in s.faults)]
        text = f"{text}{'' if names else ' though no servo failed with it'}: measure it under load"
        yield CommonCause("supply", at_s, None, tuple(names), text)


def _sagged(volts: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[float, str] | None:
    """When [s] and by how much the supply of most servos fell by a fifth or more for seconds; None if it did not.

    Before servos have power, and as a log ends with it, volts tell nothing; and a battery that empties gives no way.

    Examples
    --------
    >>> time_s = np.arange(0.0, 90.0, 0.5)
    >>> _sagged([(time_s, np.where(time_s < 40.0, 6.0, 4.5))])
    (40.0, 'it fell from 6.0 to 4.5 V')
    >>> _sagged([(time_s, np.linspace(8.4, 6.4, time_s.size))])
    """
    found = []
    for time_s, volts_v in volts:
        least_v = _SAGGED * float(np.quantile(volts_v, _FULL))
        inside = (time_s >= time_s[0] + AROUND_S) & (time_s <= time_s[-1] - AROUND_S)
        for at_s in time_s[(np.diff((volts_v < least_v).astype(int), prepend=1) == 1) & inside].tolist():
            usual_v, loaded_v, low_v, _ = _around(time_s, volts_v, at_s)
            if loaded_v >= least_v and low_v < _SAGGED * usual_v:
                found.append((at_s, fell_from(usual_v, low_v)))
                break
    return min(found) if 2 * len(found) > len(volts) else None


def _above(share: float, time_s: FloatArray, volts_v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The readings of a supply that are no less than a share of its usual ones."""
    known = volts_v >= min(share * float(np.quantile(volts_v, _FULL)), float(volts_v.max()))
    return time_s[known], volts_v[known]


def fell_from(was_v: float, is_v: float) -> str:
    """A supply that gave way, in words."""
    return f"it fell from {was_v:.1f} to {is_v:.1f} V"


def _rose(surfaces: Sequence[SurfaceAudit], cause: CommonCause) -> str:
    """By how much all that its servos draw rose with it, in words; empty if it did not, or is not known."""
    drawn_a = np.zeros(2)
    for current in (s.current for s in surfaces if s.surface in cause.surfaces):
        if current is not None and current.time_s is not None and current.current_a is not None:
            since_s = current.time_s - cause.since_s
            spans = ((since_s < 0.0) & (since_s >= -AROUND_S), (since_s > 0.0) & (since_s <= AROUND_S))
            drawn_a += [float(np.mean(current.current_a[span])) if span.any() else 0.0 for span in spans]
    was_a, is_a = drawn_a.tolist()
    return f" while its servos drew {two_digits(is_a)} A instead of {two_digits(was_a)}" if is_a > was_a > 0.0 else ""


def before_it_fell(context: Context, *, since_s: float | None = None) -> Context:
    """What acts on servos as if their supply had not given way: one that its supply makes slow is no healthy one.

    A supply that falls under load, or little by little as a battery empties, stays what it is, down to where a battery
    is empty. While a flight is not over, whether volts that fell come back is known 15 s later; `since_s` is until when
    they were looked at before [s].

    Examples
    --------
    >>> time_s = np.arange(0.0, 60.0)
    >>> volts_v = np.where(time_s < 30.0, 6.0, 4.0)
    >>> held = before_it_fell(Context(voltage_s=time_s, voltage_v=volts_v))
    >>> float(held.voltage_v.min())
    6.0
    """
    time_s, volts_v = context.voltage_s, context.voltage_v
    if not time_s.size or np.min(volts_v) >= FALLEN * np.max(volts_v):
        return context
    low_s = np.unique(np.floor(time_s[volts_v < FALLEN * np.maximum.accumulate(volts_v)]))
    if since_s is not None:
        low_s = low_s[(low_s > since_s) & (low_s <= time_s[-1] - AROUND_S)]
    for at_s in low_s:
        usual_v, loaded_v, _, high_v = _around(time_s, volts_v, at_s, _SHARP_S)
        if max(high_v, 0.0) < FALLEN * loaded_v:
            volts_v = np.where((time_s >= at_s - _SHARP_S) & (volts_v < FALLEN * loaded_v), usual_v, volts_v)
            break
    return replace(context, voltage_v=np.maximum(volts_v, _EMPTY * np.quantile(volts_v, _FULL)))


def _struck(surface: SurfaceAudit, at_s: float, within_s: float) -> Fault | None:
    """What befell a surface at an instant: a fault, or a suspicion of one."""
    found = [fault for fault in surface.faults if _is_at(_since_s(surface, fault), at_s, within_s)]
    found += [fault for fault in surface.suspicions if _is_at(fault.start_s, at_s, within_s)]
    return found[0] if found else None


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


def _stands_still(surface: SurfaceAudit, at_s: float) -> bool:
    """Whether its readings stop at this time, or freeze to the last bit although it is asked to move, without alarm."""
    seen = surface.residuals
    if seen is None:
        return False
    known = np.isfinite(seen.measured_deg)
    time_s, measured_deg, simulated_deg = seen.time_s[known], seen.measured_deg[known], seen.simulated_deg[known]
    begin, end = np.searchsorted(time_s, (at_s + _STILL_TOGETHER_S, at_s + 2.0 * _STILL_TOGETHER_S))
    if begin == end:
        return bool(begin > 0 and time_s[begin - 1] >= at_s - _STILL_TOGETHER_S)
    froze = end - begin >= _FROZEN_SAMPLES and np.ptp(measured_deg[begin:end]) == 0.0
    return bool(froze and np.ptp(simulated_deg[begin:end]) > _ASKED_DEG)


def _is_at(start_s: float, at_s: float, within_s: float = _TOGETHER_S) -> bool:
    return 0.0 <= start_s - at_s <= within_s


def _cause(struck: Sequence[tuple[str, Fault]], still: Sequence[str], at_s: float, first_s: float) -> CommonCause:
    """What happened to all of them, and what to look at."""
    names = tuple([name for name, _ in struck] + list(still))
    faults = [fault for _, fault in struck]
    ends_s = [fault.end_s for fault in faults if fault.end_s is not None]
    end_s = float(np.median(ends_s)) if len(ends_s) == len(faults) else None
    count = f"{len(names)} surfaces left their models together at {at_s:.2f} s"
    slow = [fault for fault in faults if "slow" in (fault.kind, *fault.alternatives)]
    if at_s - first_s <= _AT_START_S:
        text = (
            f"{count}: look for another aircraft's file, a wrong servo type or pairing (--servo unknown fits to a log)"
        )
        return CommonCause("servo_type", at_s, end_s, names, text)
    if 2 * sum("unpowered" in (fault.kind, *_confirming(fault)) for fault in faults) > len(faults):
        text = f"{len(names)} servos draw no current since {at_s:.2f} s: look at their supply, its fuse and its plugs"
        return CommonCause("supply", at_s, end_s, names, text)
    if still or 2 * sum(fault.kind in _FROZEN for fault in faults) > len(faults):
        until = "" if end_s is None else f", for {end_s - at_s:.1f} s"
        text = f"{count}: their positions stand still{until}; look for a frozen or late bus, or a failed supply"
        return CommonCause("bus", at_s, end_s, names, text)
    if 2 * len(slow) > len(faults):
        shares = [f.parameters["bandwidth_scale"].value for f in slow if "bandwidth_scale" in f.parameters]
        speed = f"{float(np.median(shares)):.0%} of their speed" if shares else "less than their speed"
        text = f"{len(names)} servos have {speed} since {at_s:.2f} s: measure their supply under load"
        return CommonCause("supply", at_s, end_s, names, text)
    return CommonCause("unknown", at_s, end_s, names, f"{count}: look at the servo supply, the bus and the clocks")


def _confirming(fault: Fault) -> tuple[str, ...]:
    """What another witness takes the fault for."""
    return () if fault.confirmed_by is None else (fault.confirmed_by.kind,)


def _convicted(surface: SurfaceAudit, given: Fault, *, is_fallen: bool) -> SurfaceAudit:
    """The surface at fault of what it was suspected of, since others show the same at once, or their supply fell."""
    is_slow = "slow" in (given.kind, *given.alternatives)
    if given in surface.faults or not (is_slow or is_fallen):
        return surface
    fault = replace(given, kind="slow" if is_slow else given.kind, level="fault")
    suspicions = tuple(one for one in surface.suspicions if one is not given)
    faults = tuple(sorted((*surface.faults, fault), key=lambda one: one.start_s))
    reason = f"{accusation(faults)}; others show the same at once"
    return replace(surface, status="fault", faults=faults, suspicions=suspicions, reason=reason)


def _excused(surface: SurfaceAudit, at_s: float, cause: CommonCause) -> SurfaceAudit:
    """The surface without the faults of an instant that are no servo's, and with the sentence."""
    text = f"{cause.text}: one cause, and no servo's"
    shared = [fault for fault in surface.faults if _is_at(_since_s(surface, fault), at_s)]
    own = tuple(fault for fault in surface.faults if fault not in shared)
    common = tuple(replace(fault, level="suspect") for fault in shared)
    suspicions = tuple(sorted((*surface.suspicions, *common), key=lambda fault: fault.start_s))
    if own:
        whole, left = ("; then ".join(describe(fault) for fault in faults) for faults in (surface.faults, own))
        reason = f"{surface.reason.replace(whole, left)}; {text}"
        return replace(surface, faults=own, suspicions=suspicions, reason=reason)
    return replace(surface, status="suspect", faults=(), suspicions=suspicions, reason=text)

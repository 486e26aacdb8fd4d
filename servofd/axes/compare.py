"""Feedback and motion together: whether a servo failed, or the sensor that watches it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from servofd.axes.judge import lost_between

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.axes.verdict import AxisAudit, Between
    from servofd.detection.bank.flight import Fault
    from servofd.detection.verdict import SurfaceAudit

_STILL = ("stuck", "hardover", "floating")
_MOTIONS = {"roll": "rolls", "pitch": "pitches", "side": "yaws"}


def compared(surfaces: Sequence[SurfaceAudit], axes: Sequence[AxisAudit]) -> tuple[SurfaceAudit, ...]:
    """Say of each surface at fault what the aircraft's motion tells of it.

    A servo that stands still takes its share of the axis' effect away; a sensor that does not takes nothing. Where the
    motion of that time could tell neither, nothing is added.
    """
    return tuple(_with_motion(surface, axes) for surface in surfaces)


def _with_motion(surface: SurfaceAudit, axes: Sequence[AxisAudit]) -> SurfaceAudit:
    still = [fault for fault in (*surface.faults, *surface.suspicions) if fault.kind in _STILL]
    axis = next((axis for axis in axes if surface.surface in axis.members), None)
    if axis is None or not still:
        return surface
    said = [text for text in (_sentence(fault, axis) for fault in still) if text]
    return replace(surface, reason=f"{surface.reason}; {said[0]}") if said else surface


def _sentence(fault: Fault, axis: AxisAudit) -> str:
    end_s = math.inf if fault.end_s is None else fault.end_s
    lost = lost_between(axis, fault.start_s, end_s)
    share = 1.0 / len(axis.members)
    if lost is None:
        return ""
    shown = f"lost share of {axis.axis} {lost.value:.2f} [{lost.low:.2f}, {lost.high:.2f}]"
    if _holds(lost, 0.0) and not _holds(lost, share):
        return f"the aircraft {_MOTIONS.get(axis.axis, 'moves')} as commanded ({shown}): the sensor, not the servo"
    if _holds(lost, share) and not _holds(lost, 0.0):
        return f"the aircraft's motion confirms it ({shown}): the servo, not its sensor"
    return ""


def _holds(lost: Between, value: float) -> bool:
    return lost.low <= value <= lost.high

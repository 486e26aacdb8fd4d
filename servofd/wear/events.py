"""Changes at once: another servo, another adjustment, damage; none of them is wear."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from servofd.wear.records import QUANTITIES
from servofd.wear.series import pieces

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.wear.series import Piece

EventKind = Literal["swap", "adjusted", "changed"]

_SIGMAS = 4.0
_OF_THE_SERVO = ("dead_band_deg", "delay_s", "bandwidth_hz", "rate_limit_deg_s", "bias_deg", "noise_deg")
"""What another servo brings along; size of residual and margin follow from these."""
_SAME_EVENT = 1
"""Cuts that lie no further apart are one: the best place to cut differs by a flight with the scatter."""
_NUMBERS_OF_ANOTHER_SERVO = 2


@dataclass(frozen=True, slots=True)
class Jump:
    """One number before and after."""

    before: float
    after: float


@dataclass(frozen=True, slots=True)
class Event:
    """Something was done to the servo, or happened to it, between two flights."""

    kind: EventKind
    first: int
    """Number of the first flight after it."""
    jumps: Mapping[str, Jump]
    """What changed, by name of the quantity."""
    reason: str
    """In words."""


def find_events(series: Mapping[str, Piece], telling: Mapping[str, float]) -> tuple[Event, ...]:
    """Find when numbers of a servo changed at once.

    Returns
    -------
    tuple of Event
        In the order of the flights. ``swap``: two numbers of the servo or more changed together, or a dead band went
        away, which never heals; ``adjusted``: the bias alone; ``changed``: anything else.
    """
    found: list[tuple[int, str, Jump]] = []
    for name in _OF_THE_SERVO:
        if name in series:
            one = series[name]
            cut = pieces(one.number, one.value, one.deviation)
            found += [(b.first, name, jump) for a, b in itertools.pairwise(cut) if (jump := _jump(a, b, telling[name]))]
    groups: list[list[tuple[int, str, Jump]]] = []
    for one_cut in sorted(found, key=lambda cut: cut[0]):
        if groups and one_cut[0] - groups[-1][-1][0] <= _SAME_EVENT:
            groups[-1].append(one_cut)
        else:
            groups.append([one_cut])
    return tuple(_event(group) for group in groups)


def _jump(before: Piece, after: Piece, telling: float) -> Jump | None:
    """The step between two pieces; None if there is none, only another slope."""
    middle = (before.last + after.first) / 2.0
    left, right = _end(before, middle), _end(after, middle)
    size = right[0] - left[0]
    if abs(size) < max(telling, _SIGMAS * float(np.hypot(left[1], right[1]))):
        return None
    return Jump(left[0], right[0])


def _end(piece: Piece, number: float) -> tuple[float, float]:
    """Value and deviation of a piece's line where it ends; of its median, if it is too short for a slope."""
    line = piece.line
    if piece.number.size <= 4:
        return float(np.median(piece.value)), float(np.max(piece.deviation) + np.std(piece.value))
    away = np.array([1.0, number - line.centre])
    return line.level + line.slope * float(away[1]), float(np.sqrt(away @ line.covariance @ away))


def _event(group: Sequence[tuple[int, str, Jump]]) -> Event:
    first = int(np.median([cut[0] for cut in group]))
    jumps = {name: jump for _, name, jump in group}
    changes = ", ".join(_change(name, jump) for name, jump in jumps.items())
    dead_band = jumps.get("dead_band_deg")
    if len(jumps) >= _NUMBERS_OF_ANOTHER_SERVO or (dead_band and dead_band.after < dead_band.before):
        return Event("swap", first, jumps, f"another servo or linkage since flight {first}: {changes}")
    if "bias_deg" in jumps:
        return Event("adjusted", first, jumps, f"trimmed, or the horn moved, before flight {first}: {changes}")
    return Event(
        "changed", first, jumps, f"changed at once before flight {first}, by damage or repair, not wear: {changes}"
    )


def _change(name: str, jump: Jump) -> str:
    what = QUANTITIES[name]
    before, after = (f"{what.scale * value:z.{what.digits}f}" for value in (jump.before, jump.after))
    return f"{what.title} {before} to {after} {what.unit}"

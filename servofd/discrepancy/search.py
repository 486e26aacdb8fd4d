"""Where the fit of one more effect begins: a coarse grid, then a search along each coordinate, on the liveliest part.

A part of a long log tells where the best fit lies as well as the whole does; which effect it is, the whole decides.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.record import simulate
from servofd.models.catalogue import installed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.discrepancy.record import Record
    from servofd.models.catalogue import MissingEffect, Parameter
    from servofd.types import FloatArray

__all__ = ["begin", "polish", "telling_part"]

_PART_S = 18.0
"""Enough for a dozen manoeuvres; a third of the time of the usual minute."""
_SETTLED_S = 0.3
_SEARCHES, _KINKED_ROUNDS = 9, 2


def telling_part(record: Record, error_deg: FloatArray) -> Record:
    """The stretch of a record in which a simulation is most wrong; all of it if it is short, or several runs."""
    if record.runs or record.time_s[-1] - record.time_s[0] < 1.5 * _PART_S:
        return record
    second = (record.time_s - record.time_s[0]).astype(np.int64)
    energy = np.bincount(second, weights=np.where(record.counts, np.nan_to_num(error_deg) ** 2, 0.0))
    sums = np.concatenate([[0.0], np.cumsum(energy)])
    length = round(_PART_S)
    first = int(np.argmax(sums[length:] - sums[:-length]))
    inside = (second >= first) & (second < first + length)
    start_s = float(record.time_s[inside][0])
    return replace(
        record,
        time_s=record.time_s[inside],
        measured_deg=record.measured_deg[inside],
        counts=record.counts[inside] & (record.time_s[inside] >= start_s + _SETTLED_S),
        block=record.block[inside],
        pressure_pa=None if record.pressure_pa is None else record.pressure_pa[inside],
        voltage_v=None if record.voltage_v is None else record.voltage_v[inside],
        current_a=None if record.current_a is None else record.current_a[inside],
        temperature_c=None if record.temperature_c is None else record.temperature_c[inside],
        side=None if record.side is None else record.side[inside],
    )


def begin(
    part: Record, effects: Sequence[type[MissingEffect]], known: Sequence[float], whole: Record
) -> tuple[list[float], int]:
    """Values near the best for the last of some effects, beside known ones for the others; and how many were tried.

    Limits do nothing where they are wide enough, and there the error has no slope over them. If that is best in a part
    of a log, whose known values may stand in for the limit, the search begins where the limit acts best in the whole.
    Not where poles are fitted, too: those of this search are not the servo's.
    """
    newest = effects[-1]
    trial = _Trial(part, effects)
    grid = list(product(*(p.grid for p in newest.parameters)))
    values = [*known, *min(grid, key=lambda point: trial.loss([*known, *point]))]
    polished, count = polish(part, effects, values, len(known))
    known_servo = not whole.free_poles and part is not whole
    if known_servo and trial.loss(polished) == _Trial(part, effects[:-1]).loss([*known]):
        everywhere = _Trial(whole, effects)
        losses = [everywhere.loss([*known, *point]) for point in grid]
        idle = _Trial(whole, effects[:-1]).loss([*known])
        acting = [k for k, loss in enumerate(losses) if loss != idle]
        polished = [*known, *grid[min(acting, key=losses.__getitem__)]] if acting else polished
        count += everywhere.count
    return polished, count + trial.count


def polish(
    part: Record, effects: Sequence[type[MissingEffect]], values: list[float], first: int
) -> tuple[list[float], int]:
    """Search along each coordinate from the `first` on, between the neighbours on its grid."""
    from scipy.optimize import minimize_scalar

    trial = _Trial(part, effects)
    parameters = [p for effect in effects for p in effect.parameters]
    kinked = any(p.kinked for p in parameters[first:])
    best = trial.loss(values)
    for _ in range(_KINKED_ROUNDS if kinked else 1):
        for k in range(first, len(values)):
            if parameters[k].aside and not parameters[k].kinked:  # left to the fit of all parameters together
                continue

            def loss(value: float, before: list[float] = values[:k], after: list[float] = values[k + 1 :]) -> float:
                return trial.loss([*before, value, *after])

            bounds = _neighbours(parameters[k], values[k])
            found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"maxiter": _SEARCHES})
            if found.fun < best:
                best, values = float(found.fun), [*values[:k], float(found.x), *values[k + 1 :]]
    return values, trial.count


class _Trial:
    """Sum of squares over the fitted samples of a part, and how often it was asked for."""

    def __init__(self, part: Record, effects: Sequence[type[MissingEffect]]) -> None:
        self._part, self._effects, self._where = part, effects, np.flatnonzero(part.trained)
        self.count = 0

    def loss(self, values: list[float]) -> float:
        """For given values."""
        self.count += 1
        moved = simulate(self._part, installed(self._part.plant.neutral, self._effects, values))
        error = (self._part.measured_deg - moved)[self._where]
        return float(error @ error)


def _neighbours(parameter: Parameter, value: float) -> tuple[float, float]:
    """Bracket around a grid point."""
    grid = sorted({*parameter.grid, parameter.neutral})
    if parameter.width > 0.0:
        return max(parameter.low, value - parameter.width), min(parameter.high, value + parameter.width)
    if value not in grid:
        width = 0.25 * abs(value - parameter.neutral) + 1e-9
        return max(parameter.low, value - width), min(parameter.high, value + width)
    k = grid.index(value)
    reach = 1.0 if k in (0, len(grid) - 1) else 0.0
    low = grid[k - 1] if k > 0 else value - reach * abs(grid[1] - grid[0])
    high = grid[k + 1] if k + 1 < len(grid) else value + reach * abs(grid[-1] - grid[-2])
    return max(low, parameter.low), min(high, parameter.high)

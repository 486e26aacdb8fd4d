"""Loss, offset and lag of an axis in every window that ends at a sample, and how far they are from what is expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.core.types import FloatArray
from servofd.core.windows import Sizes, Sums, distance, fitted, known_from, lasting, least

if TYPE_CHECKING:
    from servofd.aircraft.axes import AxisModel
    from servofd.axes.model import Inputs

_ENOUGH = 0.9
"""Share of a window that must be usable."""
_PERSISTENCE_S = 0.5
"""As long the statistic stays above its threshold before it is an alarm: a gust's edge does not."""
_PRIOR_SAMPLES = 50.0
"""Weight of the calibrated noise beside a window's own, in samples: two seconds of 25 Hz."""


class Asked(NamedTuple):
    """Columns of lag, loss, offset and residual: first what is free beside the sizes, then so many sizes."""

    columns: tuple[int, ...]
    patterns: int


SIZES, LAG = Asked((1, 2, 3), 2), Asked((1, 2, 0, 3), 1)
"""Lost share and offset [us]; a lag [s] beside any loss and offset."""


def sizes(inputs: Inputs, window: Sums, noise_var: float, asked: Asked = SIZES) -> Sizes:
    """Sizes in windows, by least squares; turbulence differs, so that what they leave tells of their own noise."""
    found = fitted(window, asked.patterns, columns=asked.columns)
    if inputs.variance <= 0.0:
        return found.scaled(noise_var)
    left = np.fmax(found.left, 0.0) / inputs.variance
    return found.scaled(noise_var * (_PRIOR_SAMPLES + left) / (_PRIOR_SAMPLES + window.samples))


def sliding(inputs: Inputs, length: int, noise_var: float, asked: Asked = SIZES) -> Sizes:
    """Sizes in the window of a length that ends at each sample; NaN where too little of it is usable."""
    window = inputs.sums.trailing(length)
    found = sizes(inputs, window, noise_var, asked)
    return Sizes(np.where(window.samples >= _ENOUGH * length, found.value, np.nan), found.covariance)


def part(inputs: Inputs, begin: int, end: int, noise_var: float, asked: Asked = SIZES) -> Sizes:
    """Sizes from a sample on until before another, as one window."""
    return sizes(inputs, inputs.sums.between(np.array([begin]), np.array([end])), noise_var, asked)


def expected(
    inputs: Inputs, length: int, noise_var: float, flight: FloatArray, window: FloatArray, asked: Asked = SIZES
) -> Sizes:
    """theta0 and P0 of the window that ends at each sample, from the flight before it, by P_flight and P_window."""
    n, p = inputs.usable.size, asked.patterns
    known = Sizes(np.zeros((p, n)), np.repeat(flight[..., None], n, axis=2))
    if length < n:
        past = Sums(inputs.sums.products[:, 1:-length], inputs.sums.samples[1:-length])
        found = known_from(past, p, flight, window, noise_var, asked.columns)
        known.value[:, length:], known.covariance[..., length:] = found
    return known


def _beyond(
    axis: AxisModel, inputs: Inputs, length: int, window: FloatArray, asked: Asked = SIZES
) -> tuple[Sizes, Sizes]:
    """Sizes in the windows of a length, which differ by P_window, and how far they are beyond what is expected."""
    found = sliding(inputs, length, axis.noise_var, asked)
    known = expected(inputs, length, axis.noise_var, axis.of_flights(window), window, asked)
    return found, found.beyond(known, window)


@dataclass(frozen=True)
class Windows:
    """Estimates in the windows of each length that an axis is judged by, and how far beyond what is expected."""

    axis: AxisModel
    inputs: Inputs
    found: tuple[Sizes, ...]
    away: tuple[Sizes, ...]
    late: tuple[FloatArray, ...]
    """J of a lag, where the command is the axis' own; shape (n,) each."""

    @classmethod
    def of(cls, axis: AxisModel, inputs: Inputs) -> Windows:
        """Of one flight."""
        each = []
        for spread in axis.spreads:
            length = spread.samples(inputs.rate_hz)
            one, far = _beyond(axis, inputs, length, spread.covariance)
            lateness = np.zeros(inputs.usable.size)
            if axis.own_command and spread.lag_scale is not None:  # earlier than expected is not slow
                lateness = distance(_beyond(axis, inputs, length, np.array([[spread.lag_var_s2]]), LAG)[1])
            each.append((one, far, lateness))
        found, away, late = zip(*each, strict=True)
        return cls(axis, inputs, found, away, late)

    def scaled(self, axis: AxisModel, kept: Sequence[int]) -> Windows:
        """The windows of some lengths, by an axis that differs in its scales and levels alone."""
        found, away = (tuple(each[k] for k in kept) for each in (self.found, self.away))
        return Windows(axis, self.inputs, found, away, tuple(self.late[k] for k in kept))

    def shifted(self, change: FloatArray) -> Windows:
        """The same if the axis had lost a share, and stood away [us], shape (2,)."""
        return replace(
            self, away=tuple(one._replace(value=one.value + np.asarray(change)[:, None]) for one in self.away)
        )

    def distances(self) -> list[FloatArray]:
        """J in the windows of each length; of the offset alone where the command may as well be another's."""
        if self.axis.own_command:
            return [distance(one) for one in self.away]
        return [distance(one.only(1), None) for one in self.away]

    def shares(self) -> FloatArray:
        """J in the windows of each length, as multiples of the calibration's largest; shape (k, n)."""
        return np.array([j / spread.scale for j, spread in zip(self.distances(), self.axis.spreads, strict=True)])

    def smallest(self) -> FloatArray:
        """Smallest loss and offset [us] that the windows of each length would have shown; shape (k, 2, n)."""
        levels = [self.axis.suspect * spread.scale for spread in self.axis.spreads]
        return np.array(
            [
                (
                    least(one, level),
                    np.nan_to_num(np.sqrt(level * one.covariance[1, 1]) + np.abs(one.value[1]), nan=np.inf),
                )
                for one, level in zip(self.away, levels, strict=True)
            ]
        )

    def statistic(self) -> FloatArray:
        """Largest J of all windows at each sample, as a multiple of the calibration's largest, after persistence."""
        late = [j / (spread.lag_scale or np.inf) for j, spread in zip(self.late, self.axis.spreads, strict=True)]
        shares = [*self.shares(), *late]
        return lasting(np.max(shares, axis=0), max(1, round(_PERSISTENCE_S * self.inputs.rate_hz)))

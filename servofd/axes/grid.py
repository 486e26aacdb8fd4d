"""Channels with stamps of their own, brought to one uniform grid of time."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from servofd.core.errors import NoMeasurement

if TYPE_CHECKING:
    from collections.abc import Sequence

    from logparsers.records import Channel, FlightLog
    from servofd.core.types import BoolArray, FloatArray

LARGEST_GAP_S = 1.0
"""Channels of an autopilot come every 0.25 s at the slowest; nothing is guessed across more than four of them."""


_SLOWER = 1.5
_SLOWEST_HZ = 10.0
"""What comes more seldom is judged on a grid as fast, that of ALFA, whose commands come at 3 Hz: a command holds until
the next, and the filters of the axes need some samples in a period of their corner."""


def grid_rate(label: str, native_hz: float, rate_hz: float | None) -> float:
    """Rate of the grid for commands and motion of some rate.

    Those that come much more seldom than those of the calibration are refused: they are late and coarse.

    Examples
    --------
    >>> grid_rate("flight.bin", 25.0, None), grid_rate("flight.tlog", 3.0, None)
    (25.0, 10.0)
    """
    if rate_hz is None:
        return max(native_hz, _SLOWEST_HZ)
    if rate_hz > max(_SLOWER * native_hz, _SLOWEST_HZ):
        raise NoMeasurement(
            f"{label}: commands and motion come at {native_hz:.3g} Hz, those of the calibration at {rate_hz:.3g} Hz; "
            "calibrate on logs of the same kind, or log faster"
        )
    return rate_hz


@dataclass(frozen=True, slots=True)
class Series:
    """Finite values of a channel at their own times, shape (n,) each."""

    time_s: FloatArray
    values: FloatArray

    @classmethod
    def of(cls, channel: Channel) -> Self:
        """What a channel holds."""
        good = np.isfinite(channel.values)
        return cls(channel.time_s[good], channel.values[good])

    @property
    def rate_hz(self) -> float:
        """Typical rate of samples."""
        return 1.0 / float(np.median(np.diff(self.time_s)))

    def on(self, grid_s: FloatArray, *, held: bool = False) -> FloatArray:
        """Means over the cells of a grid."""
        return cell_means(grid_s, self.time_s, self.values, held=held)


def day_of(log: FlightLog) -> str:
    """Day of a flight: what the log says, else a date in its name, else the name: a day of its own."""
    if log.start_utc is not None:
        return log.start_utc.date().isoformat()
    dated = re.search(r"(20\d\d)[-_]?(\d\d)[-_]?(\d\d)", log.source.name)
    return "-".join(dated.groups()) if dated else log.source.name


def present_on(grid_s: FloatArray, channels: Sequence[Series]) -> BoolArray:
    """Where no channel has a gap."""
    present = np.ones(grid_s.size, dtype=bool)
    for channel in channels:
        time_s = channel.time_s
        after = np.clip(np.searchsorted(time_s, grid_s), 1, time_s.size - 1)
        gap_s = time_s[after] - time_s[after - 1]
        present &= (gap_s <= LARGEST_GAP_S) & (grid_s >= time_s[0]) & (grid_s <= time_s[-1])
    return present


def cell_means(grid_s: FloatArray, time_s: FloatArray, values: FloatArray, *, held: bool = False) -> FloatArray:
    """Mean of a channel over the cell that ends at each point of a uniform grid.

    A faster channel is averaged, which keeps what it has above half the grid's rate from folding down; of a slower
    one the straight line between samples is taken, or what was held.

    Parameters
    ----------
    grid_s : ndarray, shape (n,)
        Uniform times [s], n >= 2.
    time_s, values : ndarray, shape (m,)
        The channel; its times rise strictly and its values are finite.

    Returns
    -------
    ndarray, shape (n,)
        Means, in the unit of `values`.

    Examples
    --------
    >>> cell_means(np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.5, 1.0, 1.5, 2.0]), np.array([0.0, 1, 2, 3, 4]))
    array([0., 1., 3.])
    """
    step_s = float(grid_s[1] - grid_s[0])
    edges = np.concatenate(([grid_s[0] - step_s], grid_s))
    if time_s.size < 2:
        return np.full(grid_s.size, values[0])
    spans = np.diff(time_s)
    pieces = (values[:-1] if held else (values[:-1] + values[1:]) / 2.0) * spans
    areas = np.concatenate(([0.0], np.cumsum(pieces)))
    inside = np.clip(edges, time_s[0], time_s[-1])
    place = np.clip(np.searchsorted(time_s, inside, side="right") - 1, 0, time_s.size - 2)
    ahead = inside - time_s[place]
    slope = 0.0 if held else (values[place + 1] - values[place]) / spans[place]
    area = areas[place] + values[place] * ahead + slope * ahead**2 / 2.0
    area += np.where(edges < time_s[0], values[0], values[-1]) * (edges - inside)
    means: FloatArray = np.diff(area) / step_s
    return means

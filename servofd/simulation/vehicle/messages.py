"""What a vehicle has to tell at a time: the newest row of each message."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from servofd.simulation.telemetry_writer import air_rows, beats, servo_rows

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from servofd.aircraft.schema import Aircraft
    from servofd.core.types import IntArray
    from servofd.simulation.flight import SimulatedFlight


class Send(NamedTuple):
    """A message that shall leave."""

    name: str
    fields: Mapping[str, Any]


class Telemetry:
    """Rows of a flight, in the numbers that its ``.tlog`` would hold.

    `flight`: with outputs. `aircraft`: tells which servos report their positions. `feedback`: how, as in
    `servofd.simulation.telemetry_writer.servo_rows`.
    """

    def __init__(self, flight: SimulatedFlight, aircraft: Aircraft, feedback: str) -> None:
        self._series: dict[str, list[_Series]] = defaultdict(list)
        for name, made_us, columns in (*beats(flight), *servo_rows(flight, aircraft, feedback), *air_rows(flight)):
            self._series[name].append(_Series(made_us, {key: np.asarray(column) for key, column in columns.items()}))

    @property
    def names(self) -> tuple[str, ...]:
        """Messages that there are."""
        return tuple(self._series)

    def newest(self, name: str, now_us: int, *, again: bool = False) -> list[Send]:
        """Latest row of each source of a message.

        `again`: also if it was given before. Result: None that is yet to be made.
        """
        return [Send(name, row) for series in self._series[name] if (row := series.row(now_us, again)) is not None]


class _Series:
    """One source of a message."""

    def __init__(self, made_us: IntArray, columns: dict[str, NDArray[Any]]) -> None:
        self._made_us = made_us
        self._columns = columns
        self._last = -1

    def row(self, now_us: int, again: bool) -> dict[str, Any] | None:
        at = int(np.searchsorted(self._made_us, now_us, side="right")) - 1
        if at < 0 or (at == self._last and not again):
            return None
        self._last = at
        return {key: column[at].tolist() for key, column in self._columns.items()}

"""Writing simulated flights in the formats that real logs have."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servofd.errors import ConfigError, suggest
from servofd.outputs.files import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.aircraft import Aircraft
    from servofd.simulation.flight import SimulatedFlight
    from servofd.types import FloatArray

__all__ = ["WRITERS", "write_flight"]

_BIG_ENDIAN_SINGLE = 1010
_CSV_DECIMALS = 9


def write_flight(path: str | Path, flight: SimulatedFlight, aircraft: Aircraft) -> None:
    """Write a flight; the suffix chooses the format.

    Parameters
    ----------
    path : str or Path
        ``.csv`` (servofd's plain table) or ``.mat`` (FASER log: level 4, big-endian, single precision).
    flight : SimulatedFlight
        What to write.
    aircraft : Aircraft
        Its calibration turns degrees into what a FASER log holds.

    Raises
    ------
    ConfigError
        If no writer has that suffix, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ConfigError(f"{path}: {suggest('output suffix', suffix, WRITERS)}")
    write_whole(path, WRITERS[suffix](flight, aircraft))


def _csv(flight: SimulatedFlight, aircraft: Aircraft) -> bytes:  # noqa: ARG001 - all writers share a form
    import pyarrow as pa
    from pyarrow import csv

    columns = {"time_s": flight.time_s}
    for i, name in enumerate(flight.surfaces):
        columns[f"{name}_cmd_deg"] = np.round(flight.command_deg[:, i], _CSV_DECIMALS)
        columns[f"{name}_pos_deg"] = np.round(flight.measured_deg[:, i], _CSV_DECIMALS)
    sink = io.BytesIO()
    csv.write_csv(pa.table(columns), sink, csv.WriteOptions(quoting_style="needed"))
    return sink.getvalue()


def _mat(flight: SimulatedFlight, aircraft: Aircraft) -> bytes:
    variables = {"time": flight.time_s}
    for i, name in enumerate(flight.surfaces):
        surface = aircraft.surfaces[name]
        variables[surface.command.channel] = surface.command.from_deg(flight.command_deg[:, i])
        if surface.measured is not None:
            variables[surface.measured.channel] = surface.measured.from_deg(flight.measured_deg[:, i])
    buffer = io.BytesIO()
    for name, values in variables.items():
        buffer.write(_level_4_variable(name, values))
    return buffer.getvalue()


def _level_4_variable(name: str, values: FloatArray) -> bytes:
    """One column as FASER's flight computer writes it."""
    label = name.encode() + b"\0"
    header = struct.pack(">5i", _BIG_ENDIAN_SINGLE, values.size, 1, 0, len(label))
    return header + label + values.astype(">f4").tobytes()


WRITERS: dict[str, Callable[[SimulatedFlight, Aircraft], bytes]] = {".csv": _csv, ".mat": _mat}
"""Formats by suffix."""

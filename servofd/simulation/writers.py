"""Writing simulated flights in the formats that real logs have."""

from __future__ import annotations

import csv
import io
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from servofd.aircraft.schema import Aircraft
from servofd.core.errors import ConfigError, suggest
from servofd.core.files import write_whole
from servofd.core.types import FloatArray
from servofd.simulation.dataflash_writer import GENERATIONS, dataflash_log
from servofd.simulation.flight import SimulatedFlight
from servofd.simulation.telemetry_writer import telemetry_log
from servofd.simulation.ulog_writer import ulog_log

_BIG_ENDIAN_SINGLE = 1010
"""Type of a level 4 MAT-file's matrix: big-endian, single precision."""
_CSV_DECIMALS = 9
"""Decimals of the numbers of a table."""


@dataclass(frozen=True, slots=True)
class Writer:
    """One format."""

    encode: Callable[[SimulatedFlight, Aircraft], bytes]
    """Content of the file."""
    rate_hz: float = 100.0
    """Sample rate unless another is chosen [Hz]."""
    context: bool = False
    """True for logs that hold what the servos felt of the air and their supply."""
    pulses: bool = False
    """True for logs of autopilots: the flight must be simulated with outputs."""


def writer_for(path: str | Path, generation: str | None = None) -> Writer:
    """Choose the format by the suffix.

    `path`: ``.csv`` (servofd's plain table), ``.mat`` (FASER log: level 4, big-endian, single precision), ``.bin``
    (ArduPilot DataFlash), ``.tlog`` (MAVLink telemetry) or ``.ulg`` (PX4). `generation`: one of
    `servofd.simulation.dataflash_writer.GENERATIONS`, for ``.bin`` alone; the newest if None.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ConfigError(f"{path}: {suggest('output suffix', suffix, WRITERS)}")
    writer = WRITERS[suffix]
    if generation is None:
        return writer
    if suffix != ".bin":
        raise ConfigError(f"{path}: a generation of servo telemetry belongs to a .bin log, and to that alone")
    if generation not in GENERATIONS:
        raise ConfigError(suggest("generation", generation, GENERATIONS))
    return replace(writer, encode=partial(dataflash_log, generation=GENERATIONS[generation]))


def write_flight(
    path: str | Path, flight: SimulatedFlight, aircraft: Aircraft, *, generation: str | None = None
) -> None:
    """Write a flight in the format that `writer_for` chooses.

    `aircraft`: its calibrations make of degrees what a FASER log holds; its measured channels tell which servos report.
    """
    writer = writer_for(path, generation)
    if flight.context.logged and not writer.context:
        raise ConfigError(
            f"{path}: an effect depends on {', '.join(sorted(flight.context.logged))} as simulated, which only a .csv "
            "holds: choose -o FILE.csv"
        )
    write_whole(path, writer.encode(flight, aircraft))


def _csv(flight: SimulatedFlight, aircraft: Aircraft) -> bytes:  # noqa: ARG001 - all writers share a form
    columns = {"time_s": flight.time_s}
    for i, name in enumerate(flight.surfaces):
        columns[f"{name}_cmd_deg"] = np.round(flight.command_deg[:, i], _CSV_DECIMALS)
        columns[f"{name}_pos_deg"] = np.round(flight.measured_deg[:, i], _CSV_DECIMALS)
    felt = flight.context
    columns |= {
        name: np.round(values, _CSV_DECIMALS)
        for name, values in (
            ("airspeed_m_s", felt.airspeed_m_s),
            ("servo_voltage_v", felt.voltage_v),
            ("servo_current_a", felt.current_a),
            ("servo_load", felt.load),
        )
        if values.size
    }
    rows = zip(
        *(["" if np.isnan(cell) else cell for cell in values.tolist()] for values in columns.values()), strict=True
    )
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(rows)
    return text.getvalue().encode()


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


WRITERS: dict[str, Writer] = {
    ".csv": Writer(_csv, context=True),
    ".mat": Writer(_mat),
    ".bin": Writer(dataflash_log, pulses=True),
    ".tlog": Writer(telemetry_log, rate_hz=40.0, pulses=True),  # the most an ArduPlane sends
    ".ulg": Writer(ulog_log, pulses=True),
}
"""Formats by suffix."""

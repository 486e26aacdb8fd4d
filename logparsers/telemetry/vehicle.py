"""What a telemetry log says about the aircraft itself: parameters, spoken words, type and firmware."""

from __future__ import annotations

import re
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from logparsers.channels import as_float
from logparsers.mavlink import enum_name, version_text
from logparsers.records import Text

if TYPE_CHECKING:
    from collections.abc import Mapping

    from logparsers.telemetry.file import TelemetryFile
    from logparsers.telemetry.messages import Sender

__all__ = ["Vehicle", "read_parameters", "read_texts", "read_vehicle"]

_INVALID, _PX4 = 8, 12  # MAV_AUTOPILOT
_BYTEWISE = 16  # MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
_INTEGERS = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4"}  # MAV_PARAM_TYPE
_BANNER = re.compile(r"(Ardu\w+|APM:\w+|PX4|Rover|Blimp|AntennaTracker)[ -]?V?\d")
_CHUNK = 50  # characters of one STATUSTEXT


@dataclass(frozen=True, slots=True)
class Vehicle:
    """The aircraft, as its autopilot introduces itself.

    Parameters
    ----------
    type : str
        For example ``"fixed wing"``.
    autopilot : str
        For example ``"ardupilotmega"`` or ``"px4"``.
    firmware : str
        Version, for example ``"4.7.0-dev"`` or a line of text; empty if it never said.
    system, component : int
        Its MAVLink address; 0 where the log has none.
    """

    type: str
    autopilot: str
    firmware: str = ""
    system: int = 0
    component: int = 0


def read_vehicle(file: TelemetryFile) -> Vehicle | None:
    """Find the autopilot of a log: the sender of the most heartbeats that name one.

    Parameters
    ----------
    file : TelemetryFile
        An open log.

    Returns
    -------
    Vehicle or None
        None if nobody introduced itself as an autopilot.
    """
    best: tuple[int, Vehicle] | None = None
    for source in file.sources("HEARTBEAT"):
        autopilots = file.column("HEARTBEAT", "autopilot", source=source)
        named = autopilots != _INVALID
        count = int(np.count_nonzero(named))
        if not count or (best and count <= best[0]):
            continue
        kind = int(np.bincount(file.column("HEARTBEAT", "type", source=source)[named]).argmax())
        autopilot = enum_name("MAV_AUTOPILOT", int(np.bincount(autopilots[named]).argmax()))
        best = count, Vehicle(enum_name("MAV_TYPE", kind), autopilot, _firmware(file, source), *source)
    return best[1] if best else None


def _firmware(file: TelemetryFile, source: Sender) -> str:
    """Version from AUTOPILOT_VERSION, else from the banner that ArduPilot prints when parameters are read."""
    if source in file.sources("AUTOPILOT_VERSION"):
        number = int(file.column("AUTOPILOT_VERSION", "flight_sw_version", source=source)[-1])
        if number:
            return version_text(number)
    return next((said.text for said in file.texts if _BANNER.match(said.text)), "")


def read_parameters(file: TelemetryFile) -> Mapping[str, float]:
    """Parameters the vehicle reported; the last value counts.

    Parameters
    ----------
    file : TelemetryFile
        An open log.

    Returns
    -------
    Mapping[str, float]
        By name; empty if none was reported. Integers of PX4, which travel as the bytes of a float, are
        restored.
    """
    source = _vehicle_source(file, "PARAM_VALUE")
    if source is None:
        return MappingProxyType({})
    values = file.column("PARAM_VALUE", "param_value", source=source)
    numbers = as_float(values)
    if _sends_bytes(file, source):
        kinds = file.column("PARAM_VALUE", "param_type", source=source)
        for kind, dtype in _INTEGERS.items():
            rows = kinds == kind
            raw = np.ascontiguousarray(values[rows]).view(np.uint8).reshape(-1, 4)
            width = np.dtype(dtype).itemsize
            numbers[rows] = np.ascontiguousarray(raw[:, :width]).view(dtype).reshape(-1)
    names = file.column("PARAM_VALUE", "param_id", source=source)
    return MappingProxyType(dict(zip(names.tolist(), numbers.tolist(), strict=True)))


def _sends_bytes(file: TelemetryFile, source: Sender) -> bool:
    if source in file.sources("AUTOPILOT_VERSION"):
        return bool(int(file.column("AUTOPILOT_VERSION", "capabilities", source=source)[-1]) & _BYTEWISE)
    if source in file.sources("HEARTBEAT"):
        return bool((file.column("HEARTBEAT", "autopilot", source=source) == _PX4).any())
    return False


def _vehicle_source(file: TelemetryFile, message: str) -> Sender | None:
    """Pick the vehicle among the senders of a message, or the busiest if it is not among them."""
    senders = file.sources(message)
    if not senders:
        return None
    craft = file.vehicle
    for sender in senders:
        if craft and sender == (craft.system, craft.component):
            return sender
    return max(senders, key=lambda sender: file.stream(message, sender).size)


def read_texts(file: TelemetryFile) -> tuple[Text, ...]:
    """Everything said in STATUSTEXT messages; long texts are put together again.

    Parameters
    ----------
    file : TelemetryFile
        An open log.

    Returns
    -------
    tuple of Text
        In the order of the file.
    """
    found: list[tuple[int, Text]] = []
    senders = file.sources("STATUSTEXT")
    for sender in senders:
        name = f"{sender.system}/{sender.component}" if len(senders) > 1 else ""
        columns = ("severity", "text", "id", "chunk_seq")
        rows = [file.column("STATUSTEXT", field, source=sender).tolist() for field in columns]
        begun: tuple[int, int] | None = None  # text and next chunk that may continue the last entry
        times = file.time_s("STATUSTEXT", source=sender).tolist()
        places = file.stream("STATUSTEXT", sender).tolist()
        for place, time_s, severity, text, number, chunk in zip(places, times, *rows, strict=True):
            if begun and begun == (number, chunk) and number:
                where, before = found[-1]
                found[-1] = where, Text(before.time_s, before.text + text, severity, name)
            else:
                found.append((place, Text(time_s, text, severity, name)))
            begun = (number, chunk + 1) if len(text) == _CHUNK else None
    return tuple(text for _, text in sorted(found, key=lambda entry: entry[0]))

"""MAVLink telemetry logs (``.tlog``): opened in one checked pass, decoded one column at a time."""

from __future__ import annotations

from logparsers.channels import recorded_log
from logparsers.only import Only
from logparsers.protocol import kind_of
from logparsers.records import FlightLog
from logparsers.source import Source
from logparsers.telemetry.file import TelemetryFile, Vehicle
from logparsers.telemetry.messages import Sender
from logparsers.telemetry.remote_log import BLOCKS, RemoteLogs, WithRemoteLog, remote_logs

__all__ = ["Sender", "TelemetryFile", "Vehicle", "read_telemetry"]

_AUTOPILOTS = {"ardupilotmega": "ArduPilot", "px4": "PX4"}


def read_telemetry(source: Source, only: Only) -> FlightLog:
    """Read a telemetry log; channels are decoded when they are looked up."""
    file = TelemetryFile(source.mapped(), str(source.path))
    logs = remote_logs(file) if BLOCKS in file.messages else RemoteLogs((), ())
    craft = file.vehicle
    parameters = {**logs.parameters, **file.parameters}
    return recorded_log(
        WithRemoteLog(file, logs) if logs.parts else file,
        source.path,
        "tlog",
        only,
        damage=(*file.damage, *logs.damage),
        parameters=parameters,
        texts=file.texts,
        vehicle=kind_of(craft.type, parameters) if craft else "",
        firmware=_firmware(craft) if craft else "",
        start_utc=file.start_utc,
        changed=file.changed,
    )


def _firmware(craft: Vehicle) -> str:
    """Name and version; a version alone gets the name of the autopilot."""
    name = _AUTOPILOTS.get(craft.autopilot, craft.autopilot)
    return f"{name} {craft.firmware}" if craft.firmware[:1].isdigit() else craft.firmware or name

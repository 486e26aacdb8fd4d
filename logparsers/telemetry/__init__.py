"""MAVLink telemetry logs (``.tlog``): opened in one checked pass, decoded one column at a time."""

from __future__ import annotations

from logparsers.channels import recorded_log
from logparsers.only import Only
from logparsers.records import FlightLog
from logparsers.source import Source
from logparsers.telemetry.file import TelemetryFile
from logparsers.telemetry.messages import Sender
from logparsers.telemetry.remote_log import BLOCKS, WithRemoteLog

__all__ = ["Sender", "TelemetryFile", "read_telemetry"]


def read_telemetry(source: Source, only: Only) -> FlightLog:
    """Read a telemetry log; channels are decoded when they are looked up."""
    file = TelemetryFile(source.mapped(), str(source.path))
    return recorded_log(WithRemoteLog(file) if BLOCKS in file.messages else file, source.path, "tlog", only)

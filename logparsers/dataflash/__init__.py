"""ArduPilot DataFlash logs, binary (``.bin``) and text (``.log``): columnar, memory-mapped, lazy."""

from __future__ import annotations

from typing import TYPE_CHECKING

from logparsers.channels import LazyChannels
from logparsers.dataflash.channels import DataFlashRecording
from logparsers.dataflash.file import DataFlashFile, ParameterChange
from logparsers.dataflash.formats import Field, Layout
from logparsers.dataflash.store import Step, Stretch
from logparsers.records import FlightLog

if TYPE_CHECKING:
    from pathlib import Path

    from logparsers.only import Only
    from logparsers.source import Source

__all__ = ["DataFlashFile", "Field", "Layout", "ParameterChange", "Step", "Stretch", "flight_log", "read_dataflash"]


def read_dataflash(source: Source, only: Only) -> FlightLog:
    """Read a DataFlash log; channels are decoded when they are looked up."""
    return flight_log(DataFlashFile.of(source.mapped(), str(source.path)), source.path, only)


def flight_log(file: DataFlashFile, path: Path, only: Only) -> FlightLog:
    """Make a log of a file, or of what another tool exported of one.

    `path`: where they come from.
    """
    channels = LazyChannels(DataFlashRecording(file)).only(only, path)
    disorder, span_s = channels.survey()
    return FlightLog(
        path,
        "dataflash",
        channels,
        (*file.damage, *disorder),
        parameters=file.parameters,
        texts=file.texts,
        vehicle=file.vehicle,
        firmware=file.firmware,
        start_utc=file.start_utc,
        span_s=span_s,
    )

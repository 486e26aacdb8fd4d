"""ArduPilot DataFlash logs, binary (``.bin``) and text (``.log``): columnar, memory-mapped, lazy."""

from __future__ import annotations

from logparsers.dataflash.file import DataFlashFile
from logparsers.dataflash.formats import Field, Layout
from logparsers.dataflash.store import Step, Stretch
from logparsers.only import Only
from logparsers.records import FlightLog
from logparsers.source import Source

__all__ = ["DataFlashFile", "Field", "Layout", "Step", "Stretch", "read_dataflash"]


def read_dataflash(source: Source, only: Only) -> FlightLog:
    """Read a DataFlash log; channels are decoded when they are looked up."""
    return DataFlashFile.of(source.mapped(), str(source.path)).log(source.path, only)

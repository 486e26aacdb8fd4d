"""ArduPilot DataFlash logs, binary (``.bin``) and text (``.log``): columnar, memory-mapped, lazy."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import recorded_log
from logparsers.dataflash.binary import BinaryFile
from logparsers.dataflash.file import DataFlashFile
from logparsers.dataflash.text import TextFile
from logparsers.errors import UnreadableLog
from logparsers.only import Only
from logparsers.records import FlightLog
from logparsers.source import LogBytes, Source, mapped

__all__ = ["DataFlashFile", "located", "open_dataflash", "read_dataflash"]

_HEAD_SIZE = 8192
"""Bytes at the beginning in which the form of a log is recognised."""


def located(content: NDArray[np.uint8], label: str) -> DataFlashFile:
    """Locate the records of a log.

    `content` (shape (n,)): the file; kept, not copied. `label`: what to call it in messages.
    """
    head = content[:_HEAD_SIZE].tobytes()
    is_text = re.search(rb"(?:^|\n)FMT, ?\d", head) is not None and head[:2] != b"\xa3\x95"
    log = TextFile(label, content.data) if is_text else BinaryFile(label, content.data)
    if not any(name != "FMT" for name in log.layouts):
        raise UnreadableLog(f"{label}: no DataFlash message definition (FMT) in it; copy the log again")
    return log


def open_dataflash(file: LogBytes) -> DataFlashFile:
    """Open a log, a path or its content, and locate its records."""
    return located(*mapped(file))


def read_dataflash(source: Source, only: Only) -> FlightLog:
    """Read a DataFlash log; channels are decoded when they are looked up."""
    return recorded_log(located(source.mapped(), str(source.path)), source.path, "dataflash", only)

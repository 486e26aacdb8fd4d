"""PX4 logs (``.ulg``), decoded topic by topic."""

from __future__ import annotations

from dataclasses import replace

from logparsers.channels import recorded_log
from logparsers.only import Only
from logparsers.records import FlightLog
from logparsers.source import Source
from logparsers.ulog.file import UlogFile

__all__ = ["UlogFile", "read_ulog"]


def read_ulog(source: Source, only: Only) -> FlightLog:
    """Read the topics of a PX4 log that have wanted channels; the others never reach memory."""
    file = UlogFile(source.mapped(), str(source.path), only.topics)
    log = recorded_log(file, source.path, "ulog", only, file.announced)
    if log.span_s and log.span_s[0] < file.begin_s < log.span_s[1]:  # topics published once, before the log began
        return replace(log, span_s=(file.begin_s, log.span_s[1]))
    return log

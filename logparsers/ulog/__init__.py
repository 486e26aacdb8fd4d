"""PX4 logs (``.ulg``), decoded by pyulog topic by topic."""

from __future__ import annotations

from typing import TYPE_CHECKING

from logparsers.channels import LazyChannels
from logparsers.records import FlightLog
from logparsers.ulog.channels import UlogRecording
from logparsers.ulog.file import UlogFile

if TYPE_CHECKING:
    from logparsers.only import Only
    from logparsers.source import Source

__all__ = ["UlogFile", "read_ulog"]


def read_ulog(source: Source, only: Only) -> FlightLog:
    """Read the topics of a PX4 log that have wanted channels; the others never reach memory."""
    file = UlogFile(source.mapped(), str(source.path), only.topics)
    channels = LazyChannels(UlogRecording(file)).only(only, source.path, file.announced)
    disorder, span_s = channels.survey()
    if span_s and span_s[0] < file.begin_s < span_s[1]:  # topics published once, before the log began
        span_s = file.begin_s, span_s[1]
    return FlightLog(
        source.path,
        "ulog",
        channels,
        (*file.damage, *disorder),
        parameters=file.parameters,
        texts=file.texts,
        vehicle=file.vehicle,
        firmware=file.firmware,
        start_utc=file.start_utc,
        span_s=span_s,
    )

"""The autopilot's own log inside a telemetry log: blocks that went over the link, put together and read as a file."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import Series
from logparsers.dataflash import DataFlashFile, located
from logparsers.dataflash.live import BlockStream, RowDecoder
from logparsers.errors import LogError
from logparsers.records import Damage
from logparsers.telemetry.file import Stream, TelemetryFile
from logparsers.units import S_PER_US

BLOCKS = "REMOTE_LOG_DATA_BLOCK"


class _Part(NamedTuple):
    """What was logged between two restarts of the vehicle."""

    file: DataFlashFile
    shift_s: float
    """From time since that boot to the time of the telemetry log."""


def _parts_of(file: TelemetryFile) -> tuple[list[_Part], int]:
    """Put the blocks of a telemetry log together, of several vehicles those of the one that sent most.

    Whole records only: what stands at the edge of a lost block is left out. And how many blocks were lost.
    """
    sender = max(file.sources(BLOCKS), key=lambda each: file.stream(BLOCKS, each).size)
    markers = file.stream(BLOCKS, sender)
    arrivals_s = file.arrivals_us(markers).astype(float) * S_PER_US
    numbers = file.column(BLOCKS, "seqno", source=sender).tolist()
    contents = np.ascontiguousarray(file.column(BLOCKS, "data", source=sender), dtype=np.uint8)
    shifts_s = file.clock.timeline.shift_s[file.clock.timeline.part(markers)]
    blocks, rows = BlockStream(), RowDecoder()
    by_boot: dict[float, list[bytes]] = {}
    for number, content, arrival_s, shift_s in zip(
        numbers, contents, arrivals_s.tolist(), shifts_s.tolist(), strict=True
    ):
        for data in blocks.take(number, content.tobytes(), arrival_s):
            if not data:
                rows.lose()
            by_boot.setdefault(shift_s, []).extend(rows.records(data))
    parts = []
    for shift_s, records in by_boot.items():
        with suppress(LogError):  # a few blocks that define nothing
            parts.append(_Part(located(np.frombuffer(b"".join(records), dtype=np.uint8), file.name), shift_s))
    return parts, blocks.lost


class WithRemoteLog:
    """A telemetry log, and the log of the autopilot that came with it, on one time base.

    Channels of the telemetry come first, and keep their names. Of parameters the last value counts.
    """

    def __init__(self, telemetry: TelemetryFile) -> None:
        self._telemetry = telemetry
        self._parts, lost = _parts_of(telemetry)
        self._logged = [part.file.series() for part in self._parts]
        self._groups = [{series.group for series in logged.values()} for logged in self._logged]
        note = f"{lost} blocks of the log over MAVLink never came"
        self.damage = (*telemetry.damage, *([Damage("corrupt", note, lost)] if lost else ()))
        logged = {name: value for part in self._parts for name, value in part.file.parameters.items()}
        self.parameters = {**logged, **telemetry.parameters}
        self.vehicle = telemetry.craft.kind(self.parameters) if telemetry.craft else ""
        self.firmware, self.start_utc = telemetry.firmware, telemetry.start_utc
        self.texts, self.changed = telemetry.texts, telemetry.changed

    def series(self) -> Mapping[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for logged in self._logged:
            found |= logged
        return found | self._telemetry.series()

    def stamps(self, group: Any) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:  # noqa: ANN401
        """Time of each row [s], and which of them are sound."""
        if isinstance(group, Stream):
            return self._telemetry.stamps(group)
        times, sound = [], []
        for part in self._having(group):
            time_s, good = part.file.stamps(group)
            times.append(time_s + part.shift_s)
            sound.append(np.ones(time_s.size, np.bool_) if good is None else good)
        return np.concatenate(times), np.concatenate(sound)

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        if isinstance(series.group, Stream):
            return self._telemetry.values(series)
        return np.concatenate([part.file.values(series) for part in self._having(series.group)])

    def _having(self, group: Hashable) -> list[_Part]:
        """Parts with rows of a message of the autopilot's log."""
        return [part for part, groups in zip(self._parts, self._groups, strict=True) if group in groups]

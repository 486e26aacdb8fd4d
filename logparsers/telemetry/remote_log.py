"""The autopilot's own log inside a telemetry log: blocks that went over the link, put together and read as a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from logparsers.channels import Recording, Series
from logparsers.dataflash.file import DataFlashFile
from logparsers.dataflash.live import BlockStream, RowDecoder
from logparsers.errors import LogError
from logparsers.records import Damage
from logparsers.units import S_PER_US

if TYPE_CHECKING:
    from logparsers.telemetry.file import TelemetryFile

BLOCKS = "REMOTE_LOG_DATA_BLOCK"


class _Part(NamedTuple):
    """What was logged between two restarts of the vehicle."""

    file: DataFlashFile
    shift_s: float
    """From time since that boot to the time of the telemetry log."""


class RemoteLogs(NamedTuple):
    """The log of one vehicle, as far as it came."""

    parts: tuple[_Part, ...]
    damage: tuple[Damage, ...]

    @property
    def parameters(self) -> dict[str, float]:
        """As the vehicle wrote them into its log; the last value counts."""
        return {name: value for part in self.parts for name, value in part.file.parameters.items()}


def remote_logs(file: TelemetryFile) -> RemoteLogs:
    """Put the blocks of a telemetry log together.

    `file`: with messages of the kind `BLOCKS`; of several vehicles the one that sent most is taken. Result: whole
    records only: what stands at the edge of a lost block is left out, and the block recorded as damage.
    """
    sender = max(file.sources(BLOCKS), key=lambda each: file.stream(BLOCKS, each).size)
    markers = file.stream(BLOCKS, sender)
    arrivals_s = file.arrivals_us(markers).astype(float) * S_PER_US
    numbers = file.column(BLOCKS, "seqno", source=sender).tolist()
    contents = np.ascontiguousarray(file.column(BLOCKS, "data", source=sender), dtype=np.uint8)
    shifts_s = file.timeline.shift_s[file.timeline.part(markers)]
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
        try:
            log = DataFlashFile.of(np.frombuffer(b"".join(records), dtype=np.uint8), file.name)
        except LogError:
            continue  # a few blocks that define nothing
        parts.append(_Part(log, shift_s))
    damage = []
    if blocks.lost:
        damage.append(Damage("corrupt", f"{blocks.lost} blocks of the log over MAVLink never came", blocks.lost))
    return RemoteLogs(tuple(parts), tuple(damage))


class WithRemoteLog:
    """Channels of a telemetry log, and those of the log that came with it, on one time base.

    `telemetry`: its channels come first, and keep their names. `logs`: part by part.
    """

    def __init__(self, telemetry: Recording, logs: RemoteLogs) -> None:
        self._telemetry, self._parts = telemetry, logs.parts
        self._logged = [part.file.series() for part in logs.parts]

    def series(self) -> Mapping[str, Series]:
        """Every series by the name of its channel."""
        found: dict[str, Series] = {}
        for logged in self._logged:
            found |= logged
        mine = {name: replace(series, group=_Logged(series.group)) for name, series in found.items()}
        return mine | dict(self._telemetry.series())

    def stamps(self, group: Any) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:  # noqa: ANN401
        """Time of each row [s], and which of them are sound."""
        if not isinstance(group, _Logged):
            return self._telemetry.stamps(group)
        times, sound = [], []
        for part in self._having(group):
            time_s, good = part.file.stamps(group.group)
            times.append(time_s + part.shift_s)
            sound.append(np.ones(time_s.size, np.bool_) if good is None else good)
        return np.concatenate(times), np.concatenate(sound)

    def values(self, series: Series) -> NDArray[Any]:
        """Numbers of a series in the order of the file."""
        if not isinstance(series.group, _Logged):
            return self._telemetry.values(series)
        inner = replace(series, group=series.group.group)
        return np.concatenate([part.file.values(inner) for part in self._having(series.group)])

    def _having(self, group: _Logged) -> list[_Part]:
        """Parts with rows of a message."""
        return [
            part
            for part, logged in zip(self._parts, self._logged, strict=True)
            if any(series.group == group.group for series in logged.values())
        ]


class _Logged(NamedTuple):
    """Rows of the autopilot's log, not messages."""

    group: Any

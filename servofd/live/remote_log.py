"""DataFlash over MAVLink: the autopilot's own log as a source of commands and positions, at the rate of the log."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from logparsers.dataflash.live import BlockStream, RowDecoder
from logparsers.protocol import RemoteLogCommand

if TYPE_CHECKING:
    from logparsers.codec import Heard

_AGAIN_S: Final = 1.0
_QUIET_S: Final = 3.0
"""Without a block for so long it is asked to begin; that changes nothing for one that only pauses, as around arming."""
LOG_SILENCE_S: Final = 10.0
"""When an autopilot gives up whoever does not answer; before, a pause of its log is none of its servos'."""
_REVIEW_S: Final = 10.0
_MUCH: Final = 0.05
"""Share of the log that may get lost without a word: every twentieth position."""
_DROPPED: Final = "DMS.Dp"
"""Rows that found no room in the autopilot's buffer, counted by itself once a second."""

Message = tuple[str, dict[str, Any]]


class RemoteLog:
    """The log of one vehicle: acknowledges blocks, asks for those that are missing, and gives samples of channels."""

    def __init__(self, system: int) -> None:
        self._system = system
        self._blocks, self._rows = BlockStream(), RowDecoder()
        self._asked_s = self._heard_s = float("-inf")
        self._reviewed_s = float("inf")
        self._counts = self._before = (0, 0, 0)
        """Blocks received, blocks lost, rows received."""
        self._decoded = 0
        self._dropped = self._dropped_before = 0.0
        self._told = _MUCH / 2.0

    @property
    def said(self) -> str:
        """How much came, and how much did not."""
        blocks, rows = self._blocks, f", {self._dropped:.0f} rows dropped on board" if self._dropped else ""
        return f"log: {blocks.received} blocks, {blocks.lost} lost{rows}" if blocks.begun else ""

    def hear(self, heard: Heard, now_s: float) -> list[tuple[str, float, float]]:
        """Samples in a block: channel, time [s] and value as logged; `now_s` is the receiver's clock [s]."""
        if heard.name != "REMOTE_LOG_DATA_BLOCK":
            return []
        found = []
        self._heard_s = now_s
        self._reviewed_s = min(self._reviewed_s, now_s)
        for data in self._blocks.take(int(heard.fields["seqno"]), bytes(heard.fields["data"]), now_s):
            if not data:
                self._rows.lose()
            for row in self._rows.feed(data):
                self._decoded += 1
                self._dropped = row.values.get(_DROPPED, self._dropped)
                found += [(channel, row.time_s, value) for channel, value in row.values.items()]
        return found

    def news(self, now_s: float) -> str:
        """A sentence if much of the log got lost lately; else empty."""
        if now_s - self._reviewed_s < _REVIEW_S:
            return ""
        counts = (self._blocks.received, self._blocks.lost, self._decoded)
        blocks, lost, rows = (after - before for after, before in zip(counts, self._before, strict=True))
        dropped = max(self._dropped - self._dropped_before, 0.0)
        self._before, self._dropped_before, self._reviewed_s = counts, self._dropped, now_s
        kept = (1.0 - lost / max(blocks + lost, 1)) * (1.0 - dropped / max(rows + dropped, 1.0))
        if 1.0 - kept < 2.0 * self._told:
            return ""
        self._told = 1.0 - kept
        return f"{1.0 - kept:.0%} of the log is lost: log less (LOG_BITMASK without attitude, IMU and PID)"

    def due(self, now_s: float) -> list[Message]:
        """What to answer, or the request to begin."""
        answers = self._blocks.answers(now_s)
        if now_s - self._heard_s >= _QUIET_S and now_s - self._asked_s >= _AGAIN_S:
            self._asked_s = now_s
            answers.append((RemoteLogCommand.START, True))
        target = {"target_system": self._system, "target_component": 1}
        return [("REMOTE_LOG_BLOCK_STATUS", target | {"seqno": seq, "status": int(there)}) for seq, there in answers]

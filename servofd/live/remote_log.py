"""DataFlash over MAVLink: the autopilot's own log as a source of commands and positions, at the rate of the log."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from logparsers.dataflash.live import BlockStream, RowDecoder

if TYPE_CHECKING:
    from logparsers.codec import Heard

__all__ = ["RemoteLog"]

_START: Final = 2_147_483_646
_AGAIN_S = 1.0

Message = tuple[str, dict[str, Any]]


class RemoteLog:
    """Asks one vehicle for its log, acknowledges blocks, and gives samples of channels.

    Parameters
    ----------
    system : int
        The vehicle.
    """

    def __init__(self, system: int) -> None:
        self._system = system
        self._blocks, self._rows = BlockStream(), RowDecoder()
        self._asked_s = float("-inf")

    @property
    def lost(self) -> int:
        """Blocks that never came."""
        return self._blocks.lost

    def hear(self, heard: Heard, now_s: float) -> list[tuple[str, float, float]]:
        """Samples in a block: channel, time [s] and value as logged; `now_s` is the receiver's clock [s]."""
        if heard.name != "REMOTE_LOG_DATA_BLOCK":
            return []
        found = []
        for data in self._blocks.take(int(heard.fields["seqno"]), bytes(heard.fields["data"]), now_s):
            if not data:
                self._rows.lose()
            for row in self._rows.feed(data):
                found += [(channel, row.time_s, value) for channel, value in row.values.items()]
        return found

    def due(self, now_s: float) -> list[Message]:
        """What to answer, or the request to begin."""
        answers = self._blocks.answers(now_s)
        if not self._blocks.begun and now_s - self._asked_s >= _AGAIN_S:
            self._asked_s = now_s
            answers = [(_START, True)]
        target = {"target_system": self._system, "target_component": 1}
        return [("REMOTE_LOG_BLOCK_STATUS", target | {"seqno": seq, "status": int(there)}) for seq, there in answers]

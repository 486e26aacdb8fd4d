"""DataFlash over MAVLink: the autopilot's log in blocks of 200 bytes, sent again until they are acknowledged."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from logparsers.dataflash.encode import Rows
from logparsers.protocol import RemoteLogCommand

_BLOCK: Final = 200
"""Bytes of a block (MAVLink, REMOTE_LOG_DATA_BLOCK)."""
_BUFFER: Final = 40
"""Blocks of the usual buffer of 8 kB (ArduPilot, HAL_LOGGING_MAV_BUFSIZE)."""
_PER_TURN: Final = 8
"""New blocks that leave in one turn of the main loop."""
_AGAIN_US: Final = 100_000
"""A block that is not acknowledged leaves again after this [us]."""
_GONE_US: Final = 10_000_000
"""A station without any acknowledgement for this long is given up [us]."""
_HEAD: Final = 3
"""Bytes of a row before its time stamp."""
_PROLOGUE: Final = ("UNIT", "MULT", "FMTU", "PARM", "MSG")

Client = tuple[int, int]
"""System and component."""


class Send(NamedTuple):
    """A message that shall leave."""

    name: str
    fields: Mapping[str, Any]


class RemoteLog:
    """Sends a log as it is written, with the buffer, the pace and the patience of ArduPilot's AP_Logger_MAVLink.

    Definitions, parameters and words wait for room in the buffer; other rows that find it full are dropped. A block
    that is not acknowledged is sent again after 0.1 s; a client that is silent for 10 s is given up.

    `rows`: of the whole flight; each is written at its time. `speed`: how much faster than real time the vehicle's
    clock runs: buffer and patience grow with it. `stalls_us`: when nothing is sent, from and until [us]; what finds no
    room meanwhile is dropped.
    """

    def __init__(self, rows: Rows, speed: float, stalls_us: Sequence[tuple[int, int]]) -> None:
        self._rows = rows
        self._stalls_us = tuple(stalls_us)
        self._room = round(_BUFFER * max(speed, 1.0))
        self._again_us = round(_AGAIN_US * max(speed, 1.0))
        self._gone_us = round(_GONE_US * max(speed, 1.0))
        self._prologue = int(np.isin(rows.named, _PROLOGUE).sum())
        self._client: Client | None = None
        self._begin(0)
        self.dropped = 0
        """Rows that found no room."""

    def _begin(self, now_us: int) -> None:
        """Begin the log anew, with nothing sent."""
        self._begun_us = self._response_us = now_us
        self._blocks: dict[int, bytes] = {}
        self._sent_us: dict[int, int] = {}
        self._next_number = self._row = 0
        self._partial = b""
        self._resume = max(self._prologue, int(np.searchsorted(self._rows.time_us, now_us)))

    def receive(self, client: Client, seqno: int, *, arrived: bool, now_us: int) -> None:
        """Take a REMOTE_LOG_BLOCK_STATUS.

        `client`: system and component that sent it; the first to begin gets the log. `seqno`: number of a block, one
        of `RemoteLogCommand`.
        """
        if arrived and seqno == RemoteLogCommand.START:
            if self._client is None:
                self._client = client
                self._begin(now_us)
        elif client == self._client:
            if arrived and seqno == RemoteLogCommand.STOP:
                self._client = None
            elif seqno in self._sent_us:
                self._response_us = now_us
                if arrived:
                    del self._sent_us[seqno], self._blocks[seqno]
                else:
                    self._sent_us[seqno] = now_us - self._again_us

    def due(self, now_us: int) -> list[Send]:
        """Write the rows that were made since the last time, and give the blocks to send now."""
        if self._sent_us and max(self._sent_us.values()) - self._response_us > self._gone_us:
            self._client = None
        if self._client is None:
            return []
        self._write(now_us)
        if any(begin_us <= now_us < end_us for begin_us, end_us in self._stalls_us):
            return []
        again = [n for n, sent_us in self._sent_us.items() if now_us - sent_us >= self._again_us]
        new = [n for n in self._blocks if n not in self._sent_us][:_PER_TURN]
        for number in (*again, *new):
            self._sent_us[number] = now_us
        to = {"target_system": self._client[0], "target_component": self._client[1]}
        return [
            Send("REMOTE_LOG_DATA_BLOCK", {**to, "seqno": number, "data": list(self._blocks[number])})
            for number in (*again, *new)
        ]

    def _write(self, now_us: int) -> None:
        """Rows up to now; those that find no room are dropped."""
        rows = self._rows
        while self._row < rows.ends.size and rows.time_us[self._row] <= now_us:
            begin = int(rows.ends[self._row - 1]) if self._row else 0  # the definitions go with the first row
            content = self._stamped(rows.content[begin : rows.ends[self._row]])
            if len(content) <= (self._room - len(self._blocks)) * _BLOCK - len(self._partial):
                self._put(content)
            elif self._row < self._prologue:
                break
            else:
                self.dropped += 1
            self._row += 1
            if self._row == self._prologue:
                self._row = self._resume

    def _stamped(self, content: bytes) -> bytes:
        """A row at the beginning of a log is written when that begins, whenever the vehicle was booted."""
        if self._row >= self._prologue or self._rows.time_us[self._row] >= self._begun_us:
            return content
        size = int(self._rows.ends[1] - self._rows.ends[0]) if self._row == 0 else len(content)
        at = len(content) - size + _HEAD
        return content[:at] + struct.pack("<Q", self._begun_us) + content[at + 8 :]

    def _put(self, content: bytes) -> None:
        waiting = self._partial + content
        while len(waiting) >= _BLOCK:
            self._blocks[self._next_number] = waiting[:_BLOCK]
            self._next_number += 1
            waiting = waiting[_BLOCK:]
        self._partial = waiting

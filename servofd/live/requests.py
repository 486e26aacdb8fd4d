"""Asking an autopilot for the rates that a model needs, and taking no for an answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

from logparsers.codec import Received
from logparsers.dataflash.live import BlockStream, RowDecoder
from logparsers.mavlink import dialect
from logparsers.protocol import Command, RemoteLogCommand, Result

Message = tuple[str, dict[str, Any]]
"""Name and fields of what is to be sent."""

_RATES_HZ: Final = (50.0, 40.0, 25.0, 10.0)
"""ArduPlane grants 0.8 of its loop rate: 40 Hz with the usual 50 Hz loop."""
_SELDOM_HZ: Final = (5.0, 2.0, 1.0)
"""Rates of airspeed and supply that are asked for, one after the other [Hz]."""
_PATIENCE_S, _TRIES = 1.0, 3
"""How long an answer is waited for before the question is asked again [s], and how often it is asked."""
_DEADLINE_S = 5.0
"""An answer that is later than this will not come. It does not say what it answers: what is asked next waits for it."""
_UNASKED = ("NAMED_VALUE", "DEBUG")
"""Sent by scripts: no autopilot grants them, and ArduPilot complains on every ground station."""
_AGAIN_S = 30.0
"""Time after the last request before a slow message is asked for again [s]."""
_TOO_SLOW = 0.6
"""A message that comes at less than this share of its granted rate is asked for again."""


@dataclass(slots=True)
class _Wish:
    message: str
    rates_hz: tuple[float, ...] = _RATES_HZ
    step: int = 0
    tries: int = 0
    granted_hz: float = 0.0
    done: bool = False


@dataclass(slots=True)
class Requests:
    """One vehicle's message intervals, asked for one after the other."""

    system: int
    messages: set[str]
    seldom: set[str] = field(default_factory=set)
    component: int = 191
    _wishes: list[_Wish] = field(init=False)
    _open: list[tuple[_Wish, int, float]] = field(default_factory=list)
    """Asked and not answered, in order: what, which of its rates, and when [s]; copies of one question only."""
    _finished_s: float = float("-inf")

    def __post_init__(self) -> None:
        self.again()

    def due(self, now_s: float) -> list[Message]:
        """What to ask now [s, the receiver's clock]."""
        self._open = [entry for entry in self._open if now_s - entry[2] < _DEADLINE_S]
        wish = next((wish for wish in self._wishes if not wish.done), None)
        if wish is None:
            return []
        if self._open:
            asked, step, asked_s = self._open[-1]
            if asked is not wish or step != wish.step or now_s - asked_s < _PATIENCE_S or wish.tries >= _TRIES:
                return []
        elif wish.tries >= _TRIES:
            wish.done, self._finished_s = True, now_s
            return self.due(now_s)
        wish.tries += 1
        self._open.append((wish, wish.step, now_s))
        period_us = 1e6 / wish.rates_hz[wish.step]
        number = dialect().layouts[wish.message].id
        fields = {"target_system": self.system, "target_component": 1, "command": Command.SET_MESSAGE_INTERVAL}
        return [("COMMAND_LONG", fields | {"param1": float(number), "param2": period_us})]

    def receive(self, message: Received) -> str:
        """Take an answer, and say what it means; empty if it is none."""
        if message.name != "COMMAND_ACK" or message.fields["command"] != Command.SET_MESSAGE_INTERVAL or not self._open:
            return ""
        result = int(message.fields["result"])
        if result == Result.IN_PROGRESS or message.fields.get("target_component", 0) not in (0, self.component):
            return ""
        wish, step, self._finished_s = self._open.pop(0)
        if wish.done or step != wish.step:
            return ""  # the answer to a copy of a question that has been answered
        asked_hz = wish.rates_hz[step]
        if result == Result.ACCEPTED:
            wish.done, wish.granted_hz = True, asked_hz
            return f"{wish.message} at {asked_hz:g} Hz granted"
        wish.step, wish.tries = step + 1, 0
        wish.done = result == Result.UNSUPPORTED or wish.step == len(wish.rates_hz)
        return f"{wish.message} at {asked_hz:g} Hz denied" if not wish.done else f"{wish.message}: no rate is granted"

    def measured(self, message: str, rate_hz: float, now_s: float) -> str:
        """Ask again if a message comes much more slowly than was granted, and say so: another station changed it."""
        granted_hz = next((wish.granted_hz for wish in self._wishes if wish.message == message), 0.0)
        if self._open or now_s - self._finished_s <= _AGAIN_S or not rate_hz < _TOO_SLOW * granted_hz:
            return ""
        self.again()
        return f"{message} comes at {rate_hz:.2g} Hz, not at {granted_hz:g} Hz as granted: asks again"

    def again(self) -> None:
        """Ask for everything once more, as after a restart."""
        self._wishes = [_Wish(message) for message in sorted(self.messages) if not message.startswith(_UNASKED)]
        self._wishes += [_Wish(message, _SELDOM_HZ) for message in sorted(self.seldom)]


_AGAIN_S_LOG: Final = 1.0
_QUIET_S: Final = 3.0
"""Without a block for so long it is asked to begin; that changes nothing for one that only pauses, as around arming."""
LOG_SILENCE_S: Final = 10.0
"""When an autopilot gives up whoever does not answer; before, a pause of its log is none of its servos'."""
_REVIEW_S: Final = 10.0
"""How often the losses of a log over the link are counted [s]."""
_MUCH: Final = 0.05
"""Share of the log that may get lost without a word: every twentieth position."""
_DROPPED: Final = "DMS.Dp"
"""Rows that found no room in the autopilot's buffer, counted by itself once a second."""


class RemoteLog:
    """The log of one vehicle: acknowledges blocks, asks for those that are missing, and gives samples of channels."""

    def __init__(self, system: int) -> None:
        self._system = system
        self._blocks, self._rows = BlockStream(), RowDecoder()
        self._asked_s = self._received_s = float("-inf")
        self._reviewed_s = float("inf")
        self._before = (0.0, 0.0, 0.0, 0.0)
        """Blocks received, blocks lost, rows received, rows dropped on board."""
        self._decoded, self._dropped, self._told = 0, 0.0, _MUCH / 2.0

    @property
    def said(self) -> str:
        """How much came, and how much did not."""
        blocks, rows = self._blocks, f", {self._dropped:.0f} rows dropped on board" if self._dropped else ""
        return f"log: {blocks.received} blocks, {blocks.lost} lost{rows}" if blocks.begun else ""

    def receive(self, message: Received, now_s: float) -> list[tuple[str, float, float]]:
        """Samples in a block: channel, time [s] and value as logged; `now_s` is the receiver's clock [s]."""
        if message.name != "REMOTE_LOG_DATA_BLOCK":
            return []
        found = []
        self._received_s = now_s
        self._reviewed_s = min(self._reviewed_s, now_s)
        for data in self._blocks.take(int(message.fields["seqno"]), bytes(message.fields["data"]), now_s):
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
        counts = (self._blocks.received, self._blocks.lost, self._decoded, self._dropped)
        blocks, lost, rows, dropped = (max(now - before, 0.0) for now, before in zip(counts, self._before, strict=True))
        self._before, self._reviewed_s = counts, now_s
        kept = (1.0 - lost / max(blocks + lost, 1)) * (1.0 - dropped / max(rows + dropped, 1.0))
        if 1.0 - kept < 2.0 * self._told:
            return ""
        self._told = 1.0 - kept
        return f"{1.0 - kept:.0%} of the log is lost: log less (LOG_BITMASK without attitude, IMU and PID)"

    def due(self, now_s: float) -> list[Message]:
        """What to answer, or the request to begin."""
        answers = self._blocks.answers(now_s)
        if now_s - self._received_s >= _QUIET_S and now_s - self._asked_s >= _AGAIN_S_LOG:
            self._asked_s = now_s
            answers.append((RemoteLogCommand.START, True))
        target = {"target_system": self._system, "target_component": 1}
        return [("REMOTE_LOG_BLOCK_STATUS", target | {"seqno": seq, "status": int(there)}) for seq, there in answers]

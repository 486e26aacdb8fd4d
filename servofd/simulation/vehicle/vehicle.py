"""An ArduPlane on a link: what it sends at each turn of its main loop, and what it answers."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.codec import Received
from logparsers.dataflash.encode import encode_rows
from logparsers.mavlink import message_name
from logparsers.protocol import LONGEST_TEXT, NO_INDEX, Capability, Command, Component, ParameterType, Result, Severity
from logparsers.units import US_PER_S
from servofd.aircraft.schema import Aircraft
from servofd.core.errors import ConfigError, suggest
from servofd.core.types import IntArray
from servofd.simulation.ardupilot import banner, parameters, rate_hz
from servofd.simulation.dataflash_writer import VOLZ, dataflash_messages
from servofd.simulation.flight import SimulatedFlight
from servofd.simulation.surroundings import microseconds
from servofd.simulation.telemetry_writer import FEEDBACK, VERSION, air_rows, beats, servo_rows
from servofd.simulation.vehicle.remote_log import RemoteLog, Send
from servofd.simulation.vehicle.troubles import Edit, Stall, Trouble

_4_7_0_DEV: Final = 0x04070000
"""Version 4.7.0, development, as AUTOPILOT_VERSION packs it."""
_POSITIONS: Final = ("NAMED_VALUE_FLOAT", "DEBUG_FLOAT_ARRAY")
_GROUPS: Final = {3: "SERVO_OUTPUT_RAW", 10: "ATTITUDE", 11: "VFR_HUD", 12: "SYSTEM_TIME"}
"""Message of a data stream (MAVLink, MAV_DATA_STREAM; 3 is RC_CHANNELS)."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How a vehicle speaks.

    `system`: its number, from 1 to 255. `feedback`: how it tells positions: one of
    `servofd.simulation.telemetry_writer.FEEDBACK`. `message_hz`: rate of SERVO_OUTPUT_RAW before anybody asks for
    another [Hz]; ArduPlane's is 1. `any_rate`: grant rates up to that of the main loop, not just 0.8 of it. `speed`:
    how much faster than real time it flies. `troubles`: what goes wrong on board: `servofd.simulation.vehicle.fly.legs`
    makes the flight that belongs to it.
    """

    system: int = 1
    feedback: str = "named"
    message_hz: float = 1.0
    any_rate: bool = False
    speed: float = 1.0
    troubles: tuple[Trouble, ...] = ()

    def __post_init__(self) -> None:
        if not 1 <= self.system <= 255:
            raise ConfigError(f"system {self.system}: vehicles have numbers from 1 to 255")
        if self.feedback not in FEEDBACK:
            raise ConfigError(suggest("feedback", self.feedback, FEEDBACK))
        if not 0.0 <= self.message_hz <= 1000.0:
            raise ConfigError(f"{self.message_hz:g} messages per second: give a rate from 0 to 1000 Hz")
        if not 0.01 <= self.speed <= 1000.0:
            raise ConfigError(f"speed {self.speed:g}: give a factor from 0.01 to 1000; 1 is real time")


class Vehicle:
    """A simulated flight that is sent as it happens: each sample is one turn of the autopilot's main loop."""

    def __init__(self, flight: SimulatedFlight, aircraft: Aircraft, settings: Settings) -> None:
        begun_us = int(microseconds(flight.time_s[:1])[0])
        loop_hz = rate_hz(flight)
        self.system, self.speed = settings.system, settings.speed
        self.time_us: IntArray = microseconds(flight.time_s)
        """Time of the vehicle's clock at each turn of its loop [us], of shape (n,)."""
        known = parameters(flight, aircraft, VOLZ.name) | {
            "LOG_BACKEND_TYPE": 3.0, "SCHED_LOOP_RATE": float(math.ceil(loop_hz)), "SCR_ENABLE": 1.0,
            "SERVO_RATE": float(math.ceil(loop_hz)), "SYSID_THISMAV": float(settings.system),
        }  # fmt: skip
        self._parameters = Parameters(known)
        self._telemetry = Telemetry(flight, aircraft, settings.feedback)
        self._schedule = _schedule(self._telemetry.names, loop_hz, settings)
        rows = encode_rows(dataflash_messages(flight, aircraft, VOLZ, settings=known))

        def at_us(elapsed_s: float) -> int:
            return begun_us + round(US_PER_S * elapsed_s)

        stalls = (t for t in settings.troubles if isinstance(t, Stall))
        stalls_us = [(at_us(t.start_s), at_us(t.start_s + t.for_s)) for t in stalls]
        self._log = RemoteLog(rows, settings.speed, stalls_us)
        edits = (t for t in settings.troubles if isinstance(t, Edit))
        self._edits = sorted((at_us(t.start_s), t.name, t.value) for t in edits)

    @property
    def dropped_rows(self) -> int:
        """Rows of the streamed log that found no room in its buffer."""
        return self._log.dropped

    def turn(self, index: int) -> list[Send]:
        """One turn of the main loop."""
        now_us = int(self.time_us[index])
        sent = [Send("STATUSTEXT", {"severity": Severity.INFO, "text": banner(VERSION)})] if index == 0 else []
        for name in self._schedule.due(now_us):
            sent += self._telemetry.newest(name, now_us, again=name == "HEARTBEAT")
        while self._edits and self._edits[0][0] <= now_us:
            _, parameter, value = self._edits.pop(0)
            sent += self._parameters.set(parameter, value)
        return [*sent, *self._parameters.due(), *self._log.due(now_us)]

    def heartbeat(self) -> Send:
        """Message of a vehicle that waits for a ground station."""
        return self._telemetry.newest("HEARTBEAT", int(self.time_us[0]), again=True)[0]

    def receive(self, message: Received, now_us: int) -> list[Send]:
        """Answer a message; what is meant for other vehicles, or what it does not know, is passed over.

        The component that is meant does not matter: ArduPilot itself takes what it cannot forward to another link.
        """
        given = message.fields
        answer: list[Send] = []
        is_own = message.system == self.system and message.component == Component.AUTOPILOT1
        if is_own or given.get("target_system", 0) not in (0, self.system):
            return []
        match message.name:
            case "COMMAND_LONG" | "COMMAND_INT":
                answer = self._command(message, now_us)
            case "REQUEST_DATA_STREAM":
                for group, name in _GROUPS.items():
                    if given["req_stream_id"] in (0, group):
                        self._schedule.ask_rate(name, given["req_message_rate"] if given["start_stop"] else 0)
            case "PARAM_REQUEST_LIST":
                self._parameters.list_all()
            case "PARAM_REQUEST_READ" | "PARAM_SET":
                answer = self._parameters.read(given["param_id"], given.get("param_index", -1))
            case "TIMESYNC" if given["tc1"] == 0:
                answer = [Send("TIMESYNC", {"tc1": 1000 * now_us, "ts1": given["ts1"], **_to(message)})]
            case "AUTOPILOT_VERSION_REQUEST":
                answer = [self._version()]
            case "MISSION_REQUEST_LIST":
                none = {**_to(message), "mission_type": given.get("mission_type", 0)}
                answer = [Send("MISSION_COUNT", none)]
            case "REMOTE_LOG_BLOCK_STATUS":
                client = message.system, message.component
                self._log.receive(client, given["seqno"], arrived=given["status"] == 1, now_us=now_us)
        return answer

    def _command(self, message: Received, now_us: int) -> list[Send]:
        given = message.fields
        command, what, value = given["command"], given["param1"], given["param2"]
        if not (np.isfinite(what) and np.isfinite(value)):
            return [_result(message, Result.DENIED)]
        name = message_name(int(what)) or ""
        if command == Command.SET_MESSAGE_INTERVAL:
            return self._set_interval(message, name, int(value))
        if command == Command.REQUEST_MESSAGE:
            newest = self._telemetry.newest(name, now_us, again=True)
            asked = [self._version()] if name == "AUTOPILOT_VERSION" else newest
            return [_result(message, Result.ACCEPTED if asked else Result.DENIED), *asked]
        if command == Command.GET_MESSAGE_INTERVAL:
            interval_us = self._schedule.interval_us(name)
            sent = Send("MESSAGE_INTERVAL", {"message_id": int(what) & 0xFFFF, "interval_us": interval_us})
            return [_result(message, Result.ACCEPTED), sent]
        if command == Command.REQUEST_AUTOPILOT_CAPABILITIES:
            return [_result(message, Result.ACCEPTED), self._version()]
        return [_result(message, Result.UNSUPPORTED)]

    def _set_interval(self, message: Received, name: str, interval_us: int) -> list[Send]:
        if name in _POSITIONS:
            number = int(message.fields["param1"])
            return [*_chunks(f"No ap_message for mavlink id ({number})"), _result(message, Result.DENIED)]
        if name not in self._telemetry.names or interval_us < -1:
            return [_result(message, Result.DENIED)]
        if not self._schedule.ask(name, interval_us):
            number = int(message.fields["param1"])
            words = f"Requested rate for message ID {number} too fast. Increase SCHED_LOOP_RATE"
            return [*_chunks(words), _result(message, Result.DENIED)]
        return [_result(message, Result.ACCEPTED)]

    def _version(self) -> Send:
        fields: dict[str, Any] = {
            "capabilities": Capability.PARAM_FLOAT | Capability.COMMAND_INT | Capability.MAVLINK2,
            "flight_sw_version": _4_7_0_DEV,
        }
        return Send("AUTOPILOT_VERSION", {**fields, "uid": self.system})


def _schedule(names: tuple[str, ...], loop_hz: float, settings: Settings) -> Schedule:
    """Before anybody asks: positions as often as the loop allows, for a script sends them unasked."""
    fastest_ms = math.ceil(1000.0 / loop_hz) if settings.any_rate else math.ceil(1000.0 / (0.8 * loop_hz) - 1e-9)
    usual_ms = {"HEARTBEAT": 1000, "SYSTEM_TIME": 1000, "ATTITUDE": 250, "VFR_HUD": 500}
    usual_ms |= dict.fromkeys(_POSITIONS, fastest_ms)
    pulses_ms = max(round(1000.0 / settings.message_hz), fastest_ms) if settings.message_hz else 0
    usual_ms["SERVO_OUTPUT_RAW"] = pulses_ms
    return Schedule({n: usual_ms[n] for n in names}, loop_us=round(1e6 / loop_hz), any_rate=settings.any_rate)


def _to(message: Received) -> dict[str, int]:
    """Whom an answer is for."""
    return {"target_system": message.system, "target_component": message.component}


def _result(message: Received, result: int) -> Send:
    return Send("COMMAND_ACK", {"command": message.fields["command"], "result": result, **_to(message)})


def _chunks(words: str) -> list[Send]:
    """STATUSTEXT holds 50 characters; longer texts share a number, and the last piece is a short one."""
    pieces = [words[at : at + LONGEST_TEXT] for at in range(0, len(words) + 1, LONGEST_TEXT)]
    return [
        Send("STATUSTEXT", {"severity": Severity.INFO, "text": piece, "id": 1, "chunk_seq": n})
        for n, piece in enumerate(pieces)
    ]


class Telemetry:
    """Rows of a flight, in the numbers that its ``.tlog`` would hold; `feedback` as in `servo_rows`."""

    def __init__(self, flight: SimulatedFlight, aircraft: Aircraft, feedback: str) -> None:
        self._series: dict[str, list[_Series]] = defaultdict(list)
        for name, made_us, columns in (*beats(flight), *servo_rows(flight, aircraft, feedback), *air_rows(flight)):
            self._series[name].append(_Series(made_us, {key: np.asarray(column) for key, column in columns.items()}))

    @property
    def names(self) -> tuple[str, ...]:
        """Messages that there are."""
        return tuple(self._series)

    def newest(self, name: str, now_us: int, *, again: bool = False) -> list[Send]:
        """Latest row of each source of a message that was made by now; `again`: also if it was given before."""
        found = []
        for series in self._series.get(name, ()):
            at = int(np.searchsorted(series.made_us, now_us, side="right")) - 1
            if at >= 0 and (again or at != series.last):
                series.last = at
                found.append(Send(name, {key: column[at].tolist() for key, column in series.columns.items()}))
        return found


@dataclass(slots=True, eq=False)
class _Series:
    """One source of a message."""

    made_us: IntArray
    columns: dict[str, NDArray[Any]]
    last: int = -1
    """Row that was given last."""


_PER_TURN: Final = 5
"""Parameters of a list that leave in one turn of the main loop."""
_WHOLE: Final = (
    (
        ("_REVERSED", "_DISARMED", "_REPLAY", "_TYPE", "_ENABLE", "_TRIM_AUTO", "_PROTOCOL", "_DRIVER"),
        ParameterType.INT8,
    ),
    (("_FUNCTION", "_MIN", "_MAX", "_TRIM", "_RATE", "_RANGE", "_THISMAV"), ParameterType.INT16),
    (("_MASK", "_BITMASK", "_BM"), ParameterType.INT32),
)


class Parameters:
    """Answers what a ground station asks about parameters; it can change none."""

    def __init__(self, known: Mapping[str, float]) -> None:
        self._known = dict(known)
        self._names = list(known)
        self._listed = len(known)

    def list_all(self) -> None:
        """Begin to send them all, from the first."""
        self._listed = 0

    def due(self) -> list[Send]:
        """Next few of a list that was asked for."""
        found = [self._value(n) for n in range(self._listed, min(self._listed + _PER_TURN, len(self._names)))]
        self._listed += len(found)
        return found

    def read(self, name: str, index: int) -> list[Send]:
        """One of them, by its index, or by its name if the index is -1; nothing if there is none."""
        if index < 0:
            index = self._names.index(name) if name in self._known else -1
        return [self._value(index)] if 0 <= index < len(self._names) else []

    def set(self, name: str, value: float) -> list[Send]:
        """Set a parameter by other means than the link; the message, without its place in the list, goes to all."""
        if name not in self._known:
            return []
        self._known[name] = value
        sent = self._value(self._names.index(name))
        return [Send(sent.name, {**sent.fields, "param_index": NO_INDEX})]

    def _value(self, index: int) -> Send:
        name = self._names[index]
        kind = next((kind for endings, kind in _WHOLE if name.endswith(endings)), ParameterType.REAL32)
        count = len(self._names)
        fields: dict[str, Any] = {"param_id": name, "param_value": self._known[name], "param_type": kind}
        return Send("PARAM_VALUE", {**fields, "param_count": count, "param_index": index})


OFF: Final = 0
"""Interval of a message that is not sent [ms]."""

_LONGEST_MS: Final = 60_000
"""Longest interval of a message [ms]."""
_NOW: Final = -1


class Schedule:
    """Intervals of messages, and when each is due.

    A message leaves at a turn of the main loop, so that 40 Hz of a 50 Hz loop are gaps of 20 and 40 ms, as in real
    logs.

    `usual_ms`: interval of each message before anybody asks for another [ms]; 0 for one that is not sent. `loop_us`:
    period of the main loop [us]. `any_rate`: grant whatever is asked for, up to the rate of the loop.
    """

    def __init__(self, usual_ms: Mapping[str, int], *, loop_us: int, any_rate: bool = False) -> None:
        self._usual_ms = dict(usual_ms)
        self._interval_ms = dict(usual_ms)
        self._next_us = dict.fromkeys(usual_ms, _NOW)
        self._loop_us = loop_us
        self._any_rate = any_rate

    def ask(self, name: str, interval_us: int) -> bool:
        """Ask for another interval: in whole milliseconds up to a minute; 0 for the usual one, -1 for none.

        Whether it is granted: the main loop may not turn often enough.
        """
        if interval_us <= 0:
            self._interval_ms[name] = self._usual_ms[name] if interval_us == 0 else OFF
            return True
        interval_ms = min(max(interval_us // 1000, 1), _LONGEST_MS)
        granted = self._any_rate or interval_ms * 800 >= self._loop_us
        if granted:
            self._interval_ms[name] = interval_ms
            self._next_us[name] = _NOW
        return granted

    def ask_rate(self, name: str, rate_hz: int) -> None:
        """Ask for a rate, as REQUEST_DATA_STREAM does [Hz]: the fastest if it is too fast, 0 for none."""
        fastest_ms = -(-self._loop_us // 800)
        self.ask(name, 1000 * max(1000 // rate_hz, fastest_ms) if rate_hz else -1)

    def interval_us(self, name: str) -> int:
        """Interval as MESSAGE_INTERVAL tells it [us]: -1 for a message that is not sent, 0 for one that is unknown."""
        interval_ms = self._interval_ms.get(name)
        if interval_ms is None:
            return 0
        return -1 if interval_ms == OFF else 1000 * interval_ms

    def due(self, now_us: int) -> list[str]:
        """Messages that leave at this turn of the loop."""
        found = []
        for name, interval_ms in self._interval_ms.items():
            if interval_ms != OFF and now_us >= self._next_us[name]:
                found.append(name)
                behind = self._next_us[name] == _NOW or now_us - self._next_us[name] >= 1000 * interval_ms
                self._next_us[name] = 1000 * interval_ms + (now_us if behind else self._next_us[name])
        return found

"""Writes telemetry logs for tests: every kind of frame a sender may produce."""

from __future__ import annotations

import importlib
import inspect
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.mavlink import Layout, dialect
from logparsers.telemetry.encode import Message, payloads
from logparsers.telemetry.frames import check_sum

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

EPOCH_US = 1_700_000_000_000_000


def extension_bytes(layout: Layout, dialect_name: str) -> int:
    """Of the fields that a sender may leave out, which pymavlink gives a default."""
    message = importlib.import_module(f"pymavlink.dialects.v20.{dialect_name}").mavlink_map[layout.id]
    parameters = inspect.signature(message.__init__).parameters
    return sum(
        field.width for field in layout.fields.values() if parameters[field.name].default is not inspect.Parameter.empty
    )


def frame(
    name: str,
    values: Mapping[str, Any],
    *,
    version: int = 2,
    source: tuple[int, int] = (1, 1),
    sequence: int = 0,
    signed: bool = False,
    extensions: bool = True,
    trim: bool = True,
    dialect_name: str = "all",
) -> bytes:
    layout = dialect(dialect_name).layouts[name]
    payload = payloads(Message(name, [0], {key: [value] for key, value in values.items()}), layout).tobytes()
    if version == 1 or not extensions:
        payload = payload[: layout.size - extension_bytes(layout, dialect_name)]
    if version == 2 and trim:
        payload = payload.rstrip(b"\0") or b"\0"
    if version == 1:
        head = bytes((0xFE, len(payload), sequence % 256, *source, layout.id))
    else:
        number = layout.id.to_bytes(3, "little")
        head = bytes((0xFD, len(payload), int(signed), 0, sequence % 256, *source)) + number
    body = head + payload
    crc = check_sum(np.frombuffer(body, np.uint8), 1, len(body), layout.seed)
    signature = bytes(range(13)) if signed else b""
    return body + struct.pack("<H", crc) + signature


def record(time_us: int, content: bytes) -> bytes:
    return struct.pack(">Q", time_us) + content


def log(entries: Iterable[tuple[float, bytes]]) -> bytes:
    """Frames with their arrival times [s since the start of the recording]."""
    return b"".join(record(EPOCH_US + round(time_s * 1e6), content) for time_s, content in entries)


def flight(seconds: float = 20.0, *, rate_hz: float = 10.0, boot_s: float = 50.0) -> bytes:
    """A little of everything: both versions, signed frames, three senders, arrays, texts, parameters."""
    entries: list[tuple[float, bytes]] = []
    for k in range(round(seconds * rate_hz)):
        now_s = k / rate_hz
        boot_ms = round((boot_s + now_s) * 1000)
        late_s = now_s + 0.02 + 0.01 * (k % 3)
        servo = {"time_usec": boot_ms * 1000 % 2**32, **{f"servo{i}_raw": 1000 + k + i for i in range(1, 17)}}
        attitude = {"time_boot_ms": boot_ms, "roll": 0.01 * k, "pitch": -0.02 * k}
        position = {"time_boot_ms": boot_ms, "name": f"SRVP{1 + k % 2}", "value": 0.1 * k}
        entries += [
            (late_s, frame("SERVO_OUTPUT_RAW", servo, version=1 + k % 2, sequence=3 * k)),
            (late_s, frame("ATTITUDE", attitude, signed=k % 5 == 0, sequence=3 * k + 1)),
            (late_s + 0.001, frame("NAMED_VALUE_FLOAT", position, source=(1, 191), sequence=k)),
            (
                late_s + 0.002,
                frame("VFR_HUD", {"airspeed": 20.0 + k, "throttle": k % 100}, sequence=3 * k + 2),
            ),
        ]
        if k % 10 == 0:
            beat = {"type": 1, "autopilot": 3, "mavlink_version": 3}
            data = {"time_usec": boot_ms * 1000, "name": "rig", "array_id": 7, "data": np.arange(58.0) + k}
            entries += [
                (late_s + 0.003, frame("HEARTBEAT", beat, version=1)),
                (late_s + 0.003, frame("HEARTBEAT", {"type": 6, "autopilot": 8}, source=(255, 190))),
                (late_s + 0.004, frame("DEBUG_FLOAT_ARRAY", data)),
                (
                    late_s + 0.005,
                    frame("PARAM_VALUE", {"param_id": f"SERVO{k // 10}_MIN", "param_value": 1000 + k}),
                ),
                (late_s + 0.006, frame("STATUSTEXT", {"severity": 6, "text": "ArduPlane V4.6.0 (abc)"})),
            ]
    return log(entries)

"""Writes small PX4 logs for tests."""

from __future__ import annotations

import struct


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def header(start_us: int = 1_000_000) -> bytes:
    return b"ULog\x01\x12\x35\x01" + struct.pack("<Q", start_us) + message("B", bytes(40))


def info(key: str, value: bytes, kind: str = "I") -> bytes:
    return message(kind, bytes((len(key),)) + key.encode() + value)


def subscribe(number: int, topic: str, instance: int = 0) -> bytes:
    return message("A", struct.pack("<BH", instance, number) + topic.encode())


def data(number: int, content: bytes) -> bytes:
    return message("D", struct.pack("<H", number) + content)


FORMATS = (
    "actuator_servos:uint64_t timestamp;uint64_t timestamp_sample;float[8] control;",
    "actuator_outputs:uint64_t timestamp;float[16] output;uint32_t noutputs;uint8_t[4] _padding0;",
    "debug_array:uint64_t timestamp;float[58] data;uint16_t id;char[10] name;uint8_t[4] _padding0;",
    "sensor_baro:uint64_t timestamp;float pressure;",
)


def flight(rows: int = 40, *, dropout: bool = True) -> bytes:
    """Commands on two outputs, positions as debug arrays of two senders, a parameter changed in flight."""
    out = [header(), info("uint32_t ver_sw_release", struct.pack("<I", 0x010F01FF))]
    out += [message("F", text.encode()) for text in FORMATS]
    out += [
        info("int32_t MAV_TYPE", struct.pack("<i", 1), "P"),
        info("float TRIM", struct.pack("<f", 0.5), "P"),
    ]
    out += [
        subscribe(0, "actuator_servos"),
        subscribe(1, "actuator_outputs", 0),
        subscribe(2, "actuator_outputs", 1),
    ]
    out += [subscribe(3, "debug_array"), subscribe(4, "sensor_baro")]
    for k in range(rows):
        stamp = struct.pack("<Q", 1_000_000 + 20_000 * k)
        out.append(data(0, stamp + stamp + struct.pack("<8f", *(0.01 * k * i for i in range(8)))))
        for number in (1, 2):
            out.append(data(number, stamp + struct.pack("<16fI", *range(1000 + k, 1016 + k), 16)))
        name = (b"SRVP", b"RIG")[k % 2].ljust(10, b"\0")
        out.append(data(3, stamp + struct.pack("<58fH10s", *(k + i for i in range(58)), 1, name)))
        out.append(data(4, stamp + struct.pack("<f", 101_325.0 + k)))
        if k == rows // 2:
            out.append(info("float TRIM", struct.pack("<f", 0.75), "P"))
            if dropout:
                out.append(message("O", struct.pack("<H", 30)))
            out.append(message("L", b"4" + stamp + b"[commander] low battery"))
    return b"".join(out)

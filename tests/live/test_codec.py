"""Frames that are read without pymavlink's parser hold what that parser finds in them."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as peer

from logparsers.codec import Codec


def framed(message: Any, payload: bytes, version: int) -> bytes:
    number = int(message.id)
    head = bytes([len(payload), 0, 0, 7, 1, 2]) + number.to_bytes(3, "little")
    if version == 1:
        head = bytes([len(payload), 7, 1, 2, number])
    check: int = peer.x25crc(head + payload + bytes([message.crc_extra])).crc
    return bytes([0xFD if version == 2 else 0xFE]) + head + payload + struct.pack("<H", check)


def peers(data: bytes) -> list[tuple[bytes, str, dict[str, Any]]]:
    parser = peer.MAVLink(None)
    parser.robust_parsing = True
    return [
        (bytes(m.get_msgbuf()), m.get_type(), {name: getattr(m, name) for name in m.get_fieldnames()})
        for m in parser.parse_buffer(data) or ()
        if m.get_type() != "BAD_DATA"
    ]


def ours(codec: Codec, data: bytes) -> list[tuple[bytes, str, dict[str, Any]]]:
    return [(frame, heard.name, dict(heard.fields)) for frame, heard in codec.frames(data) if heard is not None]


@pytest.mark.parametrize("version", [1, 2])
def test_every_message_is_read_as_pymavlink_reads_it(version: int) -> None:
    rng = np.random.default_rng(version)
    for message in peer.mavlink_map.values():
        if version == 1 and message.id > 255:
            continue
        size = message.unpacker.size
        for length in (size, size // 2, min(size + 3, 255)):
            frame = framed(message, rng.integers(0, 256, length, dtype=np.uint8).tobytes(), version)
            assert repr(ours(Codec(0, 0), frame)) == repr(peers(frame))


def test_damage_and_pieces_change_nothing() -> None:
    """Among good frames: garbage, wrong check-sums, and pieces that end anywhere."""
    rng, plane = np.random.default_rng(5), Codec(1, 1)
    data = b""
    for k in range(300):
        frame = plane.encode("NAMED_VALUE_FLOAT", {"time_boot_ms": k, "name": f"SRVP{k % 6}", "value": 0.1 * k})
        kind = rng.random()
        if kind < 0.1:
            frame = frame[:20] + bytes([frame[20] ^ 0x55]) + frame[21:]
        elif kind < 0.2:
            frame = rng.integers(0, 0xFD, 7, dtype=np.uint8).tobytes() + frame
        data += frame
    ground, found, at = Codec(0, 0), [], 0
    while at < len(data):
        piece = int(rng.integers(1, 90))
        found += ours(ground, data[at : at + piece])
        at += piece
    assert found == peers(data)
    assert len(found) > 200

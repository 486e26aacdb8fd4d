"""Endpoints, links and frames, without a vehicle."""

from __future__ import annotations

import contextlib
import re
import socket
import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as version_2

from logparsers.codec import Codec, Signature, signing_key
from logparsers.endpoint import Serial, Socket, parse_endpoint
from logparsers.errors import LinkError
from logparsers.link import open_link
from servofd.live.vehicle import Losses
from tests.live.vehicles import free_port, until

_LIKE_AN_ENDPOINT = re.compile(r"(udp|tcp)(in|out)?:[\w.]*:\d{0,6}|/dev/[\w./]+(,\d+)?", re.ASCII)
"""Of letters of all languages any text may be; here they would take seconds to draw."""


@pytest.mark.slow
@given(st.text(max_size=40) | st.from_regex(_LIKE_AN_ENDPOINT, fullmatch=True))
def test_a_text_is_an_endpoint_or_refused_in_one_line(text: str) -> None:
    try:
        endpoint = parse_endpoint(text)
    except LinkError as error:
        words = str(error)
    else:
        assert parse_endpoint(str(endpoint)) == endpoint
        assert isinstance(endpoint, Serial) or endpoint.kind in ("udpin", "udpout", "tcp", "tcpin")
        return
    assert "/dev/" in words


@pytest.mark.parametrize(
    "text",
    [
        "/bin/sh", "./arduplane.elf", "/home/me/arduplane.elf", "/dev/../bin/sh", "/dev/pts/../../bin/sh", "mcast:",
        "udpbcast:1.2.3.4:5", "ws://host", "unix:x", "uds:x", "csv:x", "flight.tlog", "127.0.0.1:14550",
        "udp:127.0.0.1:14550", "udpin:host:", "udpin:a b:1", "udpin:$(id):1", "tcp:[::1]:5760", "COM", "", ",",
        "/dev/ttyS0,fast", "udpin:0", "udpin:65536",
    ],
)  # fmt: skip
def test_what_pymavlink_would_run_or_open_is_refused(text: str) -> None:
    with pytest.raises(LinkError):
        parse_endpoint(text)


def test_loopback_is_what_is_meant_when_no_host_is_given() -> None:
    assert parse_endpoint("tcpin:5760") == parse_endpoint("tcpin::5760") == Socket("tcpin", "127.0.0.1", 5760)


def test_udpin_answers_everybody_who_spoke_and_nobody_else() -> None:
    port = free_port()
    with contextlib.ExitStack() as stack:
        here = open_link(Socket("udpin", "127.0.0.1", port))
        stack.callback(here.close)
        peers = [open_link(Socket("udpout", "127.0.0.1", port)) for _ in range(3)]
        for peer in peers:
            stack.callback(peer.close)
        here.send(b"nobody hears this")
        for peer in peers[:2]:
            peer.send(b"hello")
            assert until(lambda: here.receive(0.1), "a datagram") == b"hello"
        here.send(b"answer")
        assert [peer.receive(5.0) for peer in peers[:2]] == [b"answer"] * 2
        assert peers[2].receive(0.0) == b""


def test_a_port_is_not_shared_with_pymavlink() -> None:
    """Its sockets allow others to bind the same port; who got which datagram would be chance."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", 0))
        with pytest.raises(LinkError, match="another program listens there"):
            open_link(Socket("udpin", "127.0.0.1", other.getsockname()[1]))


def test_frames_survive_any_cut() -> None:
    sender, receiver = Codec(1, 1), Codec(2, 2)
    stream = b"".join(sender.encode("NAMED_VALUE_FLOAT", {"time_boot_ms": n, "name": "SRVP1"}) for n in range(300))
    heard = [m for at in range(0, len(stream), 7) for m in receiver.decode(stream[at : at + 7])]
    assert [m.fields["time_boot_ms"] for m in heard] == list(range(300))


@pytest.mark.parametrize("seed", range(4))
def test_any_bytes_are_read_as_pymavlink_reads_them(seed: int) -> None:
    """Every message with any content, in frames of both versions, cut short, damaged, amid bytes of nobody's."""
    rng = np.random.default_rng(seed)
    reader, theirs, stream = Codec(2, 2), version_2.MAVLink(None), bytearray()
    theirs.robust_parsing = True
    for kind in version_2.mavlink_map.values():
        payload = rng.bytes(int(rng.integers(1, min(kind.unpacker.size + 4, 255))))
        old = kind.id < 256 and rng.random() < 0.3
        header = struct.pack("<BBBB", len(payload), *rng.integers(0, 256, 3).tolist())
        frame = (header if old else header[:1] + b"\0\0" + header[1:]) + kind.id.to_bytes(1 if old else 3, "little")
        frame = (b"\xfe" if old else b"\xfd") + frame + payload
        frame += struct.pack("<H", version_2.x25crc(frame[1:] + bytes([kind.crc_extra])).crc)
        what = rng.random()
        if what < 0.1:
            frame = rng.bytes(int(rng.integers(1, 30)))
        elif what < 0.2:
            at = int(rng.integers(len(frame)))
            frame = frame[:at] + bytes([frame[at] ^ 1]) + frame[at + 1 :]
        stream += frame
    ours: list[str] = []
    expected: list[str] = []
    for begin, end in pairwise([0, *sorted(rng.integers(0, len(stream), 400).tolist()), len(stream)]):
        piece = bytes(stream[begin:end])
        for frame, m in reader.frames(piece):
            known = m and (m.name, m.system, m.component, m.sequence, sorted(m.fields.items()))
            ours.append(repr((frame, known)))
        for got in theirs.parse_buffer(piece) or ():
            bad = got.get_type() == "BAD_DATA"
            lost = bad or got.get_type().startswith("UNKNOWN")
            fields = sorted((name, getattr(got, name)) for name in got.get_fieldnames())
            sender = got.get_srcSystem(), got.get_srcComponent(), got.get_seq()
            known = None if lost else (got.get_type(), *sender, fields)
            expected.append(repr((bytes(got.data if bad else got.get_msgbuf()), known)))
    assert len(expected) > 300
    assert ours == expected


def test_what_is_lost_is_counted_where_frames_overtake_each_other() -> None:
    """Of 20 000 frames in volleys of 25, late by up to 0.2 s each, 3 in 10 are lost; then nothing comes for a while."""
    rng = np.random.default_rng(5)
    sent_s = np.repeat(0.1 * np.arange(800), 25)
    arrival_s = sent_s + rng.uniform(0.0, 0.2, sent_s.size)
    kept = (rng.random(sent_s.size) >= 0.3) & ((sent_s < 40.0) | (sent_s >= 40.0 + 0.8))
    losses = Losses()
    for k in np.argsort(arrival_s)[kept[np.argsort(arrival_s)]].tolist():
        losses.count(k % 256, float(arrival_s[k]))
    assert losses.received == np.count_nonzero(kept)
    assert losses.lost / (losses.received + losses.lost) == pytest.approx(1.0 - np.mean(kept), abs=0.002)


def test_version_1_leaves_out_what_it_lacks() -> None:
    old, reader = Codec(1, 1, version=1), Codec(2, 2)
    (servo,) = reader.decode(old.encode("SERVO_OUTPUT_RAW", {"servo1_raw": 1500, "servo9_raw": 1600}))
    assert (servo.fields["servo1_raw"], servo.fields["servo9_raw"]) == (1500, 0)
    assert old.encode("DEBUG_FLOAT_ARRAY", {"time_usec": 1}) == b""


def test_a_signature_is_believed_once() -> None:
    sender, receiver = (Codec(n, 1, signature=Signature(signing_key(b"secret"), 1.8e9)) for n in (1, 2))
    frame = sender.encode("HEARTBEAT", {})
    assert len(receiver.decode(frame)) == 1
    assert receiver.decode(frame) == []

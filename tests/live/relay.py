"""A bad link on cue: what passes, twice, late, damaged or not at all, is drawn from a seed."""

from __future__ import annotations

import socket
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.codec import Codec

if TYPE_CHECKING:
    from collections.abc import Iterator

_TICK_S = 0.05


@dataclass
class BadLink:
    """One direction of a link.

    Parameters
    ----------
    loss, duplicate, reorder, corrupt : float
        Fractions of the datagrams; one that is reordered comes after its successor.
    outages_s : tuple of (float, float)
        Nothing passes while the clock of the vehicle is within one of these [s].
    seed : int
        The same seed does the same to the same datagrams.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    outages_s: tuple[tuple[float, float], ...] = ()
    seed: int = 0
    now_s: float = 0.0
    lost: int = 0
    passed: int = 0
    record: bytearray = field(default_factory=bytearray)
    """Every byte that came in."""
    _held: list[bytes] = field(default_factory=list)
    _codec: Codec = field(default_factory=lambda: Codec(254, 1))

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    def through(self, datagram: bytes) -> list[bytes]:
        """What comes out at the other end for one that goes in."""
        self.record += datagram
        if self.outages_s:
            self._follow(datagram)
        draw = self._rng.random(4)
        if draw[0] < self.loss or any(begin <= self.now_s < end for begin, end in self.outages_s):
            self.lost += 1
            return []
        self.passed += 1
        if draw[3] < self.corrupt:
            damaged = bytearray(datagram)
            damaged[int(self._rng.integers(len(damaged)))] ^= int(self._rng.integers(1, 256))
            datagram = bytes(damaged)
        if draw[2] < self.reorder and not self._held:
            self._held.append(datagram)
            return []
        out = [datagram, *self._held] + [datagram] * int(draw[1] < self.duplicate)
        self._held.clear()
        return out

    def _follow(self, datagram: bytes) -> None:
        for heard in self._codec.decode(datagram):
            if "time_boot_ms" in heard.fields:
                self.now_s = 1e-3 * heard.fields["time_boot_ms"]


@contextmanager
def relayed(to_port: int, down: BadLink, up: BadLink | None = None) -> Iterator[int]:
    """Relay between a vehicle (``udpout:`` to the port that this gives) and ``udpin:`` on `to_port`."""
    up = up or BadLink()
    vehicle_side = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ground_side = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    vehicle_side.bind(("127.0.0.1", 0))
    ground_side.connect(("127.0.0.1", to_port))
    for each in (vehicle_side, ground_side):
        each.settimeout(_TICK_S)
    stop = threading.Event()
    peers: list[Any] = []

    def downwards() -> None:
        while not stop.is_set():
            try:
                datagram, peer = vehicle_side.recvfrom(65_536)
                peers[:] = [peer]
                for each in down.through(datagram):
                    ground_side.send(each)
            except (TimeoutError, ConnectionRefusedError):
                continue

    def upwards() -> None:
        while not stop.is_set():
            try:
                datagram = ground_side.recv(65_536)
                for each in up.through(datagram):
                    vehicle_side.sendto(each, peers[0])
            except (TimeoutError, ConnectionRefusedError):
                continue

    threads = [threading.Thread(target=run) for run in (downwards, upwards)]
    for thread in threads:
        thread.start()
    try:
        yield int(vehicle_side.getsockname()[1])
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        vehicle_side.close()
        ground_side.close()

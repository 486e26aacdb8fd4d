"""Ground stations for tests: pymavlink's, ours, and MAVProxy."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from pymavlink import mavutil

from logparsers.codec import Codec, Received
from logparsers.endpoint import parse_endpoint
from logparsers.link import open_link
from tests.live.vehicles import DEADLINE_S, free_port, until

if TYPE_CHECKING:
    from collections.abc import Iterator

    from logparsers.link import Link


@contextlib.contextmanager
def pymavlink_station(endpoint: str, *, source: tuple[int, int] = (255, 0)) -> Iterator[Any]:
    """Pymavlink's own link, as user scripts open it."""
    station = mavutil.mavlink_connection(
        endpoint, source_system=source[0], source_component=source[1], dialect="ardupilotmega"
    )
    try:
        yield station
    finally:
        station.close()


def received(station: Any, kind: str) -> Any:
    """Next message of a kind at a pymavlink station."""
    message = station.recv_match(type=kind, blocking=True, timeout=DEADLINE_S)
    assert message is not None, f"no {kind} came"
    return message


class Ground:
    """A ground station of ours on any link."""

    def __init__(self, link: Link, codec: Codec | None = None) -> None:
        self.link = link
        self.codec = codec or Codec(255, 190)
        self.received: dict[str, list[Received]] = defaultdict(list)

    def say(self, name: str, **fields: Any) -> None:
        self.link.send(self.codec.encode(name, {"target_system": 1, "target_component": 1} | fields))

    def listen(self) -> list[Received]:
        new = self.codec.decode(self.link.receive(0.1))
        for message in new:
            self.received[message.name].append(message)
        return new

    def wait_for(self, name: str, count: int = 1) -> list[Received]:
        until(lambda: self.listen() and len(self.received[name]) >= count, f"{count} {name}")
        return self.received[name]


@contextlib.contextmanager
def ours(endpoint: str, codec: Codec | None = None) -> Iterator[Ground]:
    link = open_link(parse_endpoint(endpoint))
    try:
        yield Ground(link, codec)
    finally:
        link.close()


class MavProxy:
    """MAVProxy, from its own package, with its console in a pipe."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        program = Path(sys.executable).with_name("mavproxy.py")
        if not program.exists():
            pytest.skip("MAVProxy is not installed: pip install '.[test-mavproxy]'")
        command = [sys.executable, str(program), "--non-interactive", f"--state-basedir={folder}", "--aircraft=plane"]
        self._process = subprocess.Popen(
            [*command, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "HOME": str(folder)},
        )
        self._folder = folder
        self.console = ""

    def read(self) -> str:
        """What the console shows so far."""
        pipe = self._process.stdout
        assert pipe is not None
        if select.select([pipe], [], [], 0.1)[0]:
            self.console += os.read(pipe.fileno(), 65_536).decode(errors="replace")
        return self.console

    def wait_for(self, words: str) -> None:
        until(lambda: words in self.read(), f"{words!r} on the console, which shows:\n{self.console}\n")

    def telemetry_log(self) -> Path:
        (path,) = self._folder.glob("plane/logs/*/*/flight.tlog")
        return path

    def close(self) -> None:
        self._process.terminate()
        self._process.communicate(timeout=DEADLINE_S)


@contextlib.contextmanager
def mavproxy(folder: Path, *arguments: str) -> Iterator[MavProxy]:
    program = MavProxy(folder, *arguments)
    try:
        yield program
    finally:
        program.close()


class Router(NamedTuple):
    """MAVProxy between a vehicle, somebody who sends alerts, and somebody who listens and asks."""

    console: MavProxy
    vehicle: str
    """Where the vehicle sends to."""
    alerts: str
    """Where alerts are sent to."""
    out: str
    """Where the stream comes out."""


@contextlib.contextmanager
def router(folder: Path, *commands: str) -> Iterator[Router]:
    """MAVProxy that forwards between its links, as it is set up at the field, waiting for a vehicle."""
    vehicle, alerts, out = (f"127.0.0.1:{free_port()}" for _ in range(3))
    with mavproxy(
        folder,
        f"--master=udpin:{vehicle}",
        f"--master=udpin:{alerts}",
        f"--out=udpout:{out}",
        "--streamrate=-1",
        "--target-system=1",
        "--target-component=0",
        f"--cmd={'; '.join(('set mavfwd_link 1', *commands))}",
    ) as console:
        yield Router(console, f"udpout:{vehicle}", f"udpout:{alerts}", f"udpin:{out}")

"""Threads of the monitor: what is received, written, and said on the link, each without waiting for another."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

from logparsers.codec import Codec, Signature, signing_key
from logparsers.link import Link
from logparsers.protocol import Command
from servofd.core.errors import ConfigError

T = TypeVar("T")
_POLL_S = 0.1
"""How long a thread waits for data before it looks whether it should end [s]."""
_CHUNKS = 20_000
"""Pieces of data that may wait to be judged."""
_JOIN_S = 5.0
"""How long the end of a thread is waited for [s]."""


class Queue(Generic[T]):
    """A bounded queue."""

    def __init__(self, room: int) -> None:
        self._entries: deque[T] = deque(maxlen=room)
        self._ready = threading.Condition()
        self.dropped = 0

    def put(self, entry: T) -> None:
        """Add an entry; never waits."""
        with self._ready:
            self.dropped += len(self._entries) == self._entries.maxlen
            self._entries.append(entry)
            self._ready.notify()

    def take(self, timeout_s: float) -> list[T]:
        """All entries, waiting for the first at most so long [s]."""
        with self._ready:
            if not self._entries:
                self._ready.wait(timeout_s)
            entries = list(self._entries)
            self._entries.clear()
            return entries


class Receiver:
    """Takes bytes off a link as soon as they arrive, with their arrival times [s since 1970]."""

    def __init__(self, link: Link) -> None:
        self._link, self._stop = link, threading.Event()
        self.chunks: Queue[tuple[float, bytes]] = Queue(_CHUNKS)
        self._since_s = time.time() - time.monotonic()
        self._thread = threading.Thread(target=self._run, name="servofd receive", daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Clock of the arrival times [s]; it is never set back."""
        return self._since_s + time.monotonic()

    def close(self) -> None:
        """Stop receiving."""
        self._stop.set()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        while not self._stop.is_set():
            data = self._link.receive(_POLL_S)
            if data:
                self.chunks.put((self.now_s(), data))


class Worker:
    """Writes or sends in a thread of its own; gives up, and says why, when that fails."""

    def __init__(self, write: Callable[[bytes], object], close: Callable[[], object], room: int = 20_000) -> None:
        self._write, self._close, self._stop = write, close, threading.Event()
        self.queue: Queue[bytes] = Queue(room)
        self.error = ""
        self._thread = threading.Thread(target=self._run, name="servofd write", daemon=True)
        self._thread.start()

    def put(self, data: bytes) -> None:
        """Have it written, some time soon."""
        if not self.error:
            self.queue.put(data)

    def close(self) -> None:
        """Write what waits, and end."""
        self._stop.set()
        self._thread.join(_JOIN_S)
        with contextlib.suppress(OSError):
            self._close()

    def _run(self) -> None:
        while True:
            last = self._stop.is_set()
            try:
                for data in self.queue.take(0.0 if last else _POLL_S):
                    self._write(data)
            except OSError as error:
                self.error = error.strerror or str(error)
                return
            if last:
                return


ALLOWED = frozenset(
    {
        "HEARTBEAT",
        "STATUSTEXT",
        "NAMED_VALUE_FLOAT",
        "COMMAND_LONG",
        "TIMESYNC",
        "PARAM_REQUEST_READ",
        "REMOTE_LOG_BLOCK_STATUS",
    }
)
"""COMMAND_LONG for message intervals alone: nothing that moves the vehicle or changes a setting of it."""
_ROOM = 256
"""Batches that may wait to be written."""


@contextmanager
def speaking(
    link: Link, component: int, system: int | None, signature: Signature | None
) -> Iterator[Callable[[int, str, dict[str, Any]], None]]:
    """Sender of a few kinds of messages on a link, in a thread of its own, in the name of an onboard component.

    It is of that `system`; where none is given, of the vehicle that is spoken of.
    """
    worker = Worker(link.send, lambda: None, _ROOM)
    codecs: dict[int, Codec] = {}

    def send(vehicle: int, name: str, fields: dict[str, Any]) -> None:
        if name not in ALLOWED or (name == "COMMAND_LONG" and fields["command"] != Command.SET_MESSAGE_INTERVAL):
            raise ValueError(f"the monitor never sends {name}")
        speaks_as = system or vehicle or 1
        if speaks_as not in codecs:
            codecs[speaks_as] = Codec(speaks_as, component, signature=signature)
        worker.put(codecs[speaks_as].encode(name, fields))

    try:
        yield send
    finally:
        worker.close()


def signature_of(name: str | None) -> Signature | None:
    """Signature with the key in a file, from now on; none without a file."""
    if name is None:
        return None
    try:
        content = Path(name).read_bytes()
    except OSError as error:
        raise ConfigError(f"--signing-key {name}: cannot read it ({error.strerror or error})") from None
    if not content.strip():
        raise ConfigError(f"--signing-key {name}: holds no key; give 32 bytes, 64 hex digits, or a passphrase")
    return Signature(signing_key(content), time.time())

"""Work that must not hold up the receiver: one thread that only receives, others that only write or send.

Queues are bounded. When one is full, its oldest entry is dropped and counted: what is new matters more.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from logparsers.link import Link

T = TypeVar("T")
_POLL_S = 0.1
_CHUNKS = 20_000
_JOIN_S = 5.0


class Queue(Generic[T]):
    """A bounded queue.

    Examples
    --------
    >>> queue: Queue[int] = Queue(2)
    >>> for number in (1, 2, 3):
    ...     queue.put(number)
    >>> queue.take(0.0), queue.dropped
    ([2, 3], 1)
    """

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
    """Takes bytes off a link as soon as they arrive, with their arrival times [s since 1970].

    Parameters
    ----------
    link : Link
        Where from.
    """

    def __init__(self, link: Link) -> None:
        self._link, self._stop = link, threading.Event()
        self.chunks: Queue[tuple[float, bytes]] = Queue(_CHUNKS)
        self._since_s = time.time() - time.monotonic()
        self._thread = threading.Thread(target=self._run, name="servofd receive", daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Clock of the arrival times [s]; nobody can set it back."""
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
    """Writes or sends in a thread of its own; gives up, and says why, when that fails.

    Examples
    --------
    >>> written: list[bytes] = []
    >>> worker = Worker(written.append, lambda: None)
    >>> worker.put(b"one")
    >>> worker.close()
    >>> written, worker.error
    ([b'one'], '')
    """

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

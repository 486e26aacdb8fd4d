"""A pseudo-terminal, and the screen of whoever sits before it."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any, Self

import pyte

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from types import TracebackType


class Screen(pyte.HistoryScreen):
    """One that has an alternate screen, as xterm has, which pyte lacks."""

    is_alternate = False

    def set_mode(self, *modes: int, **kwargs: Any) -> None:
        super().set_mode(*modes, **kwargs)
        if kwargs.get("private") and 1049 in modes:
            self.is_alternate = True
            self.kept, self.at = {y: dict(row) for y, row in self.buffer.items()}, (self.cursor.y, self.cursor.x)
            self.erase_in_display(2)

    def reset_mode(self, *modes: int, **kwargs: Any) -> None:
        super().reset_mode(*modes, **kwargs)
        if kwargs.get("private") and 1049 in modes:
            self.is_alternate = False
            self.erase_in_display(2)
            for y, row in self.kept.items():
                self.buffer[y].update(row)
            self.cursor.y, self.cursor.x = self.at

    def text(self) -> list[str]:
        """Everything that stands on the screen, and above it unless it is the alternate one."""
        rows = () if self.is_alternate else self.history.top
        above = ["".join(row[x].data for x in range(self.columns)) for row in rows]
        return [line.rstrip() for line in (*above, *self.display)]


class Terminal:
    """A terminal in which a program runs.

    Parameters
    ----------
    columns, rows : int
        Its size.
    """

    def __init__(self, columns: int, rows: int = 40) -> None:
        self._ours, self._theirs = pty.openpty()
        self.screen = Screen(columns, rows, history=10_000, ratio=0.5)
        self._stream = pyte.ByteStream(self.screen)
        self.raw = bytearray()
        self._running: list[subprocess.Popen[bytes]] = []
        self.resize(columns, rows)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        for process in self._running:
            process.kill()  # none, where a test went as it should
            process.wait()
        for end in (self._ours, self._theirs):
            os.close(end)

    def resize(self, columns: int, rows: int = 40) -> None:
        """Change its size; what runs in it is told by a signal, as by a window."""
        fcntl.ioctl(self._theirs, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.screen.resize(rows, columns)

    def run(self, words: Sequence[str], **environment: str) -> subprocess.Popen[bytes]:
        """Start servofd in it."""
        process = subprocess.Popen(
            [sys.executable, "-m", "servofd", *words],
            stdin=self._theirs,
            stdout=self._theirs,
            stderr=self._theirs,
            env={**os.environ, "TERM": "xterm-256color", **environment},
            start_new_session=True,
        )
        self._running.append(process)
        return process

    @contextmanager
    def open(self) -> Iterator[IO[str]]:
        """A text stream that writes to it, for what runs in this process; what is written is read meanwhile."""
        done = threading.Event()

        def read() -> None:
            while not done.is_set():
                self.look(0.02)

        reader = threading.Thread(target=read)
        reader.start()
        try:
            with os.fdopen(os.dup(self._theirs), "w", encoding="utf-8") as stream:
                yield stream
        finally:
            done.set()
            reader.join()

    def look(self, wait_s: float = 0.0) -> list[str]:
        """What stands there now, when nothing more has come for so long [s]."""
        while select.select([self._ours], [], [], wait_s)[0]:
            data = os.read(self._ours, 65_536)
            self.raw += data
            self._stream.feed(data)
        return self.screen.text()

    def wait(self, until: Callable[[list[str]], bool], patience_s: float = 60.0) -> list[str]:
        """What stands there as soon as it is as expected."""
        end_s = time.monotonic() + patience_s
        while not until(shown := self.look(0.05)):
            assert time.monotonic() < end_s, "\n".join(shown[-self.screen.lines :])
        return shown

    def end(self, process: subprocess.Popen[bytes], number: signal.Signals | None = None) -> int:
        """Exit code of what runs there, after a signal to it if one is given."""
        if number is not None:
            process.send_signal(number)
        while process.poll() is None:
            self.look(0.05)
        self.look(0.05)
        return process.returncode

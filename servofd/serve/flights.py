"""The flights of a folder: found there or dropped on the page, judged one after the other by a few processes."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import queue
import re
import shutil
import tempfile
import threading
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

from servofd.batch.find import META_FILE, find_logs
from servofd.batch.key import Job, content_key
from servofd.batch.local import cores, interrupts_wait, processes
from servofd.core.errors import ConfigError
from servofd.core.files import distinct_file_names, make_folder, write_whole
from servofd.serve.judge import Summary, judge

if TYPE_CHECKING:
    from types import TracebackType

State = Literal["waiting", "at work", "done"]

RESULTS = "servofd"
"""Folder of results within the folder of logs."""
_ID = re.compile(r"[0-9a-f]{32}")
_KEPT_FREE_BYTES = 200 * 1024 * 1024
_DIED = "Could not be judged: its process ended before it was done (out of memory, or stopped)."


class TooLarge(ConfigError):  # noqa: N818 - reads better without "Error"
    """More than this page takes, or than the disk holds."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One log and what became of it so far."""

    id: str
    """Digest of its bytes: a log that is dropped twice is one flight."""
    log: Path
    size_bytes: int
    state: State
    summary: Summary | None = None

    @property
    def name(self) -> str:
        """Name of the file, without its folders."""
        return self.log.name


class Flights:
    """All flights of a folder and those below, and the processes that judge them; the `with` block ends those.

    What is dropped, of at most `most_bytes`, goes into the folder as well, which is made if it is not there; one worker
    per core if their number is None.
    """

    def __init__(self, folder: Path, job: Job, *, most_bytes: int, workers: int | None = None) -> None:
        self.folder, self.job, self.most_bytes = folder, job, most_bytes
        make_folder(folder / RESULTS)
        write_whole(folder / RESULTS / META_FILE, b"{}\n")  # no logs are looked for in there
        self._flights: dict[str, Flight] = {}
        self._ended = False
        self._lock = threading.Lock()
        self._waiting: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._workers = [threading.Thread(target=self._work, daemon=True) for _ in range(workers or cores())]
        self._finder = threading.Thread(target=self._find, daemon=True)

    def __enter__(self) -> Self:
        for thread in (self._finder, *self._workers):
            thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended = True
        for _ in self._workers:
            self._waiting.put(None)
        for process in multiprocessing.active_children():
            process.terminate()
        for thread in self._workers:
            thread.join()

    def all(self) -> list[Flight]:
        """Every flight, the one that came last first."""
        with self._lock:
            return list(reversed(self._flights.values()))

    def get(self, flight_id: str) -> Flight | None:
        """A flight by its digest."""
        with self._lock:
            return self._flights.get(flight_id)

    def results(self, flight_id: str) -> Path:
        """Folder of its results."""
        if not _ID.fullmatch(flight_id):
            raise ConfigError("no such flight")
        return self.folder / RESULTS / flight_id

    def upload(self, name: str, expected_bytes: int) -> Upload:
        """Somewhere to put the bytes of a log that comes."""
        if expected_bytes > self.most_bytes:
            raise TooLarge(f"{name}: larger than {self.most_bytes / 1e6:.0f} MB, which this page takes")
        if expected_bytes > shutil.disk_usage(self.folder).free - _KEPT_FREE_BYTES:
            raise TooLarge(f"{name}: there is no room for it on the disk")
        return Upload(self, name)

    def add(self, log: Path, flight_id: str) -> Flight:
        """Take up a log of the folder; one that was judged in the same way before is done."""
        summary = Summary.read(self.results(flight_id))
        if summary is not None and summary.key != self.job.key:
            summary = None
        with self._lock:
            known = self._flights.get(flight_id)
            if known is not None:
                return known
            flight = Flight(flight_id, log, log.stat().st_size, "done" if summary else "waiting", summary)
            self._flights[flight_id] = flight
        if flight.state == "waiting":
            self._waiting.put(flight_id)
        return flight

    def _find(self) -> None:
        """Logs that lie in the folder already."""
        try:
            found = find_logs([str(self.folder)]).logs
        except ConfigError:  # there are none
            return
        for source in found:
            try:
                self.add(Path(source.path), content_key(source.path))
            except OSError:  # gone, or not to be read
                continue

    def _work(self) -> None:
        """Judge what waits, in a process that is replaced if it dies; a flight that it dies of says so."""
        while True:
            with processes(1) as pool:
                while (flight_id := self._waiting.get()) is not None and not self._ended:
                    flight = self._set(flight_id, "at work", None)
                    try:
                        with interrupts_wait():
                            future = pool.submit(judge, str(flight.log), str(self.results(flight_id)), self.job)
                        self._set(flight_id, "done", future.result())
                    except BrokenProcessPool:
                        self._set(flight_id, "done", Summary("unknown", _DIED))
                        break
                    except Exception as error:
                        text = str(error).replace(str(flight.log), flight.name)
                        self._set(flight_id, "done", Summary("unknown", f"Could not be judged: {text}"))
                else:
                    return

    def _set(self, flight_id: str, state: State, summary: Summary | None) -> Flight:
        with self._lock:
            flight = replace(self._flights[flight_id], state=state, summary=summary)
            self._flights[flight_id] = flight
        return flight


class Upload:
    """The bytes of a log as they come; nothing of it is left if they do not all come."""

    def __init__(self, flights: Flights, name: str) -> None:
        self._flights = flights
        (self._name,) = distinct_file_names([name.replace("\\", "/").rpartition("/")[2]])
        handle, self._path = tempfile.mkstemp(dir=flights.folder / RESULTS, prefix=".upload-")
        self._file = os.fdopen(handle, "wb")
        self._digest = hashlib.blake2b(digest_size=16)
        self._size = 0

    def write(self, some: bytes) -> None:
        """Take some bytes."""
        self._size += len(some)
        if self._size > self._flights.most_bytes:
            raise TooLarge(f"{self._name}: larger than {self._flights.most_bytes / 1e6:.0f} MB, which this page takes")
        try:
            self._file.write(some)
        except OSError as error:
            raise TooLarge(f"{self._name}: there is no room for it on the disk ({error.strerror})") from None
        self._digest.update(some)

    def finish(self) -> Flight:
        """All have come: the log goes into the folder, and is judged when its turn comes."""
        self._file.close()
        path, flight_id = Path(self._path), self._digest.hexdigest()
        known = self._flights.get(flight_id)
        if known is not None:
            path.unlink()
            return known
        return self._flights.add(self._placed(path), flight_id)

    def abandon(self) -> None:
        """They do not all come."""
        self._file.close()
        Path(self._path).unlink(missing_ok=True)

    def _placed(self, path: Path) -> Path:
        """Under its own name, or with a number if another log has it; never over one that is there."""
        stem, suffix = Path(self._name).stem, Path(self._name).suffix
        path.chmod(0o644)
        number = 1
        while True:
            target = self._flights.folder / (self._name if number == 1 else f"{stem}~{number}{suffix}")
            try:
                target.open("xb").close()
            except FileExistsError:
                number += 1
                continue
            return path.replace(target)

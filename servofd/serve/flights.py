"""The flights of a folder: found there or dropped on the page, judged one after the other by a few processes."""

from __future__ import annotations

import hashlib
import itertools
import json
import multiprocessing
import os
import queue
import re
import secrets
import shutil
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool, ProcessPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

from servofd.aircraft.columns import aircraft_of_columns
from servofd.aircraft.schema import load_aircraft
from servofd.batch.find import META_FILE, find_logs
from servofd.batch.key import Job, content_key
from servofd.batch.local import cores, interrupts_wait, processes
from servofd.core.errors import ConfigError, NoMeasurement
from servofd.core.files import distinct_file_names, make_folder, write_whole
from servofd.outputs.sentence import spoken
from servofd.serve.judge import SUMMARY, TASK, Summary, Task, Verb, do, judge, kept

State = Literal["waiting", "at work", "done"]

RESULTS = "servofd"
"""Folder of results within the folder of logs."""
BIN = "bin"
"""What was thrown away, within the results."""
SHIPPED = ("faser", "bench")
"""Aircraft that come with servofd."""
_TASKS, _CHOICE, _UPLOAD = "tasks", "choice.json", ".upload-"
_ID = re.compile(r"[0-9a-f]{32}")
_KEPT_FREE_BYTES = 200 * 1024 * 1024
"""Room that is left on the disk when a log is taken."""
_DIED = "Could not be judged: its process ended before it was done (out of memory, or stopped)."


class TooLarge(ConfigError):  # noqa: N818 - reads better without "Error"
    """More than this page takes, or than the disk holds."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What a flight is judged with, where it was chosen on the page."""

    aircraft: str = ""
    """Its file in the folder, or the name of one that comes with servofd."""
    columns: Mapping[str, str] = field(default_factory=dict)
    """Of a table, what its columns are (`servofd.aircraft.columns`)."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One log and what became of it so far."""

    id: str
    """Digest of its bytes: a log that is dropped twice is one flight."""
    log: Path
    size_bytes: int
    state: State
    summary: Summary | None = None
    choice: Choice = Choice()

    @property
    def name(self) -> str:
        """Name of the file, without its folders."""
        return self.log.name


_Run = Callable[[Callable[[], object]], Any]
"""Gives what came of a call in another process, or why nothing did."""


class Flights:
    """All flights of a folder and those below, and the processes that judge them; the `with` block ends those.

    What is dropped, of at most `most_bytes`, goes into the folder as well, which is made if it is not there; one worker
    per core if their number is None.
    """

    def __init__(self, folder: Path, job: Job, *, most_bytes: int, workers: int | None = None) -> None:
        self.folder, self.job, self.most_bytes = folder, job, most_bytes
        make_folder(folder / RESULTS)
        write_whole(folder / RESULTS / META_FILE, b"{}\n")  # no logs are looked for in there
        for left in (folder / RESULTS).glob(f"{_UPLOAD}*"):  # by a server that was killed
            left.unlink(missing_ok=True)
        self._flights: dict[str, Flight] = {}
        self._tasks: dict[str, Task] = {}
        self._ended = False
        self._lock = threading.Lock()
        self._waiting: queue.SimpleQueue[Callable[[_Run], object] | None] = queue.SimpleQueue()
        self._workers = [threading.Thread(target=self._work, daemon=True) for _ in range(workers or cores())]
        self._finder = threading.Thread(target=self._find, daemon=True)

    def __enter__(self) -> Self:
        for thread in (self._finder, *self._workers):
            thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._ended = True
        for _ in self._workers:
            self._waiting.put(None)
        for process in multiprocessing.active_children():
            process.terminate()
        for thread in self._workers:
            thread.join()

    def all(self) -> list[Flight]:
        """Every flight: what is not done, then by the date of the flight, the latest first, then those without one."""
        with self._lock:
            flights = list(reversed(self._flights.values()))
        dated = sorted(flights, key=lambda one: (one.summary and one.summary.start_utc) or "", reverse=True)
        return sorted(dated, key=lambda one: one.state == "done")

    def get(self, flight_id: str) -> Flight | None:
        """A flight by its digest."""
        with self._lock:
            return self._flights.get(flight_id)

    def results(self, flight_id: str) -> Path:
        """Folder of its results."""
        if not _ID.fullmatch(flight_id):
            raise ConfigError("no such flight or task")
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
        choice = kept(Choice, self.results(flight_id) / _CHOICE) or Choice()  # what was chosen before
        summary, key = kept(Summary, self.results(flight_id) / SUMMARY), ""
        with suppress(ConfigError):
            key = self.job_of(choice).key
        if summary is not None and summary.key != key:
            summary = None
        with self._lock:
            known = self._flights.get(flight_id)
            if known is not None:
                return known
            flight = Flight(flight_id, log, log.stat().st_size, "done" if summary else "waiting", summary, choice)
            self._flights[flight_id] = flight
        if flight.state == "waiting":
            self._waiting.put(partial(self._judging, flight_id))
        return flight

    def choose(self, flight_id: str, choice: Choice) -> None:
        """Judge a flight again, with what was chosen; raises `ConfigError` if it is gone or is being judged as well."""
        self.job_of(choice)
        with self._lock:
            flight = self._flights.get(flight_id)
            if flight is None:
                raise ConfigError("it is gone")
            if flight.state == "at work":
                raise ConfigError("this flight is being judged; choose again when it is done")
            self._flights[flight_id] = replace(flight, state="waiting", summary=None, choice=choice)
        make_folder(self.results(flight_id))
        write_whole(self.results(flight_id) / _CHOICE, json.dumps(asdict(choice)).encode())
        if flight.state == "done":
            self._waiting.put(partial(self._judging, flight_id))

    def remove(self, flight_id: str) -> str:
        """Move the log of a flight to the bin; gives what to say of it."""
        with self._lock:
            flight = self._flights.get(flight_id)
            if flight is not None and flight.state != "at work":
                del self._flights[flight_id]
        if flight is None:
            return "This flight is gone already."
        if flight.state == "at work":
            return f"{flight.name} is being judged; delete it when it is done."
        make_folder(self.folder / RESULTS / BIN)
        with suppress(FileNotFoundError):  # it was taken away by hand
            _moved(flight.log, self.folder / RESULTS / BIN, flight.name)
        return f"{flight.name} is in the bin (the folder {RESULTS}/{BIN})."

    def restore(self, flight_id: str) -> str:
        """Take the log of a flight out of the bin again; gives what to say of it."""
        for path in (self.folder / RESULTS / BIN).glob("*"):
            if content_key(str(path)) == flight_id:
                return f"{self.add(_moved(path, self.folder, path.name), flight_id).name} is in the list again."
        return "It is not in the bin any more." if self.get(flight_id) is None else "This flight is in the list."

    def aircraft(self) -> list[str]:
        """Aircraft files of the folder, and those that come with servofd."""
        return [*sorted(path.name for path in self.folder.glob("*.toml") if path.is_file()), *SHIPPED]

    def job_of(self, choice: Choice) -> Job:
        """What to judge with, as it was chosen; raises `ConfigError` if it is not there, or makes no sense."""
        if choice.columns:
            return replace(self.job, aircraft=aircraft_of_columns(choice.columns))
        if not choice.aircraft:
            return self.job
        if choice.aircraft not in self.aircraft():
            raise ConfigError(f"{choice.aircraft}: there is no such aircraft file in the folder")
        source = choice.aircraft if choice.aircraft in SHIPPED else self.folder / choice.aircraft
        try:
            return replace(self.job, aircraft=load_aircraft(source))
        except ConfigError as error:
            raise ConfigError(str(error).replace(f"{self.folder}{os.sep}", "")) from None

    def tasks(self) -> list[Task]:
        """What was done at a click, the latest first."""
        with self._lock:
            return list(reversed(self._tasks.values()))

    def task(self, task_id: str) -> Task | None:
        """One of them."""
        with self._lock:
            return self._tasks.get(task_id)

    def task_folder(self, task_id: str) -> Path:
        """Folder of its results."""
        return self.results(task_id).parent / _TASKS / task_id

    def begin(self, verb: Verb, flights: Sequence[Flight], *, aircraft: str = "", surface: str = "") -> Task:
        """Calibrate from flights, follow them, or explain a surface of one; raises what `job_of` does."""
        choice = Choice(aircraft) if aircraft else flights[0].choice
        known = self.job_of(choice).aircraft
        names = ", ".join(one.name for one in flights)
        titles = {"calibrate": f"Calibration from {names}", "trend": f"Trend of {names}"}
        title = titles.get(verb, f"Explanation of {spoken(surface)}, {names}")
        task = Task(secrets.token_hex(16), verb, title, flights=tuple(one.id for one in flights))
        stem, output = Path(aircraft).stem or "aircraft", ""
        if verb == "calibrate":  # an aircraft file that is not there yet
            every = (self.folder / f"{stem}-{number}.toml" for number in itertools.count(1))
            output = str(next(path for path in every if not path.exists()))
        logs = [str(one.log) for one in flights]
        call = partial(do, task, str(self.task_folder(task.id)), logs, known, surface, output)
        self._set_task(task)
        self._waiting.put(partial(self._doing, task, call))
        return task

    def _doing(self, task: Task, call: Callable[[], object], run: _Run) -> object:
        self._set_task(replace(task, state="at work"))
        done = run(call)
        failed = replace(task, state="done", status="unknown", sentence=str(done))
        self._set_task(done if isinstance(done, Task) else failed)
        return done

    def _set_task(self, task: Task) -> None:
        with self._lock:
            self._tasks[task.id] = task

    def _find(self) -> None:
        """Logs that lie in the folder already, and what was dropped before and is no log."""
        found: list[str] = []
        with suppress(ConfigError):  # there are none
            found = [source.path for source in find_logs([str(self.folder)]).logs]
        others = [path for path in self.folder.iterdir() if path.is_file()]
        for path in (*map(Path, found), *others):
            try:
                flight_id = content_key(str(path))
                if str(path) in found or (self.results(flight_id).is_dir() and self.get(flight_id) is None):
                    self.add(path, flight_id)
            except OSError:  # gone, or not to be read
                continue
        tasks = [kept(Task, path) for path in (self.folder / RESULTS / _TASKS).glob(f"*/{TASK}")]
        with self._lock:
            self._tasks = {task.id: task for task in tasks if task is not None} | self._tasks

    def _judging(self, flight_id: str, run: _Run) -> object:
        flight = self.get(flight_id)
        if flight is None or flight.state != "waiting":
            return None
        self._set(flight_id, "at work", None)
        try:
            found = run(partial(judge, str(flight.log), str(self.results(flight_id)), self.job_of(flight.choice)))
        except ConfigError as error:
            found = f"Could not be judged: {error}."
        self._set(flight_id, "done", Summary("unknown", found) if isinstance(found, str) else found)
        return found

    def _work(self) -> None:
        """Do what waits, in a process that is replaced if it dies; a flight that it dies of says so."""
        while True:
            with processes(1) as pool:
                while (work := self._waiting.get()) is not None and not self._ended:
                    if work(partial(self._run, pool)) == _DIED:
                        break
                else:
                    return

    def _run(self, pool: ProcessPoolExecutor, call: Callable[[], object]) -> object:
        try:
            with interrupts_wait():
                future = pool.submit(call)
            return future.result()
        except BrokenProcessPool:
            return _DIED
        except Exception as error:
            return f"Could not be judged: {str(error).replace(f'{self.folder}{os.sep}', '')}"

    def _set(self, flight_id: str, state: State, summary: Summary | None) -> None:
        with self._lock:
            flight = self._flights[flight_id]
            self._flights[flight_id] = replace(flight, state=state, summary=summary)


def _moved(path: Path, folder: Path, name: str) -> Path:
    """Move a file under its name, or with a number if another has it; never over one that is there."""
    stem, suffix = Path(name).stem, Path(name).suffix
    others = (folder / f"{stem}~{number}{suffix}" for number in itertools.count(2))
    for target in itertools.chain([folder / name], others):
        with suppress(FileExistsError):
            target.open("xb").close()
            break
    try:
        return path.replace(target)
    except BaseException:
        target.unlink()
        raise


class Upload:
    """The bytes of a log as they come; nothing of it is left if they do not all come."""

    def __init__(self, flights: Flights, name: str) -> None:
        self._flights, self.given = flights, name
        (self._name,) = distinct_file_names([name.replace("\\", "/").rpartition("/")[2]])
        handle, self._path = tempfile.mkstemp(dir=flights.folder / RESULTS, prefix=_UPLOAD)
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
            raise self._no_room(error) from None
        self._digest.update(some)

    def finish(self) -> tuple[Flight | None, str]:
        """All have come: the log goes into the folder, and is judged when its turn comes.

        Gives its flight, or None for an aircraft file, and what to say of it: nothing of a new flight.
        """
        try:
            self._file.close()
            path, flight_id = Path(self._path), self._digest.hexdigest()
            known = self._flights.get(flight_id)
            if known is None:
                return self._placed(path, flight_id)
            path.unlink()
        except OSError as error:
            raise self._no_room(error) from None
        return self._already(known)

    def abandon(self) -> None:
        """They do not all come."""
        with suppress(OSError):
            self._file.close()
        Path(self._path).unlink(missing_ok=True)

    def _placed(self, path: Path, flight_id: str) -> tuple[Flight | None, str]:
        """In the folder, as a flight or as an aircraft file."""
        path.chmod(0o644)
        named = self._name == self.given
        if self._name.endswith(".toml"):
            with suppress(ConfigError, NoMeasurement):
                load_aircraft(path.rename(path.with_suffix(".toml")))
                target = _moved(path.with_suffix(".toml"), self._flights.folder, self._name)
                return None, f"{target.name} is an aircraft file: choose it on the page of a flight."
            path = path.with_suffix(".toml")
        make_folder(self._flights.results(flight_id))  # by which a server that begins again knows that it was dropped
        target = _moved(path, self._flights.folder, self._name)
        flight = self._flights.add(target, flight_id)
        if flight.log != target:  # the same bytes came twice at once
            target.unlink()
            return self._already(flight)
        return flight, "" if named and target.name == self._name else f"{self.given} is kept as {target.name}."

    def _already(self, known: Flight) -> tuple[Flight, str]:
        same = "is" if known.name == self._name else f"holds the same bytes as {known.name}, which is"
        return known, f"{self.given} {same} here already."

    def _no_room(self, error: OSError) -> TooLarge:
        return TooLarge(f"{self._name}: there is no room for it on the disk ({error.strerror})")

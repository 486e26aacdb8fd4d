"""One batch of broken inputs for one door, in a process of its own; `fuzz` starts it and reads what it leaves.

What the process dies of can still be read from ``current``, which holds the input that is being worked on.
"""

from __future__ import annotations

import collections
import faulthandler
import gc
import hashlib
import json
import mmap
import os
import random
import signal
import sys
import time
import traceback
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import TYPE_CHECKING, Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.fuzz.doors import DOORS, entered  # noqa: E402 - its folder must be known
from tests.fuzz.mutate import mutant  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.fuzz.doors import Door

LONGEST = 300_000
"""Bytes of an input; more are cut off."""
LIMIT_S = 30.0
"""A small input that takes more processor time hangs: most take milliseconds, and what is compiled a few seconds."""
SLOW_S = 5.0
"""One that takes so long is kept, to be looked at."""
TRACED = 25
"""One input in so many is followed line by line; those that reach new lines join the corpus."""
MOST_CORPUS, LARGEST_KEPT = 400, 60_000
_PACKAGES = tuple(str(ROOT / name) + os.sep for name in ("servofd", "logparsers"))


class Lines:
    """Which lines of the package have been reached."""

    def __init__(self) -> None:
        self._seen: dict[CodeType, set[int]] = {}
        self.found = 0

    def follow(self, work: Callable[[], str]) -> str:
        """Do the work and note new lines in `found`."""
        self.found = 0
        sys.settrace(self._called)
        try:
            return work()
        finally:
            sys.settrace(None)

    def _called(self, frame: FrameType, _event: str, _argument: object) -> Any:  # noqa: ANN401 - what settrace takes
        code = frame.f_code
        if not code.co_filename.startswith(_PACKAGES):
            return None
        seen = self._seen.setdefault(code, set())

        def line(frame: FrameType, event: str, _argument: object) -> Any:  # noqa: ANN401
            if event == "line" and frame.f_lineno not in seen:
                seen.add(frame.f_lineno)
                self.found += 1
            return line

        return line


@dataclass
class Batch:
    """What became of the inputs of one batch."""

    done: int = 0
    outcomes: collections.Counter[str] = field(default_factory=collections.Counter)
    failures: collections.Counter[str] = field(default_factory=collections.Counter)
    longest_s: float = 0.0
    grown_by: int = 0
    before: dict[str, int] = field(default_factory=dict)
    after: dict[str, int] = field(default_factory=dict)
    cpu_s: float = 0.0


def held() -> dict[str, int]:
    """Files, threads and memory [kB] that the process holds."""
    gc.collect()
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024
    return {
        "files": len(os.listdir("/proc/self/fd")) - 1,  # noqa: PTH208 - without the one that this opens
        "threads": len(os.listdir("/proc/self/task")),  # noqa: PTH208
        "resident_kb": resident,
    }


def place(error: BaseException) -> str:
    """Kind of an error and the innermost line of the package that it came through."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if frame.filename.startswith(_PACKAGES)] or frames
    where = f"{Path(ours[-1].filename).relative_to(ROOT)}:{ours[-1].lineno}" if ours else "?"
    return f"{type(error).__name__} at {where}"


def keep(folder: Path, content: bytes, note: str = "") -> None:
    """Store an input under the digest of its bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    name = hashlib.blake2b(content, digest_size=8).hexdigest()
    (folder / name).write_bytes(content)
    if note:
        (folder / f"{name}.txt").write_text(note, errors="backslashreplace")


def run(door: Door, batch: Batch, rng: random.Random, count: int, out: Path) -> None:
    """Break, let in, count."""
    os.chdir(out / "work")
    own = door.seeds(Path())
    kept = sorted((out / "corpus").glob("*"))
    corpus = [*own, *(path.read_bytes() for path in kept)]
    with (out / "current").open("w+b") as file:
        file.truncate(8 + LONGEST)
        current, lines = mmap.mmap(file.fileno(), 0), Lines()
    for content in own:  # sound ones first: they compile, and what they reach is not new
        lines.follow(lambda content=content: entered(door, content, Path()))  # type: ignore[misc]
    for number in range(count):
        if number == count // 2:  # compilers and caches are warm
            batch.before = held()
        content = mutant(rng, own if rng.random() < 0.4 else corpus, door.shape)[:LONGEST]
        current[: 8 + len(content)] = len(content).to_bytes(8, "little") + content
        signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
        begun = time.process_time()
        try:
            if number % TRACED:
                became = entered(door, content, Path())
            else:
                became = lines.follow(lambda content=content: entered(door, content, Path()))  # type: ignore[misc]
                if lines.found and len(corpus) < MOST_CORPUS and len(content) <= LARGEST_KEPT:
                    corpus.append(content)
                    keep(out / "corpus", content)
                    batch.grown_by += 1
        except Exception as error:  # the campaign goes on: what broke is told at its end
            became = place(error)
            batch.failures[became] += 1
            if batch.failures[became] <= 2:
                keep(out / "failures", content, "".join(traceback.format_exception(error)))
        if number % TRACED:
            took_s = time.process_time() - begun
            batch.longest_s = max(batch.longest_s, took_s)
            if took_s > SLOW_S:
                keep(out / "slow", content, f"{took_s:.1f} s")
        batch.outcomes[became] += 1
        batch.done += 1
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    batch.after = held()


def main(name: str, seed: str, number: str, count: str, folder: str) -> None:
    out = Path(folder).resolve()
    (out / "work").mkdir(parents=True, exist_ok=True)
    faulthandler.enable()
    faulthandler.register(signal.SIGPROF, chain=True)  # shows where it hangs, then lets it end
    warnings.simplefilter("error")
    batch = Batch()
    run(DOORS[name], batch, random.Random(f"{seed} {name} {number}"), int(count), out)  # noqa: S311 - a seed
    batch.cpu_s = sum(os.times()[:4])  # with the processes that it started
    (out / "batch.json").write_text(json.dumps(vars(batch)))


if __name__ == "__main__":
    main(*sys.argv[1:])

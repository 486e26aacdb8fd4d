"""Broken inputs for every door, by the hundred thousand, with counts.

``python benchmarks/fuzz.py [DOOR ...] [--count N] [--seed S] [--minutes M] [--out DIR]``; the same call again goes on
where it was. Every input must end in a result or in one line of refusal. Each batch runs in a process of its own, so
that one that crashes or hangs is counted and the input kept; within a batch open files and memory must not grow.
``DIR/DOOR/failures`` holds what broke, with its traceback; ``--replay FILE`` lets one input in again, without a net.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fuzz_child
from fuzz_child import keep

from tests.fuzz.doors import DOORS, Door, entered

PATIENCE_S = 7200
"""For a whole batch that waits for something; what computes too long is ended from inside."""
MOST_LOST = 20
LEAK_KB = 100_000
"""Growth of a batch that is more than what allocators keep for later."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@dataclass
class Tally:
    """What one door has withstood."""

    door: str
    done: int = 0
    batches: int = 0
    lost: int = 0
    """Batches whose process died: their inputs are not counted."""
    cpu_s: float = 0.0
    longest_s: float = 0.0
    corpus: int = 0
    outcomes: collections.Counter[str] = field(default_factory=collections.Counter)
    failures: collections.Counter[str] = field(default_factory=collections.Counter)
    files: int = 0
    threads: int = 0
    resident_kb: int = 0
    """Largest growth in the second half of a batch."""

    @classmethod
    def of(cls, path: Path, door: str) -> Tally:
        """As an earlier call left it."""
        if not path.exists():
            return cls(door)
        known = json.loads(path.read_text())
        counts = {name: collections.Counter(known[name]) for name in ("outcomes", "failures")}
        return cls(**(known | counts))

    def add(self, batch: dict[str, Any]) -> None:
        """Count one batch."""
        self.done += batch["done"]
        self.cpu_s += batch["cpu_s"]
        self.longest_s = max(self.longest_s, batch["longest_s"])
        self.corpus += batch["grown_by"]
        self.outcomes.update(batch["outcomes"])
        self.failures.update(batch["failures"])
        for name in ("files", "threads", "resident_kb"):
            grown = batch["after"][name] - batch["before"][name]
            setattr(self, name, max(getattr(self, name), grown))
        if batch["after"]["files"] > batch["before"]["files"]:
            self.failures["open files left behind"] += 1
        if batch["after"]["resident_kb"] - batch["before"]["resident_kb"] > LEAK_KB:
            self.failures["memory left behind"] += 1

    def line(self) -> str:
        """For a person."""
        per_ms = 1e3 * self.cpu_s / max(self.done, 1)
        return (
            f"{self.door:<15}{self.done:>8} inputs {len(self.failures):>3} kinds of failure  {per_ms:7.2f} ms each, "
            f"longest {self.longest_s:5.2f} s, corpus {self.corpus:+d}, files {self.files:+d}, "
            f"threads {self.threads:+d}, memory {self.resident_kb / 1024:+.1f} MB  "
            + ", ".join(f"{name} {number}" for name, number in self.outcomes.most_common(6))
        )


def batch_of(tally: Tally, seed: int, count: int, out: Path) -> None:
    """Run one batch; what its process dies of is a failure, too."""
    number, tally.batches = tally.batches, tally.batches + 1
    (out / "batch.json").unlink(missing_ok=True)
    (out / "current").unlink(missing_ok=True)
    command = [sys.executable, fuzz_child.__file__, tally.door, str(seed), str(number), str(count), str(out)]
    with tempfile.TemporaryFile("w+") as said:
        try:
            code = subprocess.run(
                command,
                stdout=subprocess.DEVNULL,
                stderr=said,
                env=os.environ | _ONE_THREAD,
                timeout=PATIENCE_S,
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            code = None
        said.seek(0)
        words = said.read()
    if code == 0:
        tally.add(json.loads((out / "batch.json").read_text()))
        return
    hung = code in (-signal.SIGPROF, None)
    kind = "a hang" if hung else f"a crash (exit code {code})"
    tally.failures[kind] += 1
    tally.lost += 1
    current = out / "current"
    if current.exists():
        content = current.read_bytes()
        keep(out / "failures", content[8 : 8 + int.from_bytes(content[:8], "little")], f"{kind}\n{words}")


def campaign(tally: Tally, options: argparse.Namespace) -> None:
    """One batch more of a door, unless it has had enough."""
    out = Path(options.out, tally.door).resolve()
    count = min(options.batch, options.count - tally.done)
    if count <= 0 or tally.lost > MOST_LOST:
        return
    out.mkdir(parents=True, exist_ok=True)
    batch_of(tally, options.seed, count, out)
    (out / "tally.json").write_text(json.dumps(vars(tally), indent=2) + "\n")


def replayed(door: Door, file: str) -> str:
    """Let one input in again; names what became of it."""
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        door.seeds(Path())
        return entered(door, Path(file).read_bytes(), Path())


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("doors", nargs="*", metavar="DOOR", help=", ".join(DOORS))
    parser.add_argument(
        "--count", type=int, default=10_000, help="inputs for each door, those of earlier calls included"
    )
    parser.add_argument("--batch", type=int, default=10_000, help="inputs of one process")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="after which no batch is begun")
    parser.add_argument("--out", default="fuzz_found", help="folder for counts, corpus, and what broke")
    parser.add_argument("--replay", metavar="FILE", type=os.path.abspath, help="let this one in again")
    options = parser.parse_args()
    unknown = set(options.doors) - set(DOORS)
    if unknown or (options.replay and len(options.doors) != 1):
        parser.error(f"which door? {', '.join(DOORS)}")
    return options


def main() -> None:
    options = arguments()
    if options.replay:
        print(replayed(DOORS[options.doors[0]], options.replay))
        return
    tallies = [Tally.of(Path(options.out, name, "tally.json"), name) for name in options.doors or DOORS]
    begun, before = time.monotonic(), -1
    while time.monotonic() - begun < 60.0 * options.minutes and sum(t.batches for t in tallies) > before:
        before = sum(t.batches for t in tallies)
        for tally in tallies:  # in turn, so that each has had some when time is over
            if time.monotonic() - begun < 60.0 * options.minutes:
                campaign(tally, options)
    for tally in tallies:
        print(tally.line())
        for kind, times in tally.failures.most_common():
            print(f"    {times:>6} x {kind}")
    sys.exit(any(tally.failures for tally in tallies))


if __name__ == "__main__":
    main()

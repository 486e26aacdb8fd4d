"""What currents tell: motors that block, bind or lose their power, hours of good ones, a ball screw that wears, cost.

Each part prints rows of one table; seeds are those of the motors of `tests/current/motor.py`, which share no code with
the model that judges them, and have more physics::

    python benchmarks/currents.py hub --first 1 --step 2        # odd seeds: faults found in time, by rate and fault
    python benchmarks/currents.py good --first 1 --step 2       # hours of good servos, none calibrated, and calibrated
    python benchmarks/currents.py wire --first 1 --step 2       # one current of three servos
    python benchmarks/currents.py screw FOLDER                  # cycles of the tables ram_STATE_LOAD.csv.gz
    python benchmarks/currents.py cost                          # processor time with currents over that without
"""

from __future__ import annotations

import argparse
import resource
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
import pandas as pd

import servofd
from servofd.aircraft.schema import load_aircraft
from servofd.batch.key import Job
from servofd.jobs.workflow import audit
from servofd.simulation.commands import gusty
from tests.current.motor import Flown, Sensor, fly
from tests.current.test_shared import NAMES, PLANE, bench

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

Found = TypeVar("Found")

START_S: Final = 100.0
"""Onset of the faults of `hub` [s]; those of `wire` begin at 120 s."""
RATES_HZ: Final = (1.0, 5.0, 10.0, 50.0)
IN_TIME_S: Final = {1.0: 20.0}
"""Delay that counts as in time by the rate of the current; 5 s at all others, 30 s for what binds [s]."""
FAULTS: Final = ("blocked", "unpowered", "binding")
"""The last is looked for where good flights are known."""
TRIALS, CYCLES = 5, 5
"""Healthy trials of the ball screw, and cycles of each, in the order of the runs."""


def table_of(flown: Flown, **extra: bool) -> pd.DataFrame:
    """A flight as a table, with rows of commands and rows of currents."""
    asked = pd.DataFrame({"time_s": flown.command_s, "aileron_cmd_deg": flown.command_deg})
    read = {"time_s": flown.current_s, "aileron_current_a": flown.current_a}
    if extra.get("position"):
        read["aileron_pos_deg"] = flown.position_deg
    return pd.concat([asked, pd.DataFrame(read)]).sort_values("time_s", kind="stable")


def averages(seed: int) -> bool:
    """Whether the hub of a seed reports means since its last report: every second pair of seeds does."""
    return bool(seed // 2 % 2)


def flight(seed: int, rate_hz: float, fault: str = "", seconds: float = 180.0) -> Flown:
    """One servo of an aircraft in gusts."""
    command_deg = gusty(np.arange(0.0, seconds, 0.04), np.random.default_rng([seed, 7]))
    sensor = Sensor(rate_hz, averages=averages(seed))
    return fly(seconds, seed, sensor=sensor, fault=fault, start_s=START_S, command_deg=command_deg)


def calibrated(folder: Path) -> dict[tuple[float, bool], Path]:
    """The aircraft of three good flights by rate and hub, of seeds that no other part uses."""
    found = {}
    for rate_hz in RATES_HZ:
        for mean in (False, True):
            goods = [table_of(flight(90_000 + 4 * k + 2 * mean, rate_hz, seconds=300.0)) for k in range(3)]
            name = folder / f"plane{rate_hz:g}{mean}.toml"
            found[rate_hz, mean] = servofd.calibrate(goods).save(name)
    return found


def _hub(task: tuple[int, float, str, Path | None]) -> tuple[float, str, bool, bool, bool]:
    seed, rate_hz, fault, plane = task
    found = servofd.audit(table_of(flight(seed, rate_hz, fault)), plane)["aileron"]
    first = found.faults[0] if found.faults else None
    late_s = np.inf if first is None else first.alarm_s - START_S
    in_time = first is not None and -1.0 <= late_s <= (30.0 if fault == "binding" else IN_TIME_S.get(rate_hz, 5.0))
    return rate_hz, fault, first is not None and late_s >= -1.0, in_time, first is not None and first.kind == fault


def hub(seeds: range, folder: Path) -> Iterator[str]:
    """Faults found, found in time, and named right."""
    planes = calibrated(folder)
    for known in (False, True):
        tasks = [
            (s, hz, f, planes[hz, averages(s)] if known else None)
            for hz in RATES_HZ
            for f in FAULTS[: 2 + known]
            for s in seeds
        ]
        counts: dict[tuple[float, str], Counter[str]] = {}
        for rate_hz, fault, *got in _parallel(_hub, tasks):
            each = counts.setdefault((rate_hz, fault), Counter())
            each.update(of=1, found=got[0], in_time=got[1], named=got[2])
        for (rate_hz, fault), n in counts.items():
            yield (
                f"{'calibrated' if known else 'nothing calibrated':18} {rate_hz:4g} Hz {fault:9}: "
                f"found {n['found']}, in time {n['in_time']}, named {n['named']} of {n['of']}"
            )


def _good(task: tuple[int, float, Path | None]) -> tuple[float, str, list[str]]:
    seed, rate_hz, plane = task
    found = servofd.audit(table_of(flight(seed, rate_hz, seconds=600.0)), plane)["aileron"]
    return rate_hz, found.status, [f"{one.kind} ({one.level}, seed {seed})" for one in found.faults + found.suspicions]


def good(seeds: range, folder: Path) -> Iterator[str]:
    """Verdicts on good servos, flights of ten minutes."""
    planes = calibrated(folder)
    for known in (False, True):
        tasks = [(seed, hz, planes[hz, averages(seed)] if known else None) for hz in RATES_HZ for seed in seeds]
        verdicts: dict[float, Counter[str]] = {}
        said: list[str] = []
        for rate_hz, status, kinds in _parallel(_good, tasks):
            verdicts.setdefault(rate_hz, Counter())[status] += 1
            said += [f"{rate_hz:g} Hz {kind}" for kind in kinds]
        for rate_hz, n in verdicts.items():
            hours = n.total() / 6.0
            yield f"{'calibrated' if known else 'nothing calibrated':18} {rate_hz:4g} Hz good, {hours:.1f} h: {dict(n)}"
        yield f"  raised: {said or 'nothing'}"


def _wire(task: tuple[int, str, tuple[str, ...], Path]) -> tuple[str, tuple[str, ...], str]:
    seed, fault, lost, plane = task
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.csv"
        path.write_text(bench(seed, fault, lost))
        found = servofd.audit(path, plane)
    at_fault = {s.surface for s in found.surfaces if s.faults}
    if not fault:
        return fault, lost, "nothing" if not at_fault else "false"
    may_be = set(NAMES[:2]) if lost == NAMES[:1] else set(lost)
    return fault, lost, "exact" if at_fault == may_be else "missed" if not at_fault else "other"


def wire(seeds: range, folder: Path) -> Iterator[str]:
    """Whose an event is on one wire: the elevator alone, one of two ailerons of one command, or all."""
    (folder / "draft.toml").write_text(PLANE)
    goods = [folder / f"good{k}.csv" for k in range(4)]
    for k, each in enumerate(goods):
        each.write_text(bench(90_070 + k))
    plane = servofd.calibrate(goods, folder / "draft.toml").save(folder / "plane.toml")
    cases = [("", ()), *((f, (n,)) for f in ("blocked", "unpowered", "binding") for n in ("elevator", "aileron_left"))]
    tasks = [(s, f, lost, plane) for f, lost in [*cases, ("unpowered", NAMES)] for s in seeds]
    counts: dict[tuple[str, tuple[str, ...]], Counter[str]] = {}
    for kind, of, how in _parallel(_wire, tasks):
        counts.setdefault((kind, of), Counter())[how] += 1
    for (fault, lost), n in counts.items():
        yield f"one wire of three, {fault or 'good':9} {', '.join(lost):13}: {dict(n)} of {n.total()}"


def _screw(task: tuple[Path, str, int | None]) -> tuple[str, int | None, Counter[str]]:
    folder, load, trial = task
    good_log, states = folder / f"ram_normal_{load}.csv.gz", sorted(folder.glob(f"ram_*_{load}.csv.gz"))
    rows = pd.read_csv(good_log).drop(columns="ram_pos_deg")
    out = rows["run"] // CYCLES == (TRIALS - 1 if trial is None else trial)
    plane = load_aircraft(servofd.calibrate(rows[~out]).save(Path(tempfile.mkdtemp()) / "plane.toml"))
    counts: Counter[str] = Counter()
    logs = {"normal": rows[out]}
    if trial is None:
        logs = {
            one.name.split("_")[1]: pd.read_csv(one).drop(columns="ram_pos_deg") for one in states if one != good_log
        }
    for state, log in logs.items():
        for result in audit(log, Job(plane)):
            (surface,) = result.surfaces
            counts[f"{state} cycles"] += 1
            counts[f"{state} flagged"] += bool(surface.faults or surface.suspicions)
    return load, trial, counts


def screw(folder: Path) -> Iterator[str]:
    """Cycles of a ball screw that are flagged, each load by itself: healthy ones of the trial that was left out."""
    loads = ("20kg", "40kg", "-40kg")
    tasks = [(folder, load, trial) for load in loads for trial in (*range(TRIALS), None)]
    done = list(_parallel(_screw, tasks))
    for load in loads:
        healthy = [n for at, trial, n in done if at == load and trial is not None]
        flagged = [n["normal flagged"] for n in healthy]
        cycles = sum(n["normal cycles"] for n in healthy)
        yield f"ball screw {load:>5} healthy: {sum(flagged)} of {cycles} cycles flagged, by trial {flagged}"
        (ill,) = (n for at, trial, n in done if at == load and trial is None)
        for state in dict.fromkeys(key.split()[0] for key in ill):
            found, of = ill[f"{state} flagged"], ill[f"{state} cycles"]
            yield f"ball screw {load:>5} {state:16}: {found} of {of} cycles flagged"


def cost(folder: Path) -> Iterator[str]:
    """User time of an audit of three surfaces of three minutes with currents over that without, in pairs."""
    for rate_hz in (10.0, 50.0):
        tables = []
        for k, name in enumerate(("aileron", "elevator", "rudder")):
            table = table_of(flight(91_000 + k, rate_hz), position=True)
            tables.append(table.rename(columns={each: str(each).replace("aileron", name) for each in table}))
        both = pd.concat(tables).sort_values("time_s", kind="stable")
        without = both.drop(columns=[name for name in both if str(name).endswith("_current_a")])
        paths = folder / "with.csv", folder / "without.csv"
        for path, rows in zip(paths, (both, without), strict=True):
            rows.to_csv(path, index=False)
            servofd.audit(path)
        ratios = []
        for _ in range(7):
            spent = []
            for path in paths:
                before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
                servofd.audit(path)
                spent.append(resource.getrusage(resource.RUSAGE_SELF).ru_utime - before)
            ratios.append(spent[0] / spent[1])
        middle, low, high = (float(np.quantile(ratios, q)) for q in (0.5, 0.0, 1.0))
        yield f"cost {rate_hz:g} Hz, three surfaces: {middle:.2f} times [{low:.2f}, {high:.2f}]; with {spent[0]:.2f} s"


def _parallel(work: Callable[[Any], Found], tasks: Sequence[object]) -> Iterator[Found]:
    with ProcessPoolExecutor(2) as pool:
        yield from pool.map(work, tasks, chunksize=2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("hub", "good", "wire", "screw", "cost"))
    parser.add_argument("folder", type=Path, nargs="?", help="of the ball screw's tables")
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--step", type=int, default=2)
    parser.add_argument("--count", type=int, default=10, help="seeds")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.step * options.count, options.step)
    with tempfile.TemporaryDirectory() as made:
        parts = {"hub": hub, "good": good, "wire": wire}
        if options.part in parts:
            rows = parts[options.part](seeds, Path(made))
        else:
            rows = screw(options.folder) if options.part == "screw" else cost(Path(made))
        for row in rows:
            print(row, flush=True)


if __name__ == "__main__":
    main()

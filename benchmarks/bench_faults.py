"""Real servos on the bench that nobody named: no run is at fault, and a jam or an offset after its middle is found.

Each run of 10 s or more of the tables of a folder is judged as it is, with a jam from 55 % of its time on, and with an
offset of a tenth of its travel from there on. An aircraft's servos do not rest for seconds: where the run itself rests
after its middle, the jam begins with the next motion::

    python benchmarks/bench_faults.py FOLDER
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pandas as pd

import servofd

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servofd.core.types import FloatArray

_SHORTEST_S: Final = 10.0
_FROM: Final = 0.55
"""Share of the run after which it is at fault."""
_OFFSET: Final = 0.1
"""Of the travel."""
_MOVES: Final = 0.02
"""Share of the travel by which a command has to change before a jam can show."""


def runs_of(path: Path) -> Iterator[tuple[str, FloatArray, FloatArray, FloatArray]]:
    """Name, times [s], commands [deg] and positions [deg] of each servo in each run of a table."""
    table = pd.read_csv(path)
    time = "time_s" if "time_s" in table else "t_s"
    names = [str(name).removesuffix("_cmd_deg") for name in table if str(name).endswith("_cmd_deg")]
    pairs = {"cmd": "meas"} if "cmd" in table else {f"{name}_cmd_deg": f"{name}_pos_deg" for name in names}
    for run, rows in table.groupby("run") if "run" in table else [("", table)]:
        for command, position in pairs.items():
            known = rows[[time, command, position]].drop_duplicates(time).to_numpy(float)
            if not np.isnan(known[:, 1]).all() and np.ptp(known[:, 0]) >= _SHORTEST_S:
                yield f"{path.stem} {run} {command}", known[:, 0] - known[0, 0], known[:, 1], known[:, 2]


def spoilt(kind: str, time_s: FloatArray, command_deg: FloatArray, position_deg: FloatArray) -> FloatArray:
    """The positions of a servo that jams, or is off by a tenth of its travel, after its middle."""
    travel_deg = float(np.nanmax(position_deg) - np.nanmin(position_deg))
    first = int(np.searchsorted(time_s, _FROM * time_s[-1]))
    if kind == "offset":
        return np.where(np.arange(time_s.size) < first, position_deg, position_deg + _OFFSET * travel_deg)
    asked = np.abs(command_deg[first:] - command_deg[first]) > _MOVES * travel_deg
    first += int(np.argmax(asked))
    return np.where(np.arange(time_s.size) < first, position_deg, position_deg[first])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    tally: dict[str, Counter[str]] = {kind: Counter() for kind in ("as it is", "jam", "offset")}
    for path in sorted(options.folder.glob("*.csv")):
        for name, time_s, command_deg, position_deg in runs_of(path):
            found = {}
            for kind, counts in tally.items():
                reads = position_deg if kind == "as it is" else spoilt(kind, time_s, command_deg, position_deg)
                log = {"time_s": time_s, "servo_cmd_deg": command_deg, "servo_pos_deg": reads}
                (audit,) = servofd.audit(log)
                found[kind] = audit.surfaces[0].status
                counts[found[kind]] += 1
            print(name, found, flush=True)
    for kind, counts in tally.items():
        print(f"{kind:>9}: {sum(counts.values())} runs, {dict(counts)}")


if __name__ == "__main__":
    main()

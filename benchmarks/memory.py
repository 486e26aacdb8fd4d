"""Memory of every reader: the most that it takes beside what it hands over, in sizes of the file.

``python benchmarks/memory.py [--mb MB] [KIND ...]``: each log is made by this script and read in a process of its own
that has read it before: code and its caches do not count. `read` is the peak of reading alone; `all` holds every
channel; `info` looks at every channel and lets it go. Columns of files that are read as a whole, and arrays that are
held, are not counted; pages of the file itself are. None may be above 6.
"""

from __future__ import annotations

import argparse
import gzip
import json
import subprocess
import sys
import tempfile
import zipfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from scipy.io import savemat

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from reading import make_bin, make_tlog, make_ulg
from tests.parsers import dataflash_writer, tlog_writer, writers
from tests.parsers.test_many_names import named_values

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

MOST = 6.0
CHILD = '''
import ctypes
import sys
from pathlib import Path
import logparsers

def status(name):
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return 1024 * int(line.split()[1])

def read(path, mode):
    """Bytes of the arrays that are held."""
    log = logparsers.read_all(path)
    if mode == "read":
        return (log,), 0
    held, sizes = [], {}
    for one in log:
        for name in one.channels:
            channel = one.channels[name]
            if mode == "all":
                held.append(channel)
                for values in (channel.time_s, channel.values):
                    sizes[values.__array_interface__["data"][0]] = values.nbytes
    return (log, held), sum(sizes.values())

path, mode = sys.argv[1:]
read(path, mode)
ctypes.CDLL("").malloc_trim(0)
before = status("VmRSS")
Path("/proc/self/clear_refs").write_text("5")
(log, *kept), held = read(path, mode)
peak = status("VmHWM") - before
if mode != "all" and log[0].format in ("table", "faser"):
    held = sum(one.channels[name].values.nbytes for one in log for name in one.channels)
print(peak - held, held)
'''


def of_size(make: Callable[[int], bytes], path: Path, size: int) -> None:
    """As many rows as give that size."""
    rows = 2000
    rows = int(rows * size / len(make(rows)))
    path.write_bytes(make(rows))


def flight(rows: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    columns = {f"s{n}_{what}_deg": np.round(rng.normal(size=rows), 3) for n in range(6) for what in ("cmd", "pos")}
    return {"time_s": np.round(0.02 * np.arange(rows), 2), **columns}


def table(rows: int, end: str = "\n", sign: str = ",") -> bytes:
    columns = flight(rows)
    cells = (sign.join(f"{cell:.10g}" for cell in row) for row in np.column_stack(list(columns.values())))
    return (sign.join(columns) + end + end.join(cells) + end).encode()


def quoted(rows: int) -> bytes:
    names, *lines = table(rows).decode().splitlines()
    return "\n".join([names, *('"' + line.replace(",", '","') + '"' for line in lines)]).encode()


def digits(rows: int) -> bytes:
    """The least that a cell can be."""
    return b"time_s,a_cmd_deg,a_pos_deg,b\n" + b"".join(b"%d,1,2,3\n" % k for k in range(rows))


def empty(rows: int) -> bytes:
    return b"time_s,a_cmd_deg,a_pos_deg\n" + b"".join(b"%d,,\n" % k for k in range(rows))


def joined(rows: int) -> bytes:
    return b"time_s,run,a_cmd_deg,a_pos_deg\n" + b"".join(b"%d,r%d,1.5,2.5\n" % (k, k // 5000) for k in range(rows))


def header(names: int) -> bytes:
    """Hardly anything but names, as many as there may be."""
    names = min(names, 49_000)
    return b"time_s," + b",".join(b"c%d" % k for k in range(names)) + b"\n0" + b",1" * names + b"\n"


def values(rows: int, names: int = 40) -> bytes:
    rng, out = np.random.default_rng(4), []
    for k in range(rows):
        fields = {"time_boot_ms": 5 * k, "name": f"V{k % names}", "value": float(rng.normal())}
        out.append(
            (1_700_000_000_000_000 + 5000 * k).to_bytes(8, "big")
            + tlog_writer.frame("NAMED_VALUE_FLOAT", fields, sequence=k % 256)
        )
    return b"".join(out)


def mat(rows: int, make: Callable[[int], Mapping[str, object]], *, compressed: bool = False) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.mat")
        savemat(path, dict(make(rows)), do_compression=compressed)
        return path.read_bytes()


def faser(rows: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {"time": 0.02 * np.arange(rows), **{n: rng.normal(size=rows) for n in ("de", "de_pos", "dr", "dr_pos")}}


def hdf5(path: Path, size: int, chunks: bool | None = None) -> None:
    with h5py.File(path, "w") as file:
        for name, column in faser(size // 40).items():
            file.create_dataset(name, data=column, chunks=chunks, compression="gzip" if chunks else None)


def level4(rows: int) -> bytes:
    return writers.level4({name: ("f4", column) for name, column in faser(rows).items()})


def text_log(path: Path, size: int) -> None:
    rows = dataflash_writer.as_text(dataflash_writer.servo_flight(4.0))
    seconds = 4.0 * size / len(rows)
    path.write_bytes(dataflash_writer.as_text(dataflash_writer.servo_flight(seconds)))


def packed(path: Path, size: int, pack: str) -> None:
    """The size is that of what is within."""
    make_bin(path, size)
    content = path.read_bytes()
    if pack == "gz":
        path.write_bytes(gzip.compress(content, 1))
        return
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("flight.bin", content)


def rows_of(make: Callable[[int], bytes]) -> Callable[[Path, int], None]:
    return partial(of_size, make)


MAKERS: dict[str, Callable[[Path, int], None]] = {
    "bin": make_bin,
    "bin.gz": partial(packed, pack="gz"),
    "bin.zip": partial(packed, pack="zip"),
    "log": text_log,
    "old_log": rows_of(dataflash_writer.before_stamps),
    "tlog": make_tlog,
    "named_values": rows_of(values),
    "new_names": rows_of(named_values),
    "ulg": make_ulg,
    "table": rows_of(table),
    "table_crlf": rows_of(partial(table, end="\r\n")),
    "table_semicolon": rows_of(partial(table, sign=";")),
    "table_blanks": rows_of(partial(table, sign="   ")),
    "table_quoted": rows_of(quoted),
    "table_runs": rows_of(joined),
    "table_digits": rows_of(digits),
    "table_empty": rows_of(empty),
    "table_header": rows_of(header),
    "level4": rows_of(level4),
    "level5": rows_of(partial(mat, make=faser)),
    "level5_packed": rows_of(partial(mat, make=faser, compressed=True)),
    "hdf5": hdf5,
    "hdf5_packed": partial(hdf5, chunks=True),
}


def peak(path: Path, mode: str) -> tuple[float, float]:
    """Most that was taken beside what is held, and that [bytes]."""
    words = [sys.executable, "-c", CHILD, str(path), mode]
    said = subprocess.run(words, capture_output=True, text=True, check=False)
    if said.returncode:
        raise RuntimeError(said.stderr[-2000:])
    most, held = map(int, said.stdout.split())
    return most, held


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(MAKERS))
    parser.add_argument("--mb", type=float, default=30.0, help="size of each log")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = {}
    print("kind                 size [MB]  read   all  info  held")
    with tempfile.TemporaryDirectory() as folder:
        for kind in options.kinds or MAKERS:
            path = Path(folder, "log")
            MAKERS[kind](path, int(1e6 * options.mb))
            size = path.stat().st_size
            taken = {}
            for mode in ("read", "all", "info"):
                most, held = peak(path, mode)
                taken[mode] = most / size
                if mode == "all":
                    taken["held"] = held / size
            found[kind] = taken
            row = "  ".join(f"{taken[mode]:4.1f}" for mode in ("read", "all", "info", "held"))
            worst = max(taken[mode] for mode in ("read", "all", "info"))
            print(f"{kind:20} {size / 1e6:9.1f}  {row}{'  over' if worst > MOST else ''}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()

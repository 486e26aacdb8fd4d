"""Time the DataFlash reader against pymavlink, and against just reading the file's bytes.

Makes its own logs: a fixed wing with six feedback servos, 90 minutes, with and without a GPS message.
pymavlink is timed on the first 12 MB of the same log and scaled by the number of rows (its cost per row is
constant; its indexing is scaled by bytes). All ratios are of the same run; run it on an idle machine::

    python benchmarks/dataflash.py [--minutes 90]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pymavlink import DFReader

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from logparsers.dataflash import open_dataflash
from logparsers.dataflash.encode import Message, encode

if TYPE_CHECKING:
    from collections.abc import Callable

WANTED = ("RCOU", "CSRV", "AETR", "ARSP")
PREFIX = 12_000_000
MEGABYTE = 1e6


def clock_us(minutes: float, rate_hz: float, lag_us: int, rng: np.random.Generator) -> np.ndarray[Any, Any]:
    n = int(minutes * 60 * rate_hz)
    jitter = rng.integers(0, 300, n)
    return (30_000_000 + lag_us + np.arange(n) * (1e6 / rate_hz) + jitter).astype(np.int64)


def filled(
    name: str, format_: str, names: str, units: str, times: np.ndarray[Any, Any], instance: int | None = None
) -> Message:
    """Fill a message with smooth signals; the second column is the instance if there is one."""
    labels = names.split(",")
    columns: dict[str, Any] = {"TimeUS": times}
    for i, (label, character) in enumerate(zip(labels[1:], format_[1:], strict=True)):
        wave = np.sin(times * 1e-6 * (0.3 + 0.1 * i) + (instance or 0))
        columns[label] = 1500 + 300 * wave if character in "HI" else 20 + 15 * wave
    if instance is not None:
        columns[labels[1]] = np.full(len(times), instance)
    return Message(name, format_, columns, units, "F" + "-" * (len(units) - 1))


def merged(messages: list[Message]) -> Message:
    """Join the instances of one message."""
    first = messages[0]
    columns = {k: np.concatenate([np.asarray(m.columns[k]) for m in messages]) for k in first.columns}
    return Message(first.name, first.format, columns, first.units, first.multipliers)


def make_log(minutes: float, *, gps: bool) -> bytes:
    rng = np.random.default_rng(7)

    def at(rate_hz: float, lag_us: int) -> np.ndarray[Any, Any]:
        return clock_us(minutes, rate_hz, lag_us, rng)

    outputs = "TimeUS," + ",".join(f"C{i}" for i in range(1, 15))
    imu = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    csrv = "TimeUS,Id,Pos,Force,Speed,Pow,PosCmd,V,A,MotT,PCBT,Err"
    state = "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"
    arsp = "TimeUS,I,Airspeed,DiffPress,Temp,RawPress,Offset,U,H,Hp,TR,Pri"
    baro = "TimeUS,I,Alt,AltAMSL,Press,Temp,CRt,SMS,Offset,GndTemp,H,CPress"
    fixes = "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"
    names = np.array([f"PRM_{i:04d}" for i in range(1400)])
    start = np.full(1400, 29_000_000)
    parm = {"TimeUS": start, "Name": names, "Value": np.arange(1400) * 0.5, "Default": np.zeros(1400)}
    servos = (0, 1, 3, 8, 9, 11)
    messages = [
        Message("PARM", "QNff", parm, "s---", "F---"),
        merged([filled("IMU", "QBffffffIIfBBHH", imu, "s#EEEooo--O--zz", at(50, i), i) for i in range(3)]),
        merged([filled("CSRV", "QBfffBfffffB", csrv, "s#dtk%dvAOO-", at(50, 40 + i), i) for i in servos]),
        filled("ATT", "QffffffB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF", "sddddhh-", at(25, 60)),
        filled("RCOU", "QHHHHHHHHHHHHHH", outputs, "sYYYYYYYYYYYYYY", at(25, 70)),
        filled("RCIN", "QHHHHHHHHHHHHHH", outputs, "sYYYYYYYYYYYYYY", at(25, 80)),
        filled("AETR", "Qfffffff", "TimeUS,Ail,Elev,Thr,Rudd,Flap,Steer,SS", "s-------", at(25, 90)),
        merged([filled("XKF1", "QBccCfffffffccce", state, "s#ddhnnnnmmmkkkm", at(25, 100 + i), i) for i in (0, 1)]),
        merged([filled("ARSP", "QBffcffBBffB", arsp, "s#nPOPP-----", at(10, 110), 0)]),
        merged([filled("BARO", "QBfffcfIffBf", baro, "s#mmPOnsmO-P", at(10, 120), 0)]),
        filled("POWR", "QffHHB", "TimeUS,Vcc,VServo,Flags,AccFlags,Safety", "svv---", at(10, 130)),
    ]
    if gps:
        fix = filled("GPS", "QBBIHBcLLeffffB", fixes, "s#-s-S-DUmnhnh-", at(5, 140), 0)
        steady = {"Status": np.full(len(np.asarray(fix.columns["TimeUS"])), 3)}
        messages.append(Message("GPS", fix.format, {**fix.columns, **steady}, fix.units, fix.multipliers))
    return encode(messages, start_us=28_000_000)


def best(task: Callable[[], object], repeats: int = 5) -> float:
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        task()
        times.append(time.perf_counter() - begin)
    return min(times)


def read_bytes(path: Path) -> int:
    raw = np.frombuffer(path.read_bytes(), np.uint8)
    return int(raw.sum())


def read_columns(path: Path) -> dict[str, dict[str, Any]]:
    log = open_dataflash(path)
    return {name: log.table(name) for name in WANTED}


def read_pymavlink(path: Path) -> tuple[float, float, int]:
    """Return seconds to open, seconds to read, and rows read."""
    begin = time.perf_counter()
    reader = DFReader.DFReader_binary(str(path))
    opened = time.perf_counter()
    rows = 0
    while (message := reader.recv_match(type=list(WANTED))) is not None:
        for field in message.get_fieldnames():
            getattr(message, field)
        rows += 1
    return opened - begin, time.perf_counter() - opened, rows


def memory(path: Path) -> dict[str, float]:
    """Read in a process of its own, and report its memory high-water marks [bytes]."""
    result = subprocess.run(
        [sys.executable, __file__, "--memory-of", str(path)], capture_output=True, text=True, check=True
    )
    measured: dict[str, float] = json.loads(result.stdout)
    return measured


def high_water() -> int:
    """Peak resident memory, mapped file pages included [bytes] (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))


def report_memory(path: Path) -> None:
    tiny = path.with_name("tiny.bin")  # numba and all other code is loaded by a first, small log
    begin = time.perf_counter()
    read_columns(tiny)
    cold = time.perf_counter() - begin
    before = high_water()
    columns = read_columns(path)
    size = sum(v.nbytes for table in columns.values() for v in table.values())
    print(json.dumps({"peak": high_water() - before, "columns": size, "cold_s": cold}))


def compare(folder: Path, minutes: float, *, gps: bool) -> None:
    path = folder / ("gps.bin" if gps else "no_gps.bin")
    content = make_log(minutes, gps=gps)
    path.write_bytes(content)
    (folder / "prefix.bin").write_bytes(content[:PREFIX])
    (folder / "tiny.bin").write_bytes(content[: 3 << 20])
    size = len(content)
    del content
    read_columns(folder / "tiny.bin")
    floor, ours = best(lambda: read_bytes(path)), best(lambda: read_columns(path))
    opened = best(lambda: open_dataflash(path))
    rows = sum(len(t["TimeUS"]) for t in read_columns(path).values())
    open_s, read_s, prefix_rows = read_pymavlink(folder / "prefix.bin")
    theirs = open_s * size / min(PREFIX, size) + read_s * rows / prefix_rows
    used = memory(path)
    budget = 1.5 * used["columns"] + size
    print(f"{'with' if gps else 'without'} GPS: {size / MEGABYTE:.0f} MB, {rows} rows of {', '.join(WANTED)}")
    print(f"  bytes only {floor:.3f} s; index {opened:.3f} s; index and columns {ours:.3f} s")
    print(f"  pymavlink {theirs:.1f} s (scaled from {PREFIX / MEGABYTE:.0f} MB: {open_s:.2f} + {read_s:.2f} s)")
    print(f"  {theirs / ours:.0f} x pymavlink (goal {60 if gps else 100}); {ours / floor:.2f} x bytes (goal 6)")
    print(
        f"  peak memory {used['peak'] / MEGABYTE:.0f} MB: columns {used['columns'] / MEGABYTE:.0f} MB, file "
        f"{size / MEGABYTE:.0f} MB; {used['peak'] / budget:.2f} of 1.5 x columns + file (goal 1)"
    )
    print(f"  first read in a new process, 3 MB, compiler's import included: {used['cold_s']:.2f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=90.0)
    parser.add_argument("--memory-of", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory_of:
        report_memory(options.memory_of)
        return
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        compare(Path(folder), options.minutes, gps=True)
        compare(Path(folder), options.minutes, gps=False)


if __name__ == "__main__":
    main()

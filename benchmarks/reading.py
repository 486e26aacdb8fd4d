"""Reading everything: every channel of whole logs, beside pymavlink and pyulog that read every field of every message.

``python benchmarks/reading.py [--largest MB]``: DataFlash, telemetry and PX4 logs of 3 MB up to 160 MB, made by this
script with the messages of real flights at their rates. pymavlink reads the first 3 MB, and its time is scaled by size
(its cost for each message is constant); pyulog reads the whole. Seconds are processor time; ours is the best of three
in this process, with compiled code loaded; `first` is all of a new one that reads one log, imports included.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

os.environ["MAVLINK20"] = "1"

from pymavlink import DFReader, mavutil
from pyulog import ULog

import logparsers
from dataflash import make_log
from logparsers.mavlink import dialect
from tlog import frame, message

if TYPE_CHECKING:
    from collections.abc import Callable

PREFIX = 3_000_000
GOALS = {"bin": 12.0, "tlog": 15.0, "ulg": 1.5}
RATES_HZ = {
    "SERVO_OUTPUT_RAW": 40,
    "ATTITUDE": 40,
    "RAW_IMU": 20,
    "AHRS2": 10,
    "VFR_HUD": 10,
    "GLOBAL_POSITION_INT": 10,
    "RC_CHANNELS": 10,
    "SCALED_PRESSURE": 5,
    "SYS_STATUS": 5,
    "GPS_RAW_INT": 5,
    "NAV_CONTROLLER_OUTPUT": 5,
    "MISSION_CURRENT": 5,
    "WIND": 2,
    "VIBRATION": 2,
    "EKF_STATUS_REPORT": 2,
    "BATTERY_STATUS": 2,
    "TERRAIN_REPORT": 2,
    "MEMINFO": 1,
    "HEARTBEAT": 1,
    "SYSTEM_TIME": 1,
}
TOPICS = {
    "sensor_combined": ("uint64_t timestamp;float[3] gyro_rad;float[3] accel;uint32_t[4] dt;", 48, 250),
    "vehicle_angular_velocity": ("uint64_t timestamp;float[3] xyz;float[3] d;", 32, 250),
    "vehicle_attitude": ("uint64_t timestamp;float[4] q;float[4] delta;", 40, 100),
    "actuator_outputs": ("uint64_t timestamp;float[16] output;uint32_t noutputs;", 76, 50),
    "actuator_servos": ("uint64_t timestamp;uint64_t sample;float[8] control;", 48, 50),
    "vehicle_local_position": ("uint64_t timestamp;float[30] x;uint8_t[8] valid;", 136, 50),
    "estimator_states": ("uint64_t timestamp;float[24] states;float[24] covariances;uint8_t n;", 201, 10),
    "battery_status": ("uint64_t timestamp;float[12] v;uint16_t[4] n;", 64, 5),
    "vehicle_gps_position": ("uint64_t timestamp;double lat;double lon;float[16] more;", 88, 5),
    "input_rc": ("uint64_t timestamp;uint16_t[18] values;uint8_t rssi;", 45, 10),
    "cpuload": ("uint64_t timestamp;float load;float ram;", 16, 2),
}


def make_bin(path: Path, size: int) -> None:
    minutes = 1.0
    while True:
        content = make_log(minutes, gps=True)
        if len(content) >= size or minutes > 2000:
            path.write_bytes(content[:size])
            return
        minutes *= 1.05 * size / len(content)


def make_tlog(path: Path, size: int) -> None:
    """A ground station's record: six positions at 20 Hz beside what ArduPilot sends."""
    rng, layouts = np.random.default_rng(1), dialect().layouts
    written, tick = 0, 0
    with path.open("wb") as out:
        while written < size:
            boot_us = 25_000 * tick
            sent = [name for name, rate in RATES_HZ.items() if tick % (40 // min(rate, 40)) == 0]
            frames: list[bytes] = []
            for name in sent:
                numbers = rng.integers(1, 120, len(layouts[name].fields)).tolist()
                values: dict[str, Any] = {
                    field.name: number
                    for field, number in zip(layouts[name].fields.values(), numbers, strict=True)
                    if not field.is_text and not field.length
                }
                values |= {"time_boot_ms": boot_us // 1000, "time_usec": boot_us % 2**32, "autopilot": 3}
                known = {key: value for key, value in values.items() if key in layouts[name].fields}
                frames.append(frame(name, known, len(frames)))
            for n in range(6 * (tick % 2)):
                position = {"time_boot_ms": boot_us // 1000, "name": f"SRVP{n + 1}", "value": float(rng.normal())}
                frames.append(frame("NAMED_VALUE_FLOAT", position, len(frames)))
            stamp = struct.pack(">Q", 1_700_000_000_000_000 + boot_us)
            written += out.write(b"".join(stamp + one for one in frames))
            tick += 1


def make_ulg(path: Path, size: int) -> None:
    rng, written, tick = np.random.default_rng(2), 0, 0
    with path.open("wb") as out:
        out.write(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40)))
        for name, (fields, _, _) in TOPICS.items():
            out.write(message("F", f"{name}:{fields}".encode()))
        for number, name in enumerate(TOPICS):
            out.write(message("A", struct.pack("<BH", 0, number) + name.encode()))
        bodies = {name: rng.bytes(width - 8) for name, (_, width, _) in TOPICS.items()}
        while written < size:
            stamp = struct.pack("<Q", 4_000 * tick)
            for number, (name, (_, _, rate)) in enumerate(TOPICS.items()):
                if tick % (250 // rate) == 0:
                    written += out.write(message("D", struct.pack("<H", number) + stamp + bodies[name]))
            tick += 1


def ours(path: Path) -> int:
    """Every value of every channel."""
    log = logparsers.read(path)
    return sum(log[name].values.size for name in log.channels)


def pymavlinks_bin(path: Path) -> int:
    reader, rows = DFReader.DFReader_binary(str(path)), 0
    while (one := reader.recv_msg()) is not None:
        for field in one.get_fieldnames():
            getattr(one, field)
        rows += 1
    return rows


def pymavlinks_tlog(path: Path) -> int:
    mavutil.set_dialect("all")
    log, rows = mavutil.mavlink_connection(str(path)), 0
    while (one := log.recv_match()) is not None:
        for field in one.get_fieldnames():
            getattr(one, field)
        rows += 1
    log.close()
    return rows


def pyulogs(path: Path) -> int:
    return sum(column.size for topic in ULog(str(path)).data_list for column in topic.data.values())


MAKERS: dict[str, Callable[[Path, int], None]] = {"bin": make_bin, "tlog": make_tlog, "ulg": make_ulg}
THEIRS: dict[str, Callable[[Path], int]] = {"bin": pymavlinks_bin, "tlog": pymavlinks_tlog, "ulg": pyulogs}


def seconds(work: Callable[[Path], object], path: Path, times: int = 1) -> float:
    taken = []
    for _ in range(times):
        begun = time.process_time()
        work(path)
        taken.append(time.process_time() - begun)
    return min(taken)


def first_s(path: Path) -> float:
    """Processor time of a new process that reads one log, imports included, beyond one that imports numpy."""

    def spent_s(code: str) -> float:
        before = os.times()
        subprocess.run([sys.executable, "-c", code], check=True)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    reads = f"import logparsers; log = logparsers.read({str(path.resolve())!r}); [log[n].values for n in log.channels]"
    return min(spent_s(reads) for _ in range(3)) - min(spent_s("import numpy") for _ in range(3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--largest", type=float, default=160.0, metavar="MB")
    sizes = [size for size in (3.0, 14.0, 45.0, 160.0) if size <= parser.parse_args().largest]
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print("kind   size [MB]  ours [s]  first [s]  theirs [s]  ratio  goal")
    with tempfile.TemporaryDirectory() as folder:
        for kind, make in MAKERS.items():
            sample, log = Path(folder) / f"sample.{kind}", Path(folder) / f"log.{kind}"
            make(sample, PREFIX)
            sample_s = seconds(THEIRS[kind], sample)
            for size in sizes:
                make(log, int(1e6 * size))
                bytes_ = log.stat().st_size
                mine_s = seconds(ours, log, 3)
                whole = kind == "ulg"
                theirs_s = seconds(THEIRS[kind], log) if whole else sample_s * bytes_ / sample.stat().st_size
                print(
                    f"{kind:5}  {bytes_ / 1e6:9.0f}  {mine_s:8.2f}  {first_s(log):9.2f}  {theirs_s:10.2f}"
                    f"  {theirs_s / mine_s:5.1f}  {GOALS[kind]:4.1f}"
                )
                log.unlink()


if __name__ == "__main__":
    main()

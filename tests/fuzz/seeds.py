"""Small sound inputs of every door, from which broken ones are made."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

import logparsers
from logparsers.codec import Codec
from logparsers.dataflash.encode import encode
from logparsers.replay import replayed
from servofd import audit
from servofd.aircraft.schema import plain_aircraft
from servofd.batch.find import find_logs
from servofd.batch.key import Job
from servofd.feedback.draft import draft_to_toml
from servofd.fleets.run import audit_fleet
from servofd.fleets.store import FleetStore
from servofd.outputs.recording.content import Recording, verdicts_of
from servofd.outputs.recording.stream import recording_file
from servofd.outputs.recording.surface import send_context, send_surface
from servofd.servo.context import Context
from servofd.servo.faults import Bias, Stuck
from servofd.simulation.flight import SimulatedFlight, simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.writers import write_flight
from tests.fuzz.harness import SEEDS
from tests.live.vehicles import plane_file
from tests.parsers import dataflash_writer, tlog_writer, writers

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

__all__ = [
    "EFFECTS",
    "ONE_SURFACE",
    "PLANE",
    "SERVO",
    "fleet_parts",
    "flight",
    "frames",
    "logs_of",
    "planes",
    "recordings",
    "telemetry",
]

ROOT = Path(__file__).resolve().parents[2]
PLANE = plain_aircraft(["elevator", "rudder"], "hs225bb-eq31")
SECONDS = 5.0
ONE = plain_aircraft(["elevator"], "hs225bb-eq31")
ONE_SURFACE = plane_file(["elevator"])
"""Aircraft file for what is judged at every input: a second surface takes its time, and reaches no other line."""

EFFECTS = b"""name = "worn"

[surfaces.elevator]
servo = "mine"
threshold = "interval"
threshold_sigmas = 6.0
persistence = 2
suspicions = true
position_limit_deg = [-20.0, 20.0]
command_saturation_deg = [-25.0, 25.0]
command_hold = "linear"
command_period_s = 0.02
command = { channel = "elevator_cmd_deg", unit = "deg", trim_deg = 0.1, sign = -1 }
measured = { channel = "elevator_pos_deg", unit = "deg" }
tolerance = { gain = 0.03, delay_s = 0.003, bandwidth = 0.10, rate = 0.10, bias_deg = 0.3, noise_deg = 0.2 }
serial = "B3"
swaps = [{ date = 2026-03-01, removed = "A17" }]
limits = { dead_band_deg = 2.0, delay_s = 0.05, margin = 0.1 }

[surfaces.elevator.effects]
delay = { delay_s = 0.024 }
rate_limit = { rate_limit_deg_s = 88.0, form = "output" }
friction = { friction_deg = 0.2, torque_share = 0.8 }
backlash = { width_deg = 0.8 }
gravity_load = { droop_deg = 0.5 }
linkage_nonlinearity = { quadratic_per_deg = 0.001, cubic_per_deg2 = 0.0001 }
resonance = { frequency_hz = 9.0, damping_ratio = 0.2 }

[surfaces.rudder]
servo = "s9254"
threshold_deg = 1.5
filter_pole_rad_s = 60.0
command = { channel = "rudder_cmd_deg", unit = "norm", slope_deg = 1.0, trim = 0.0 }
measured = { channel = "rudder_pos_deg", unit = "count", trim_count = 0.0, cubic_deg = [0.1, 1.01, 0.001, 0.0] }
alive = ["servo_voltage_v"]

[surfaces.rudder.effects]
slow_dynamics = { bandwidth_scale = 0.7 }
damping = { damping_scale = 0.9 }
deadband = { width_deg = 0.4, form = "whole error" }
pwm_frame = { period_s = 0.02, phase = 0.1 }
quantization = { step_deg = 0.1 }
sensor_lag = { time_constant_s = 0.01 }
clock_offset = { offset_s = 0.004 }
gain = { gain = 1.05 }
bias = { bias_deg = 0.2 }
position_limit = { lower_deg = -15.0, upper_deg = 15.0, form = "servo" }

[servos.mine]
title = "My servo"
bandwidth_hz = 5.2
damping = 0.7
delay_s = 0.012
hold = "zoh"
rate_limit_deg_s = 400.0
source = "bench"

[table]
time = "time_s"
time_unit = "s"
"""
"""An aircraft file with everything that an aircraft file can hold, for a plain table."""

SERVO = b"""[servos.mine]
title = "My servo"
numerator = [811.0]
denominator = [1.0, 42.0, 811.0]
delay_s = 0.004
hold = "zoh"
rate_limit_deg_s = 300.0
source = "bench"
"""


_SUFFIXES = {"dataflash": ".bin", "tlog": ".tlog", "ulog": ".ulg", "table": ".csv"}
_ALIKE = {
    "matlab4": ("level4",),
    "matlab5": ("level5",),
    "hdf5": ("matlab73", "raptrs"),
    "packed": ("gzipped", "zipped"),
    "table": ("table", "quoted", "blanks"),
}


@cache
def flight(rate_hz: float = 25.0) -> SimulatedFlight:
    """A short flight in which one servo jams and the other slips."""
    faults = {"elevator": Stuck(2.5), "rudder": Bias(3.0, bias_deg=3.0)}
    return simulate_flight(
        PLANE, command="gusty", duration_s=SECONDS, rate_hz=rate_hz, seed=1, faults=faults, outputs=outputs_of(PLANE)
    )


@cache
def _written(suffix: str) -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"flight{suffix}"
        write_flight(path, flight(), PLANE)
        return path.read_bytes()


@cache
def _slip() -> bytes:
    """Telemetry of a single servo that slips, and is found out."""
    flown = simulate_flight(
        ONE,
        command="gusty",
        duration_s=3.5,
        rate_hz=25.0,
        seed=1,
        faults={"elevator": Bias(2.5, bias_deg=3.0)},
        outputs=outputs_of(ONE),
    )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "flight.tlog"
        write_flight(path, flown, ONE)
        return path.read_bytes()


@cache
def _faser() -> Mapping[str, np.ndarray]:
    """Columns of a FASER log."""
    flown = flight()
    asked, done = np.radians(flown.command_deg[:, 0]), np.radians(flown.measured_deg[:, 0])
    return {"time": flown.time_s, "de": asked, "de_pos": done}


def logs_of(kind: str) -> list[bytes]:
    """Small files of one format; those in which servos move are judged as well."""
    sound = [SEEDS[name] for name in SEEDS if name in _ALIKE.get(kind, (kind,))]
    return [*(_MAKERS[kind]() if kind in _MAKERS else [_written(_SUFFIXES[kind])]), *sound]


def _one_frame() -> list[bytes]:
    """Telemetry of a single message, and of two and three; with times of arrival and without."""
    beats = [tlog_writer.frame("HEARTBEAT", {"type": 1, "autopilot": 3}, sequence=k, version=1 + k % 2) for k in (0, 1)]
    told = {"time_boot_ms": 20, "name": "SRVP1", "value": 1.5}
    value = tlog_writer.frame("NAMED_VALUE_FLOAT", told, signed=True)
    stamped = [tlog_writer.record(tlog_writer.EPOCH_US + 1000 * k, one) for k, one in enumerate((*beats, value))]
    return [*stamped, *beats, value, stamped[0] + stamped[2], b"".join(stamped)]


_PACKERS = (gzip.compress, bz2.compress, lzma.compress, lambda raw: writers.zipped({"log": raw}))
_MAKERS: Mapping[str, Callable[[], list[bytes]]] = {
    "dataflash_text": lambda: [dataflash_writer.as_text(dataflash_writer.servo_flight(2.0))],
    "matlab4": lambda: [writers.level4({name: ("f4", values) for name, values in _faser().items()})],
    "matlab5": lambda: [writers.matlab(_faser()), writers.matlab(_faser(), compressed=True)],
    "hdf5": lambda: [writers.matlab73(_faser())],
    "packed": lambda: [pack(_written(suffix)) for pack in _PACKERS for suffix in (".csv", ".bin")],
    "old_text": lambda: [dataflash_writer.before_stamps(60, gps=gps) for gps in ("Time", "TimeMS", "T", "Hour")],
    "one_frame": _one_frame,
}


@cache
def drafted(log: bytes) -> bytes:
    """Aircraft file fitted to a log."""
    return draft_to_toml(logparsers.read(io.BytesIO(log))).encode()


def planes() -> list[bytes]:
    """Aircraft files: shipped, drafted, and one with everything."""
    shipped = [(ROOT / "configs" / f"{name}.toml").read_bytes() for name in ("faser", "bench", "simulated")]
    fitted = [drafted(_written(suffix)) for suffix in (".bin", ".tlog")]
    return [EFFECTS, EFFECTS, *shipped, *fitted, plane_file().encode()]


def frames() -> list[bytes]:
    """What comes over a link: telemetry, and the autopilot's own log in blocks."""
    streamed = [frame for _, frame in replayed(_slip())]
    log, vehicle = encode(dataflash_writer.servo_flight(0.5)), Codec(1, 1)
    blocks = [log[at : at + 200].ljust(200, b"\0") for at in range(0, len(log), 200)]
    remote = [
        vehicle.encode("REMOTE_LOG_DATA_BLOCK", {"seqno": number, "data": list(block)})
        for number, block in enumerate(blocks)
    ]
    few, some = b"".join(streamed[:60]), b"".join(streamed[:200])
    return [few, few, few, few, some, b"".join(streamed), b"".join(remote[:12]), b"".join(remote)]


def telemetry() -> list[bytes]:
    """What a monitor replays: a servo that slips, and the beginning of that."""
    return [_slip(), _slip()[: len(_slip()) // 3], SEEDS["tlog"]]


def recordings(folder: Path) -> list[bytes]:
    """What an audit records of one surface, and of its surroundings; without the layout, which nobody reads back."""
    log, path = folder / "flight.csv", folder / "audit.rrd"
    log.write_bytes(_written(".csv"))
    (found,) = audit(log, PLANE, surfaces=("rudder",))
    recording, time_s = Recording.of(found), np.arange(0.0, SECONDS, 0.5)
    with recording_file(path, "servofd", None) as recorder:
        recorder.properties(log.name, verdicts_of(recording))
        send_surface(recorder, found.surfaces[0], recording.traces["rudder"], recording.start_s, "measured")
        send_context(recorder, Context(time_s, time_s + 10.0, time_s, time_s + 5.0))
    return [path.read_bytes()]


def fleet_parts(folder: Path) -> dict[str, bytes]:
    """A folder of results: its files by name."""
    log = folder / "flight.csv"
    log.write_bytes(_written(".csv"))
    job = Job()
    with FleetStore(folder / "results", job.key) as store:
        for judged in audit_fleet(find_logs([str(log)]).logs, job, workers=0):
            store.add(judged)
    paths = [path for path in sorted((folder / "results").rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder / "results")): path.read_bytes() for path in paths}

"""What a recording costs: an hour of eight surfaces, written, read back, opened; and what others need for the same.

``python benchmarks/recording.py [SECONDS]`` prints processor time (best of three) and bytes for six channels of eight
surfaces at 100 Hz. Peers: one ``rerun.log`` call per value (of a shorter stretch, scaled up), and bare Parquet files of
the same columns, which no viewer opens and which hold neither states nor layout.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from logparsers.records import Channel, FlightLog
from servofd.aircraft.schema import plain_aircraft
from servofd.detection.audit import audit_log
from servofd.detection.verdict import LogAudit
from servofd.outputs.recording.content import Recording
from servofd.outputs.recording.read import read_recording
from servofd.outputs.recording.write import save_recording
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel

SURFACES, CHANNELS, RATE_HZ = 8, 6, 100
LOGGED_S = 2.0


def audited(duration_s: float) -> LogAudit:
    """Audit of a made-up flight; one servo jams half-way."""
    rng = np.random.default_rng(1)
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    time_s = np.arange(int(duration_s * RATE_HZ)) / RATE_HZ
    channels = {}
    for number in range(SURFACES):
        corners = rng.normal(size=int(duration_s * 2) + 2) * 8.0
        command = np.interp(time_s, np.arange(corners.size) / 2.0, corners)
        measured = model.simulate(time_s, command, time_s) + 0.05 * rng.normal(size=time_s.size)
        if number == 3:
            half = time_s.size // 2
            measured[half:] = measured[half] + 0.05 * rng.normal(size=time_s.size - half)
        for name, values in ((f"s{number}_cmd_deg", command), (f"s{number}_pos_deg", measured)):
            channels[name] = Channel(name, time_s, values, "deg", "")
    log = FlightLog(Path("hour.csv"), "table", channels)
    return audit_log(log, plain_aircraft([f"s{number}" for number in range(SURFACES)], "hs225bb-eq31"))


def cost_s(work: Callable[[], object], times: int = 3) -> float:
    """Processor time of the best of some runs [s]."""
    spent = []
    for _ in range(times):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return min(spent)


def write_parquet(recording: Recording, folder: Path) -> None:
    """Bare columns, one file per surface."""
    for name, trace in recording.traces.items():
        names = ("time_s", "command_deg", "simulated_deg", "measured_deg", "residual_deg", "threshold_deg")
        columns = {column: getattr(trace, column) for column in names} | {"lower_deg": -trace.threshold_deg}
        pq.write_table(pa.table(columns), folder / f"{name}.parquet")


def read_parquet(folder: Path) -> None:
    """All of it, as numpy arrays."""
    for path in folder.glob("*.parquet"):
        table = pq.read_table(path)
        for column in table.column_names:
            table[column].to_numpy()


def write_by_value(recording: Recording, path: Path, duration_s: float) -> None:
    """One call per value, as most examples do."""
    import rerun as rr

    with rr.RecordingStream("peer", send_properties=False) as stream:
        stream.save(str(path))
        for name, trace in recording.traces.items():
            curves = (trace.command_deg, trace.simulated_deg, trace.measured_deg, trace.residual_deg)
            for row in range(int(duration_s * RATE_HZ)):
                stream.set_time("time_boot", duration=float(trace.time_s[row]))
                for number, curve in enumerate((*curves, trace.threshold_deg, -trace.threshold_deg)):
                    stream.log(f"{name}/{number}", rr.Scalars(curve[row]))


def opened_s(path: Path) -> float:
    """Until the viewer, without a window, has loaded a recording [s]; NaN where it cannot run."""
    from rerun.experimental import ViewerClient

    folder = str(Path(sys.executable).parent)
    client = ViewerClient.spawn(
        headless=True, port=9931, hide_welcome_screen=True, executable_path=shutil.which("rerun", path=folder)
    )
    try:
        client.get_state()
        start = time.perf_counter()
        client.open(str(path))
        while not client.get_state().recordings:
            time.sleep(0.01)
        return time.perf_counter() - start
    except (RuntimeError, OSError):
        return float("nan")
    finally:
        client.quit()


def main() -> None:
    duration_s = float(sys.argv[1]) if len(sys.argv) > 1 else 3600.0
    scalars = int(duration_s * RATE_HZ) * SURFACES * CHANNELS
    audit = audited(duration_s)
    recording = Recording.of(audit)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / "a.rrd"
        rows = [
            ("servofd", cost_s(lambda: save_recording(audit, path)), cost_s(lambda: read_recording(path)), path),
            ("parquet", cost_s(lambda: write_parquet(recording, folder)), cost_s(lambda: read_parquet(folder)), None),
        ]
        print(f"{scalars / 1e6:.1f} million scalars")
        base = rows[0]
        for who, write_s, read_s, file in rows:
            size = (file.stat().st_size if file else sum(p.stat().st_size for p in folder.glob("*.parquet"))) / scalars
            ratio = write_s / base[1]
            print(f"{who:22} write {write_s:7.2f} s ({ratio:6.2f} x)   read {read_s:5.2f} s   {size:5.1f} B/scalar")
        some_s = min(LOGGED_S, duration_s)
        by_value_s = cost_s(lambda: write_by_value(recording, folder / "b.rrd", some_s), 1) * duration_s / some_s
        size = (folder / "b.rrd").stat().st_size / (some_s * RATE_HZ * SURFACES * CHANNELS)
        ratio = by_value_s / base[1]
        print(f"{'rerun.log per value':22} write {by_value_s:7.0f} s ({ratio:6.0f} x)   {size:24.1f} B/scalar")
        subprocess.run([sys.executable, "-m", "rerun_cli", "rrd", "verify", str(path)], check=True)
        print(f"opened by the viewer after {opened_s(path):.2f} s")


if __name__ == "__main__":
    main()

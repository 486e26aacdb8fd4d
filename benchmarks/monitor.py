"""What the live monitor costs, per message and stage, beside pymavlink's own receive loop; and how late it is.

``python benchmarks/monitor.py [SURFACES] [SECONDS]``: CPU time of one thread, best of three, for a flight with two jams
and for a healthy one; then what share of a core and how much memory ``servofd monitor`` itself takes of both, from
compiled byte code as an installation has it; and how long after the position that raises it an alarm is told, over
loopback.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pymavlink import mavutil

from logparsers.codec import Codec
from logparsers.endpoint import parse_endpoint
from logparsers.link import open_link
from logparsers.replay import replayed
from servofd.aircraft.calibration import DegreeCalibration, PulseCalibration
from servofd.aircraft.schema import Aircraft, plain_aircraft
from servofd.live.run import watch_link
from servofd.live.session import Session
from servofd.live.threads import Receiver
from servofd.servo.faults import Stuck
from servofd.simulation.flight import simulate_flight
from servofd.simulation.pulses import MOST_OUTPUTS, outputs_of
from servofd.simulation.telemetry_writer import telemetry_log

if TYPE_CHECKING:
    from servofd.detection.event import Event

_STARTED_S = 10.0
_BATCH = 100
"""Messages that have come in together at 5000 a second, evaluated every 20 ms."""


def craft(surfaces: int) -> tuple[Aircraft, Aircraft]:
    """An aircraft for the simulator, and the same one as a stream shows it.

    A simulated autopilot has outputs for 13 surfaces; any more watch the first ones once again.
    """
    plain = plain_aircraft([f"surface_{k + 1}" for k in range(min(surfaces, MOST_OUTPUTS - 1))], "hs225bb-eq31")
    entries = {}
    for output in outputs_of(plain):
        command = PulseCalibration(
            channel=f"SERVO_OUTPUT_RAW.servo{output.number}_raw", unit="us", slope_deg_per_us=output.travel_deg / 500.0
        )
        measured = DegreeCalibration(channel=f"NAMED_VALUE_FLOAT[SRVP{output.number}].value", unit="deg")
        change = {"command": command, "measured": measured, "threshold": "interval"}
        entries[output.surface] = plain.surfaces[output.surface].model_copy(update=change)
    for again in range(surfaces - len(entries)):
        entries[f"again_{again + 1}"] = entries[f"surface_{again + 1}"]
    return plain, plain.model_copy(update={"surfaces": entries})


def cpu_s(work: Callable[[], object]) -> float:
    """Least CPU time of three [s]."""
    best = float("inf")
    for _ in range(3):
        begun = time.process_time()
        work()
        best = min(best, time.process_time() - begun)
    return best


def run(aircraft: Aircraft, frames: list[tuple[float, bytes]], *, looks: bool = True) -> int:
    session = Session(Codec(0, 191), {0: aircraft})
    done = 0
    for k, (now_s, frame) in enumerate(frames):
        session.take(now_s, frame)
        if k % _BATCH == 0:
            if looks:
                session.step(now_s)
            else:
                for vehicle in session.vehicles.values():
                    vehicle.evaluate()
        done += 1
    return done


def heard(aircraft: Aircraft, frames: list[tuple[float, bytes]]) -> None:
    session = Session(Codec(0, 191), {0: aircraft})
    for now_s, frame in frames:
        session.take(now_s, frame)


def parsed(frames: list[tuple[float, bytes]]) -> None:
    codec = Codec(0, 191)
    for _, frame in frames:
        codec.frames(frame)


def bare(path: Path) -> None:
    link = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    while link.recv_match() is not None:
        pass
    link.close()


class Noted:
    """Takes down when alarms are told."""

    def __init__(self) -> None:
        self.alarms: list[tuple[float, float]] = []
        """Time of the data, and by the receiver's clock [s]."""

    def events(self, events: list[Event]) -> None:
        """Take events of a step."""
        told_s = time.time()
        self.alarms += [(event.time_s, told_s) for event in events if event.event == "alarm"]

    def tick(self, now_s: float) -> None:
        """Nothing to draw."""


def late_s(aircraft: Aircraft, frames: list[tuple[float, bytes]]) -> np.ndarray:
    """Seconds from when the position was sent at which an alarm is raised to when that alarm is told."""
    ground = open_link(parse_endpoint("udpin:14797"))
    vehicle = open_link(parse_endpoint("udpout:14797"))
    receiver, codec = Receiver(ground), Codec(0, 191)
    first_s, sent_s = frames[0][0], {}

    def fly() -> None:
        begun = time.monotonic()
        for at_s, frame in frames:
            time.sleep(max(begun + at_s - first_s - time.monotonic(), 0.0))
            vehicle.send(frame)
            for heard in codec.decode(frame):
                if heard.name == "NAMED_VALUE_FLOAT":
                    sent_s[heard.fields["time_boot_ms"]] = time.time()

    thread = threading.Thread(target=fly)
    session, noted = Session(Codec(0, 191), {0: aircraft}, aside=True), Noted()
    thread.start()
    watch_link(session, receiver, noted, frames[-1][0] - first_s)
    thread.join()
    session.finish(receiver.now_s())
    receiver.close()
    for link in (ground, vehicle):
        link.close()
    return np.array(
        [told_s - sent_s[round(1e3 * at_s)] for at_s, told_s in noted.alarms if round(1e3 * at_s) in sent_s]
    )


def aircraft_file(surfaces: int) -> str:
    """The aircraft of `craft` as its user would write it."""
    _, aircraft = craft(surfaces)
    text = 'name = "plane"\n'
    for name, one in aircraft.surfaces.items():
        command, measured = one.command, one.measured
        if not isinstance(command, PulseCalibration) or measured is None:
            continue
        text += f'[surfaces.{name}]\nservo = "hs225bb-eq31"\nthreshold = "interval"\n'
        text += f'command = {{ channel = "{command.channel}", unit = "us", slope_deg_per_us = '
        text += f'{command.slope_deg_per_us} }}\nmeasured = {{ channel = "{measured.channel}", unit = "deg" }}\n'
    return text


def process(surfaces: int, frames: list[tuple[float, bytes]]) -> tuple[float, float]:
    """Share of a core, after its start, and peak memory [MB] of the program itself."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plane.toml"
        path.write_text(aircraft_file(surfaces))
        words = ["monitor", "udpin:127.0.0.1:14798", "-c", str(path), "--plain"]
        around = {**os.environ, "PYTHONPYCACHEPREFIX": folder, "PYTHONDONTWRITEBYTECODE": ""}
        program = [sys.executable, "-m", "servofd"]
        subprocess.run([*program, *words, "--duration", "3"], env=around, capture_output=True, check=False)
        child = subprocess.Popen([*program, *words], env=around, stdout=subprocess.DEVNULL)
        vehicle = open_link(parse_endpoint("udpout:127.0.0.1:14798"))
        begun_s, first_s, used_s, since_s = time.monotonic(), frames[0][0], 0.0, 0.0
        for at_s, frame in frames:
            time.sleep(max(begun_s + at_s - first_s - time.monotonic(), 0.0))
            with contextlib.suppress(OSError):
                vehicle.send(frame)
            if not since_s and at_s - first_s > _STARTED_S:
                since_s, used_s = time.monotonic(), spent_s(child.pid)
        share = (spent_s(child.pid) - used_s) / (time.monotonic() - since_s)
        peak = next(line for line in Path(f"/proc/{child.pid}/status").read_text().splitlines() if "VmHWM" in line)
        child.send_signal(signal.SIGINT)
        child.wait()
        vehicle.close()
        return share, float(peak.split()[1]) / 1e3


def spent_s(pid: int) -> float:
    """Processor time of a process until now [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def stages(aircraft: Aircraft, log: bytes) -> None:
    """Print what each stage takes of one thread."""
    frames = list(replayed(log))
    run(aircraft, frames)  # compiles
    count = len(frames)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.tlog"
        path.write_bytes(log)
        reference_s = cpu_s(lambda: bare(path))
    parse_s = cpu_s(lambda: parsed(frames))
    hear_s = cpu_s(lambda: heard(aircraft, frames))
    evaluate_s = cpu_s(lambda: run(aircraft, frames, looks=False))
    total_s = cpu_s(lambda: run(aircraft, frames))
    steps = (("parse", parse_s), ("clock and channels", hear_s - parse_s), ("evaluate", evaluate_s - hear_s))
    for name, spent_s in (*steps, ("bank and alerts", total_s - evaluate_s), ("all", total_s)):
        print(f"{name:20} {1e6 * spent_s / count:8.1f} us/message")
    print(f"{'pymavlink recv_match':20} {1e6 * reference_s / count:8.1f} us/message, ratio {total_s / reference_s:.1f}")
    print(f"one core holds {count / total_s:.0f} messages/s")


def main() -> None:
    given = [int(word) for word in sys.argv[1:]]
    surfaces, seconds = (*given, *(16, 30)[len(given) :])
    plain, aircraft = craft(surfaces)
    jams = {"surface_1": Stuck(seconds / 2.0), "surface_2": Stuck(seconds / 1.5)}
    for words, faults in (("none at fault", {}), ("two of them at fault", jams)):
        flight = simulate_flight(
            plain, rate_hz=50.0, duration_s=float(seconds), faults=faults, outputs=outputs_of(plain)
        )
        log = telemetry_log(flight, plain)
        frames = list(replayed(log))
        print(f"{len(frames)} messages, {surfaces} surfaces at 50 Hz, {words}")
        stages(aircraft, log)
        share, peak_mb = process(surfaces, frames)
        print(
            f"the program: {share:.1%} of a core for {len(frames) / seconds:.0f} messages/s, {peak_mb:.0f} MB at most"
        )
    few, eight = craft(8)
    delays_ms = np.zeros(0)
    for seed in range(3):
        jams = {f"surface_{k + 1}": Stuck(10.0 + 1.13 * k + 0.37 * seed) for k in range(8)}
        short = simulate_flight(few, rate_hz=50.0, duration_s=25.0, faults=jams, outputs=outputs_of(few), seed=seed)
        delays_ms = np.append(delays_ms, 1e3 * late_s(eight, list(replayed(telemetry_log(short, few)))))
    print(
        f"{delays_ms.size} alarms of 8 surfaces at 50 Hz: told after {np.median(delays_ms):.1f} ms in the median, "
        f"99 % {np.percentile(delays_ms, 99.0):.1f} ms"
    )


if __name__ == "__main__":
    main()

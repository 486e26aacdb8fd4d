"""Make ``docs/performance.md``: ``OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python docs/make_performance.py [FOLDER]``.

The quick forms of what is in `benchmarks/`, each beside its peer in the same process, one after the other. About two
minutes of processor time; needs PySINDy besides (``pip install pysindy``).
"""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import bank_cost
import dataflash
import hidden_peers
import hidden_physics
import identify as identification
import monitor
import recording
import residual
import tlog
from logparsers.replay import replayed
from logparsers.ulog import UlogFile
from servofd.aircraft.series import Series
from servofd.detection.pulse import design_pulse_filter
from servofd.detection.residual import ResidualGenerator
from servofd.discrepancy.explanation import explain_gap
from servofd.identification.identify import identify
from servofd.outputs.recording.content import Recording
from servofd.outputs.recording.write import save_recording
from servofd.servo.context import Context
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import flight
from servofd.simulation.flight import simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.telemetry_writer import telemetry_log

HERE = Path(__file__).parent
SERVO = "hs225bb-eq31"
PACKAGES = ("numpy", "scipy", "numba", "pymavlink", "pyulog", "control", "pysindy", "pyarrow", "rerun-sdk")
LOG_MINUTES, LOG_BYTES, PREFIX_BYTES = 20.0, 16_000_000, 4_000_000
EFFECTS = ("delay", "rate_limit", "backlash", "gain", "airload")
"""Each hidden in a flight of its own, of medium size, with 0.1 deg of noise."""


class Row(NamedTuple):
    """One line of the page: processor time of both for the same work."""

    what: str
    peer: str
    ours_s: float
    theirs_s: float
    remark: str

    def __str__(self) -> str:
        times = f"{_ratio(self.theirs_s / self.ours_s)} | {_seconds(self.ours_s)} | {_seconds(self.theirs_s)}"
        return f"| {self.what} | {self.peer} | {times} | {self.remark} |"


def main(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        rows = [row for group in GROUPS for row in _reported(group(Path(name)))]
    path = folder / "performance.md"
    path.write_text(page(rows, machine()), encoding="utf-8")
    print(path)


def cost_s(work: Callable[[], object], times: int = 3) -> float:
    """Processor time of the best of some runs [s]."""
    spent = []
    for _ in range(times):
        start_s = time.process_time()
        work()
        spent.append(time.process_time() - start_s)
    return min(spent)


def logs(folder: Path) -> Iterable[Row]:
    """Parsing, beside the libraries of the firmwares; pymavlink on a prefix, scaled by bytes."""
    path, prefix = folder / "a.bin", folder / "prefix.bin"
    content = dataflash.make_log(LOG_MINUTES, gps=False)
    path.write_bytes(content)
    prefix.write_bytes(content[:PREFIX_BYTES])
    dataflash.read_columns(prefix)  # compiles
    theirs_s = cost_s(lambda: dataflash.read_pymavlink(prefix), 1) * len(content) / PREFIX_BYTES
    what = f"DataFlash, {len(content) / 1e6:.0f} MB, {len(dataflash.WANTED)} messages"
    yield Row(what, "pymavlink", cost_s(lambda: dataflash.read_columns(path)), theirs_s, "values bit-equal")
    tlog.TLOG_BYTES = tlog.ULOG_BYTES = LOG_BYTES
    path = folder / "a.tlog"
    tlog.make_tlog(path)
    tlog.ours_tlog(path)
    what = f"telemetry log, {LOG_BYTES / 1e6:.0f} MB, {len(tlog.MESSAGES)} messages"
    theirs_s = cost_s(lambda: tlog.pymavlinks_tlog(path), 1)
    yield Row(what, "pymavlink", cost_s(lambda: tlog.ours_tlog(path)), theirs_s, "check-sums tested by both")
    path = folder / "a.ulg"
    tlog.make_ulog(path)
    what = f"ULog, {LOG_BYTES / 1e6:.0f} MB, {len(tlog.TOPICS)} topics"
    ours_s = cost_s(lambda: UlogFile.open(path, only=tlog.TOPICS))
    yield Row(what, "pyulog", ours_s, cost_s(lambda: tlog.pyulogs_ulog(path)), "values bit-equal")


def residuals(_: Path) -> Iterable[Row]:
    """The residual filter on uniform samples, the only ones that the peers can take."""
    model = ServoModel.of(servo_named(SERVO))
    generator = ResidualGenerator(model, residual.POLE_RAD_S)
    time_s = np.round(np.arange(180_000) / residual.RATE_HZ, 9)
    command_deg = flight(time_s, np.random.default_rng(0))
    segment = Series("x", time_s, command_deg, time_s, model.simulate(time_s, command_deg, time_s))
    generator.run(segment)
    ours_s = cost_s(lambda: generator.run(segment))
    theirs_s, difference_deg = residual.peer(segment, generator)
    theirs_s *= time_s.size / residual.PEER_SAMPLES
    what = f"residual, {time_s.size:,} samples"
    yield Row(what, "python-control `forced_response`", ours_s, theirs_s, f"differ by {difference_deg:.0e} deg at most")
    design = design_pulse_filter(model.transfer, model.delay_s, 1.0 / residual.RATE_HZ, residual.POLE_RAD_S)
    rest_deg = command_deg[0]

    def filtered() -> object:
        measured = lfilter(np.asarray(design.a) * design.g, design.md, segment.measured_deg - rest_deg)
        return measured - lfilter(np.asarray(design.b[0]) * design.g, design.md, command_deg - rest_deg)

    remark = "uniform samples only: no jitter, gaps, delays between samples, rate limit or simulation"
    yield Row(what, "scipy `lfilter`", ours_s, cost_s(filtered), remark)


def naming(_: Path) -> Iterable[Row]:
    """The bank, beside servofd's own residual: no other program names faults of servos."""
    cost = bank_cost.measure(600.0)
    remark = f"{cost.alarms} alarms on healthy flights; one naming {max(cost.naming_ms):.0f} ms at most"
    what = f"threshold and bank, {cost.samples:,} samples"
    yield Row(what, "servofd, residual alone", cost.judged_s, cost.residual_s, remark)


def servos(_: Path) -> Iterable[Row]:
    """Identification from the chirp of thesis 3.2.3."""
    segment, truth = identification.record(SERVO, 0), servo_named(SERVO).transfer.poles_rad_s
    found = identify(segment)
    ours_s = cost_s(lambda: identify(segment), 1)
    ours = identification.dominant_error(found.servo.linear.poles_rad_s, truth)
    theirs = identification.dominant_error(identification.realisation(), truth)
    remark = f"error of the dominant pole {ours:.2g} % against {theirs:.2g} %: the peer knows neither delay nor noise"
    what = "identify, 12,000 samples of a chirp"
    yield Row(what, "python-control `markov`, ERA", ours_s, cost_s(identification.realisation, 1), remark)


def explanations(_: Path) -> Iterable[Row]:
    """Names of hidden effects; PySINDy is asked for a group of effects only."""
    model, ours_s, theirs_s, ours, theirs = ServoModel.of(servo_named(SERVO)), 0.0, 0.0, 0, 0
    hidden_peers.sindy_group(hidden_physics.hidden(0, {"gain": {"gain": 0.8}}, "flight"))  # imports it
    for name in EFFECTS:
        drawn = hidden_physics.draw(np.random.default_rng(1), name, "medium")
        record = hidden_physics.hidden(1, {name: drawn}, "flight")
        flown = Context(airspeed_s=record.time_s, airspeed_m_s=record.airspeed_m_s)
        segment = Series("x", record.time_s, record.command_deg, record.time_s, record.measured_deg, context=flown)
        start_s = time.process_time()
        explanation = explain_gap(segment, model)
        between_s = time.process_time()
        group = hidden_peers.sindy_group(record)
        theirs_s += time.process_time() - between_s
        ours_s += between_s - start_s
        names = [effect.name for effect in explanation.selection.final.effects]
        ours, theirs = ours + (names == [name]), theirs + (group == hidden_peers.GROUPS[name])
    remark = f"named rightly, and nothing else: {ours} of {len(EFFECTS)}; the right group by PySINDy: {theirs}"
    yield Row(f"explain, {len(EFFECTS)} flights of 60 s", "PySINDy", ours_s, theirs_s, remark)


def live(folder: Path) -> Iterable[Row]:
    """Cost of receiving and judging a stream, beside that of receiving it."""
    plain, aircraft = monitor.craft(8)
    flown = simulate_flight(plain, rate_hz=50.0, duration_s=15.0, outputs=outputs_of(plain))
    log = telemetry_log(flown, plain)
    path = folder / "live.tlog"
    path.write_bytes(log)
    frames = list(replayed(log))
    monitor.run(aircraft, frames)
    ours_s, theirs_s = monitor.cpu_s(lambda: monitor.run(aircraft, frames)), monitor.cpu_s(lambda: monitor.bare(path))
    remark = f"servofd judges 8 surfaces besides; {len(frames) / ours_s:.0f} messages a second"
    yield Row(f"monitor, {len(frames):,} messages", "pymavlink `recv_match` alone", ours_s, theirs_s, remark)


def recordings(folder: Path) -> Iterable[Row]:
    """What the viewer opens, beside bare columns and beside the usual way to fill the viewer."""
    duration_s, some_s = 120.0, 1.0
    audit = recording.audited(duration_s)
    content, path = Recording.of(audit), folder / "a.rrd"
    ours_s = cost_s(lambda: save_recording(audit, path))
    what = f"recording, {int(duration_s) * recording.RATE_HZ * recording.SURFACES * recording.CHANNELS:,} values"
    theirs_s = cost_s(lambda: recording.write_by_value(content, folder / "b.rrd", some_s), 1) * duration_s / some_s
    yield Row(what, "`rerun.log` for each value", ours_s, theirs_s, "the same viewer")
    theirs_s = cost_s(lambda: recording.write_parquet(content, folder))
    yield Row(what, "pyarrow Parquet", ours_s, theirs_s, "bare columns: no states, no layout, no viewer")


GROUPS: tuple[Callable[[Path], Iterable[Row]], ...] = (
    logs, residuals, naming, servos, explanations, live, recordings,
)  # fmt: skip


def page(rows: Iterable[Row], machine_text: str) -> str:
    """The whole page."""
    table = "\n".join(str(row) for row in rows)
    return f"""# Performance

Written by `python docs/make_performance.py` from the quick forms of the scripts in `benchmarks/`. Seconds are processor time
(best of three where that is cheap), one process, so that other work on the machine hardly counts; both columns are of the same
run and the same data, of which pymavlink (DataFlash), python-control (residual) and `rerun.log` got a part, scaled up. The ratio
is the peer's time divided by servofd's: above 1 servofd is faster. Compiling, once on a machine, is not counted.

| work | peer | ratio | servofd | peer's | besides |
|---|---|---:|---:|---:|---|
{table}

## Machine and versions

{machine_text}

## In full

| script | measures |
|---|---|
| `benchmarks/reading.py` | every channel of logs of 3 to 160 MB, beside pymavlink and pyulog: [everything read](robustness.md#everything-read) |
| `benchmarks/dataflash.py`, `benchmarks/tlog.py` | logs of 90 minutes, memory, and the bare reading of the bytes |
| `benchmarks/residual.py` | 30 minutes of six surfaces, on all cores, and with jittered time stamps |
| `benchmarks/detection.py` | what is found how soon, beside the best that any detector could do: [detection](detection.md) |
| `benchmarks/identify.py`, `benchmarks/hidden_effects.py` | errors of identified servos; names of hidden effects: [explanation](explain.md) |
| `benchmarks/monitor.py` | each step of the monitor, and the time from datagram to verdict |
| `benchmarks/recording.py` | an hour of eight surfaces, written, read back, opened |
| `benchmarks/fleet_audit.py` | many logs on many cores: [many logs](fleet.md) |
"""


def machine() -> str:
    """Processor, system and versions; no name of a computer or a user."""
    info = Path("/proc/cpuinfo")
    models = [line.partition(":")[2] for line in info.read_text().splitlines() if line.startswith("model name")]
    model = (models[0] if models else platform.machine()).strip()
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    cores = (
        f"{model}, {os.cpu_count()} cores, {platform.system()}; load {os.getloadavg()[0]:.1f} when this was written."
    )
    return f"{cores}\nPython {platform.python_version()}, {versions}."


def _reported(rows: Iterable[Row]) -> Iterable[Row]:
    for row in rows:
        print(row, flush=True)
        yield row


def _seconds(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 10.0 else f"{seconds:.0f} s"


def _ratio(ratio: float) -> str:
    return f"{ratio:.2g}" if ratio < 10.0 else f"{ratio:.0f}"


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)

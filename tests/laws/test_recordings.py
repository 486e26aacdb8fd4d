"""A recording gives back what went into it, whatever that is."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from logparsers.records import Damage, FlightLog
from servofd.aircraft.schema import plain_aircraft
from servofd.core.statistics import Estimate
from servofd.core.types import FloatArray
from servofd.detection.verdict import Fault, LogAudit, Status, SurfaceAudit
from servofd.outputs.recording.content import Recording, Trace
from servofd.outputs.recording.read import read_recording, statistics_of
from servofd.outputs.recording.stream import microseconds, seconds
from servofd.outputs.recording.surface import breaks_s
from servofd.outputs.recording.write import write_recording
from tests.recordings.inside import everything

NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), min_size=1, max_size=12)


@st.composite
def traces(draw: st.DrawFn) -> Trace:
    """Curves on irregular times, with gaps and missing values."""
    seed = draw(st.integers(0, 2**32 - 1))
    size = draw(st.integers(1, 150))
    rng = np.random.default_rng(seed)
    steps = rng.integers(100, 50_000, size) + np.where(rng.random(size) < 0.02, 3_000_000, 0)
    time_s = seconds(draw(st.integers(0, 10**10)) + np.cumsum(steps))
    if draw(st.booleans()):
        time_s = time_s.astype(np.float32).astype(float)  # not on whole microseconds
        time_s = time_s + np.arange(size) * 1e-3
    values = rng.normal(size=(5, size)) * 10.0 ** rng.integers(-3, 3)
    values[2, rng.random(size) < 0.1] = np.nan
    values[3, np.isnan(values[2]) | (rng.random(size) < 0.1)] = np.nan  # no residual without a measurement
    asked = draw(st.booleans())
    asked_s = time_s if asked else time_s[:1] + np.sort(rng.random(size // 2 + 1))
    asked_deg = values[0] if asked else rng.normal(size=size // 2 + 1)
    command, simulated, measured, residual, threshold = values
    return Trace(time_s, command, simulated, measured, residual, threshold, asked_s, asked_deg)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    """Audits with curves, faults and damage."""
    names = draw(st.lists(NAMES, min_size=1, max_size=3, unique=True))
    number = st.floats(allow_nan=False, allow_infinity=False, width=64)
    surfaces, curves = [], {}
    for name in names:
        trace = draw(traces())
        start_s = float(trace.time_s[0])
        end_s = draw(st.none() | st.just(float(trace.time_s[-1])))
        estimate = Estimate(*draw(st.tuples(number, number, number)))
        fault = Fault("bias", start_s, start_s, end_s, {"bias_deg": estimate}, 0.5, ("stuck",))
        faults = (fault,) if draw(st.booleans()) else ()
        status: Status = "fault" if faults else "healthy"
        statistics = statistics_of(trace)
        surfaces.append(
            SurfaceAudit(
                name, status, draw(st.text(max_size=20)), "s9254", "constant", 1.5, True, faults, (), statistics, 1e-6
            )
        )
        curves[name] = trace
    start = draw(st.none() | st.just(datetime(2023, 11, 14, 22, 13, 20, 123456, tzinfo=UTC)))
    log = FlightLog(
        Path("a flight.bin"), "dataflash", {}, (Damage("gap", "3 s", 1, 1.0),), start_utc=start, span_s=(0.0, 9.0)
    )
    return Recording(LogAudit(log, plain_aircraft(names, "s9254"), tuple(surfaces)), curves)


def all_alike(time_s: FloatArray) -> Trace:
    """Curves that are all the same."""
    return Trace(time_s, time_s, time_s, time_s, time_s, time_s, time_s, time_s)


def same(one: Recording, other: Recording) -> None:
    """Assert that two recordings hold the same, to the last bit."""
    assert other.audit.surfaces == one.audit.surfaces
    assert other.audit.aircraft == one.audit.aircraft
    for name in ("source", "format", "damage", "run", "start_utc", "span_s"):
        assert getattr(other.audit.log, name) == getattr(one.audit.log, name)
    assert other.traces.keys() == one.traces.keys()
    for name, trace in one.traces.items():
        for curve in ("time_s", "command_deg", "simulated_deg", "measured_deg", "residual_deg", "threshold_deg"):
            assert getattr(other.traces[name], curve).tobytes() == getattr(trace, curve).tobytes(), curve
        assert np.array_equal(other.traces[name].asked_s, trace.asked_s)
        assert np.array_equal(other.traces[name].asked_deg, trace.asked_deg)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(recordings())
def test_what_is_read_is_what_was_written(recording: Recording) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.rrd"
        write_recording(recording, path)
        again = read_recording(path)
        same(recording, again)


def test_a_curve_is_broken_a_microsecond_later_whatever_the_stamps_are_rounded_to() -> None:
    time_s = 2504.0 + np.array([0.10, 0.15, 0.1934375, 3.2, 3.25, 3.3000005, 7.0, 7.1])  # two on half microseconds
    assert np.array_equal(microseconds(breaks_s(time_s)) - microseconds(time_s[[2, 5]]), [1, 1])


@given(st.integers(-(10**15), 10**15))
def test_microseconds_survive(time_us: int) -> None:
    assert microseconds(seconds(np.array([time_us])))[0] == time_us


def test_the_time_of_the_day_is_exact(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    start = datetime(2026, 2, 3, 4, 5, 6, 789012, tzinfo=UTC)
    time_s = np.arange(1000.0) * 0.012345
    trace = all_alike(time_s)
    surface = SurfaceAudit("e", "healthy", "", "s9254", "constant", 1.5, True)
    log = FlightLog(Path("a.bin"), "dataflash", {}, start_utc=start, span_s=(0.0, 9.0))
    write_recording(Recording(LogAudit(log, plain_aircraft(["e"]), (surface,)), {"e": trace}), tmp_path / "a.rrd")
    stream = (
        RrdReader(str(tmp_path / "a.rrd")).stream().filter(content="/surfaces/e/deflection", has_timeline="time_utc")
    )
    (chunk,) = stream
    stamps = chunk.to_record_batch().column("time_utc").to_numpy(zero_copy_only=False).astype("datetime64[us]")
    wanted = [
        np.datetime64((start + timedelta(microseconds=int(us))).replace(tzinfo=None)) for us in microseconds(time_s)
    ]
    assert stamps.tolist() == [w.item() for w in wanted]


def test_a_servo_of_the_aircraft_tells_no_file_name(tmp_path: Path) -> None:
    aircraft = plain_aircraft(["e"], "s9254")
    servo = aircraft.servo("e").model_copy(update={"source": "servofd explain: /home/pilot/secret/flight.csv"})
    aircraft = aircraft.model_copy(update={"servos": {"mine": servo}})
    surface = SurfaceAudit("e", "healthy", "", "mine", "constant", 1.5, True)
    log = FlightLog(Path("/home/pilot/secret/flight.csv"), "table", {}, span_s=(0.0, 1.0))
    write_recording(Recording.of(replace(LogAudit(log, aircraft, (surface,)))), tmp_path / "a.rrd")
    assert "secret" not in everything(tmp_path / "a.rrd")
    assert read_recording(tmp_path / "a.rrd").audit.log.source == Path("flight.csv")


@pytest.mark.parametrize("name", ["a/b", "../x", "ä ö", "a.b", "/", "*"])
def test_any_name_of_a_surface_will_do(name: str, tmp_path: Path) -> None:
    time_s = np.arange(50.0) * 0.02
    surface = SurfaceAudit(name, "healthy", "", "s9254", "constant", 1.5, True)
    log = FlightLog(Path("a.csv"), "table", {}, span_s=(0.0, 1.0))
    recording = Recording(LogAudit(log, plain_aircraft([name]), (surface,)), {name: all_alike(time_s)})
    write_recording(recording, tmp_path / "a.rrd")
    same(recording, read_recording(tmp_path / "a.rrd"))

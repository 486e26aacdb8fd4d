"""What the script logs is read back, shown and judged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from logparsers.dataflash.encode import Message, encode
from servofd.aircraft.schema import load_aircraft
from servofd.cli import main
from servofd.onboard.plan import plan_onboard
from servofd.onboard.script import watch_script
from servofd.servo.faults import Stuck
from servofd.simulation.dataflash_writer import dataflash_messages
from servofd.simulation.flight import simulate_flight
from servofd.simulation.pulses import outputs_of
from tests.onboard.autopilot import Flight, fly

SIMULATED = load_aircraft("simulated")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight whose elevator jams, logged with the script's messages, and with nothing else than those."""
    folder = tmp_path_factory.mktemp("onboard")
    outputs = outputs_of(SIMULATED)
    flight = simulate_flight(
        SIMULATED, duration_s=40.0, rate_hz=50.0, seed=3, faults={"elevator": Stuck(20.0)}, outputs=outputs
    )
    time_us = np.round(1e6 * flight.time_s).astype(np.int64) + 1_000_000
    pulses = {o.number: flight.pulse_us[:, k] for k, o in enumerate(outputs)}
    positions = {o.number: flight.measured_deg[:, k] for k, o in enumerate(outputs)}
    flown = fly(watch_script(plan_onboard(SIMULATED)), Flight(time_us, pulses, positions), folder)
    assert [text.split()[1] for text in flown.said("ELEVATOR")] == ["off", "stuck"]
    names = dict(zip(("Cmd", "Sim", "Pos", "Res", "Thr"), flown.log.dtype.names[2:], strict=True))
    columns = {"TimeUS": flown.log["time_us"].astype(np.int64) - 1_000_000, "I": flown.log["output"].astype(np.int64)}
    columns |= {label: flown.log[name].astype(float) for label, name in names.items()}
    seen = Message("SFD", "QBfffff", columns, "s#ddddd", "F-00000")
    logged = dataflash_messages(flight, SIMULATED)
    (folder / "flight.bin").write_bytes(encode([*logged, seen]))
    (folder / "seen.bin").write_bytes(encode([*(m for m in logged if m.name not in ("CSRV", "RCOU")), seen]))
    return folder


@pytest.mark.slow
def test_info_shows_what_was_seen_on_board(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(folder / "flight.bin"), "--json"]) == 0
    seen = {one["output"]: one for one in json.loads(capsys.readouterr().out)["logs"][0]["on_board"]}
    assert list(seen) == [1, 2, 4]
    assert seen[2]["name"] == "elevator"
    assert seen[1]["alarms_s"] == seen[4]["alarms_s"] == []
    assert seen[1]["peak_share"] < 1.0 <= seen[2]["peak_share"]
    assert 20.0 < seen[2]["alarms_s"][0] < 26.0
    assert main(["info", str(folder / "flight.bin")]) == 0
    assert "seen on board" in capsys.readouterr().out


@pytest.mark.slow
def test_a_log_of_the_script_alone_is_judged_as_well(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["audit", str(folder / "seen.bin"), "--json", "-"]) == 1
    surfaces = json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]
    assert {name: one["status"] for name, one in surfaces.items() if one["status"] == "fault"} == {"elevator": "fault"}


@pytest.mark.slow
def test_a_recording_shows_what_was_seen_on_board(folder: Path) -> None:
    from rerun.chunk import RrdReader

    target = folder / "flight.rrd"
    assert main(["audit", str(folder / "flight.bin"), "-c", "simulated", "--rrd", str(target)]) == 1
    seen = {chunk.entity_path for chunk in RrdReader(str(target)).stream()}
    assert {f"/surfaces/{name}/onboard" for name in ("aileron", "elevator", "rudder")} <= seen

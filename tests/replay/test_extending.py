"""The examples of docs/architecture.md: each is put where it says, and then works from end to end."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import logparsers
import servofd
from servofd.aircraft.schema import plain_aircraft
from servofd.cli import main
from servofd.discrepancy.own import load_own_effect
from servofd.servo.catalogue import effects_installed
from servofd.servo.faults import FAULTS, Failure, Stuck
from servofd.servo.library import servo_named
from servofd.servo.registry import catalogue, including
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import gusty
from servofd.simulation.flight import simulate_flight

ROOT = Path(__file__).parent.parent.parent
PAGE = (ROOT / "docs" / "architecture.md").read_text()
MOST_LINES = 40


def code(title: str) -> str:
    """Code of a section."""
    section = PAGE.partition(f"### {title}\n")[2].partition("\n### ")[0]
    codes = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    assert codes
    assert sum(len(each.splitlines()) for each in codes) < MOST_LINES
    return "\n".join(codes)


def example(title: str) -> dict[str, Any]:
    """Names that the code of a section defines."""
    names: dict[str, Any] = {"__name__": "example"}
    exec(compile(code(title), f"architecture.md: {title}", "exec", dont_inherit=True), names)  # noqa: S102 - our own page
    return names


def bench_log(jammed_s: float | None) -> bytes:
    """A flight as the recorder of the example writes it."""
    faults = {} if jammed_s is None else {"elevator": Stuck(jammed_s)}
    flight = simulate_flight(
        plain_aircraft(["elevator"], "hs225bb-eq31"), duration_s=30.0, faults=faults, command="gusty"
    )
    record = np.zeros(flight.time_s.size, dtype=[("time_ms", ">u4"), ("angle", ">i2", (2,))])
    record["time_ms"] = np.round(flight.time_s * 1e3)
    angles_deg = np.hstack([flight.command_deg, flight.measured_deg])
    record["angle"] = np.round(100.0 * angles_deg)
    return b"BENCH1 elevator_cmd_deg elevator_pos_deg\n" + record.tobytes()


@pytest.mark.slow
def test_a_log_format(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = example("A log format")["LINE"]
    detect = importlib.import_module("logparsers.detect")  # the package has a function of that name
    before = next(k for k, known in enumerate(detect.FORMATS) if known.name == "MATLAB level 4")
    monkeypatch.setattr(detect, "FORMATS", (*detect.FORMATS[:before], line, *detect.FORMATS[before:]))
    path = tmp_path / "stand.log"
    for jammed_s, code in ((None, 0), (15.0, 1)):
        path.write_bytes(bench_log(jammed_s))
        assert main(["audit", str(path)]) == code
    assert "stuck" in capsys.readouterr().out
    assert list(logparsers.read(path, only=["elevator_pos_deg"]).channels) == ["elevator_pos_deg"]
    path.write_bytes(bench_log(None)[:-3])
    assert [damage.kind for damage in logparsers.read(path).damage] == ["truncated"]
    for broken in (b"BENCH1 \n", b"BENCH1 a b\n\0"):
        path.write_bytes(broken)
        assert main(["audit", str(path)]) == 2
        assert "no record of the test stand" in capsys.readouterr().err


@pytest.mark.slow
def test_an_effect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By its class alone it is simulated, found, and named in an aircraft's table."""
    path = tmp_path / "worn_horn.py"
    path.write_text(code("An effect"))
    healthy = ServoModel.of(servo_named("hs225bb-eq31"))
    with including(load_own_effect(path)):
        assert "worn_horn" in {effect.name for effect in catalogue()}
        physics = effects_installed(healthy.physics, {"worn_horn": {"width_deg": 0.8, "gain": 0.9}})
        time_s = np.arange(0.0, 20.0, 0.01)
        command_deg = gusty(time_s, np.random.default_rng(1))
        moved_deg = healthy.with_physics(physics).simulate(time_s, command_deg, time_s)
        # Play of 0.8 deg keeps a gear at most half of it from its motion; the horn scales that as well.
        lost_deg = np.abs(moved_deg - 0.9 * healthy.simulate(time_s, command_deg, time_s))
        assert lost_deg.max() == pytest.approx(0.9 * 0.4, rel=1e-6)
        flight = str(tmp_path / "flight.csv")
        effect = "elevator:worn_horn:width_deg=1.5:gain=0.8"
        assert main(["simulate", "-o", flight, "--duration", "20", "--effect", effect]) == 0
        assert main(["explain", flight, "--servo", "hs225bb-eq31", "-s", "elevator", "--json", "-"]) == 0
        (step, *_) = json.loads(capsys.readouterr().out.partition("{")[2].join(["{", ""]))["steps"]
        assert step["effect"] == "worn_horn"
        assert step["parameters"]["gain"]["value"] == pytest.approx(0.8, abs=0.02)


_IN_THE_PACKAGE = """
import json, runpy, sys
import servofd.servo.effects.sensor as module
from servofd.servo.effect import Effect, Parameter, Slot, Spread

class OneSided(Effect):
    '''Linkage that moves the surface further to one side.'''

    name, slot = "one_sided", Slot.OUTPUT
    parameters = (
        Parameter("more", low=-0.5, high=0.5, neutral=0.0, typical=0.05, calibrated=Spread(0.1, 0.01)),
    )

    @staticmethod
    def act(x, now, more):
        return x + more * max(x, 0.0)

OneSided.__module__ = module.__name__
module.OneSided = OneSided

from servofd.cli import main
good, log, plane, found = (sys.argv[1] + name for name in ("/good.csv", "/log.csv", "/plane.toml", "/found.json"))
effect = ["--effect", "elevator:one_sided:more=0.2"]
codes = [
    main(["simulate", "-o", good, "--duration", "80", "--seed", "1", *effect]),
    main(["calibrate", good, "-s", "elevator", "-o", plane]),
    main(["simulate", "-o", log, "--duration", "30", "--seed", "2", *effect]),
    main(["audit", log, "-s", "elevator", "-c", plane]),
    main(["explain", log, "--servo", "hs225bb-eq31", "-s", "elevator", "--json", found]),
]
table = runpy.run_path(sys.argv[2])["table"]()
print(json.dumps({"codes": codes, "table": table}))
"""


@pytest.mark.slow
def test_every_verb_knows_an_effect_by_its_class_alone(tmp_path: Path) -> None:
    """One more class in a module of the package: simulated, calibrated, audited, explained, and listed."""
    script = tmp_path / "script.py"
    script.write_text(_IN_THE_PACKAGE)
    command = [sys.executable, str(script), str(tmp_path), str(ROOT / "docs" / "make_effects.py")]
    ran = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    told = json.loads(ran.stdout.splitlines()[-1])
    assert told["codes"] == [0, 0, 0, 0, 0]
    assert "`one_sided`" in told["table"]
    elevator = tomllib.loads((tmp_path / "plane.toml").read_text())["surfaces"]["elevator"]
    assert elevator["calibrated"]["parameters"]["one_sided_more"] == pytest.approx(0.2, abs=0.02)
    (step, *_) = json.loads((tmp_path / "found.json").read_text())["steps"]
    assert (step["effect"], step["parameters"]["more"]["value"]) == ("one_sided", pytest.approx(0.2, abs=0.02))


@pytest.mark.slow
def test_a_fault(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kind = example("A fault")["Reversed"]
    assert issubclass(kind, Failure)
    monkeypatch.setitem(FAULTS, kind.kind, kind)
    path = str(tmp_path / "flight.csv")
    assert main(["simulate", "-o", path, "--fault", "elevator:reversed@20:share=0.8", "--duration", "40"]) == 0
    assert main(["audit", path, "--servo", "hs225bb-eq31"]) == 1
    assert "elevator" in capsys.readouterr().out
    (audit,) = servofd.audit(path, servo="hs225bb-eq31", surfaces=("elevator",))
    assert audit.surfaces[0].faults[0].alarm_s >= 20.0


@pytest.mark.slow
def test_an_output(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    text = example("An output")["junit"](list(servofd.audit("sample_logs/faser_stuck_flight.mat")))
    cases = {case.get("name"): [part.tag for part in case] for case in ET.fromstring(text).iter("testcase")}  # noqa: S314
    assert cases["elevator"] == ["failure"]
    assert cases["rudder"] == []
    assert cases["flap_left"] == ["skipped"]

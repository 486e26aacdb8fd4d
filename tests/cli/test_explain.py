"""``servofd explain`` as tools and people use it; whatever is wrong with a log is told in a sentence."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.aircraft.schema import load_aircraft
from servofd.cli import main
from servofd.discrepancy.own import load_own_effect
from servofd.servo.registry import including
from tests.recordings.inside import everything
from tests.recovery.fine_servo import FineServo, Hidden, hide

KNOWN = ("--servo", "hs225bb-eq31")


def slow() -> Hidden:
    """A servo that reacts 26 ms later than its model."""
    return hide(FineServo(delay_s=0.03), duration_s=12.0)


def healthy() -> Hidden:
    return hide(FineServo(), duration_s=12.0)


@dataclass(frozen=True)
class Told:
    """What one call said and wrote: of a slow servo, of another flight of it, and of a flight of a sound one."""

    folder: Path
    text: str
    document: dict[str, Any]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Told:
    folder: Path = tmp_path_factory.mktemp("explained")
    path = slow().write(folder / "log.csv")
    other = hide(FineServo(delay_s=0.03), duration_s=12.0, seed=4).write(folder / "other.csv")
    outputs = [
        "--json",
        str(folder / "gap.json"),
        "--save",
        str(folder / "better.toml"),
        "--rrd",
        str(folder / "g.rrd"),
    ]
    sound = healthy().write(folder / "sound.csv")
    words = ["explain", *KNOWN, str(path), "-s", "elevator", "--also", str(other), str(sound), *outputs]
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        assert main(words) == 0
    return Told(folder, text.getvalue(), json.loads((folder / "gap.json").read_text()))


@pytest.mark.slow
def test_the_json_is_what_the_contract_says(told: Told) -> None:
    document = told.document
    assert document["schema"] == "servofd.explain/1"
    assert (document["surface"], document["conclusion"]) == ("elevator", "explained")
    assert document["nominal"]["held_out_rms_deg"] > 2.0 * document["noise_floor_rms_deg"] > 0.1
    (step,) = document["steps"]
    assert step["effect"] == "delay"
    assert step["parameters"]["delay_s"]["low"] < step["parameters"]["delay_s"]["high"]
    assert {"effect", "held_out_rms_deg"} == set(step["rivals"][0])
    assert document["indistinguishable"] == [["delay", "clock_offset"]]
    assert document["final"]["model"] == {"delay": {"delay_s": step["parameters"]["delay_s"]["value"]}}
    assert all(isinstance(sentence, str) for sentence in document["where"])


@pytest.mark.slow
def test_the_better_model_makes_the_audit_quieter(told: Told, capsys: pytest.CaptureFixture[str]) -> None:
    assert "+ delay" in told.text
    assert "these data cannot tell delay from clock offset" in told.text
    errors = []
    for options in (KNOWN, ("-c", str(told.folder / "better.toml"))):
        main(["audit", str(told.folder / "log.csv"), "--json", "-", *options])
        surface = json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]["elevator"]
        errors.append(surface["simulation_error_rms_deg"])
    assert errors[1] < 0.11 < 2.0 * errors[1] < errors[0]


@pytest.mark.slow
def test_what_is_found_in_the_linkage_is_saved_and_simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = hide(FineServo(backlash_deg=1.0), duration_s=12.0).write(tmp_path / "log.csv")
    better = tmp_path / "better.toml"
    assert main(["explain", *KNOWN, str(path), "--save", str(better)]) == 0
    capsys.readouterr()
    assert load_aircraft(better).surfaces["elevator"].effects["backlash"]["width_deg"] == pytest.approx(1.0, abs=0.03)
    assert main(["audit", str(path), "-c", str(better), "--json", "-"]) == 0
    surface = json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]["elevator"]
    assert surface["status"] == "healthy"
    # Noise of 0.1 deg passes the filter with a gain of 0.42.
    assert surface["residual"]["std_deg"] < 0.045


def _scaled(log: Hidden, factor: float) -> Hidden:
    return replace(log, position_deg=factor * log.position_deg)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        (lambda log: _scaled(log, -1.0), "check the sign"),
        (lambda log: _scaled(log, 0.1), "check the scale"),
        (lambda log: replace(log, command_deg=log.position_deg, position_deg=log.command_deg), "swapped"),
        (lambda log: replace(log, time_s=10.0 * log.time_s), "at 10 Hz"),
        (lambda log: replace(log, command_deg=np.linspace(0.0, 0.1, log.time_s.size)), "hardly asked to move"),
        (
            lambda log: replace(log, position_deg=log.position_deg + 0.3 * log.time_s),
            "drifts by",
        ),
        (lambda log: Hidden(*(getattr(log, field.name)[:200] for field in fields(log))), "at least 4 s"),
    ],
    ids=["sign", "scale", "swapped", "10 Hz", "rest", "creeps", "short"],
)
def test_unfit_logs(
    changed: Callable[[Hidden], Hidden], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = changed(healthy()).write(tmp_path / "log.csv")
    assert main(["explain", *KNOWN, str(path), "-s", "elevator"]) == 2
    message = capsys.readouterr().err
    assert reason in message
    assert message.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["-s", "elevtor"], "did you mean elevator"),
        (["--servo", "nonsense"], "unknown servo"),
        (["--json", "/nowhere/at/all.json"], "does not exist"),
    ],
)
def test_wrong_calls(options: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = healthy().write(tmp_path / "log.csv")
    assert main(["explain", *KNOWN, str(path), *options]) == 2
    assert reason in capsys.readouterr().err


@pytest.mark.slow
def test_what_has_no_better_model_is_not_saved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, saved = healthy().write(tmp_path / "log.csv"), tmp_path / "same.toml"
    assert main(["explain", *KNOWN, str(path), "--save", str(saved)]) == 0
    captured = capsys.readouterr()
    assert "Nothing is missing" in captured.out
    assert "stays as it was: no effect was found" in captured.err
    assert "was not written: no surface has a better model that a file can hold" in captured.err
    assert not saved.exists()


@pytest.mark.slow
def test_the_model_is_judged_on_other_flights(told: Told) -> None:
    document = told.document
    also, sound = document["also"]
    assert "other.csv: the model does worse there" not in told.text
    assert "sound.csv: the model does worse there" in told.text
    assert sound["nominal_rms_deg"] < sound["extended_rms_deg"]
    assert also["path"].endswith("other.csv")
    assert also["nominal_rms_deg"] > 2.0 * also["extended_rms_deg"]
    assert also["extended_rms_deg"] == pytest.approx(0.1, abs=0.01)
    assert document["separating"][0]["sentence"] == (
        "no manoeuvre tells delay from clock offset by command and position alone"
    )


@pytest.mark.nightly
def test_several_flights_are_explained_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The servo's poles and damping are refitted within what servos differ by, and take 2 % of the delay with them."""
    flights = [
        hide(FineServo(delay_s=0.03), duration_s=10.0, seed=seed).write(tmp_path / f"{seed}.csv") for seed in (1, 2, 3)
    ]
    assert main(["explain", *KNOWN, *map(str, flights), "--json", "-"]) == 0
    (step,) = json.loads(capsys.readouterr().out)["steps"]
    assert step["effect"] == "delay"
    delay_s = step["parameters"]["delay_s"]
    assert delay_s["value"] == pytest.approx(0.03, rel=0.02)
    assert delay_s["low"] < 0.03 < delay_s["high"]


def two_surfaces(path: Path) -> Path:
    rests = np.zeros(slow().time_s.size)
    noise = 0.1 * np.random.default_rng(0).standard_normal(rests.size)
    columns = (slow().time_s, slow().command_deg, slow().position_deg, rests, noise)
    header = "time_s,elevator_cmd_deg,elevator_pos_deg,rudder_cmd_deg,rudder_pos_deg"
    np.savetxt(path, np.column_stack(columns), "%.6f", ",", header=header, comments="")
    return path


@pytest.mark.slow
def test_a_surface_that_cannot_be_told_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, better = two_surfaces(tmp_path / "log.csv"), tmp_path / "better.toml"
    assert main(["explain", *KNOWN, str(path), "--json", "-", "--save", str(better)]) == 2
    captured = capsys.readouterr()
    assert json.loads(captured.out)["surfaces"]["elevator"]["conclusion"] == "explained"
    assert "rudder: " in captured.err
    assert captured.err.count("\n") == 1
    saved = load_aircraft(better)
    assert {"delay"} <= set(saved.surfaces["elevator"].effects) <= {"delay", "poles", "gain", "bias"}
    assert saved.surfaces["rudder"].effects == {}


@pytest.mark.slow
def test_the_recording_holds_both_simulations(told: Told) -> None:
    from rerun.chunk import RrdReader

    recording = told.folder / "g.rrd"
    assert str(told.folder) not in everything(recording)
    values = {}
    for chunk in RrdReader(recording).stream().filter(has_timeline="time_boot", components="Scalars:scalars"):
        column = chunk.to_record_batch().column("Scalars:scalars")
        values[chunk.entity_path] = np.array(column.flatten()).reshape(len(column), -1)
    deflection, error = values["/surfaces/elevator/deflection"], values["/surfaces/elevator/error"]
    assert deflection.shape == (slow().time_s.size, 4)
    np.testing.assert_allclose(deflection[:, 3], slow().position_deg, atol=1e-5)
    assert np.nanstd(error[:, 1]) < 0.11
    assert np.nanstd(error[:, 0]) > 0.2


@pytest.mark.slow
def test_the_example_of_an_effect_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = Path(__file__).parent.parent.parent / "docs" / "own_effect.py"
    assert len(example.read_text().splitlines()) < 40
    path = hide(FineServo(cyclic_deg=0.5), duration_s=20.0).write(tmp_path / "log.csv")
    saved = ["--save", str(tmp_path / "better.toml")]
    with including(load_own_effect(example)):  # afterwards it is forgotten: other tests explain without it
        assert main(["explain", *KNOWN, str(path), "--effect", str(example), "--json", "-", *saved]) == 0
    shown = capsys.readouterr()
    assert "worn_gear comes from a file of your own" in shown.err
    document = json.loads(shown.out)
    (step,) = document["steps"]
    assert step["effect"] == "worn_gear"
    # The hidden error is 0.5 deg and repeats every 4 deg.
    assert step["parameters"]["amplitude_deg"]["value"] == pytest.approx(0.5, abs=0.02)
    assert step["parameters"]["pitch_deg"]["value"] == pytest.approx(4.0, abs=0.03)


@pytest.mark.nightly
def test_a_reading_that_creeps_is_not_explained_by_an_offset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By 0.8 deg in a minute, of which the catalogue has no effect; what is left is no correlated noise."""
    flown = hide(FineServo(), duration_s=60.0)
    path = replace(flown, position_deg=flown.position_deg + 0.8 / 60.0 * flown.time_s).write(tmp_path / "log.csv")
    assert main(["explain", *KNOWN, str(path)]) == 1
    assert "Not all is explained" in capsys.readouterr().out


def own(body: str = "return x + a_deg", parameters: str = "(A,)", name: str = "e", more: str = "") -> str:
    """Source of an effect of one's own."""
    return (
        "import numpy as np\nfrom servofd import Effect, Parameter, Slot\n"
        "A = Parameter('a_deg', low=0.0, high=1.0, neutral=0.0, typical=0.1)\n"
        f"class E(Effect):\n    'Of a test.'\n    name, slot, parameters = {name!r}, Slot.OUTPUT, {parameters}\n"
        f"    {more}\n"
        f"    @staticmethod\n    def act(x, now, a_deg):\n        {body}\n"
    )


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        (None, "cannot read the effect: No such file"),
        ("x = 1\n", "defines no effect"),
        (own() + own().replace("class E", "class F").replace("'e'", "'f'"), "defines 2 effects"),
        ("x = = 1\n", "line 1: SyntaxError"),
        ("\nx = undefined\n", "line 2: NameError: name 'undefined'"),
        (own("return 'far'"), "act must return a finite number"),
        (own("return x / 0.0"), "act: ZeroDivisionError"),
        (own("return np.sin(x)"), "act may use math, numbers and functions of its module, not np"),
        (own("return (lambda q: q + a_deg)(x)"), "act may use math, numbers and functions of its module, not q"),
        (own(more="memory = 1"), "act is called with (x, now, e_a_deg, memory)"),
        (own().replace("Slot.OUTPUT", "Slot.EVENTS"), "act takes the commands (times, values, slopes; arrays)"),
        (own(name="backlash"), "the catalogue has one of this name"),
        (own(parameters="()"), "it needs a parameter"),
        (own(parameters="(Parameter('a', low=1.0, high=0.0, neutral=0.5, typical=0.1),)"), "its lower bound 1 must be"),
        (own(parameters="(Parameter('a', low=0.0, neutral=0.5, typical=0.1),)"), "parameter a: high is missing"),
    ],
)
def test_errors_in_an_effect_of_ones_own(
    source: str | None, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, path = healthy().write(tmp_path / "log.csv"), tmp_path / "effect.py"
    if source is not None:
        path.write_text(source)
    assert main(["explain", *KNOWN, str(log), "--effect", str(path)]) == 2
    message = capsys.readouterr().err
    assert reason in message
    assert "effect.py" in message
    assert message.count("\n") == 1


def test_other_wrong_calls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = healthy().write(tmp_path / "log.csv")
    rudder = tmp_path / "rudder.csv"
    rudder.write_text(log.read_text().replace("elevator", "rudder"))
    unmeasured = tmp_path / "unmeasured.csv"
    unmeasured.write_text("\n".join(",".join(line.split(",")[:2]) for line in log.read_text().splitlines()))
    for options, reason in (
        (["--also", str(rudder)], "give a log of the same aircraft"),
        (["--also", str(tmp_path / "none.csv")], "none.csv"),
        (["--rrd", str(tmp_path)], "is a folder"),
        (["--save", str(log)], "is a log already; choose another file"),
        (["--rrd", "x", "--json", "x"], "is another output already; choose another file"),
        (["-c", str(tmp_path / "none.toml")], "none.toml"),
    ):
        assert main(["explain", *KNOWN, str(log), *options]) == 2
        message = capsys.readouterr().err
        assert reason in message
        assert message.count("\n") == 1
    assert main(["explain", *KNOWN, str(unmeasured)]) == 2
    assert "elevator_pos_deg" in capsys.readouterr().err


@pytest.mark.parametrize("scale", [57.3, 1.0 / 57.3])
def test_another_unit_is_told_as_a_wrong_scale(
    scale: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = replace(healthy(), position_deg=scale * healthy().position_deg).write(tmp_path / "log.csv")
    assert main(["explain", *KNOWN, str(path)]) == 2
    assert "check the scale of the calibration" in capsys.readouterr().err


@pytest.mark.slow
def test_a_log_without_noise_hides_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.csv"
    assert main(["simulate", "-o", str(path), "--command", "gusty", "--duration", "20", "--noise-deg", "0"]) == 0
    capsys.readouterr()
    assert main(["explain", *KNOWN, str(path), "-s", "elevator", "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["conclusion"], document["steps"]) == ("nothing_missing", [])


@pytest.mark.slow
def test_what_is_missing_in_the_fitted_run_alone_is_not_nothing(tmp_path: Path) -> None:
    path, other = slow().write(tmp_path / "log.csv"), healthy().write(tmp_path / "other.csv")
    assert main(["explain", *KNOWN, str(path), str(other)]) == 1


def test_every_run_must_come_fast_enough(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    thinned = Hidden(*(np.ascontiguousarray(getattr(healthy(), name)[::10]) for name in healthy().__dataclass_fields__))
    assert (
        main(["explain", *KNOWN, str(thinned.write(tmp_path / "a.csv")), str(thinned.write(tmp_path / "b.csv"))]) == 2
    )
    assert "position comes at 10 Hz" in capsys.readouterr().err

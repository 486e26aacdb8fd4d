"""What the pilot sees of the script, and what `servofd onboard` says before it writes one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import logparsers
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.cli import main
from servofd.core.errors import ConfigError
from servofd.feedback.draft import draft_to_toml
from servofd.onboard.plan import LONGEST_NAME, plan_onboard
from servofd.onboard.script import stream_script, watch_script
from tests.onboard.autopilot import Flight, fly

SIMULATED = load_aircraft("simulated")


def many(count: int, name: str = "surface") -> Aircraft:
    """So many surfaces with the servo of the thesis."""
    first = SIMULATED.surfaces["aileron"]
    assert first.measured is not None
    surfaces = {
        f"{name}_{k}": first.model_copy(
            update={
                "command": first.command.model_copy(update={"channel": f"RCOU.C{k}"}),
                "measured": first.measured.model_copy(update={"channel": f"CSRV[{k - 1}].Pos"}),
            }
        )
        for k in range(1, count + 1)
    }
    return SIMULATED.model_copy(update={"surfaces": surfaces})


def wiggled(plane: Aircraft, jammed: int = 0, armed: bool = False, duration_s: float = 8.0) -> Flight:
    """Sticks moved to their ends; one output may be jammed."""
    plan = plan_onboard(plane)
    time_us = 5_000_000 + np.arange(0, int(1e6 * duration_s), 1000 * plan.period_ms // plan.turns)
    time_s = time_us.astype(np.float64) / 1e6
    pulses, positions = {}, {}
    for planned in plan.surfaces:
        surface = plane.surfaces[planned.surface]
        pulse_us = np.round(1500.0 + 450.0 * np.sin(3.0 * (time_s - time_s[0])) * (time_s > time_s[0] + 2.0))
        pulses[planned.output] = pulse_us
        moved_deg = plane.model(planned.surface).simulate(time_s, surface.command.to_deg(pulse_us), time_s)
        positions[planned.output] = np.zeros(time_s.size) if planned.output == jammed else moved_deg
    return Flight(time_us, pulses, positions, armed)


def test_the_pilot_reads_which_surface_is_stuck_within_two_seconds(tmp_path: Path) -> None:
    flown = fly(watch_script(plan_onboard(SIMULATED)), wiggled(SIMULATED, jammed=2, armed=True), tmp_path)
    (alarm_us, alarm), (named_us, named) = [each for each in flown.texts if each[1].startswith("ELEVATOR")]
    assert alarm.startswith("ELEVATOR off by ")
    assert named == "ELEVATOR stuck 0.0 deg"
    assert named_us - alarm_us < 2_000_000
    assert not flown.said("AILERON")
    assert not flown.said("RUDDER")


def test_a_hardover_is_told_from_a_jam_by_the_ends_of_the_output(tmp_path: Path) -> None:
    flight = wiggled(SIMULATED, armed=True)
    jump = np.clip(150.0 * (1e-6 * flight.time_us - 9.0), 0.0, 44.0)
    positions = {**flight.position_deg, 4: np.where(flight.time_us > 9_000_000, jump, flight.position_deg[4])}
    flown = fly(watch_script(plan_onboard(SIMULATED)), Flight(flight.time_us, flight.pulse_us, positions), tmp_path)
    assert flown.said("RUDDER")[-1] == "RUDDER hardover 44.0 deg"


@pytest.mark.slow
def test_each_fault_of_a_surface_is_reported_and_its_end_within_two_seconds(tmp_path: Path) -> None:
    """A jam, another one after it, and a hard-over that follows a third without a pause."""
    flight = wiggled(SIMULATED, armed=True, duration_s=30.0)
    time_s = 1e-6 * flight.time_us
    moved = flight.position_deg[2]
    jams = np.select([(time_s > 9.0) & (time_s < 13.0), (time_s > 18.0) & (time_s < 21.0)], [4.0, -11.0], moved)
    hard = np.clip(-11.0 - 150.0 * (time_s - 28.0), -44.0, -11.0)
    position = np.where(time_s > 25.0, np.where(time_s > 28.0, hard, -11.0), jams)
    flown = fly(
        watch_script(plan_onboard(SIMULATED)),
        Flight(flight.time_us, flight.pulse_us, {**flight.position_deg, 2: position}, armed=True),
        tmp_path,
    )
    told = [(1e-6 * at_us, text.removeprefix("ELEVATOR ")) for at_us, text in flown.texts if "ELEVATOR" in text]
    assert [text for _, text in told if "off" not in text] == [
        *("stuck 4.0 deg", "follows again", "stuck -11.0 deg", "follows again", "stuck -11.0 deg", "hardover -44.0 deg")
    ]
    ends_s = [at_s for at_s, text in told if text == "follows again"]
    assert all(0.0 < at_s - end_s <= 2.0 for at_s, end_s in zip(ends_s, (13.0, 21.0), strict=True))


@pytest.mark.parametrize(
    ("check", "jammed", "last"),
    [(0, 2, None), (1, 2, "ELEVATOR did not follow"), (1, 0, ""), (2, 0, ""), (2, 2, "ELEVATOR did not follow")],
)
def test_arming_is_refused_by_name(tmp_path: Path, check: int, jammed: int, last: str | None) -> None:
    script = watch_script(plan_onboard(SIMULATED))
    flown = fly(script, wiggled(SIMULATED, jammed), tmp_path, parameters={"SFD_CHECK": check})
    assert flown.refusals[-1:] == ([] if last is None else [last])
    assert (flown.refusals[:1] == ["AILERON not moved by sticks"]) == (check == 2)


def test_the_reason_to_refuse_arming_is_whole_for_the_longest_name(tmp_path: Path) -> None:
    """ArduPilot copies 42 characters into a buffer of 42 and reads on beyond it: the stub takes 41."""
    flown = fly(
        watch_script(plan_onboard(many(2, "the_flap_in_the_middle"))),
        wiggled(many(2)),
        tmp_path,
        parameters={"SFD_CHECK": 2},
    )
    assert flown.refusals[0].endswith(" not moved by sticks")
    assert len(flown.refusals[0]) == 41


def test_positions_that_stop_are_told_once_and_of_all_together(tmp_path: Path) -> None:
    flight = wiggled(SIMULATED, armed=True)
    late = flight.time_us > 9_000_000
    frozen = {output: np.where(late, np.nan, deg) for output, deg in flight.position_deg.items()}
    one = {**flight.position_deg, 1: frozen[1]}
    script = watch_script(plan_onboard(SIMULATED))
    texts = [
        [text for _, text in fly(script, Flight(flight.time_us, flight.pulse_us, each), tmp_path).texts[1:]]
        for each in (one, frozen)
    ]
    assert texts == [["AILERON no position"], ["servos: no positions"]]


@pytest.mark.parametrize(("lasts_s", "told"), [(0.3, []), (2.0, ["servos: positions stand still"])])
def test_a_bus_that_freezes_is_no_fault_of_a_servo(tmp_path: Path, lasts_s: float, told: list[str]) -> None:
    """ArduPilot's Volz driver repeats the last readings with new stamps for 5 s; then servos move one by one."""
    flight = wiggled(SIMULATED, armed=True)
    positions = {}
    for output, deg in flight.position_deg.items():
        end_us = 9_000_000 + 1e6 * lasts_s + 10_000 * output
        is_frozen = (flight.time_us > 9_000_000) & (flight.time_us <= end_us)
        positions[output] = np.where(is_frozen, deg[np.argmax(is_frozen)], deg)
    flown = fly(watch_script(plan_onboard(SIMULATED)), Flight(flight.time_us, flight.pulse_us, positions), tmp_path)
    assert [text for _, text in flown.texts[1:]] == told


def test_a_jam_while_the_other_servos_rest_is_told_after_a_second(tmp_path: Path) -> None:
    flight = wiggled(SIMULATED, 2, armed=True)
    pulses = {o: us if o == 2 else np.full_like(us, 1500) for o, us in flight.pulse_us.items()}
    positions = {o: deg if o == 2 else np.zeros_like(deg) for o, deg in flight.position_deg.items()}
    flown = fly(watch_script(plan_onboard(SIMULATED)), Flight(flight.time_us, pulses, positions), tmp_path)
    assert flown.said("ELEVATOR")[0].startswith("ELEVATOR off by")


@pytest.mark.slow
def test_positions_go_to_the_ground_at_the_rate_of_the_parameter(tmp_path: Path) -> None:
    script, flight = watch_script(plan_onboard(SIMULATED)), wiggled(SIMULATED)
    for hz, least, most in ((0, 0, 40), (10, 220, 300), (50, 1100, 1200)):
        assert least <= fly(script, flight, tmp_path, parameters={"SFD_STREAM_HZ": hz}).named <= most


@pytest.mark.slow
def test_six_surfaces_fit_an_autopilot(tmp_path: Path) -> None:
    plane = many(6)
    flight = wiggled(plane, jammed=3, duration_s=5.0)
    plan = plan_onboard(plane)
    flown = fly(watch_script(plan), flight, tmp_path, counted=True)
    assert flown.most_instructions <= plan.instructions <= 10_000
    assert flown.heap_kb <= 80.0, "with pointers and numbers of 64 bits; an autopilot's have 32"


@pytest.mark.slow
def test_whatever_a_surface_is_made_of_it_takes_hardly_more_memory(tmp_path: Path) -> None:
    """A Lua table doubles where it has more than 64 entries: the settings and states of a surface stay below."""
    plane = many(6)
    plan, flight = plan_onboard(plane), wiggled(plane, jammed=3)
    most: dict[str, Any] = {"curve": (1e-7, 1e-9), "bounds": (-55.0, 55.0), "stops": (-60.0, 60.0)}
    surfaces = [replace(each, settings=(each.settings[0] | most, *each.settings[1:])) for each in plan.surfaces]
    full = replace(plan, surfaces=tuple(surfaces))
    usual_kb, full_kb = (fly(watch_script(each), flight, tmp_path).heap_kb for each in (plan, full))
    assert full_kb - usual_kb <= 6 * 0.35


def test_more_surfaces_than_a_call_has_time_for_are_refused_with_how_many_fit() -> None:
    with pytest.raises(ConfigError, match=r"32 surfaces are more than .* 2\d are not; choose them with -s"):
        plan_onboard(many(32))
    assert len(plan_onboard(many(12)).surfaces) == 12


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (("gain=0.09", "gain=much"), "servofd: AILERON: gain: 1 number"),
        (("name=RUDDER", "name=A_NAME_THAT_IS_FAR_TOO_LONG_FOR_A_TEXT"), "servofd: a name: 1 to 21 letters"),
        (("modes=", "modes=1.0,"), "servofd: AILERON: modes: 4 numbers"),
        (("rates=370.0,", "rates=,"), "servofd: AILERON: rates: 3 numbers"),
        (("doubt=", "doubts="), "servofd: AILERON: doubt: 21 numbers"),
        (("limit=", "stops=12.0 limit="), "servofd: AILERON: stops: 2 numbers"),
        (("rates=", "rats="), ""),  # without a limit it is another servo, and one that works
    ],
)
def test_an_edited_script_says_what_is_wrong(tmp_path: Path, edit: tuple[str, str], told: str) -> None:
    script = watch_script(plan_onboard(SIMULATED))
    assert edit[0] in script
    flown = fly(script.replace(*edit, 1), wiggled(SIMULATED), tmp_path)
    assert flown.ended == bool(told)
    assert flown.texts[-1][1].startswith(told)


def test_an_older_autopilot_is_told_what_it_lacks(tmp_path: Path) -> None:
    for script in (watch_script(plan_onboard(SIMULATED)), stream_script([1])):
        flown = fly(script, wiggled(SIMULATED), tmp_path, old=True)
        assert flown.ended
        assert [text for _, text in flown.texts] == ["servofd: needs ArduPilot 4.6 with servo telemetry"]


def test_the_streaming_script_sends_what_servos_measure(tmp_path: Path) -> None:
    script = stream_script(range(1, 17))
    assert len(script.splitlines()) <= 25
    flown = fly(script, wiggled(SIMULATED), tmp_path)
    assert flown.named == 3 * 401  # each of three, once at the start and at every call
    assert flown.texts == []


def test_names_are_whole_or_stay_different() -> None:
    plane = many(3, 'the_"outermost"_flap_größer_than_all')
    names = [surface.name for surface in plan_onboard(plane).surfaces]
    assert len(set(names)) == 3
    assert all(len(name) <= LONGEST_NAME and name.isascii() and '"' not in name for name in names)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["faser"], "names no output of an ArduPilot"),
        ([], "onboard needs an aircraft file"),
        (["simulated", "-s", "elevatr"], "did you mean elevator"),
        (["simulated", "--rate-hz", "1"], "10 to 200 Hz work"),
        (["simulated", "--instructions", "100"], "0 are not"),
        (["none.toml"], "none.toml"),
    ],
)
def test_what_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    target = tmp_path / "servofd.lua"
    assert main(["onboard", *words, "-o", str(target)]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert len(error.splitlines()) == 1
    assert not target.exists()


@pytest.mark.slow
def test_a_px4_is_told_that_it_runs_no_scripts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = Path(__file__).parents[2] / "sample_logs" / "px4_stuck.ulg"
    (tmp_path / "px4.toml").write_text(draft_to_toml(logparsers.read(sample)))
    assert main(["onboard", str(tmp_path / "px4.toml"), "-o", str(tmp_path / "x.lua")]) == 2
    assert "PX4 runs no scripts" in capsys.readouterr().err


def test_what_is_lost_without_calibration_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["onboard", "simulated", "-o", str(tmp_path / "servofd.lua")]) == 0
    output = capsys.readouterr()
    assert "elevator is not calibrated" in output.err
    assert "SCR_ENABLE = 1" in output.out

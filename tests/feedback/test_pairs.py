"""Which position belongs to which output."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from logparsers import Channel, FlightLog
from servofd.aircraft.pairs import find_pairs
from servofd.core.errors import NoMeasurement
from servofd.feedback.advice import what_to_log
from servofd.feedback.draft import draft_aircraft
from servofd.feedback.toml import draft_to_toml
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import flight

TIME_S = np.arange(4000) / 50.0
FUNCTIONS = {1: 4, 2: 19, 3: 70, 4: 21}


def channel(name: str, values: object, unit: str = "") -> Channel:
    return Channel(name, TIME_S, np.asarray(values, dtype=float), unit, name.replace("[", "."))


def log_of(
    ids: list[int],
    *,
    base: int,
    unit: str = "deg",
    command_field: bool = False,
    parameters: dict[str, float] | None = None,
) -> FlightLog:
    """Log with pulses on four outputs and positions of some of them, ids counted from `base`."""
    channels = {}
    model = ServoModel.of(servo_named("s9254"))
    for output in range(1, 5):
        command_deg = np.round(flight(TIME_S, np.random.default_rng(output)), 1)
        channels[f"RCOU.C{output}"] = channel(f"RCOU.C{output}", 1500.0 + 10.0 * command_deg, "us")
        if output - 1 + base in ids:
            noise_deg = 0.05 * np.random.default_rng(output).standard_normal(TIME_S.size)
            position_deg = model.simulate(TIME_S, command_deg, TIME_S) + noise_deg
            stem = f"CSRV[{output - 1 + base}]"
            scale = np.pi / 180.0 if unit == "rad" else 1.0
            channels[f"{stem}.Pos"] = channel(f"{stem}.Pos", scale * position_deg, unit)
            if command_field:
                channels[f"{stem}.PosCmd"] = channel(f"{stem}.PosCmd", command_deg, "deg")
    known = {f"SERVO{n}_FUNCTION": float(f) for n, f in FUNCTIONS.items()} | (parameters or {})
    return FlightLog(Path("flight.bin"), "dataflash", channels, parameters=known, vehicle="fixed wing")


@pytest.mark.parametrize(
    ("base", "ids", "parameters"),
    [
        (0, [0, 1, 3], {}),  # an id of 0 exists
        (0, [1, 3], {"SERVO_VOLZ_MASK": float(0b1010)}),  # bits count from 0
        (1, [1, 2, 4], {"CAN_D1_UC_SRV_BM": float(0b1011)}),  # bit n - 1 stands for output n
        (0, [1, 3], {}),  # nothing but the data tells
        (1, [2, 4], {}),
    ],
)
def test_ids_are_paired_with_outputs(base: int, ids: list[int], parameters: dict[str, float]) -> None:
    pairs = find_pairs(log_of(ids, base=base, parameters=parameters))
    assert [pair.output.number for pair in pairs] == [i - base + 1 for i in ids]
    names = {1: "aileron", 2: "elevator", 4: "rudder"}
    assert [pair.surface for pair in pairs] == [names[pair.output.number] for pair in pairs]
    assert [pair.command for pair in pairs] == [f"RCOU.C{pair.output.number}" for pair in pairs]


def test_motors_are_left_out() -> None:
    pairs = find_pairs(log_of([0, 1, 2, 3], base=0))
    assert [pair.output.number for pair in pairs] == [1, 2, 4]


def test_what_the_servo_says_it_was_told_comes_first() -> None:
    pairs = find_pairs(log_of([0, 1], base=0, command_field=True))
    assert [pair.command for pair in pairs] == ["CSRV[0].PosCmd", "CSRV[1].PosCmd"]


@pytest.mark.parametrize("unit", ["deg", pytest.param("rad", marks=pytest.mark.slow)])
def test_the_scale_of_pulses_is_found(unit: str) -> None:
    draft = draft_aircraft(log_of([0, 1, 3], base=0, unit=unit))
    for surface in draft.surfaces:
        assert surface.command["slope_deg_per_us"] == pytest.approx(0.1, rel=0.01)
        assert surface.command["trim_us"] == pytest.approx(1500.0, abs=0.5)
        assert surface.measured["unit"] == unit
        assert surface.drafted is not None
        assert surface.drafted.peak_deg < 1.0


@pytest.mark.slow
def test_the_drafted_file_is_accepted_as_it_is(tmp_path: Path) -> None:
    from servofd.aircraft.schema import load_aircraft

    draft = draft_aircraft(log_of([0, 1, 3], base=0, command_field=True))
    config = tmp_path / "plane.toml"
    config.write_text(draft_to_toml(draft))
    loaded = load_aircraft(config)
    assert loaded.surfaces == draft.aircraft().surfaces
    assert loaded.servos == draft.aircraft().servos


def test_a_log_without_positions_says_what_to_log() -> None:
    with pytest.raises(NoMeasurement, match="SERVO_VOLZ_MASK"):
        draft_aircraft(log_of([], base=0))


def test_positions_in_another_unit_are_not_taken_for_degrees() -> None:
    with pytest.raises(NoMeasurement, match="is in us, not in deg or rad"):
        draft_aircraft(log_of([1, 2, 4], base=1, unit="us"))


def test_a_multirotor_is_called_one() -> None:
    for craft in ("quadrotor", "multirotor"):
        assert f"it is of a {craft}" in what_to_log(FlightLog(Path("a.bin"), "dataflash", {}, vehicle=craft))
    wing = what_to_log(FlightLog(Path("a.bin"), "dataflash", {}, vehicle="fixed wing"))
    assert wing.startswith("healthy flights of four days tell what each axis loses: `servofd calibrate")
    assert "CSRV" in wing

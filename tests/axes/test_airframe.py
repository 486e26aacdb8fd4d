"""A simulated aeroplane answers its surfaces, through every mixer, and its log is read as it was flown."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import logparsers
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.judge import judge_motion
from servofd.axes.motion import Motion, motion_of_autopilot
from servofd.cli import main
from servofd.simulation.airframe import MIXERS, AirframeFault, airframe_log, fly_airframe


@pytest.mark.slow
@pytest.mark.parametrize("mixer", list(MIXERS))
def test_every_mixer_flies_the_same_aeroplane(mixer: str, tmp_path: Path) -> None:
    log = tmp_path / "plane.bin"
    assert main(["simulate", "-o", str(log), "--airframe", mixer, "--duration", "60", "--seed", "3"]) == 0
    flight = fly_airframe(3, mixer=mixer, duration_s=60.0)
    motion = motion_of_autopilot(logparsers.read(log))
    flown = np.interp(motion.time_s - 5.0, flight.time_s, flight.rates_deg_s[0])
    assert np.corrcoef(motion.rates_deg_s[0], flown)[0, 1] > 0.98
    # A rolling moment rolls: the rate follows what was asked of the ailerons.
    asked, rate = motion.commands_us["roll"], motion.rates_deg_s[0]
    assert np.corrcoef(asked[:-5], rate[5:])[0, 1] > 0.3
    assert len(motion.members["roll"]) == 2


def test_a_jam_takes_half_of_the_roll() -> None:
    well = fly_airframe(4, duration_s=60.0, turbulence=0.0)
    jam = AirframeFault("aileron_left", "stuck", 20.0, 10.0)
    jammed = fly_airframe(4, duration_s=60.0, turbulence=0.0, faults=(jam,))
    assert np.array_equal(well.deflections_deg[well.time_s < 20.0], jammed.deflections_deg[jammed.time_s < 20.0])
    assert np.all(jammed.deflections_deg[jammed.time_s > 20.1, 0] == 10.0)


def flown(seed: int, day: int, **how: Any) -> Motion:
    """A flight as its log is read."""
    content = airframe_log(fly_airframe(seed, day=day, duration_s=120.0, **how))
    return replace(motion_of_autopilot(logparsers.read(io.BytesIO(content))), day=f"day {day}")


@pytest.mark.nightly
def test_an_aerobatic_flight_among_those_of_calibration_hides_no_half_of_an_elevator() -> None:
    days = [flown(1000 + day, day, turbulence=0.6 + 0.2 * (day % 4)) for day in range(6)]
    wild = flown(1100, 9, manoeuvres=2.4)
    assert np.max(np.abs(wild.roll_deg)) > 75.0
    half = AirframeFault("elevator", "loss_of_effectiveness", 60.0, 0.5)
    failed = [flown(seed, seed, faults=(half,)) for seed in (5001, 5003)]
    for flights in (days, [*days, wild]):
        model = calibrate_motion(flights)
        assert model.regime.lift_high_m_s2 < 20.0
        for motion in failed:
            (pitch,) = (audit for audit in judge_motion(model, motion) if audit.axis == "pitch")
            assert pitch.status in ("suspect", "fault")
            assert 60.0 < min(event.alarm_s for event in pitch.events) < 75.0


@pytest.mark.slow
def test_an_aileron_hard_over_whose_bank_moves_pitch_as_well_is_one_of_roll() -> None:
    model = calibrate_motion([flown(1000 + k, k // 2, turbulence=0.5 + 0.2 * (k % 4)) for k in range(6)])
    for seed in (3, 5):
        jam = AirframeFault("aileron_left", "stuck", 60.0, 20.0)
        flight = flown(seed, 9, turbulence=0.4, faults=(jam,))
        begin_s = float(flight.time_s[0]) + 60.0
        bank_deg = flight.roll_deg - np.interp(begin_s, flight.time_s, flight.roll_deg)
        pulled_us = 30.0 * np.abs(np.sin(np.radians(bank_deg)))
        flight.commands_us["pitch"][:] += np.where(flight.time_s > begin_s, pulled_us, 0.0)
        roll, pitch = (audit for audit in judge_motion(model, flight) if audit.axis in ("roll", "pitch"))
        assert roll.status in ("suspect", "fault")
        assert next(event.cause for event in pitch.events if event.start_s >= begin_s - 0.5) == "roll"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--airframe", "plane"], "mixer"),
        (["--airframe", "plain", "--fault", "flap:stuck@1:value=0"], "surface"),
        (["--airframe", "plain", "--fault", "rudder:stuck@1"], "value=X"),
        (["--airframe", "plain", "-c", "nosuch.toml"], "only --seed, --duration and --fault count; leave --config out"),
        (["--airframe", "plain", "--noise-deg", "0.2"], "leave --noise-deg out"),
    ],
)
def test_what_cannot_be_flown_is_one_line(
    words: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "-o", str(tmp_path / "a.bin"), *words]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1

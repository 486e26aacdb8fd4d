"""The sample logs: made by their script byte for byte, judged as their README says, and true where they are not."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import logparsers
import servofd

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
# Kind of the fault of the surface that matters, its onset and the latest alarm [s] (None: healthy).
VERDICTS: dict[str, tuple[str, str | None, float, float]] = {
    "faser_healthy_flight": ("aileron_right", None, 0.0, 0.0),
    "faser_healthy_chirp": ("aileron_right", None, 0.0, 0.0),
    "faser_deadband_flight": ("aileron_right", "deadband", 0.0, 3.5),
    "faser_deadband_chirp": ("aileron_right", "deadband", 0.0, 0.3),
    "faser_stuck_flight": ("elevator", "stuck", 5.0, 8.2),
    "faser_stuck_chirp": ("aileron_right", "stuck", 0.0, 0.3),
    "faser_bias_flight": ("rudder", "bias", 12.0, 12.3),
    "faser_hardover_flight": ("elevator", "hardover", 20.0, 20.1),
    "faser_floating_flight": ("aileron_left", "floating", 12.0, 12.5),
    "faser_oscillation_flight": ("elevator", "oscillation", 18.0, 18.3),
    "faser_slow_flight": ("aileron_right", "slow", 12.0, 15.3),
    "faser_loss_flight": ("rudder", "loss_of_effectiveness", 12.0, 15.4),
}
EARLY_S = 0.05
"""An onset is known to a few samples."""
TABLE = "table_three_faults.csv"
# Of the logs of autopilots, named by their files: commands, positions, what turns the latter into degrees, and to
# how many [deg] they are logged.
AUTOPILOTS: dict[str, tuple[str, str, float, float]] = {
    "ardupilot_volz_stuck.bin": ("RCOU.C{n}", "CSRV[{id}].Pos", 1.0, 0.03),
    "ardupilot_dronecan_healthy.bin": ("RCOU.C{n}", "CSRV[{n}].Pos", 180.0 / np.pi, 0.02),
    "telemetry_stuck.tlog": ("SERVO_OUTPUT_RAW.servo{n}_raw", "NAMED_VALUE_FLOAT[SRVP{n}].value", 1.0, 1e-5),
    "px4_stuck.ulg": ("actuator_servos[0].control[{k}]", "debug_array[0][SRVP].data[{k}]", 1.0, 1e-5),
}
MAKE = runpy.run_path(str(SAMPLES / "make.py"))


@pytest.mark.slow
@pytest.mark.parametrize("name", VERDICTS)
def test_verdicts(name: str) -> None:
    surface, kind, onset_s, alarm_s = VERDICTS[name]
    (result,) = servofd.audit(SAMPLES / f"{name}.mat")
    verdicts = {verdict.surface: verdict for verdict in result.surfaces}
    for other, verdict in verdicts.items():
        if other != surface or kind is None:
            assert verdict.status == ("no_data" if other.startswith("flap") else "healthy")
    if kind is not None:
        assert verdicts[surface].status == "fault"
        (fault,) = verdicts[surface].faults
        assert (fault.kind, fault.end_s) == (kind, None)
        assert onset_s - EARLY_S <= fault.start_s <= fault.alarm_s <= alarm_s


@pytest.mark.slow
def test_one_fault_passes_another_follows_and_a_second_surface_fails_meanwhile() -> None:
    (result,) = servofd.audit(SAMPLES / TABLE, servo="hs225bb-eq31")
    verdicts = {verdict.surface: verdict for verdict in result.surfaces}
    assert {name: verdict.status for name, verdict in verdicts.items()} == {
        "aileron": "healthy",
        "elevator": "fault",
        "rudder": "fault",
    }
    band, jam = verdicts["elevator"].faults
    assert (band.kind, jam.kind) == ("deadband", "stuck")
    assert 5.0 <= band.start_s <= band.alarm_s < 6.0
    assert band.end_s is not None
    assert 14.0 <= band.end_s < 29.0
    assert 30.0 <= jam.start_s <= jam.alarm_s < 32.0
    assert jam.end_s is None
    (bias,) = verdicts["rudder"].faults
    assert (bias.kind, bias.end_s) == ("bias", None)
    assert 10.0 <= bias.start_s <= bias.alarm_s < 10.3


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_logs_of_autopilots_hold_the_truth(name: str) -> None:
    path = SAMPLES / name
    assert path.stat().st_size <= 400_000
    log = logparsers.read(path)
    assert (log.damage, log.vehicle, "stuck" in name) == ((), "fixed wing", bool(MAKE["AUTOPILOTS"][name][2]))
    _, flight = MAKE["flown_by_autopilot"](name)
    command, position, to_deg, tolerance_deg = AUTOPILOTS[name]
    for k, output in enumerate(flight.outputs):
        labels = {"n": output.number, "id": output.number - 1, "k": k}
        sent, reported = log[command.format(**labels)], log[position.format(**labels)]
        for channel in (sent, reported):
            np.testing.assert_allclose(channel.time_s, flight.time_s, rtol=0, atol=1e-6)
        if sent.unit == "us":
            asked_deg = output.deflection_deg(sent.values.astype(np.int64))
        else:
            asked_deg = sent.values * output.travel_deg
        # Another CPU may round one pulse of the simulation otherwise: 0.09 deg.
        np.testing.assert_allclose(asked_deg, flight.command_deg[:, k], rtol=0, atol=0.1)
        np.testing.assert_allclose(reported.values * to_deg, flight.measured_deg[:, k], rtol=0, atol=tolerance_deg)
        late = reported.values[reported.time_s > 21.0] * to_deg
        assert (np.std(late) < 0.15) == ("stuck" in name and output.surface == "elevator")


@pytest.mark.slow
def test_the_script_makes_the_same_bytes(tmp_path: Path) -> None:
    made = MAKE["make"](tmp_path)
    assert {path.name for path in made} == {*(f"{name}.mat" for name in VERDICTS), TABLE, *AUTOPILOTS}
    for path in made:
        ours, stored = logparsers.read(path), logparsers.read(SAMPLES / path.name)
        assert list(ours.channels) == list(stored.channels)
        for channel in ours.channels:
            # Single precision on file; another CPU may round the last bit of the simulation otherwise.
            np.testing.assert_allclose(ours[channel].values, stored[channel].values, rtol=2e-7, atol=1.0)
        assert path.stat().st_size == (SAMPLES / path.name).stat().st_size


# Format, surface that jams at 20 s (None: all healthy), latest alarm: 0.5 s after its first brisk command [s].
AUTOPILOT_VERDICTS: dict[str, tuple[str, str | None, float]] = {
    "ardupilot_dronecan_healthy.bin": ("dataflash", None, 0.0),
    "ardupilot_volz_stuck.bin": ("dataflash", "elevator", 26.0),
    "telemetry_stuck.tlog": ("tlog", "elevator", 26.0),
    "px4_stuck.ulg": ("ulog", "servo_2", 26.0),
}


@pytest.mark.parametrize(
    ("name", "configured"),
    [
        # The README's audit is of the log with Volz servos; its test is of every word that it prints.
        *(
            pytest.param(name, False, marks=pytest.mark.nightly if "volz" in name else [])
            for name in AUTOPILOT_VERDICTS
        ),
        *(
            pytest.param(name, True, marks=[] if name.endswith(".ulg") else pytest.mark.nightly)
            for name in AUTOPILOT_VERDICTS
        ),
    ],
)
@pytest.mark.slow
def test_autopilot_logs_are_audited_with_nothing_configured_by_hand(
    name: str, configured: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from servofd.cli import main

    log_format, jammed, alarm_s = AUTOPILOT_VERDICTS[name]
    config = None
    if configured:
        assert main(["config", str(SAMPLES / name)]) == 0
        config = tmp_path / "plane.toml"
        config.write_text(capsys.readouterr().out)
    (result,) = servofd.audit(SAMPLES / name, config)
    assert result.log.format == log_format
    assert len(result.surfaces) == 3
    for verdict in result.surfaces:
        assert verdict.status == ("fault" if verdict.surface == jammed else "healthy")
        for fault in verdict.faults:
            assert 20.0 <= fault.start_s <= 20.5
            assert fault.start_s <= fault.alarm_s <= alarm_s
            assert (fault.kind, fault.end_s) == ("stuck", None)

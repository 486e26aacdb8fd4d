"""Every sample log, as the autopilot would have met it: the faults of an audit, and no other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.aircraft.schema import load_aircraft
from servofd.onboard.plan import plan_onboard
from servofd.onboard.script import watch_script
from tests.onboard.autopilot import fly
from tests.onboard.flights import flight_of, on_autopilot

SAMPLES = Path(__file__).parents[2] / "sample_logs"
NAMES = {
    "ardupilot_volz_stuck.bin": {"elevator": "stuck"},
    "ardupilot_dronecan_healthy.bin": {},
    "telemetry_stuck.tlog": {"elevator": "stuck"},
    "px4_stuck.ulg": {"servo_2": "stuck"},
    "table_three_faults.csv": {"elevator": "stuck", "rudder": "offset"},
    "faser_stuck_flight.mat": {"elevator": "stuck"},
    "faser_slow_flight.mat": {"aileron_right": "slow"},
    "faser_bias_flight.mat": {"rudder": "offset"},
    "faser_hardover_flight.mat": {"elevator": "stuck"},  # where its stops are, a table of degrees does not tell
    "faser_floating_flight.mat": {"aileron_left": "moves"},  # by itself
    "faser_loss_flight.mat": {"rudder": "moves"},  # 42 % of its way
    "faser_oscillation_flight.mat": {"elevator": "moves"},
    "faser_deadband_flight.mat": {"aileron_right": ""},
    "faser_healthy_flight.mat": {},
}
"""What the script may call each fault; empty where it only says that the surface is off."""


QUICK = ("faser_slow_flight.mat",)


LATER_S = 4.0
"""The script counts three residuals in a row, and has no windows beyond 2 s."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "sample", [pytest.param(name, marks=() if name in QUICK else pytest.mark.nightly) for name in NAMES]
)
def test_faults_are_those_of_an_audit(tmp_path: Path, sample: str) -> None:
    known = load_aircraft("faser") if sample.startswith("faser") else None
    (audit,) = servofd.audit(SAMPLES / sample, aircraft=known, threshold="constant")
    judged = {one.surface: one for one in audit.surfaces if one.segment is not None and one.residuals is not None}
    aircraft = on_autopilot(audit.aircraft)
    period_s = np.median([one.segment.period_s for one in judged.values() if one.segment])
    plan = plan_onboard(aircraft, tuple(judged), rate_hz=float(1.0 / period_s), instructions=20_000)
    segments = {one.output: judged[one.surface].segment for one in plan.surfaces}
    flown = fly(watch_script(plan), flight_of(segments), tmp_path)
    for planned in plan.surfaces:
        alarms_s = [1e-6 * (time & 0xFFFFFFFF) for time, text in flown.texts if f"{planned.name} off by" in text]
        faults = judged[planned.surface].faults
        assert bool(alarms_s) == bool(faults)
        if faults:
            assert faults[0].start_s <= alarms_s[0] <= faults[0].alarm_s + LATER_S
            assert NAMES[sample].get(planned.surface, "") in [*(t.split()[1] for t in flown.said(planned.name)), ""]

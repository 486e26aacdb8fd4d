"""Every sample log, as the autopilot would have met it: the alarms of an audit, and no other."""

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
from tests.onboard.latch import alarms_s as latched_s

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
    "faser_floating_flight.mat": {"aileron_left": ""},
    "faser_loss_flight.mat": {"rudder": ""},
    "faser_oscillation_flight.mat": {"elevator": ""},
    "faser_deadband_flight.mat": {"aileron_right": ""},
    "faser_healthy_flight.mat": {},
}
"""What the script may call each fault; empty where it only says that the surface is off."""


QUICK = ("ardupilot_dronecan_healthy.bin", "faser_slow_flight.mat")


@pytest.mark.slow
@pytest.mark.parametrize(
    "sample", [pytest.param(name, marks=() if name in QUICK else pytest.mark.nightly) for name in NAMES]
)
def test_alarms_are_those_of_an_audit(tmp_path: Path, sample: str) -> None:
    known = load_aircraft("faser") if sample.startswith("faser") else None
    (audit,) = servofd.audit(SAMPLES / sample, aircraft=known, threshold="constant")
    judged = {one.surface: one for one in audit.surfaces if one.segment is not None and one.residuals is not None}
    aircraft = on_autopilot(audit.aircraft)
    period_s = np.median([one.segment.period_s for one in judged.values() if one.segment])
    plan = plan_onboard(aircraft, tuple(judged), rate_hz=float(1.0 / period_s), instructions=20_000)
    segments = {one.output: judged[one.surface].segment for one in plan.surfaces}
    flown = fly(watch_script(plan), flight_of(segments), tmp_path)
    for planned in plan.surfaces:
        one, rows = judged[planned.surface], flown.of(planned.output)
        assert one.residuals is not None
        wanted = np.where(one.residuals.settled, one.residuals.residual_deg, np.nan)
        assert np.nanmax(np.abs(rows["residual"] - wanted[np.isfinite(one.residuals.measured_deg)])) < 1e-3
        alarms_s = [1e-6 * (time & 0xFFFFFFFF) for time, text in flown.texts if f"{planned.name} off by" in text]
        assert one.threshold is not None
        surface = audit.aircraft.surfaces[planned.surface]
        # An audit may think better of an alarm where its servo was fitted to the log; the crossings are the same.
        foreseen_s = latched_s(one.residuals, one.threshold, surface.persistence)
        assert len(alarms_s) == len(foreseen_s)
        assert np.allclose(alarms_s, foreseen_s, atol=1.5 * period_s, rtol=0.0)
        said = [text.split()[1] for text in flown.said(planned.name)]
        allowed = {"off", "follows", NAMES[sample].get(planned.surface, "")} if foreseen_s else set()
        assert set(said) <= allowed
        if NAMES[sample].get(planned.surface):
            assert NAMES[sample][planned.surface] in said

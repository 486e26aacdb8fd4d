"""A linkage along cubics of the shaft, against an integration in much shorter steps; and a shaft that sticks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.discrepancy.record import record_of, simulate
from servofd.servo.library import servo_named
from servofd.servo.loops import play
from servofd.servo.physics import Physics
from servofd.servo.servo_model import ServoModel

KNOWN = ServoModel.of(servo_named("hs225bb-eq31")).linear()
FREE = Physics(delay_s=0.004)
COMMAND_S = np.arange(0.0, 8.0, 0.01)
COMMAND_DEG = 5.0 * np.sin(2.0 * np.pi * (0.5 + 0.7 * COMMAND_S) * COMMAND_S)
"""Up to 12 Hz, held over 10 ms each."""


def moved(physics: Physics, at_s: FloatArray) -> FloatArray:
    segment = Series("x", COMMAND_S, COMMAND_DEG, at_s, np.zeros(at_s.size), command_period_s=0.01)
    return simulate(record_of(segment, KNOWN), physics)


FINE_S = np.arange(0.0, 7.9, 1e-4)
JITTERED_S = np.sort(np.random.default_rng(2).choice(FINE_S, 700, replace=False))
JITTERED_S[0] = 0.0


@pytest.mark.slow
@pytest.mark.parametrize("at_s", [FINE_S[::100], JITTERED_S], ids=["even", "jittered"])
def test_a_tip_a_sensor_and_a_play_follow_the_shaft_as_if_integrated_finely(at_s: FloatArray) -> None:
    shaft_deg, at = moved(FREE, FINE_S), np.searchsorted(FINE_S, at_s - 1e-9)
    natural = 2.0 * np.pi * 9.0
    tip_deg = lsim(([natural**2], [1.0, 0.2 * natural, natural**2]), shaft_deg, FINE_S)[1]
    lagged_deg = lsim(([1.0], [0.03, 1.0]), shaft_deg, FINE_S)[1]
    tip = moved(FREE._replace(resonance_hz=9.0, resonance_damping=0.1), at_s)
    np.testing.assert_allclose(tip, tip_deg[at], rtol=0, atol=1e-3)
    np.testing.assert_allclose(moved(FREE._replace(lag_s=0.03), at_s), lagged_deg[at], rtol=0, atol=5e-4)
    loose = moved(FREE._replace(backlash_deg=1.0), at_s)
    # It turns back within a step of 2.5 ms: at 12 Hz and 3 deg by at most 3 * (2 pi 12)^2 * 0.0025^2 / 8 deg too soon.
    np.testing.assert_allclose(loose, play(shaft_deg, 1.0, 0.0)[at], rtol=0, atol=1.4e-2)


def test_a_servo_within_its_friction_stays_where_it_is() -> None:
    """A ramp of 0.5 deg/s is as much as a friction of 0.6 deg after 1.2 s; the torque is a tenth of a second behind."""
    time_s = np.arange(0.0, 3.0, 0.01)
    record = record_of(Series("x", time_s, 0.5 * time_s, time_s, np.zeros(time_s.size)), KNOWN)
    moved_deg = simulate(record, FREE._replace(friction_deg=0.6))
    assert np.ptp(moved_deg[time_s < 1.2]) == 0.0
    assert moved_deg[time_s < 1.25][-1] > 0.0
    heavy_deg = simulate(record, FREE._replace(friction_deg=0.3, load_friction=0.5))
    assert np.ptp(heavy_deg[time_s < 1.2]) == 0.0
    assert heavy_deg[time_s < 1.25][-1] > 0.0

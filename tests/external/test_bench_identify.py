"""Identification of real servos on the bench."""

from __future__ import annotations

import numpy as np
import pytest

from logparsers import FlightLog
from servofd.aircraft.series import Series
from servofd.identification.identify import identify
from tests.external.test_bench_tables import DATA, logs_of

pytestmark = pytest.mark.skipif(
    not (DATA / "bench").is_dir(),
    reason="no bench records: set SERVOFD_EXTERNAL_DATA to the directory that holds bench/ and logs/",
)


def segment(log: FlightLog) -> Series:
    command, measured = log["cmd"], log["meas"]
    given = np.isfinite(command.values)
    return Series("shaft", command.time_s[given], command.values[given], measured.time_s, measured.values)


@pytest.mark.nightly
def test_hobby_servo_with_everything_it_has() -> None:
    """A linear servo leaves 15.4 deg; with both rate limits and the dead band at most 3.0 deg."""
    result = identify([[segment(log) for log in logs_of("hobby_servo_encoder")]])
    assert len(result.runs) == 32
    assert result.rms_deg <= 3.0
    assert result.servo.rate_up_deg_s == pytest.approx(255.0, rel=0.05)
    assert result.servo.rate_down_deg_s == pytest.approx(276.0, rel=0.05)
    assert result.servo.dead_band_deg is not None
    assert 3.0 < result.servo.dead_band_deg < 8.0
    assert 0.03 < result.servo.linear.delay_s < 0.06


@pytest.mark.slow
def test_smart_servo_under_gravity() -> None:
    result = identify([[segment(log) for log in logs_of("smart_servo_gravity_load")]])
    assert min(result.fits_percent) >= 99.3

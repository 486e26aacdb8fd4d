"""Where a gap lies: what it depends on is told, and chance is not."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.signal import lfilter

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.discrepancy.locate import (
    coherent_to_hz,
    excess_band_hz,
    maps,
    oscillation,
    sentences,
    since_reversal_s,
    spectrum,
)
from servofd.discrepancy.record import Record, record_of, simulate
from servofd.servo.context import Context
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import doublets

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
TIME_S = np.arange(6000) / 100.0
NOISE_DEG = 0.1


@functools.cache
def flown(seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Command and position of a healthy servo, without noise [deg]."""
    command_deg = doublets(TIME_S, np.random.default_rng(seed))
    return command_deg, KNOWN.simulate(TIME_S, command_deg, TIME_S)


def record(wrong_deg: FloatArray, seed: int = 0, context: Context | None = None) -> tuple[Record, FloatArray]:
    """A flight whose position is off by so much, and the error of the healthy model [deg]."""
    command_deg, moved_deg = flown(seed)
    segment = Series("x", TIME_S, command_deg, TIME_S, moved_deg + wrong_deg, context=context or Context())
    made = record_of(segment, KNOWN)
    return made, made.measured_deg - simulate(made, made.model.physics)


def noise_deg(seed: int, memory: float = 0.0) -> FloatArray:
    white = np.random.default_rng(1000 + seed).standard_normal(TIME_S.size)
    coloured: FloatArray = NOISE_DEG * lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], white)
    return coloured


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_chance_tells_nothing(memory: float) -> None:
    """Noise of which half passes for a gap: at most one log in a hundred may seem to depend on anything."""
    wrong = 0
    for seed in range(12):
        made, error_deg = record(noise_deg(seed, memory), seed)
        wrong += any(each.share > 0.25 for each in maps(made, error_deg, 0.5 * NOISE_DEG))
    assert wrong <= 1


def test_a_gap_that_grows_with_the_temperature_is_told() -> None:
    warm_c = 20.0 + 10.0 * np.sin(0.4 * TIME_S) ** 2
    context = Context(temperature_s=TIME_S, temperature_c=warm_c)
    found = maps(*record(0.05 * (warm_c - 25.0) + noise_deg(2), context=context), NOISE_DEG)
    assert found[0].quantity == "temperature"
    assert found[0].share > 0.8


def test_a_gap_right_after_reversals_is_told() -> None:
    _, moved_deg = flown()
    since_s = since_reversal_s(TIME_S, moved_deg, 2.0)
    said = sentences(*record(np.where(since_s < 0.2, 1.0, 0.0) + noise_deg(3)), NOISE_DEG)
    assert any("within 0.3 s after reversals of more than 2 deg" in each for each in said)
    spread = sentences(*record(0.2 * moved_deg + noise_deg(3)), NOISE_DEG)
    assert not any("reversals" in each for each in spread)


def test_the_band_of_a_gap_and_the_end_of_coherence() -> None:
    made, error_deg = record(0.4 * np.sin(2.0 * np.pi * 6.0 * TIME_S) + noise_deg(4))
    found = spectrum(made, error_deg)
    assert found is not None
    band_hz = excess_band_hz(found, NOISE_DEG)
    assert band_hz is not None
    assert band_hz == pytest.approx((6.0, 6.0), abs=0.5)
    assert any("four fifths of the excess lie between" in each for each in sentences(made, error_deg, NOISE_DEG))
    linear = spectrum(*record(noise_deg(4, 0.0) * 0.01))
    assert linear is not None
    assert coherent_to_hz(linear) is None
    _, moved_deg = flown()
    rough = spectrum(*record(3.0 * np.sign(np.gradient(moved_deg)) * (np.abs(moved_deg) > 1.0)))
    assert rough is not None
    assert coherent_to_hz(rough) is not None


def test_a_short_record_has_no_spectrum() -> None:
    made, error_deg = record(noise_deg(5))
    few = slice(0, 150)
    short = record_of(Series("x", TIME_S[few], flown()[0][few], TIME_S[few], made.measured_deg[few]), KNOWN)
    assert spectrum(short, error_deg[few]) is None


@pytest.mark.parametrize(("hz", "size_deg", "from_s", "to_s"), [(3.0, 0.6, 30.0, 60.0), (5.2, 0.3, 20.0, 41.0)])
def test_an_oscillation_is_told_with_its_span(hz: float, size_deg: float, from_s: float, to_s: float) -> None:
    there = (from_s <= TIME_S) & (to_s > TIME_S)
    found = oscillation(*record(np.where(there, size_deg * np.sin(2.0 * np.pi * hz * TIME_S), 0.0) + noise_deg(6)), 0.1)
    assert found is not None
    assert found.amplitude_deg == pytest.approx(size_deg, rel=0.2)
    assert found.frequency_hz == pytest.approx(hz, abs=0.1)
    assert found.start_s == pytest.approx(from_s, abs=1.0)
    assert found.end_s == pytest.approx(to_s, abs=1.0)


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_neither_noise_nor_a_servo_that_lags_oscillates(memory: float) -> None:
    _, moved_deg = flown()
    assert oscillation(*record(noise_deg(7, memory)), NOISE_DEG) is None
    assert oscillation(*record(np.roll(moved_deg, 4) - moved_deg + noise_deg(7)), NOISE_DEG) is None

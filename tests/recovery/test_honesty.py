"""What `explain` says it knows, it knows: floors, intervals, clocks and needles in the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray
from servofd.discrepancy.adequacy import adequacy
from servofd.discrepancy.fit import Fitter
from servofd.discrepancy.known import NOTHING
from servofd.discrepancy.noise import noise_floor_deg
from servofd.discrepancy.record import Record, comb_step_deg, record_of, simulate
from servofd.discrepancy.search import best_frame
from servofd.discrepancy.select import select
from servofd.servo.catalogue import installed
from servofd.servo.effect import Effect
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import Backlash
from servofd.servo.effects.motor import CurrentLimit
from servofd.servo.library import servo_named
from servofd.servo.loop import AFTER, BEFORE
from servofd.servo.physics import Physics
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import COMMANDS

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
CONVERTER_DEG = 180.0 / 4096.0


def flown(
    effects: tuple[type[Effect], ...],
    values: list[float],
    seed: int,
    command: str = "gusty",
    noise_deg: float = 0.1,
    duration_s: float = 30.0,
) -> Record:
    """A servo with effects, simulated by the kernel; not to name them, but to see what is made of noise."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, duration_s, 0.01)
    command_deg = COMMANDS[command](time_s, rng)
    empty = record_of(Series("x", time_s, command_deg, time_s, 0.0 * time_s), KNOWN)
    moved_deg = simulate(empty, installed(empty.model.physics, effects, values))
    return replace(empty, measured_deg=moved_deg + noise_deg * rng.standard_normal(time_s.size))


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_a_surface_at_rest_is_that_of_its_comb(seed: int) -> None:
    """Noise of about one step: the median of whole steps would be off by up to 15 %."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, 0.05 + 0.002 * seed, 6000)
    read_deg: FloatArray = np.round(CONVERTER_DEG * np.round(noise / CONVERTER_DEG), 3)
    time_s: FloatArray = np.arange(0.0, 60.0, 0.01)
    record = record_of(Series("x", time_s, 0.0 * time_s, time_s, read_deg), KNOWN)
    assert record.step_deg == pytest.approx(CONVERTER_DEG, rel=2e-3)
    assert noise_floor_deg(record, read_deg) == pytest.approx(float(np.std(read_deg)), rel=0.05)


def test_a_comb_need_not_begin_at_zero_nor_be_written_exactly() -> None:
    steps = np.random.default_rng(0).integers(-200, 200, 4000)
    assert comb_step_deg(np.round(0.013 + CONVERTER_DEG * steps, 3)) == pytest.approx(CONVERTER_DEG, rel=1e-4)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("grows", "is_noise"), [(0.0, True), (1.0, False)])
def test_correlated_noise_is_that_of_a_sensor_if_it_is_the_same_throughout(
    grows: float, is_noise: bool, seed: int
) -> None:
    """What is several times the white part and swells, as no sensor's noise does, is a model's; no block stands out."""
    record = flown((), [], seed, "chirp", noise_deg=0.05, duration_s=60.0)
    white = np.random.default_rng(100 + seed).standard_normal(record.time_s.size)
    slow: FloatArray = 0.15 * lfilter([np.sqrt(1.0 - 0.9**2)], [1.0, -0.9], white)
    swells = 1.0 + 0.5 * grows * np.sin(2.0 * np.pi * record.time_s / 20.0)
    record = replace(record, measured_deg=record.measured_deg + swells * slow)
    found = adequacy(record, Fitter(record).nominal())
    assert (not found.reasons) == is_noise


def _deviations(effect: type[Effect], values: list[float], command: str) -> FloatArray:
    """Errors of the first parameter over many draws of the noise, in standard deviations that were claimed."""
    away = []
    for seed in range(16):
        fitter = Fitter(flown((effect,), values, seed, command))
        fit = fitter.descended(
            (effect,), installed(fitter.record.model.physics, (effect,), [0.97 * values[0], *values[1:]])
        )
        away.append((fit.values[0] - values[0]) / np.sqrt(fitter.covariance(fit)[0, 0]))
    return np.array(away)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "values", "command"),
    [
        (CurrentLimit, [3.0], "gusty"),
        (Backlash, [1.0], "chirp"),
        pytest.param(Delay, [0.02], "chirp", marks=pytest.mark.nightly),
    ],
)
def test_intervals_hold_the_truth(effect: type[Effect], values: list[float], command: str) -> None:
    away = _deviations(effect, values, command)
    assert np.mean(np.abs(away) < 1.96) > 0.8
    assert 0.2 < np.std(away) < 1.5  # poles that may differ by 3 % widen it


@pytest.mark.slow
@pytest.mark.parametrize(
    ("period_s", "seed", "phase"),
    [
        (0.05, 3, 0.93),
        *(
            pytest.param(*each, marks=pytest.mark.nightly)
            for each in ((0.05, 2, 0.41), (0.033, 2, 0.41), (0.033, 3, 0.93))
        ),
    ],
)
def test_frames_are_found_whatever_their_phase(period_s: float, seed: int, phase: float) -> None:
    record = flown((), [], seed)
    framed = record.model.physics._replace(frame_s=period_s, frame_phase=phase)
    noise = 0.1 * np.random.default_rng(seed).standard_normal(record.time_s.size)
    record = replace(record, measured_deg=simulate(record, framed) + noise)
    found = best_frame(record, record.model.physics)
    assert found is not None
    assert found[0] == pytest.approx(period_s, rel=2e-4)


def left(record: Record, physics: Physics) -> tuple[str, ...]:
    return adequacy(record, Fitter(record).judged((), physics)).reasons


def test_chance_alone_leaves_nothing_unexplained_however_few_the_samples() -> None:
    found = [
        left(record, record.model.physics) for record in (flown((), [], seed, duration_s=8.0) for seed in range(30))
    ]
    assert sum(bool(reasons) for reasons in found) == 0


def test_what_the_motion_predicts_is_no_noise_and_noise_with_memory_is_noise() -> None:
    """Of a tenth of the noise's variance the floor says nothing."""
    record = flown((), [], 5, duration_s=60.0)
    simulated_deg = simulate(record, record.model.physics)
    speed = np.gradient(simulated_deg, record.time_s)
    wave = 0.1 * np.sqrt(0.1) * speed / np.std(speed)
    assert left(record, record.model.physics) == ()
    assert left(replace(record, measured_deg=record.measured_deg + wave), record.model.physics) != ()
    rng, noise = np.random.default_rng(6), np.zeros(record.time_s.size)
    for k in range(1, noise.size):
        noise[k] = 0.8 * noise[k - 1] + 0.06 * rng.standard_normal()
    assert left(replace(record, measured_deg=simulated_deg + noise), record.model.physics) == ()


@pytest.mark.slow
def test_a_servo_off_by_as_much_as_its_type_differs_lacks_nothing() -> None:
    record = flown((), [], 3)
    other = record.model.physics._replace(
        slow_scale=1.03, pair_scale=0.97, damping_scale=1.05, gain=1.01, bias_deg=0.08
    )
    noise = 0.1 * np.random.default_rng(3).standard_normal(record.time_s.size)
    found = select(replace(record, measured_deg=simulate(record, other) + noise))
    assert found.final.names == ()
    assert found.adequacy.reasons == ()
    assert found.final.held_out < found.nominal.held_out


@pytest.mark.nightly
@pytest.mark.parametrize("place", [BEFORE, AFTER])
def test_the_place_of_the_slow_pole_decides_which_effect_it_is(place: float) -> None:
    """A dead band behind a slow filter, or ahead of one, is friction to a model that has its poles in the loop."""
    record = flown((), [], 3, duration_s=50.0)
    hidden = record.model.physics._replace(slow_place=place, deadband_deg=1.5)
    noise = 0.15 * np.random.default_rng(8).standard_normal(record.time_s.size)
    found = select(replace(record, measured_deg=simulate(record, hidden) + noise))
    assert found.final.names == ("deadband",)
    assert found.final.values[0] == pytest.approx(1.5, abs=0.1)
    assert found.final.place == place
    assert found.adequacy.reasons == ()


def test_what_is_held_out_was_not_fitted() -> None:
    """Though few samples count, as errors are correlated: what one half tells of the servo is not what both tell."""
    record = flown((), [], 3)
    wave = np.repeat(np.random.default_rng(8).normal(0.0, 0.4, record.time_s.size // 25), 25)
    fitter = Fitter(replace(record, measured_deg=record.measured_deg + wave, known=NOTHING))
    half = fitter.halved(fitter.root)
    assert fitter.effective < 0.1 * record.counts.sum()
    assert half.held_out > 1.005 * half.train

"""What `explain` says it knows, it knows: floors, intervals, clocks and needles in the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servofd.discrepancy.evidence import rest_matters
from servofd.discrepancy.explanation import explain_gap
from servofd.discrepancy.fit import Fitter
from servofd.discrepancy.frames import best_frame, usual_frame
from servofd.discrepancy.ladder import _behind
from servofd.discrepancy.noise import comb_step_deg, noise_floor_deg
from servofd.discrepancy.prune import pruned
from servofd.discrepancy.record import Record, record_of, simulate
from servofd.discrepancy.search import begin
from servofd.discrepancy.stamps import scatter_s
from servofd.models.catalogue import (
    Backlash,
    CurrentLimit,
    Delay,
    Friction,
    MissingEffect,
    PwmFrame,
    RateLimit,
    Resonance,
    installed,
)
from servofd.models.servo_model import ServoModel
from servofd.segment import Segment
from servofd.servos import servo_named
from servofd.simulation.commands import COMMANDS
from servofd.types import FloatArray

KNOWN = ServoModel.of(servo_named("hs225bb-eq31"))
CONVERTER_DEG = 180.0 / 4096.0


def flown(
    effects: tuple[type[MissingEffect], ...],
    values: list[float],
    seed: int,
    command: str = "lively",
    noise_deg: float = 0.1,
    duration_s: float = 30.0,
) -> Record:
    """A servo with effects, simulated by the kernel; not to name them, but to see what is made of noise."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, duration_s, 0.01)
    command_deg = COMMANDS[command](time_s, rng)
    empty = record_of(Segment("x", time_s, command_deg, time_s, 0.0 * time_s), KNOWN)
    moved_deg = simulate(empty, installed(empty.plant.neutral, effects, values))
    return replace(empty, measured_deg=moved_deg + noise_deg * rng.standard_normal(time_s.size))


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_a_surface_at_rest_is_that_of_its_comb(seed: int) -> None:
    """Noise of about one step: the median of whole steps would be off by up to 15 %."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, 0.05 + 0.002 * seed, 6000)
    read_deg: FloatArray = np.round(CONVERTER_DEG * np.round(noise / CONVERTER_DEG), 3)
    time_s: FloatArray = np.arange(0.0, 60.0, 0.01)
    record = record_of(Segment("x", time_s, 0.0 * time_s, time_s, read_deg), KNOWN)
    assert record.step_deg == pytest.approx(CONVERTER_DEG, rel=2e-3)
    assert noise_floor_deg(record, read_deg) == pytest.approx(float(np.std(read_deg)), rel=0.05)


def test_a_comb_need_not_begin_at_zero_nor_be_written_exactly() -> None:
    steps = np.random.default_rng(0).integers(-200, 200, 4000)
    assert comb_step_deg(np.round(0.013 + CONVERTER_DEG * steps, 3)) == pytest.approx(CONVERTER_DEG, rel=1e-4)


def test_chance_alone_leaves_nothing_unexplained_however_few_the_samples() -> None:
    left = 0
    for seed in range(30):
        record = flown((), [], seed, duration_s=8.0)
        fit = Fitter(record).nominal()
        left += rest_matters(record, fit, fit, noise_floor_deg(record, fit.error_deg))
    assert left == 0


def _wavering(seed: int, deviation_s: float) -> Segment:
    record = flown((), [], seed, noise_deg=0.05)
    off_s = deviation_s * np.random.default_rng(seed).standard_normal(record.time_s.size)
    stamps_s = record.time_s + np.clip(off_s, -0.0049, 0.0049)
    sent = record.commands
    return Segment("x", sent.effective_s, sent.command_deg, stamps_s, record.measured_deg)


def test_a_clock_that_wavers_is_said_to_and_no_effect_is_named() -> None:
    found = explain_gap(_wavering(3, 0.003), KNOWN)
    assert found.conclusion == "unexplained"
    assert found.selection.scatter_s == pytest.approx(0.003, rel=0.2)
    assert any("stamps scattered by" in note for note in found.notes)


@pytest.mark.parametrize("seed", range(4))
def test_stamps_that_are_true_are_not_said_to_scatter(seed: int) -> None:
    healthy = flown((), [], seed)
    assert scatter_s(healthy, Fitter(healthy).nominal().error_deg, 0.06) == 0.0
    late = flown((Delay,), [0.02], seed)
    assert scatter_s(late, Fitter(late).nominal().error_deg, 0.06) == 0.0  # the motion tells its sign


def _deviations(effect: type[MissingEffect], values: list[float], command: str) -> FloatArray:
    """Errors of the first parameter over many draws of the noise, in standard deviations that were claimed."""
    away = []
    for seed in range(16):
        fitter = Fitter(flown((effect,), values, seed, command))
        fit, covariance = fitter.on_all(fitter.refitted((effect,), [0.97 * values[0], *values[1:]]))
        away.append((fit.values[0] - values[0]) / np.sqrt(covariance[0, 0]))
    return np.array(away)


@pytest.mark.parametrize(
    ("effect", "values", "command"),
    [(CurrentLimit, [3.0], "lively"), (Backlash, [1.0], "chirp"), (Delay, [0.02], "chirp")],
)
def test_intervals_hold_the_truth(effect: type[MissingEffect], values: list[float], command: str) -> None:
    away = _deviations(effect, values, command)
    assert np.mean(np.abs(away) < 1.96) > 0.8
    assert 0.3 < np.std(away) < 1.5


def test_what_slips_within_a_step_of_the_kernel_widens_its_interval_and_a_delay_does_not() -> None:
    shares = []
    for effect, values in ((Friction, [0.8, 0.8]), (Delay, [0.02])):
        fitter = Fitter(flown((effect,), values, 1, "chirp"))
        moved = fitter.discretization(fitter.judged((effect,), values))
        shares.append(float(np.sqrt(moved[0, 0])) / values[0])
    assert shares[0] > 1.3 * shares[1]
    assert 1e-3 < shares[1] < 3e-3  # what two simulators differ by; a part of the delay was known


def test_an_effect_at_its_bound_takes_no_other_down_with_it() -> None:
    record = flown((Delay, Backlash), [0.02, 1.0], 5)
    fitter = Fitter(record)
    best = fitter.judged((Delay, Backlash, Resonance), [0.02, 1.0, 80.0, 0.5])
    assert best.ran_away == (2,)
    assert set(pruned(fitter, best).names) == {"delay", "backlash"}


@pytest.mark.slow
@pytest.mark.parametrize("period_s", [0.033, 0.05])
def test_frames_are_found_whatever_their_phase(period_s: float) -> None:
    for seed, phase in ((2, 0.41), (3, 0.93)):
        record = flown((), [], seed)
        framed = record.plant.neutral._replace(frame_s=period_s, frame_phase=phase)
        noise = 0.1 * np.random.default_rng(seed).standard_normal(record.time_s.size)
        record = replace(record, measured_deg=simulate(record, framed) + noise)
        found = best_frame(record, record.plant.neutral)
        assert found[0] == pytest.approx(period_s, rel=2e-4)


def test_usual_frames_are_as_late_as_a_delay() -> None:
    record = flown((), [], 2)
    framed = record.plant.neutral._replace(frame_s=0.04, frame_phase=0.02)
    noise = 0.1 * np.random.default_rng(2).standard_normal(record.time_s.size)
    record = replace(record, measured_deg=simulate(record, framed) + noise)
    found = usual_frame(record, record.plant.neutral, 0.018)
    assert found is not None
    assert found[0] == 0.04
    assert usual_frame(record, record.plant.neutral, 0.001) is None


def test_frames_of_no_usual_period_are_found_where_a_delay_seems_to_explain_all() -> None:
    """The floor is higher beside frames, so that a delay seems to leave nothing; and two phases are nearly as good."""
    record = flown((), [], 2)
    framed = record.plant.neutral._replace(frame_s=0.01808, frame_phase=0.97)
    noise = 0.1 * np.random.default_rng(2).standard_normal(record.time_s.size)
    record = replace(record, measured_deg=simulate(record, framed) + noise)
    fitter = Fitter(record)
    delay, frames = fitter.with_effects(fitter.nominal(), (Delay, PwmFrame), lambda _: None)
    assert delay.total < 1.06 * record.counts.sum() * noise_floor_deg(record, delay.error_deg) ** 2
    assert frames.values[0] == pytest.approx(0.01808, rel=1e-4)
    assert frames.total < delay.total - 30.0 * 0.1**2


def test_a_limit_begins_where_it_acts_though_a_part_of_the_log_never_reaches_it() -> None:
    record = flown((RateLimit,), [57.0], 3)
    calm = flown((), [], 3, command="calm")
    values, _ = begin(calm, (RateLimit,), [], record)
    assert values == [60.0]
    assert begin(calm, (RateLimit,), [], calm)[0] != values


def test_several_effects_that_leave_something_smooth_explain_nothing() -> None:
    """Of a tenth of the noise's variance the floor says nothing; its memory does."""
    record = flown((Delay, Backlash), [0.02, 1.0], 5, duration_s=60.0)
    fitter = Fitter(record)
    fit, noise = fitter.judged((Delay, Backlash), [0.02, 1.0]), np.random.default_rng(6)
    wave = 0.1 * np.sqrt(2.0 * 0.1) * np.sin(2.0 * np.pi * 3.0 * record.time_s)
    assert not rest_matters(record, fitter.nominal(), fit, 0.1)
    left = replace(fit, error_deg=fit.error_deg + wave, held_out=1.1 * fit.held_out)
    assert rest_matters(record, fitter.nominal(), left, 0.1)
    shuffled = replace(left, error_deg=noise.permutation(left.error_deg))
    assert not rest_matters(record, fitter.nominal(), shuffled, 0.1)


def test_rivals_are_compared_as_well_as_they_fit_all_samples() -> None:
    """Values that half of the samples foretell badly speak against no law."""
    record = flown((RateLimit,), [57.0], 3)
    fitter = Fitter(record)
    best, rival = (fitter.judged((RateLimit,), [rate]) for rate in (57.0, 57.8))
    behind = rival.total - best.total
    assert behind > 10.0 * 0.1**2
    assert abs(_behind(fitter, rival, best, 2.0 * behind)) < 0.1**2
    assert _behind(fitter, rival, best, 0.5 * behind) == behind

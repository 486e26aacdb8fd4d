"""Whether what a servo leaves is noise: judged on held-out samples, against the noise's own colour at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servofd.core.types import BoolArray, FloatArray, IntArray
from servofd.discrepancy.fit import Fit
from servofd.discrepancy.noise import (
    COARSE_STEP_DEG,
    SMALLEST_DEG,
    floor_uncertainty,
    long_run_factor,
    noise_below_deg,
    noise_floor_deg,
    noise_within_deg,
    stepped_noise_deg,
)
from servofd.discrepancy.record import Record
from servofd.servo.effects.sensor import Quantization

_RATIO = 1.1
"""Held-out error over the noise floor, beyond which something is left."""
_SIGMAS = 3.0
"""Standard deviations by which chance may raise the ratio of errors."""
_PREDICTED = 0.02
"""Share of what is left that command and motion may predict: less is a simulator's own error."""
_BLOCK_S, _BLOCK_SIGMAS = 2.0, 6.0
"""Length of a block [s], and the standard deviations that its error may reach."""
_QUIET, _QUIET_S, _ACTIVITY_S = 0.15, 3.0, 0.5
"""Share of the usual swing of the command below which a servo rests, how much rest shows whether noise is
correlated [s], and the length over which the swing is taken [s]."""
_LAGS_S = tuple(0.03 * k for k in range(13))
_RIDGE = 1e-3
"""Ridge of the regression, as a share of the samples."""
_BINS = 48
"""Of the deflection, for what goes with it in no simple way: a worn gear."""
_MEMORY = 1.6
"""How many times as long errors of the model may be correlated as those at rest."""
_COLOUR, _ALIKE = 3.5, 1.3
"""Error over the floor that correlated noise may have (0.8 from sample to sample makes it 2.7), and how much it may
differ between runs."""
_STEADY_SIGMAS, _FEWEST_BLOCKS = 4.5, 5
"""Standard deviations by which the power of noise may differ more between blocks than by chance, and blocks that tell.
Of 8640 draws of noise that is correlated by 0.5 to 0.98 from sample to sample, 20 to 300 s at 50 and 100 Hz, 4 came to
more. Pulse frames of 18 to 22 ms in chirps, taken for a delay, came to 4.7 where the model's error is 0.8 of the noise,
and to 9 to 15 where it is 1.4 to 5 of it."""
_DRIFT = 0.5
"""Share of an error that follows a straight line over time, from which on it is no noise: one that is correlated so
from sample to sample, for 60 s at 50 Hz, follows one with 3 % at most (2000 draws)."""


@dataclass(frozen=True, slots=True)
class Adequacy:
    """What of the errors of a servo is not noise."""

    floor_deg: float
    """Noise floor."""
    reasons: tuple[str, ...]
    """Why it is more than noise; empty if it is not."""


def floor_of(record: Record, fit: Fit) -> float:
    """Noise floor as this fit shows it [deg]: a converter's steps at least, no more than its error, but not nothing."""
    step_deg = record.step_deg or 0.0
    steps_deg = step_deg / float(np.sqrt(12.0))
    if step_deg >= COARSE_STEP_DEG:  # with the noise before them, even where readings stand
        below_deg = _below_deg(record, fit, step_deg)
        is_rounded = Quantization in fit.effects
        steps_deg = stepped_noise_deg(below_deg, step_deg) if is_rounded else float(np.hypot(below_deg, steps_deg))
    noise_deg = max(noise_floor_deg(record, fit.error_deg), steps_deg)
    return max(min(noise_deg, float(np.sqrt(fit.train))), SMALLEST_DEG)


def _below_deg(record: Record, fit: Fit, step_deg: float) -> float:
    read_deg = np.where(record.counts, record.measured_deg, np.nan)
    return noise_below_deg(read_deg, record.measured_deg - fit.unstepped_deg, step_deg)


def adequacy(record: Record, fit: Fit) -> Adequacy:
    """Judge what a servo leaves."""
    counts = record.counts
    white_deg = floor_of(record, fit)
    error_deg, usual_deg = fit.error_deg, 0.0
    simulated_deg = record.measured_deg - fit.unstepped_deg
    if Quantization in fit.effects and record.step_deg:
        # Rounding is regular, and in some seconds no edge is near: what is judged is the noise that was rounded.
        usual_deg = _below_deg(record, fit, record.step_deg)
        error_deg = noise_within_deg(record.measured_deg, simulated_deg, record.step_deg, usual_deg)
    error = error_deg[counts]
    quiet = _quiet(record)[counts]
    rest_deg, rest_memory, memory_like_it = _at_rest(record, error_deg, quiet)
    floor_deg = white_deg if usual_deg else max(white_deg, min(rest_deg, float(np.sqrt(np.mean(error**2)))))
    memory = long_run_factor(error - error.mean())
    chance = _SIGMAS * float(
        np.hypot(floor_uncertainty(record), np.sqrt(2.0 * memory / max(int(record.counts.sum()), 1)))
    )
    runs_deg2 = fit.run_deg2[fit.run_deg2 > 0.0].tolist() if len(record.runs) > 1 else []
    ratios = [float(np.sqrt(each)) / floor_deg for each in (fit.held_out, *runs_deg2)]
    reasons = []
    ratio = max(ratios)
    predicted = predicted_share(record, error_deg, simulated_deg)
    is_predicted = predicted > _PREDICTED
    # Noise that is correlated, and of which no rest tells: nothing predicts it, and it is the same everywhere.
    spread = max(ratios) / max(min(ratios), 1e-12)
    is_noise = not is_predicted and drift_share(record, error_deg) < _DRIFT
    coloured = is_noise and rest_deg == 0.0 and memory > _MEMORY and ratio < _COLOUR and spread < _ALIKE
    # A sensor's noise knows nothing of the motion, nor of its time.
    coloured = coloured and _unsteady_sigmas(record, error_deg) < _STEADY_SIGMAS
    if ratio**2 > _RATIO**2 + chance and not coloured:
        where = "" if ratio == ratios[0] else " of the worst run"
        reasons.append(
            f"{ratio * floor_deg:.3g} deg rms{where} are left on data not fitted, the noise is {floor_deg:.3g} deg"
        )
    if is_predicted:
        reasons.append(f"command and motion still predict {predicted:.0%} of what is left")
    if rest_memory > 0.0 and memory_like_it > _MEMORY * rest_memory + 1.0:
        reasons.append("what is left is correlated for longer than the noise at rest")
    block_floor_deg = 0.0 if coloured else usual_deg or floor_deg
    start_s, worst_deg, sigmas = _worst_block(record, error_deg, block_floor_deg, memory)
    if sigmas > _BLOCK_SIGMAS:
        reasons.append(f"from {start_s:.1f} to {start_s + _BLOCK_S:.1f} s {worst_deg:.3g} deg rms are left")
    return Adequacy(floor_deg, tuple(reasons))


def _quiet(record: Record) -> BoolArray:
    """Samples at which little was asked for a while."""
    quiet = []
    for run in record.runs or (record,):
        command = run.commands.at(run.time_s)
        width = max(1, round(_ACTIVITY_S / run.period_s))
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(command, (width, 0), mode="edge"), width + 1)
        quiet.append(np.ptp(windows, axis=1))
    swing = np.concatenate(quiet)
    quieter: BoolArray = swing <= _QUIET * np.quantile(swing, 0.9)
    return quieter


def _at_rest(record: Record, error_deg: FloatArray, quiet: BoolArray) -> tuple[float, float, float]:
    """Noise where the servo rests [deg, rms], its correlation factor, and that of all errors in pieces as short.

    Zeros if it hardly rests. Pieces of a second or two, each about its mean, show less correlation than there is.
    """
    errors, block = error_deg[record.counts], (record.time_s[record.counts] // _BLOCK_S).astype(np.int64)
    block -= block.min(initial=0)
    number = block[quiet]
    if number.size * record.period_s < _QUIET_S:
        return 0.0, 0.0, 0.0
    rest, length = _centred(errors[quiet], number, 0.5 * _BLOCK_S / record.period_s)
    if rest.size * record.period_s < _QUIET_S:
        return 0.0, 0.0, 0.0
    whole, _ = _centred(errors, np.arange(errors.size) // length, 0.5 * length)
    return float(np.sqrt(np.mean(rest**2))), long_run_factor(rest), long_run_factor(whole)


def _centred(errors_deg: FloatArray, piece: IntArray, least: float) -> tuple[FloatArray, int]:
    """Errors about the mean of their piece, in pieces of more samples than that, and how many those have."""
    count = np.bincount(piece)
    mean = np.bincount(piece, weights=errors_deg) / np.maximum(count, 1)
    enough = count > least
    usual = int(np.median(count[enough])) if enough.any() else 1
    return (errors_deg - mean[piece])[enough[piece]], usual


def predicted_share(record: Record, error_deg: FloatArray, moved_deg: FloatArray) -> float:
    """Share of an error that a regression on command and motion predicts in blocks to which it was not fitted."""
    counts = record.counts
    error = error_deg[counts]
    if error.size < 10 * (len(_LAGS_S) + 12 + _BINS):
        return 0.0
    features = _features(record, np.nan_to_num(moved_deg))[counts]
    spread = features.std(axis=0)
    features = (features[:, spread > 0.0] - features[:, spread > 0.0].mean(axis=0)) / spread[spread > 0.0]
    block = (record.time_s[counts] / _BLOCK_S).astype(np.int64) % 2 == 0
    left, there = 0.0, 0.0
    for fold in (block, ~block):
        if fold.sum() < features.shape[1] or (~fold).sum() < features.shape[1]:
            return 0.0
        mean = error[fold].mean()
        inside = features[fold]
        curvature = inside.T @ inside + _RIDGE * fold.sum() * np.eye(features.shape[1])
        found = np.linalg.solve(curvature, inside.T @ (error[fold] - mean))
        after = error[~fold] - mean - features[~fold] @ found
        left += float(after @ after)
        there += float(np.sum((error[~fold] - mean) ** 2))
    return max(1.0 - left / there, 0.0) if there > 0.0 else 0.0


def drift_share(record: Record, error_deg: FloatArray) -> float:
    """Share of an error that follows a straight line over the time of its run."""
    left, there = 0.0, 0.0
    for run in range(max(len(record.runs), 1)):
        rows = record.counts & (record.run == run)
        if np.count_nonzero(rows) < 3:
            continue
        error, time_s = error_deg[rows] - error_deg[rows].mean(), record.time_s[rows] - record.time_s[rows].mean()
        there += float(error @ error)
        left += float(error @ error) - float(error @ time_s) ** 2 / max(float(time_s @ time_s), SMALLEST_DEG)
    return 1.0 - left / there if there > 0.0 else 0.0


def _features(record: Record, moved_deg: FloatArray) -> FloatArray:
    rows = []
    first = 0
    for run in record.runs or (record,):
        last = first + run.time_s.size
        moved = moved_deg[first:last]
        first = last
        lagged = [run.commands.at(run.time_s - lag) for lag in _LAGS_S]
        speed = np.gradient(moved, run.time_s)
        bend = np.gradient(speed, run.time_s)
        usual = max(float(np.quantile(np.abs(speed), 0.9)), 1e-9)
        error = lagged[0] - moved
        rows.append(
            np.column_stack(
                [
                    *[each - moved for each in lagged],
                    moved,
                    moved * np.abs(moved),
                    np.abs(moved),
                    speed,
                    np.tanh(10.0 * speed / usual),
                    np.tanh(3.0 * speed / usual),
                    np.abs(speed),
                    speed * np.abs(speed),
                    bend,
                    np.tanh(5.0 * error / max(float(np.std(error)), 1e-9)),
                ]
            )
        )
    features = np.vstack(rows)
    moved = features[:, len(_LAGS_S)]
    edges = np.unique(np.quantile(moved[record.counts], np.linspace(0.0, 1.0, _BINS + 1)[1:-1]))
    return np.hstack([features, np.searchsorted(edges, moved)[:, None] == np.arange(edges.size)])


def _worst_block(record: Record, error_deg: FloatArray, floor_deg: float, memory: float) -> tuple[float, float, float]:
    """The two seconds with the largest error: when they begin [s], rms [deg], and standard deviations from noise."""
    count, mean = _blocks(record, error_deg)
    k = int(np.argmax(mean))
    floor = max(floor_deg**2, float(np.median(mean[mean > 0.0])) if floor_deg == 0.0 and mean[k] > 0.0 else 0.0)
    sigmas = (mean[k] / floor - 1.0) / np.sqrt(2.0 * memory / count[k]) if floor > 0.0 else 0.0
    return float(record.time_s[record.counts][0] + k * _BLOCK_S), float(np.sqrt(mean[k])), float(sigmas)


def _unsteady_sigmas(record: Record, error_deg: FloatArray) -> float:
    """By how many standard deviations the power of an error differs more from block to block than that of noise.

    A block tells the variance of noise as well as so many independent samples would, as it has samples over the sum of
    their squared correlations.
    """
    count, mean = _blocks(record, error_deg)
    used = mean > 0.0
    if np.count_nonzero(used) < _FEWEST_BLOCKS:
        return 0.0
    count, mean = count[used], mean[used]
    error, lag = error_deg[record.counts] - error_deg[record.counts].mean(), np.arange(int(np.median(count)))
    alike = np.fft.irfft(np.abs(np.fft.rfft(error, 2 * error.size)) ** 2)[lag]
    freedom = count / (2.0 * float((1.0 - lag / lag.size) @ (alike / alike[0]) ** 2) - 1.0)
    off = (mean / np.average(mean, weights=freedom) - 1.0) * np.sqrt(0.5 * freedom)
    others = mean.size - 1
    return float((off @ off / others - 1.0) / np.sqrt((2.0 + 12.0 / np.median(freedom)) / others))


def _blocks(record: Record, error_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Samples of each block, and the mean square of an error in it [deg^2]; zero where few count."""
    time_s = record.time_s[record.counts]
    number = ((time_s - time_s[0]) / _BLOCK_S).astype(np.int64)
    count = np.bincount(number).astype(float)
    energy = np.bincount(number, weights=error_deg[record.counts] ** 2)
    mean: FloatArray = np.where(count > 0.5 * count.max(), energy / np.maximum(count, 1.0), 0.0)
    return count, mean

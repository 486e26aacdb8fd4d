"""Where model and measurement disagree: in which seconds, and under which conditions, against the noise floor."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from servofd.discrepancy.record import Record
    from servofd.types import BoolArray, FloatArray, IntArray

__all__ = ["Block", "Map", "bad_seconds", "blocks", "is_told", "maps", "sentences", "speed_deg_s"]

_FALSE_DISCOVERIES = 0.01
_BINS, _FEWEST_PER_BIN = 12, 30
_TOP = 0.8
_SHOWN_SHARE, _NO_SHARE, _MOST = 0.25, 0.05, 0.5
_FIR_LAGS = 25
_FOLDS = 2
_EXCESS = 0.03


class Map(NamedTuple):
    """How much of the disagreement one quantity tells."""

    quantity: str
    unit: str
    share: float
    """Of the variance above the noise floor, predicted for samples that were not used: 1 is all of it."""
    above: float
    """The quantity's size that 20 % of the samples exceed."""
    concentration: float
    """Share of the excess energy that lies in those samples."""


class Block(NamedTuple):
    """A second of the log."""

    start_s: float
    end_s: float
    rms_deg: float
    """Of what model and measurement differ by."""
    chance: float
    """How often noise alone would do as much."""
    bad: bool
    """Whether it counts as more than noise."""


def blocks(record: Record, error_deg: FloatArray, sigma_deg: float) -> tuple[Block, ...]:
    """How large the error is in each second, and whether that is more than noise.

    The energy of a block of n samples of noise is chi-squared with n degrees of freedom; of the blocks that are
    called bad, at most 1 % are so by chance (Benjamini and Hochberg 1995).
    """
    from scipy.stats import chi2

    start_s = float(record.time_s[0])
    second = (record.time_s - start_s).astype(np.int64)[record.counts]
    count = np.bincount(second)
    energy = np.bincount(second, weights=error_deg[record.counts] ** 2)
    used = np.flatnonzero(count >= 5)
    # The noise floor is itself uncertain by a few per cent.
    chance: FloatArray = np.asarray(chi2.sf(energy[used] / sigma_deg**2 / (1.0 + _EXCESS), count[used]), dtype=float)
    ranked = np.sort(chance)
    passed = np.flatnonzero(ranked <= _FALSE_DISCOVERIES * np.arange(1, ranked.size + 1) / max(ranked.size, 1))
    limit = float(ranked[passed[-1]]) if passed.size else -1.0
    return tuple(
        Block(start_s + k, start_s + k + 1.0, float(np.sqrt(energy[k] / count[k])), float(odds), bool(odds <= limit))
        for k, odds in zip(used.tolist(), chance, strict=True)
    )


def bad_seconds(record: Record, error_deg: FloatArray, sigma_deg: float) -> tuple[tuple[float, float], ...]:
    """Seconds whose error is more than noise, joined, as (start, end) [s]."""
    pieces: list[tuple[float, float]] = []
    for block in blocks(record, error_deg, sigma_deg):
        if block.bad and pieces and block.start_s - pieces[-1][1] < 0.5:
            pieces[-1] = (pieces[-1][0], block.end_s)
        elif block.bad:
            pieces.append((block.start_s, block.end_s))
    return tuple(pieces)


def maps(record: Record, error_deg: FloatArray, sigma_deg: float) -> tuple[Map, ...]:
    """What the disagreement depends on, most telling first."""
    where = record.counts
    time_s, error = record.time_s[where], error_deg[where]
    simulated = record.measured_deg[where] - error
    excess = max(float(np.mean(error**2)) - sigma_deg**2, 1e-12)
    command = _command(record)
    speed = speed_deg_s(record, error_deg)[where]
    rate = _gradient(_smooth(command), record.time_s)[where]
    lag = command[where] - simulated
    quantities: list[tuple[str, str, FloatArray, bool]] = [
        ("command rate", "deg/s", rate, True),
        ("speed", "deg/s", speed, True),
        ("deflection", "deg", simulated, True),
        ("lag behind the command", "deg", lag, True),
        ("time", "s", time_s - time_s[0], False),
    ]
    if record.pressure_pa is not None:
        quantities.append(("deflection times dynamic pressure", "deg Pa", simulated * record.pressure_pa[where], True))
    if record.voltage_v is not None:
        quantities.append(("supply voltage", "V", record.voltage_v[where], False))
    block = record.block[where]
    found = []
    for name, unit, values, signed in quantities:
        size = np.abs(values) if signed else values
        above = float(np.quantile(size, _TOP))
        top = size > above
        share = float(np.sum(error[top] ** 2 - sigma_deg**2)) / (excess * error.size) if top.any() else 0.0
        found.append(Map(name, unit, _predicted(values, error, block, excess), above, share))
    moving = np.sign(speed) * (np.abs(speed) > np.quantile(np.abs(speed), 0.3))
    found.append(Map("direction of motion", "", _predicted(moving, error, block, excess), 0.0, 0.0))
    found.append(Map("linear filter of the command", "", _filtered(record, command, error_deg, excess), 0.0, 0.0))
    return tuple(sorted(found, key=lambda m: -m.share))


def is_told(record: Record, error_deg: FloatArray, sigma_deg: float) -> bool:
    """Whether command or motion tell most of what is more than noise."""
    return any(found.share > _MOST for found in maps(record, error_deg, sigma_deg))


def speed_deg_s(record: Record, error_deg: FloatArray) -> FloatArray:
    """Speed of the simulation that leaves this error [deg/s], shape (n,)."""
    known = np.isfinite(error_deg)
    moved = np.interp(record.time_s, record.time_s[known], (record.measured_deg - error_deg)[known])
    return _gradient(moved, record.time_s)


def sentences(record: Record, error_deg: FloatArray, sigma_deg: float) -> list[str]:
    """Where the disagreement lies, in words."""
    error = error_deg[record.counts]
    rms = float(np.sqrt(np.mean(error**2)))
    bad = bad_seconds(record, error_deg, sigma_deg)
    total = float(np.unique((record.time_s - record.time_s[0]).astype(int)[record.counts]).size)
    if not bad:
        return [f"nowhere: {rms:.3g} deg rms, the noise floor is {sigma_deg:.3g} deg, and no second stands out"]
    length = sum(end - start for start, end in bad)
    longest = sorted(bad, key=lambda piece: piece[0] - piece[1])[:4]
    shown = ", ".join(f"{start:.0f} to {end:.0f} s" for start, end in sorted(longest))
    more = f" and {len(bad) - 4} more" if len(bad) > 4 else ""
    texts = [
        f"disagreement above the noise floor ({rms:.3g} against {sigma_deg:.3g} deg rms) in {length:.0f} of "
        f"{total:.0f} seconds: {shown}{more}"
    ]
    if rms**2 < (1.0 + 2.0 * _EXCESS) * sigma_deg**2:
        return texts
    found = maps(record, error_deg, sigma_deg)
    dense = max(found, key=lambda m: m.concentration)
    if dense.concentration > 0.5 and dense.quantity != "time":
        size = f"|{dense.quantity}|" if dense.unit != "V" else dense.quantity
        texts.append(
            f"disagreement concentrates where {size} > {dense.above:.3g} {dense.unit} "
            f"({dense.concentration:.0%} of the excess in 20 % of the samples)"
        )
    telling = [m for m in found if m.share > _SHOWN_SHARE]
    if telling:
        texts.append("of the excess, " + ", ".join(f"{_percent(m.share)} follows {_article(m)}" for m in telling[:3]))
    else:
        texts.append(
            "hardly any of the excess follows command, speed, deflection or time: a disturbance, noise with memory, or "
            "an effect with a memory of its own"
        )
    silent = [_article(m) for m in found if m.share < _NO_SHARE and m.quantity not in ("time", "direction of motion")]
    if silent and telling:
        texts.append(f"none of it follows {' or '.join(silent[:3])}")
    return texts


def _percent(share: float) -> str:
    return f"{min(share, 1.0):.0%}"


def _article(found: Map) -> str:
    if found.quantity == "linear filter of the command":
        return "a linear filter of the command"
    return f"the {found.quantity}"


def _command(record: Record) -> FloatArray:
    """Command in force at each sample [deg]."""
    index = np.searchsorted(record.commands.effective_s, record.time_s, side="right") - 1
    command: FloatArray = record.commands.command_deg[np.maximum(index, 0)]
    return command


def _gradient(values: FloatArray, time_s: FloatArray) -> FloatArray:
    slope: FloatArray = np.asarray(np.gradient(values, time_s), dtype=float)
    return slope


def _smooth(values: FloatArray) -> FloatArray:
    smooth: FloatArray = np.convolve(np.pad(values, 2, mode="edge"), np.full(5, 0.2), mode="valid")
    return smooth


def _predicted(values: FloatArray, error: FloatArray, block: IntArray, excess: float) -> float:
    """Share of the excess variance that the means of bins predict, in blocks from which they were not taken."""
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1)[1:-1]))
    index = np.searchsorted(edges, values)
    saved = 0.0
    for fold in range(_FOLDS):
        known = block % _FOLDS == fold
        count = np.bincount(index[known], minlength=edges.size + 1)
        mean = np.bincount(index[known], weights=error[known], minlength=edges.size + 1) / np.maximum(count, 1)
        mean[count < _FEWEST_PER_BIN] = 0.0
        other = ~known
        saved += float(np.sum(error[other] ** 2) - np.sum((error[other] - mean[index[other]]) ** 2))
    return max(saved / error.size / excess, 0.0)


def _filtered(record: Record, command: FloatArray, error_deg: FloatArray, excess: float) -> float:
    """The same for a finite response to the last quarter of a second of commands."""
    lagged = np.column_stack([np.roll(command, k) for k in range(_FIR_LAGS)])
    where = record.counts.copy()
    where[:_FIR_LAGS] = False
    features, error, block = lagged[where] - command[where].mean(), error_deg[where], record.block[where]
    saved = 0.0
    for fold in range(_FOLDS):
        known: BoolArray = block % _FOLDS == fold
        normal = np.einsum("ni,nj->ij", features[known], features[known])  # too small for threads
        normal += 1e-6 * np.trace(normal) * np.eye(_FIR_LAGS) / _FIR_LAGS + 1e-9 * np.eye(_FIR_LAGS)
        weights = np.linalg.solve(normal, features[known].T @ error[known])
        other = ~known
        saved += float(np.sum(error[other] ** 2) - np.sum((error[other] - features[other] @ weights) ** 2))
    return max(saved / max(error.size, 1) / excess, 0.0)

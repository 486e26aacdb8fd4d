"""What a disagreement depends on: the share of it that each quantity foretells, and what chance makes of that share."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.discrepancy.regimes import FAST, REST, smooth

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import FloatArray, IntArray
    from servofd.discrepancy.record import Record

LINEAR, ODD, EVEN = "linear filter of the command", "odd distortion of the command", "even distortion of the command"
"""The second is the same up and down (a limit, friction, dead band), the third is not (a curved linkage)."""
_BINS, _FEWEST_PER_BIN = 12, 30
_LAGS, _MEMORY_S = 25, 0.25
_FEWER_LAGS = 12
"""Of each of two distorted commands."""
_FOLDS = 2
_CHUNK = 20_000
_DRAWS, _MOST_GROUPS = 2000, 300
_FALSE_ALARMS = 0.01
"""Share of healthy logs in which any of the quantities may seem to matter, however many there are."""


class Map(NamedTuple):
    """How much of the disagreement one quantity tells."""

    quantity: str
    unit: str
    share: float
    """Of the variance above the noise floor, predicted for samples that were not used: 1 is all of it."""
    low: float
    """What chance would make of the share lies between this and the next, in all but one of a hundred logs for all
    quantities together (block bootstrap)."""
    high: float
    above: float
    """The quantity's size that 20 % of the samples exceed."""
    concentration: float
    """Share of the excess energy that lies in those samples."""


def maps(record: Record, error_deg: FloatArray, sigma_deg: float) -> tuple[Map, ...]:
    """What the disagreement depends on, most telling first.

    Parameters
    ----------
    error_deg : ndarray, shape (n,)
        Measured minus simulated position [deg].
    """
    where = record.counts
    error = error_deg[where]
    excess = max(float(np.mean(error**2)) - sigma_deg**2, 1e-12)
    found = []
    for name, unit, values, signed in _quantities(record, error_deg):
        size = np.abs(values) if signed else values
        above = float(np.quantile(size, FAST))
        top = size > above
        share = float(np.sum(error[top] ** 2 - sigma_deg**2)) / (excess * error.size) if top.any() else 0.0
        found.append((name, unit, _binned(values, error, record.block[where]), above, share))
    found += [(name, "", saved, 0.0, 0.0) for name, saved in _filtered(record, error_deg)]
    total, drawn = excess * error.size, _Drawn(record.block[where], _FALSE_ALARMS / len(found))
    result = [
        Map(name, unit, max(float(saved.sum()) / total, 0.0), *drawn.bounds(saved / total), above, concentration)
        for name, unit, saved, above, concentration in found
    ]
    return tuple(sorted(result, key=lambda m: -m.share))


def speed_deg_s(record: Record, error_deg: FloatArray) -> FloatArray:
    """Speed of the simulation that leaves this error [deg/s], shape (n,)."""
    known = np.isfinite(error_deg)
    moved = np.interp(record.time_s, record.time_s[known], (record.measured_deg - error_deg)[known])
    speed: FloatArray = np.asarray(np.gradient(moved, record.time_s), dtype=float)
    return speed


def since_reversal_s(time_s: FloatArray, moved_deg: FloatArray, least_deg: float) -> FloatArray:
    """Time since a motion last turned after a swing of at least so much [s], shape (n,); infinite before the first.

    Examples
    --------
    >>> t = np.arange(0.0, 10.0, 0.1)
    >>> turned = since_reversal_s(t, np.where(t < 5.0, t, 10.0 - t), 2.0)
    >>> turned[[20, -1]].round(1).tolist()  # it turned at 5 s
    [inf, 4.9]
    """
    since = np.full(time_s.size, np.inf)
    if not time_s.size:
        return since
    turns, low, high, rising = [], 0, 0, 0
    for k in range(time_s.size):
        if moved_deg[k] > moved_deg[high]:
            high = k
        if moved_deg[k] < moved_deg[low]:
            low = k
        if rising >= 0 and moved_deg[high] - moved_deg[k] >= least_deg:
            turns += [high] if rising else []
            rising, low = -1, k
        elif rising <= 0 and moved_deg[k] - moved_deg[low] >= least_deg:
            turns += [low] if rising else []
            rising, high = 1, k
    if turns:
        last = np.searchsorted(turns, np.arange(time_s.size), side="right") - 1
        since[last >= 0] = (time_s - time_s[np.array(turns)[np.maximum(last, 0)]])[last >= 0]
    return since


def _quantities(record: Record, error_deg: FloatArray) -> list[tuple[str, str, FloatArray, bool]]:
    """Name, unit, values where they count, and whether they have a sign."""
    where = record.counts
    simulated = (record.measured_deg - error_deg)[where]
    command = record.commands.at(record.time_s)
    speed = speed_deg_s(record, error_deg)[where]
    rate = np.gradient(smooth(command), record.time_s)[where]
    found: list[tuple[str, str, FloatArray, bool]] = [
        ("command rate", "deg/s", rate, True),
        ("speed", "deg/s", speed, True),
        ("deflection", "deg", simulated, True),
        ("lag behind the command", "deg", command[where] - simulated, True),
        ("time", "s", record.time_s[where] - record.time_s[where][0], False),
        ("direction of motion", "", np.sign(speed) * (np.abs(speed) > np.quantile(np.abs(speed), REST)), True),
    ]
    if record.pressure_pa is not None:
        found.append(("deflection times dynamic pressure", "deg Pa", simulated * record.pressure_pa[where], True))
    if record.voltage_v is not None:
        found.append(("supply voltage", "V", record.voltage_v[where], False))
    if record.temperature_c is not None:
        found.append(("temperature", "°C", record.temperature_c[where], False))
    return found


def _binned(values: FloatArray, error: FloatArray, block: IntArray) -> FloatArray:
    """Squared error that the means of bins save, in blocks from which they were not taken [deg^2], shape (m,)."""
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1)[1:-1]))
    index = np.searchsorted(edges, values)
    saved = np.zeros(error.size)
    for fold in range(_FOLDS):
        known = block % _FOLDS == fold
        count = np.bincount(index[known], minlength=edges.size + 1)
        mean = np.bincount(index[known], weights=error[known], minlength=edges.size + 1) / np.maximum(count, 1)
        mean[count < _FEWEST_PER_BIN] = 0.0
        other = ~known
        saved[other] = error[other] ** 2 - (error[other] - mean[index[other]]) ** 2
    return saved


def _filtered(record: Record, error_deg: FloatArray) -> list[tuple[str, FloatArray]]:
    """The same for a finite response to the last quarter of a second of commands, and to distorted ones beside them."""
    command = record.commands.at(record.time_s)
    command = command - float(np.mean(command[record.counts]))
    rate = np.gradient(smooth(command), record.time_s)
    linear = _response([(command, _LAGS)], record, error_deg)
    distorted = {
        ODD: (command * np.abs(command), np.sign(rate)),
        EVEN: (np.abs(command), np.abs(rate)),
    }
    return [
        (LINEAR, linear),
        *(
            (name, _response([(command, _LAGS), *((s, _FEWER_LAGS) for s in signals)], record, error_deg) - linear)
            for name, signals in distorted.items()
        ),
    ]


def _response(signals: Sequence[tuple[FloatArray, int]], record: Record, error_deg: FloatArray) -> FloatArray:
    """Squared error that a finite response to signals saves, in blocks that it was not fitted to, shape (m,)."""
    places = np.flatnonzero(record.counts)
    step = max(1, round(_MEMORY_S / _LAGS / record.period_s))
    scaled = [(signal / max(float(np.std(signal[places])), 1e-9), lags) for signal, lags in signals]
    # With so few lags of a signal, each as much further apart.
    shifts = [(signal, step * k * (_LAGS // lags)) for signal, lags in scaled for k in range(lags)]
    error, fold = error_deg[places], record.block[places] % _FOLDS

    def features(rows: IntArray) -> FloatArray:
        return np.column_stack([signal[np.maximum(rows - shift, 0)] for signal, shift in shifts])

    size = len(shifts)
    normal, right = np.zeros((_FOLDS, size, size)), np.zeros((_FOLDS, size))
    chunks = [slice(k, k + _CHUNK) for k in range(0, places.size, _CHUNK)]
    for chunk in chunks:
        x = features(places[chunk])
        for k in range(_FOLDS):
            mine = fold[chunk] == k
            normal[k] += np.einsum("ni,nj->ij", x[mine], x[mine])  # too small for threads
            right[k] += x[mine].T @ error[chunk][mine]
    ridge = 1e-6 * np.trace(normal, axis1=1, axis2=2) / size + 1e-9
    weights = np.linalg.solve(normal + ridge[:, None, None] * np.eye(size), right[..., None])[..., 0]
    saved = np.empty(error.size)
    for chunk in chunks:
        foretold = np.sum(features(places[chunk]) * weights[1 - fold[chunk]], axis=1)
        saved[chunk] = error[chunk] ** 2 - (error[chunk] - foretold) ** 2
    return saved


class _Drawn:
    """Blocks of a record, neighbours together, drawn anew again and again: what chance makes of a sum over them."""

    def __init__(self, block: IntArray, chance: float) -> None:
        number = np.cumsum(np.diff(block, prepend=block[:1]) != 0)
        self._group = number // max(1, -(-int(number[-1] + 1) // _MOST_GROUPS))
        count = int(self._group[-1]) + 1
        # The same draws each time: the same log is told in the same words.
        self._times = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=_DRAWS)
        self._chance = chance

    def bounds(self, values: FloatArray) -> tuple[float, float]:
        """Of the sum of values of shape (m,), each passed with half of the chance."""
        sums = self._times @ np.bincount(self._group, weights=values)
        low, high = np.quantile(sums, [0.5 * self._chance, 1.0 - 0.5 * self._chance])
        return float(low), float(high)

"""Where model and measurement disagree: in which seconds, and under which conditions, against the noise floor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servofd.core.series import stretches
from servofd.core.types import BoolArray, FloatArray, IntArray
from servofd.discrepancy.record import Record, per_second

_BINS, _FEWEST_PER_BIN = 14, 12
"""Bins of a quantity, and samples in each at least."""
REST, FAST = 0.3, 0.8
"""Quantiles of the speed below which a servo is taken to rest, and above which it is fast."""
AFTER_REVERSAL_S = 0.3
"""Time after a reversal during which play and friction show [s]."""
_BAND = (5.0, 50.0, 95.0)
"""Percentiles of the error that are drawn over a quantity."""


class Bins(NamedTuple):
    """Distribution of an error over a quantity; all of shape (k,)."""

    centre: FloatArray
    low_deg: FloatArray
    """5 % quantile."""
    median_deg: FloatArray
    high_deg: FloatArray
    """95 % quantile."""


def binned(quantity: Map, error_deg: FloatArray, counts: BoolArray) -> Bins:
    """Quantiles of an error in bins of a quantity; bins of equal numbers of samples.

    Examples
    --------
    >>> x = np.linspace(0.0, 1.0, 1000)
    >>> found = binned(Map("x", "deg", x, 1.0, 0.8, 0.5), 2.0 * x, np.ones(1000, dtype=bool))
    >>> bool(np.allclose(found.median_deg, 2.0 * found.centre, atol=0.01))
    True
    """
    values, error = quantity.values, error_deg[counts]
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1)))
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
    rows = [
        (float(np.median(values[index == k])), *np.percentile(error[index == k], _BAND))
        for k in range(edges.size - 1)
        if np.count_nonzero(index == k) >= _FEWEST_PER_BIN
    ]
    return Bins(*np.array(rows).reshape(-1, 4).T)


_PIECE_S, _PIECES, _FEWEST_SAMPLES = 4.0, 5.5, 32
"""Length of what is transformed at once; the record is at least so many times as long, which makes ten of them, half
over half."""
_TAIL = 0.1
"""Share of the excess left out at either end of its band."""
_COHERENT, _ASKED = 0.9, 1e-2
"""Below the first the command tells less than nine tenths of the position; where its power is less than the second of
its largest, nothing was asked."""


class Spectrum(NamedTuple):
    """Densities over frequency; all of shape (k,)."""

    frequency_hz: FloatArray
    command_deg2_hz: FloatArray
    error_deg2_hz: FloatArray
    coherence: FloatArray
    """Of command and position: 1 where the position follows linearly and without noise, whatever the servo."""


def spectrum(record: Record, error_deg: FloatArray) -> Spectrum | None:
    """Welch's estimates, on evenly spaced samples; None if the record is too short for an average.

    `error_deg` (shape (n,)): measured minus simulated position [deg].
    """
    from scipy.signal import coherence, welch

    known = np.flatnonzero(np.isfinite(record.measured_deg))
    period_s = record.period_s
    time_s = np.arange(record.time_s[known[0]], record.time_s[known[-1]], period_s)
    count = min(round(_PIECE_S / period_s), int(time_s.size / _PIECES))
    if count < _FEWEST_SAMPLES:
        return None
    command_deg = record.commands.at(time_s)
    measured_deg = np.interp(time_s, record.time_s[known], record.measured_deg[known])
    wrong_deg = np.interp(time_s, record.time_s, np.where(record.counts, np.nan_to_num(error_deg), 0.0))
    rate_hz = 1.0 / period_s
    frequency_hz, command = welch(command_deg, rate_hz, nperseg=count)
    _, error = welch(wrong_deg, rate_hz, nperseg=count)
    with np.errstate(invalid="ignore", divide="ignore"):
        _, follows = coherence(command_deg, measured_deg, rate_hz, nperseg=count)
    return Spectrum(frequency_hz, command, error, np.nan_to_num(follows))


def excess_band_hz(found: Spectrum, sigma_deg: float) -> tuple[float, float] | None:
    """Frequencies between which four fifths of what is more than white noise lie [Hz]; None if there is no more."""
    width_hz = found.frequency_hz[1]
    floor = sigma_deg**2 / (found.frequency_hz[-1] + 0.5 * width_hz)
    more = np.cumsum(np.maximum(found.error_deg2_hz - floor, 0.0)[1:])
    if more[-1] <= 0.0:
        return None
    low, high = np.searchsorted(more, [_TAIL * more[-1], (1.0 - _TAIL) * more[-1]]) + 1
    return float(found.frequency_hz[low] - 0.5 * width_hz), float(found.frequency_hz[high] + 0.5 * width_hz)


def coherent_to_hz(found: Spectrum) -> float | None:
    """Up to where command and position are coherent [Hz]; None if they are wherever anything was asked."""
    asked = found.command_deg2_hz >= _ASKED * found.command_deg2_hz[1:].max()
    asked[0] = False
    lost = np.flatnonzero(asked & (found.coherence < _COHERENT))
    return float(found.frequency_hz[lost[0]]) if lost.size else None


_OF_LINE, _ALONE, _ON = 0.5, 0.5, 0.5
"""Share of the excess that a line of the spectrum holds, coherence that command and position have there at most, and
share of its usual amplitude from which on it counts as there."""
_CLEAR, _SHORTEST_S = 6.0, 3.0
"""Amplitude over its standard deviation in a second of noise, and for how long it lasts at least [s]."""


class Oscillation(NamedTuple):
    """A line in an error that the command does not ask for."""

    amplitude_deg: float
    frequency_hz: float
    start_s: float
    end_s: float

    @property
    def sentence(self) -> str:
        """In words."""
        return (
            f"An oscillation of {self.amplitude_deg:.2g} deg at {self.frequency_hz:.2g} Hz from {self.start_s:.0f} to "
            f"{self.end_s:.0f} s, which the command does not ask for"
        )


def oscillation(record: Record, error_deg: FloatArray, sigma_deg: float) -> Oscillation | None:
    """The oscillation that most of an error is, and when it lasts; None if it is none.

    `error_deg` (shape (n,)): measured minus simulated position [deg].
    """
    found = spectrum(record, error_deg)
    if found is None:
        return None
    width_hz = found.frequency_hz[1]
    excess = np.maximum(found.error_deg2_hz - sigma_deg**2 / found.frequency_hz[-1], 0.0)[1:]
    top = int(np.argmax(excess))
    line = slice(max(top - 1, 0), top + 2)
    if excess[line].sum() < _OF_LINE * excess.sum() or found.coherence[top + 1] > _ALONE:
        return None
    frequency_hz = float(found.frequency_hz[1:][line] @ excess[line] / excess[line].sum())
    start_s = float(record.time_s[0])
    second = (record.time_s - start_s).astype(np.int64)[record.counts]
    turned = error_deg[record.counts] * np.exp(-2j * np.pi * frequency_hz * record.time_s[record.counts])
    count = np.bincount(second)
    sums = np.bincount(second, turned.real) + 1j * np.bincount(second, turned.imag)
    amplitude_deg = 2.0 * np.abs(sums) / np.maximum(count, 1)
    usual_deg = float(np.quantile(amplitude_deg, _USUALLY))
    spans = stretches(amplitude_deg > _ON * usual_deg)
    first, last = max(spans, key=lambda span: span[1] - span[0], default=(0, 0))
    noise_deg = sigma_deg * float(np.sqrt(2.0 * record.period_s))
    if last - first < max(_SHORTEST_S, 1.0 / frequency_hz, 2.0 * width_hz) or usual_deg < _CLEAR * noise_deg:
        return None
    size_deg = float(np.median(amplitude_deg[first:last]))
    return Oscillation(size_deg, frequency_hz, start_s + first, start_s + last)


_USUALLY = 0.9
"""Quantile of the amplitude of seconds that is that of an oscillation."""
_BINS_OF_MAP, _FEWEST_IN_MAP = 12, 30
"""Bins of a quantity in a map, and samples in each at least."""
_FOLDS = 2


class Map(NamedTuple):
    """How much of the disagreement one quantity predicts."""

    quantity: str
    unit: str
    values: FloatArray
    """At the samples that count."""
    share: float
    """Of the variance above the noise floor, predicted for samples that were not used: 1 is all of it."""
    above: float
    """The quantity's size that 20 % of the samples exceed."""
    concentration: float
    """Share of the excess energy that lies in those samples."""


def maps(record: Record, error_deg: FloatArray, sigma_deg: float) -> tuple[Map, ...]:
    """What the disagreement depends on, most telling first.

    `error_deg` (shape (n,)): measured minus simulated position [deg].
    """
    where = record.counts
    error = error_deg[where]
    total = max(float(np.mean(error**2)) - sigma_deg**2, 1e-12) * error.size
    found = []
    for name, unit, values, signed in _quantities(record, error_deg):
        size = np.abs(values) if signed else values
        above = float(np.quantile(size, FAST))
        top = size > above
        concentration = float(np.sum(error[top] ** 2 - sigma_deg**2)) / total if top.any() else 0.0
        share = max(float(_binned(values, error, record.block[where]).sum()) / total, 0.0)
        found.append(Map(name, unit, values, share, above, concentration))
    return tuple(sorted(found, key=lambda each: -each.share))


def since_reversal_s(time_s: FloatArray, moved_deg: FloatArray, least_deg: float) -> FloatArray:
    """Time since a motion last turned after a swing of at least so much [s], shape (n,); infinite before the first."""
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
    known, moved = np.isfinite(error_deg), record.measured_deg - error_deg
    simulated, command = moved[where], record.commands.at(record.time_s)
    speed = np.gradient(np.interp(record.time_s, record.time_s[known], moved[known]), record.time_s)[where]
    smooth = np.convolve(np.pad(command, 2, mode="edge"), np.full(5, 0.2), mode="valid")
    rate = np.gradient(smooth, record.time_s)[where]
    found: list[tuple[str, str, FloatArray, bool]] = [
        ("command rate", "deg/s", rate, True),
        ("speed", "deg/s", speed, True),
        ("deflection", "deg", simulated, True),
        ("lag behind the command", "deg", command[where] - simulated, True),
        ("time", "s", record.time_s[where] - record.time_s[where][0], False),
        ("direction of motion", "", np.sign(speed) * (np.abs(speed) > np.quantile(np.abs(speed), REST)), True),
    ]
    beside = {name: values[where] for name, values in record.logged.items()}
    if "airspeed_m_s" in beside:
        found.append(("deflection times dynamic pressure", "deg Pa", simulated * beside["airspeed_m_s"], True))
    kinds = ("supply voltage", "V", "servo_voltage_v"), ("temperature", "°C", "servo_temperature_c")
    return found + [(words, unit, beside[name], False) for words, unit, name in kinds if name in beside]


def _binned(values: FloatArray, error: FloatArray, block: IntArray) -> FloatArray:
    """Squared error that the means of bins save, in blocks from which they were not taken [deg^2], shape (m,)."""
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, _BINS_OF_MAP + 1)[1:-1]))
    index = np.searchsorted(edges, values)
    saved = np.zeros(error.size)
    for fold in range(_FOLDS):
        known = block % _FOLDS == fold
        count = np.bincount(index[known], minlength=edges.size + 1)
        mean = np.bincount(index[known], weights=error[known], minlength=edges.size + 1) / np.maximum(count, 1)
        mean[count < _FEWEST_IN_MAP] = 0.0
        other = ~known
        saved[other] = error[other] ** 2 - (error[other] - mean[index[other]]) ** 2
    return saved


_FALSE_DISCOVERIES = 0.01
"""Share of the bad seconds that chance alone may have made (Benjamini and Hochberg)."""
SHOWN_SHARE = 0.25
"""Share of the disagreement, in blocks from which it was not learnt, from which on a quantity is named."""
_EXCESS = 0.03
"""Relative excess over the noise floor's energy that is still noise."""
_REVERSAL_DEG, _REVERSAL_OF_NOISE = 2.0, 6.0
"""Motion before a reversal that counts [deg], or in noise floors if that is more."""
_DENSE, _DENSER = 0.5, 1.5
"""Share of the excess from which on a part of the log is reported, and how many times that of its samples."""
_SURROUNDS = ("V", "°C")
"""Units of what acts on a servo from outside, which has no sign."""
_NARROW = 0.5
"""Share of all frequencies that a reported band has at most."""


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

    start_s, (count, energy) = float(record.time_s[0]), per_second(record, error_deg)
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
        if block.bad:
            begin_s = pieces.pop()[0] if pieces and block.start_s - pieces[-1][1] < 0.5 else block.start_s
            pieces.append((begin_s, block.end_s))
    return tuple(pieces)


def sentences(record: Record, error_deg: FloatArray, sigma_deg: float) -> list[str]:
    """Where the disagreement lies, in words."""
    error = error_deg[record.counts]
    rms = float(np.sqrt(np.mean(error**2)))
    bad = bad_seconds(record, error_deg, sigma_deg)
    total = np.count_nonzero(per_second(record, error_deg)[0])
    if not bad:
        return [f"nowhere: {rms:.3g} deg rms, the noise floor is {sigma_deg:.3g} deg, and no second stands out"]
    length = sum(end - start for start, end in bad)
    longest = sorted(bad, key=lambda piece: piece[0] - piece[1])[:4]
    shown = ", ".join(f"{start:.0f} to {end:.0f} s" for start, end in sorted(longest))
    more = f" and {len(bad) - 4} more" if len(bad) > 4 else ""
    texts = [
        f"disagreement above the noise floor ({rms:.3g} against {sigma_deg:.3g} deg rms) in {length:.0f} of "
        f"{total} seconds: {shown}{more}"
    ]
    if rms**2 < (1.0 + 2.0 * _EXCESS) * sigma_deg**2:
        return texts
    found = maps(record, error_deg, sigma_deg)
    texts += [
        *_concentrated(found),
        *_after_reversals(record, error_deg, sigma_deg),
        *_at_frequencies(record, error_deg, sigma_deg),
    ]
    telling = [f"{_percent(m.share)} follows the {m.quantity}" for m in found[:3] if m.share > SHOWN_SHARE]
    texts.append(
        f"of the excess, {', '.join(telling)}"
        if telling
        else "hardly any of the excess follows command, speed, deflection or time: a disturbance, correlated noise, or "
        "an effect with a state of its own"
    )
    return texts


def _concentrated(found: tuple[Map, ...]) -> list[str]:
    """Where a quantity is large, if that is where most of the excess lies."""
    dense = max(found, key=lambda m: m.concentration)
    if dense.concentration <= _DENSE or dense.quantity == "time":
        return []
    size = dense.quantity if dense.unit in _SURROUNDS else f"|{dense.quantity}|"
    return [
        f"disagreement concentrates where {size} > {dense.above:.3g} {dense.unit} "
        f"({dense.concentration:.0%} of the excess in 20 % of the samples)"
    ]


def _after_reversals(record: Record, error_deg: FloatArray, sigma_deg: float) -> list[str]:
    """Right after the motion has turned, if that is where most of the excess lies."""
    least_deg = max(_REVERSAL_DEG, _REVERSAL_OF_NOISE * sigma_deg)
    counts = record.counts
    error, moved_deg = error_deg[counts], (record.measured_deg - error_deg)[counts]
    after = since_reversal_s(record.time_s[counts], moved_deg, least_deg) < AFTER_REVERSAL_S
    excess = error**2 - sigma_deg**2
    part, share = float(excess[after].sum() / max(excess.sum(), 1e-12)), float(np.mean(after))
    if part < max(_DENSE, _DENSER * share):
        return []
    return [
        f"{_percent(part)} of the excess lies within {AFTER_REVERSAL_S:g} s after reversals of more than "
        f"{least_deg:.2g} deg ({share:.0%} of the samples)"
    ]


def _at_frequencies(record: Record, error_deg: FloatArray, sigma_deg: float) -> list[str]:
    """Band of the excess, if it is narrow, and where the position no longer follows the command linearly."""
    found = spectrum(record, error_deg)
    if found is None:
        return []
    texts, band_hz = [], excess_band_hz(found, sigma_deg)
    if band_hz is not None and band_hz[1] - band_hz[0] < _NARROW * found.frequency_hz[-1]:
        texts.append(f"four fifths of the excess lie between {band_hz[0]:.2g} and {band_hz[1]:.2g} Hz")
    limit_hz = coherent_to_hz(found)
    if limit_hz is not None:
        texts.append(f"at {limit_hz:.2g} Hz the position no longer follows the command linearly (coherence below 0.9)")
    return texts


def _percent(share: float) -> str:
    return f"{min(share, 1.0):.0%}"

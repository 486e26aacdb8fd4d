"""Where model and measurement disagree: in which seconds, and under which conditions, against the noise floor."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.discrepancy.maps import EVEN, LINEAR, ODD, maps, since_reversal_s
from servofd.discrepancy.regimes import AFTER_REVERSAL_S
from servofd.discrepancy.spectrum import coherent_to_hz, excess_band_hz, spectrum

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.discrepancy.maps import Map
    from servofd.discrepancy.record import Record

_FALSE_DISCOVERIES = 0.01
_SHOWN_SHARE, _NO_SHARE = 0.25, 0.05
_HARDLY = 0.15
"""What chance may make of a share that is said to be none."""
_EXCESS = 0.03
_REVERSAL_DEG, _REVERSAL_OF_NOISE = 2.0, 6.0
_DENSE, _DENSER = 0.5, 1.5
"""Share of the excess in a part of the log that is told, and times the share of the samples there."""
_NOT_SILENT = ("time", "direction of motion")
_SURROUNDS = ("V", "°C")
"""Units of what acts on a servo from outside, which has no sign."""
_NARROW = 0.5
"""Share of all frequencies that a band may have and still be told."""


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
    texts += [
        *_concentrated(found),
        *_after_reversals(record, error_deg, sigma_deg),
        *_at_frequencies(record, error_deg, sigma_deg),
    ]
    telling = [m for m in found if m.share > _SHOWN_SHARE and m.low > 0.0]
    if telling:
        texts.append("of the excess, " + ", ".join(f"{_percent(m.share)} follows {_article(m)}" for m in telling[:3]))
    else:
        texts.append(
            "hardly any of the excess follows command, speed, deflection or time: a disturbance, noise with memory, or "
            "an effect with a memory of its own"
        )
    silent = [_article(m) for m in found if m.share < _NO_SHARE and m.high < _HARDLY and m.quantity not in _NOT_SILENT]
    if silent and telling:
        texts.append(f"none of it follows {' or '.join(silent[:3])}")
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


def _article(found: Map) -> str:
    article = {LINEAR: "a", ODD: "an", EVEN: "an"}.get(found.quantity, "the")
    return f"{article} {found.quantity}"

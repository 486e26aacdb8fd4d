"""When a servo that was well stopped being so: a fault in the middle of a log is not a missing effect."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.discrepancy.record import Record
    from servofd.discrepancy.select import Selection

_SHORTEST_S = 3.0
_RATIO = 3.0
_BEYOND = 6.0
"""A sample this many noise floors away is no noise: one in a billion."""


def fault_start_s(record: Record, selection: Selection) -> float | None:
    """Where the error of the nominal servo grows [s]; None if it does nowhere.

    The split into two stretches of constant variance that is most likely for Gaussian errors, taken second by second,
    of those after which it is larger: a jam that passes leaves a servo that is well behind it, too.
    """
    error = selection.nominal.error_deg
    start_s = float(record.time_s[0])
    second = (record.time_s - start_s).astype(np.int64)[record.counts]
    count = np.bincount(second).astype(float)
    energy = np.bincount(second, weights=error[record.counts] ** 2)
    sums, counts = np.cumsum(energy), np.cumsum(count)
    edge = np.arange(int(_SHORTEST_S) - 1, sums.size - 2)
    if not edge.size:
        return None
    floor = selection.sigma_deg**2
    before = np.maximum(sums[edge] / np.maximum(counts[edge], 1.0), floor)
    after = np.maximum((sums[-1] - sums[edge]) / np.maximum(counts[-1] - counts[edge], 1.0), floor)
    likely = counts[edge] * np.log(before) + (counts[-1] - counts[edge]) * np.log(after)
    grows = after >= _RATIO * before
    if not grows.any():
        return None
    best = int(np.argmin(np.where(grows, likely, np.inf)))
    from_s = start_s + float(edge[best]) - 1.0
    limit = _BEYOND * float(np.sqrt(before[best]))
    late = record.counts & (record.time_s >= from_s) & (np.abs(error) > limit)
    return float(record.time_s[late][0]) if late.any() else start_s + float(edge[best]) + 1.0

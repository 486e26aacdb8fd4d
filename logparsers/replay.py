"""A telemetry log, frame by frame with its arrival times, as it came over the link."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from logparsers.errors import UnreadableLog
from logparsers.mavlink import dialect
from logparsers.protocol import CHECK_BYTES, HEADER_1, HEADER_2, MARKER_1, SIGNATURE_BYTES, SIGNED
from logparsers.source import LogBytes, mapped
from logparsers.telemetry import frames
from logparsers.units import S_PER_US


def replayed(source: LogBytes) -> Iterator[tuple[float, bytes]]:
    """Good frames of a telemetry log, and when each arrived [s since 1970].

    `source`: a ``.tlog``.
    """
    data, name = mapped(source)
    known = dialect()
    markers, _, unstamped, _, _, _ = frames.scan(data, known.slots, known.seeds)
    if markers.size == 0:
        raise UnreadableLog(f"{name}: no MAVLink message with a correct check-sum in {data.size} bytes")
    is_stamped = np.isin(markers, unstamped, invert=True)
    arrivals_s = np.append(0.0, frames.arrivals_us(data, markers[is_stamped]) * S_PER_US)
    of_2 = HEADER_2 + SIGNATURE_BYTES * (data[markers + 2] & SIGNED).astype(np.intp)
    ends = markers + np.where(data[markers] == MARKER_1, HEADER_1, of_2) + data[markers + 1] + CHECK_BYTES
    columns = markers.tolist(), ends.tolist(), arrivals_s[np.cumsum(is_stamped)].tolist()
    for marker, end, arrival_s in zip(*columns, strict=True):
        yield arrival_s, data[marker:end].tobytes()

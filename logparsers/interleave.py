"""Put the records of several streams into one file, in the order of time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def places(times: Sequence[ArrayLike], lengths: Sequence[ArrayLike]) -> tuple[list[NDArray[np.int64]], int]:
    """Where each record begins in the file.

    `times` (shape (n_i,)): when each record of a stream was written; records of equal time keep the order of the
    streams. `lengths` (shape (n_i,)): their sizes [bytes]. Result: `starts` (shape (n_i,)): first byte of each record.
    `size`: of all records together [bytes].
    """
    counts = [np.size(t) for t in times]
    if not sum(counts):
        return [np.zeros(0, np.int64) for _ in counts], 0
    size = np.concatenate([np.asarray(n, np.int64) for n in lengths])
    order = np.argsort(np.concatenate([np.asarray(t, np.int64) for t in times]), kind="stable")
    starts = np.empty(size.size, np.int64)
    starts[order] = np.cumsum(size[order]) - size[order]
    return np.split(starts, np.cumsum(counts)[:-1]), int(size.sum())


def interleave(times: Sequence[ArrayLike], records: Sequence[NDArray[Any]]) -> bytes:
    """Write packed records of equal size per stream.

    `times` (shape (n_i,)): when each record was written. `records` (shape (n_i,)): the records of each stream, as they
    shall stand in the file.
    """
    starts, size = places(times, [np.full(len(r), r.dtype.itemsize) for r in records])
    body = np.zeros(size, np.uint8)
    for at, rows in zip(starts, records, strict=True):
        if len(rows):
            width = rows.dtype.itemsize
            anywhere = np.ndarray((size - width + 1,), rows.dtype, body.data, strides=(1,))
            anywhere[at] = rows
    return body.tobytes()

"""Rows that belong together, recognised by a text or a number in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def distinct_texts(raw: NDArray[np.uint8], most: int | None = None) -> tuple[list[str], NDArray[np.int64]]:
    """Find the distinct texts among rows of characters. By sorting: no choice of texts can make it slow.

    `raw` (shape (n, width)): ASCII, ended by a NUL or by the last column. `most`: of more texts than that, only so
    many; rows of the others have the code behind them. Result: `codes` (shape (n,)): which text each row is.
    """
    count, width = raw.shape
    words = np.zeros((count, -(-width // 8)), dtype=np.uint64)
    letters = words.view(np.uint8)[:, :width]
    letters[:] = raw
    for place in range(1, width):
        letters[:, place] *= letters[:, place - 1] != 0
    order = np.lexsort(words.T)
    fresh = np.zeros(count, dtype=bool)
    fresh[:1] = True
    for column in words.T:
        ordered = column[order]
        fresh[1:] |= ordered[1:] != ordered[:-1]
    group = np.empty(count, dtype=np.int64)
    group[order] = np.cumsum(fresh) - 1
    found = [words[i].tobytes().rstrip(b"\0").decode("ascii", errors="replace") for i in order[fresh][:most]]
    texts = sorted(set(found))  # different damage can decode to the same replacement
    place_of = {text: k for k, text in enumerate(texts)}
    places = np.array([place_of[text] for text in found], dtype=np.int64)
    if most is None or group.size == 0 or places.size > group.max():
        return texts, places[group]
    return texts, np.append(places, len(texts))[np.minimum(group, places.size)]


def split_rows(values: Sequence[Any], codes: NDArray[Any]) -> dict[Any, NDArray[np.intp]]:
    """Rows of each value, by one sort however many values there are.

    `values`: what the codes stand for; more codes than values are left out. `codes` (shape (n,)): which value each row
    has; every value has a row.

    Examples
    --------
    >>> {name: rows.tolist() for name, rows in split_rows(["a", "b"], np.array([1, 0, 1])).items()}
    {'a': [1], 'b': [0, 2]}
    """
    ends = np.cumsum(np.bincount(codes, minlength=len(values)))[: len(values)]
    order = np.argsort(codes, kind="stable")
    if ends.size and ends[-1] < order.size:
        order = order[: ends[-1]].copy()
    return dict(zip(values, np.split(order, ends[:-1]), strict=True))

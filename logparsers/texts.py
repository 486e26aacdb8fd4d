"""Rows that belong together, recognised by a text or a number in them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["distinct_texts", "split_rows"]


def distinct_texts(raw: NDArray[np.uint8]) -> tuple[list[str], NDArray[np.int64]]:
    r"""Find the distinct texts among rows of characters. By sorting: no choice of texts can make it slow.

    Parameters
    ----------
    raw : ndarray of uint8, shape (n, width)
        ASCII, ended by a NUL or by the last column.

    Returns
    -------
    texts : list of str
        Sorted.
    codes : ndarray of int64, shape (n,)
        Which text each row is.

    Examples
    --------
    >>> rows = np.frombuffer(b"POS\0PWM\0POS\0", np.uint8).reshape(3, 4)
    >>> texts, codes = distinct_texts(rows)
    >>> texts, codes.tolist()
    (['POS', 'PWM'], [0, 1, 0])
    """
    count, width = raw.shape
    ended = np.logical_or.accumulate(raw == 0, axis=1)
    words = np.zeros((count, -(-width // 8)), dtype=np.uint64)
    words.view(np.uint8)[:, :width] = np.where(ended, 0, raw)
    order = np.lexsort(words.T)
    fresh = np.ones(count, dtype=bool)
    fresh[1:] = (words[order[1:]] != words[order[:-1]]).any(axis=1)
    group = np.empty(count, dtype=np.int64)
    group[order] = np.cumsum(fresh) - 1
    found = [words[i].tobytes().rstrip(b"\0").decode("ascii", errors="replace") for i in order[fresh]]
    texts = sorted(set(found))  # different damage can decode to the same replacement
    place = {text: k for k, text in enumerate(texts)}
    return texts, np.array([place[text] for text in found], dtype=np.int64)[group]


def split_rows(values: Sequence[Any], codes: NDArray[Any]) -> dict[Any, NDArray[np.intp]]:
    """Rows of each value, by one sort however many values there are.

    Parameters
    ----------
    values : sequence of k
        What the codes stand for.
    codes : ndarray of int, shape (n,)
        Which value each row has; every value has a row.

    Examples
    --------
    >>> {name: rows.tolist() for name, rows in split_rows(["a", "b"], np.array([1, 0, 1])).items()}
    {'a': [1], 'b': [0, 2]}
    """
    starts = np.cumsum(np.bincount(codes, minlength=len(values)))[:-1]
    return dict(zip(values, np.split(np.argsort(codes, kind="stable"), starts), strict=True))

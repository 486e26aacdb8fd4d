r"""Windows over the residual of a witness: how large a change is, how far beyond healthy, since when and for how long.

Whatever tells of a surface (its position, its current, the motion of the aircraft) hands over (x, A, Sigma): a residual
e, what a change of size theta would leave in it, and what a healthy one may differ by,

    e = x theta + A c + n,     c ~ N(0, Sigma),     theta of a healthy one ~ N(theta0, P).

Products of these columns, summed up to each edge of a grid, give every window as a difference of two sums. A window is
fitted by elimination: A first, with the precision of c on the diagonal, which marginalises it, then x. That gives theta
and its covariance, and what theta explains of e^2 is twice the logarithm of the likelihood ratio of the change, times
the variance of the noise. Of theta

    J = (theta - theta0)^T (Sigma_theta + P)^-1 (theta - theta0)

is what a healthy one does not explain: a chi-square, one-sided where only one direction is a fault. With one x this is
the square of the score test of `servofd.detection.changes`, which a compiled loop evaluates for streams.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servofd.core.types import BoolArray, FloatArray, IntArray

_ALIKE = 1e-9
"""Share of a column's square that the columns before it must leave of it: less is rounding, and tells nothing."""
_LEARNED_SIGMAS = 2.5
"""A flight is believed to differ from others by no more, lest one that failed before it teaches what to expect: one in
a hundred does by a chance of its own."""
_LEAST_VAR = 1e-12
"""Added to the variance of what healthy ones differ by, which a file may say is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Products of columns, summed up to each edge of a grid, or in windows.

    `products` (shape (q (q + 1) / 2, n + 1) or (q (q + 1) / 2, n)): of all pairs of columns, row by row of the upper
    triangle. `samples` (shape (n + 1,) or (n,)): how many were usable.
    """

    products: FloatArray
    samples: FloatArray

    @classmethod
    def of(cls, columns: FloatArray, usable: BoolArray, begins: IntArray | None = None) -> Sums:
        """Up to each of m samples, or to the end of each group of samples that begin at some places.

        Parameters
        ----------
        columns : ndarray, shape (q, m)
            The residual last.
        usable : ndarray of bool, shape (m,)
            Which samples count.
        begins : ndarray of int, optional
            First sample of each group.

        Examples
        --------
        >>> sums = Sums.of(np.array([[1.0, 1.0, 1.0], [2.0, 3.0, 4.0]]), np.array([True, False, True]))
        >>> sums.table[0, 1], sums.samples
        (array([0., 2., 2., 6.]), array([0., 1., 1., 2.]))
        """
        rows = np.where(usable, columns, 0.0)
        left, right = np.triu_indices(len(rows))
        return cls.running((rows[i] * rows[j] for i, j in zip(left, right, strict=True)), usable, begins)

    @classmethod
    def running(cls, rows: Iterable[FloatArray], usable: BoolArray, begins: IntArray | None = None) -> Sums:
        """Of rows (m,) as they are, where samples count, such as how much likelier some change makes each sample."""
        each, samples = [np.where(usable, row, 0.0) for row in rows], usable.astype(np.float64)
        if begins is not None:
            each, samples = [np.add.reduceat(row, begins) for row in each], np.add.reduceat(samples, begins)
        totals, counts = np.zeros((len(each), samples.size + 1)), np.zeros(samples.size + 1)
        for total, row in zip(totals, each, strict=True):
            np.cumsum(row, out=total[1:])
        np.cumsum(samples, out=counts[1:])
        return cls(totals, counts)

    def between(self, begin: IntArray | int, end: IntArray | int) -> Sums:
        """In windows from some edges to others."""
        begin, end = np.atleast_1d(begin), np.atleast_1d(end)
        return Sums(self.products[:, end] - self.products[:, begin], self.samples[end] - self.samples[begin])

    def trailing(self, length: int) -> Sums:
        """In the window of a length that ends with each sample; the first ones are shorter."""
        products, samples = self.products[:, 1:].copy(), self.samples[1:].copy()
        if length < samples.size:
            products[:, length:] -= self.products[:, 1:-length]
            samples[length:] -= self.samples[1:-length]
        return Sums(products, samples)

    @property
    def width(self) -> int:
        """Number of columns, q."""
        return (math.isqrt(8 * len(self.products) + 1) - 1) // 2

    @property
    def _places(self) -> IntArray:
        """Row of the products of two columns, shape (q, q)."""
        place = np.zeros((self.width, self.width), dtype=np.intp)
        place[np.triu_indices(self.width)] = np.arange(len(self.products))
        return np.maximum(place, place.T)

    @property
    def table(self) -> FloatArray:
        """Products of all columns with all, shape (q, q, n)."""
        return np.asarray(self.products[self._places])

    def given(self, count: int, precision: FloatArray) -> Sums:
        """Products of the other columns, once the first so many were fitted to them with a precision (count, count).

        Examples
        --------
        >>> a, x = np.array([1.0, 1.0]), np.array([1.0, 3.0])
        >>> Sums.of(np.array([a, x]), np.ones(2, dtype=bool)).between(0, 2).given(1, np.zeros((1, 1))).products
        array([[2.]])
        """
        table = np.moveaxis(self.table, 2, 0)
        first, rest = table[:, :count, :count] + precision, table[:, :count, count:]
        left = table[:, count:, count:] - rest.transpose(0, 2, 1) @ np.linalg.solve(first, rest)
        return Sums(np.moveaxis(left, 0, 2)[np.triu_indices(left.shape[1])], self.samples)

    def rows(self, columns: Sequence[int]) -> list[list[FloatArray]]:
        """Of some columns, in an order of their own: rows of the upper triangle of their products."""
        place = self._places
        return [[self.products[place[i, j]] for j in columns[k:]] for k, i in enumerate(columns)]


class Sizes(NamedTuple):
    """Sizes of a change, or what to expect of them, for each of n windows; NaN where a window does not tell."""

    value: FloatArray
    """Shape (p, n)."""
    covariance: FloatArray
    """Shape (p, p, n)."""

    def at(self, chosen: IntArray | BoolArray) -> Sizes:
        """Of some windows."""
        return Sizes(self.value[:, chosen], self.covariance[..., chosen])

    def only(self, k: int) -> Sizes:
        """One of the sizes, whatever the others are."""
        return Sizes(self.value[k : k + 1], self.covariance[k : k + 1, k : k + 1])

    def beyond(self, expected: Sizes, healthy: FloatArray) -> Sizes:
        """How far these are from what is expected, where healthy windows (p, p) differ as well."""
        wide = np.asarray(healthy)[..., None]
        return Sizes(self.value - expected.value, self.covariance + expected.covariance + wide)

    @property
    def known(self) -> BoolArray:
        """Windows that tell."""
        known: BoolArray = np.isfinite(self.value[0])
        return known

    @classmethod
    def nothing(cls, healthy: FloatArray) -> Sizes:
        """Before anything was seen: none, as far as healthy ones (p, p) differ."""
        return cls(np.zeros((len(healthy), 1)), np.asarray(healthy, dtype=np.float64)[..., None])


class Fitted(NamedTuple):
    """Sizes in some windows, for noise of unit variance, and what they leave."""

    sizes: Sizes
    explained: FloatArray
    """Of the squares of the residual by the sizes: a likelihood ratio, shape (n,)."""
    left: FloatArray
    """Of the squares of the residual, shape (n,)."""

    def scaled(self, noise_var: FloatArray | float) -> Sizes:
        """The sizes for noise of a variance."""
        return Sizes(self.sizes.value + 0.0 * noise_var, self.sizes.covariance * noise_var)


def _eliminated(
    rows: list[list[FloatArray]], count: int
) -> tuple[list[list[FloatArray]], list[tuple[FloatArray, list[FloatArray], FloatArray]]]:
    """What is left of the upper triangle of products once so many columns were fitted to the others (Gauss).

    And of each of these its square, its share in the columns after it, and its product with the last.
    """
    squares, steps = [row[0] for row in rows[:count]], []
    for square in squares:
        (pivot, *others), *rest = rows
        pivot = np.where(pivot > _ALIKE * square, pivot, np.nan)
        shares = [other / pivot for other in others]
        rows = [
            [x - other * share for x, share in zip(row, shares[i:], strict=True)]
            for i, (row, other) in enumerate(zip(rest, others, strict=True))
        ]
        steps.append((pivot, shares, others[-1]))
    return rows, steps


def fitted(
    window: Sums, patterns: int, precision: FloatArray | None = None, columns: Sequence[int] | None = None
) -> Fitted:
    """Fit the last columns of windows before the residual to it, beside those that come first.

    `window`: of what a healthy one may differ by, of `patterns` columns of a change, and of the residual. `patterns`:
    how many sizes are asked for. `precision` (shape (q - 1, q - 1) or (q - 1, q - 1, n), optional): inverse covariance
    of differences and sizes before the window, times the variance of the noise; None: free. `columns`: which columns,
    in which order, and which of them more than once; None: all as they are.
    """
    rows = window.rows(range(window.width) if columns is None else columns)
    if precision is not None:
        for i, row in enumerate(rows[:-1]):
            row[:-1] = [x + known if np.any(known) else x for x, known in zip(row, precision[i, i:], strict=False)]
    ((left,),), steps = _eliminated(rows, len(rows) - 1)
    n, p = window.samples.size, patterns
    value, covariance, explained = np.zeros((p, n)), np.zeros((p, p, n)), np.zeros(n)
    for k, (pivot, shares, with_e) in zip(range(p - 1, -1, -1), steps[: -p - 1 : -1], strict=True):
        # What the sizes after it leave of each (Takahashi 1973).
        after = list(zip(range(k + 1, p), shares, strict=False))
        for j in range(k + 1, p):
            covariance[k, j] = covariance[j, k] = -sum(share * covariance[m, j] for m, share in after)
        covariance[k, k] = 1.0 / pivot - sum(share * covariance[m, k] for m, share in after)
        value[k] = shares[-1] - sum(share * value[m] for m, share in after)
        explained += with_e * shares[-1]
    return Fitted(Sizes(value, covariance), explained, left)


def known_from(
    past: Sums,
    patterns: int,
    flight: FloatArray,
    window: FloatArray,
    noise_var: float,
    columns: Sequence[int] | None = None,
) -> Sizes:
    """What to expect of the sizes in a window, from all that came before it.

    The past counts as one window's worth of knowledge however long it is, because windows of one flight differ: it
    shows the sizes of the flight, of covariance `flight` (p, p), and of one window, `window` (p, p), beside each other.

    `past` is of columns as `fitted` takes them, and may be empty.
    """
    columns = range(past.width) if columns is None else columns
    q, p = len(columns), patterns
    known = np.zeros((q - 1 + p, q - 1 + p))
    inverse = np.asarray(np.linalg.inv(flight + _LEAST_VAR * np.eye(p)), dtype=np.float64)
    known[q - 1 :, q - 1 :] = inverse
    known[q - 1 - p : q - 1, q - 1 - p : q - 1] = np.linalg.inv(window + _LEAST_VAR * np.eye(p))
    doubled = [columns[k] for k in (*range(q - 1), *range(q - 1 - p, q))]
    found, prior = fitted(past, p, noise_var * known, doubled).scaled(noise_var), Sizes.nothing(flight)
    value = np.where(found.known, found.value, prior.value)
    away = np.sqrt(np.sum(value * (inverse @ value), axis=0))
    held = np.minimum(1.0, _LEARNED_SIGMAS / np.maximum(away, _LEAST_VAR))
    return Sizes(held * value, np.where(found.known, found.covariance, prior.covariance))


def _conditional(away: Sizes, faulty: int | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """J of all sizes but one, and that one beyond what they imply with its variance."""
    order = [k for k in range(len(away.value)) if k != faulty]
    count, order = len(order), order if faulty is None else [*order, faulty]
    rows = [[*(away.covariance[i, j] for j in order[k:]), away.value[i]] for k, i in enumerate(order)]
    rest, _ = _eliminated([*rows, [np.zeros_like(away.value[0])]], count)
    variance, given = (rest[0][0], rest[0][1]) if faulty is not None else (np.ones(1), np.zeros(1))
    return -rest[-1][0], given, variance


def distance(away: Sizes, faulty: int | None = 0) -> FloatArray:
    """J of windows, shape (n,); 0 where none tells. Of the size `faulty` only more counts, of the others either way.

    In healthy windows it is a chi-square with as many degrees of freedom as there are sizes.

    Examples
    --------
    >>> apart = Sizes(np.array([[3.0, -3.0], [2.0, 2.0]]), np.eye(2)[..., None] * np.ones(2))
    >>> distance(apart), distance(apart, None)
    (array([13.,  4.]), array([13., 13.]))
    """
    others, given, variance = _conditional(away, faulty)
    return np.fmax(others + np.maximum(given, 0.0) ** 2 / variance, 0.0)


def least(away: Sizes, level: float) -> FloatArray:
    """More of the first size that would lift J to a level, shape (n,); inf where no window tells.

    Examples
    --------
    >>> float(least(Sizes(np.zeros((1, 1)), np.full((1, 1, 1), 0.25)), 4.0)[0])
    1.0
    """
    others, given, variance = _conditional(away, 0)
    missing = np.maximum(level - others, 0.0)
    more = np.where(missing == 0.0, 0.0, np.maximum(np.sqrt(missing * variance) - given, 0.0))
    return np.asarray(np.nan_to_num(more, nan=np.inf))


def lasting(statistic: FloatArray, count: int) -> FloatArray:
    """Least of so many values in a row along the last axis, of those before the first 0: an alarm that outlasts a gust.

    Examples
    --------
    >>> lasting(np.array([5.0, 1.0, 7.0, 6.0]), 2)
    array([0., 1., 1., 6.])
    """
    kept = np.array(statistic, dtype=np.float64)
    for back in range(1, count):
        kept[..., back:] = np.minimum(kept[..., back:], statistic[..., :-back])
        kept[..., :back] = np.minimum(kept[..., :back], 0.0)
    return kept


def split(since: FloatArray, before: FloatArray | float = 0.0) -> int:
    """Best onset of a change: from where on it explains most, with what health explains before it.

    NaN where that is not known; the last place where it is known nowhere.

    Examples
    --------
    >>> split(np.array([3.0, 5.0, np.nan, 1.0])), split(np.array([np.nan, np.nan]))
    (1, 1)
    """
    explained = since + before
    return int(np.nanargmax(explained)) if np.isfinite(explained).any() else explained.size - 1

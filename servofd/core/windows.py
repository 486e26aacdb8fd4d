r"""Windows over the residual of a witness: how large a change is, how far beyond healthy, since when and for how long.

Whatever tells of a surface (its position, its current, the motion of the aircraft) hands over (x, A, Sigma): a residual
e, what a change of size theta would leave in it, and what a healthy one may differ by,

    e = x theta + A c + n,     c ~ N(0, Sigma),     theta of a healthy one ~ N(theta0, P).

Products of these columns, summed up to each edge of a grid, give every window as a difference of two sums. A window is
fitted by sweeping its products (Goodnight 1979): A first, with the precision of c on the diagonal, which marginalises
it, then x. What is left beside e tells theta and its covariance, and what theta explains of e^2 is twice the logarithm
of the likelihood ratio of the change, times the variance of the noise. Of it

    J = (theta - theta0)^T (Sigma_theta + P)^-1 (theta - theta0)

is what a healthy one does not explain: a chi-square, one-sided where only one direction is a fault. With one x this is
the square of the score test of `servofd.detection.changes`, which a compiled loop evaluates for streams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

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

    Parameters
    ----------
    products : ndarray, shape (q, q, n + 1) or (q, q, n)
        Of all pairs of columns.
    samples : ndarray, shape (n + 1,) or (n,)
        How many were usable.
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
        >>> sums.products[0, 1], sums.samples
        (array([0., 2., 2., 6.]), array([0., 1., 1., 2.]))
        """
        rows = np.where(usable, columns, 0.0)
        products, samples = rows[:, None] * rows, usable.astype(np.float64)
        if begins is not None:
            products, samples = np.add.reduceat(products, begins, axis=2), np.add.reduceat(samples, begins)
        q = len(rows)
        totals, counts = np.zeros((q, q, samples.size + 1)), np.zeros(samples.size + 1)
        np.cumsum(products, axis=2, out=totals[..., 1:])
        np.cumsum(samples, out=counts[1:])
        return cls(totals, counts)

    def between(self, begin: IntArray | int, end: IntArray | int) -> Sums:
        """In windows from some edges to others."""
        begin, end = np.atleast_1d(begin), np.atleast_1d(end)
        return Sums(self.products[..., end] - self.products[..., begin], self.samples[end] - self.samples[begin])

    def trailing(self, length: int) -> Sums:
        """In the window of a length that ends with each sample; the first ones are shorter."""
        products, samples = self.products[..., 1:].copy(), self.samples[1:].copy()
        if length < samples.size:
            products[..., length:] -= self.products[..., 1:-length]
            samples[length:] -= self.samples[1:-length]
        return Sums(products, samples)

    def at(self, columns: Sequence[int]) -> Sums:
        """Of some columns alone, in another order, or of some more than once."""
        if list(columns) == list(range(columns[0], len(self.products))):
            return Sums(self.products[columns[0] :, columns[0] :], self.samples)
        chosen = np.asarray(columns)
        return Sums(self.products[chosen[:, None], chosen], self.samples)


def swept(products: FloatArray, places: Sequence[int]) -> FloatArray:
    """Products (q, q, n) of columns after some of them were fitted to all others; NaN where they are too much alike.

    Of fitted columns stand the inverse of their products, and in the other columns their coefficients; of the others
    what is left of their products.

    Examples
    --------
    >>> line = np.array([[1.0, 1.0, 1.0], [0.0, 1.0, 2.0], [1.0, 3.0, 5.0]])
    >>> left = swept((line @ line.T)[..., None], (0, 1))[..., 0]
    >>> left[:2, 2].round(6), bool(abs(left[2, 2]) < 1e-12)
    (array([1., 2.]), True)
    """
    out = np.array(products, dtype=np.float64)
    for k in places:
        pivot = np.where(out[k, k] > _ALIKE * products[k, k], out[k, k], np.nan)
        row, column = out[k] / pivot, out[:, k].copy()
        out -= column[:, None] * row
        out[k], out[:, k], out[k, k] = row, -column / pivot, 1.0 / pivot
    return out


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


def fitted(window: Sums, patterns: int, precision: FloatArray | None = None) -> Fitted:
    """Fit the last columns of windows before the residual to it, beside those that come first.

    Parameters
    ----------
    window : Sums
        Of what a healthy one may differ by, of `patterns` columns of a change, and of the residual.
    patterns : int
        How many sizes are asked for.
    precision : ndarray, shape (q - 1, q - 1) or (q - 1, q - 1, n), optional
        Inverse covariance of differences and sizes before the window, times the variance of the noise; None: free.

    Examples
    --------
    >>> e, x, a = np.array([2.0, 2.0, 2.0, 2.0]), np.ones(4), np.array([1.0, -1.0, 1.0, -1.0])
    >>> sums = Sums.of(np.array([a, x, e]), np.ones(4, dtype=bool)).trailing(4)
    >>> found = fitted(sums, 1, np.diag([1.0, 4.0]))  # as likely near zero as four readings make it otherwise
    >>> float(found.sizes.value[0, -1]), float(found.explained[-1])
    (1.0, 8.0)
    """
    rest = window.products
    if precision is not None:
        rest = rest.copy()
        rest[:-1, :-1] += precision if np.ndim(precision) > 2 else precision[..., None]
    squares = [rest[k, k] for k in range(len(rest) - 1 - patterns)]
    for square in squares:
        pivot = np.where(rest[0, 0] > _ALIKE * square, rest[0, 0], np.nan)
        rest = rest[1:, 1:] - rest[1:, :1] * (rest[0, 1:] / pivot)
    done = swept(rest, range(patterns))
    sizes = Sizes(done[:patterns, -1], done[:patterns, :patterns])
    return Fitted(sizes, rest[-1, -1] - done[-1, -1], done[-1, -1])


def known_from(past: Sums, patterns: int, flight: FloatArray, window: FloatArray, noise_var: float) -> Sizes:
    """What to expect of the sizes in a window, from all that came before it.

    The past counts as one window's worth of knowledge however long it is, because windows of one flight differ: it
    shows the sizes of the flight, of covariance `flight` (p, p), and of one window, `window` (p, p), beside each other.

    `past` is of columns as `fitted` takes them, and may be empty.
    """
    q, p = len(past.products), patterns
    known = np.zeros((q - 1 + p, q - 1 + p))
    inverse = np.asarray(np.linalg.inv(flight + _LEAST_VAR * np.eye(p)), dtype=np.float64)
    known[q - 1 :, q - 1 :] = inverse
    known[q - 1 - p : q - 1, q - 1 - p : q - 1] = np.linalg.inv(window + _LEAST_VAR * np.eye(p))
    doubled = past.at([*range(q - 1), *range(q - 1 - p, q - 1), q - 1])
    found, prior = fitted(doubled, p, noise_var * known).scaled(noise_var), Sizes.nothing(flight)
    value = np.where(found.known, found.value, prior.value)
    away = np.sqrt(np.sum(value * (inverse @ value), axis=0))
    held = np.minimum(1.0, _LEARNED_SIGMAS / np.maximum(away, _LEAST_VAR))
    return Sizes(held * value, np.where(found.known, found.covariance, prior.covariance))


def _conditional(away: Sizes, faulty: int | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """J of all sizes but one, and that one beyond what they imply with its variance."""
    p, n = away.value.shape
    table = np.zeros((p + 1, p + 1, n))
    table[:p, :p], table[:p, p], table[p, :p] = away.covariance, away.value, away.value
    table = swept(table, [k for k in range(p) if k != faulty])
    if faulty is None:
        return -table[p, p], np.zeros(n), np.ones(n)
    return -table[p, p], table[faulty, p], table[faulty, faulty]


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
    squares: FloatArray = np.fmax(others + np.maximum(given, 0.0) ** 2 / variance, 0.0)
    return squares


def least(away: Sizes, level: float, faulty: int = 0) -> FloatArray:
    """More of the size `faulty` that would lift J to a level, shape (n,); inf where no window tells.

    Examples
    --------
    >>> float(least(Sizes(np.zeros((1, 1)), np.full((1, 1, 1), 0.25)), 4.0)[0])
    1.0
    """
    others, given, variance = _conditional(away, faulty)
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

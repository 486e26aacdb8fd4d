"""Residuals over their total sigma, and tests of changed parameters, over windows that end every quarter of a second.

With e the residual, s its sensitivities to the parameters of the servo and Sigma what those may differ by between good
flights, a residual of a good flight has the variance

    sigma_tot^2 = sigma_noise^2 + s' Sigma s.

A changed parameter h is tested by what of its pattern the others cannot explain (score test, nuisances with their
covariance; A = sum s s', b = sum s e, both whitened by the noise):

    z_h = (b_h - A_hn M b_n) / sqrt(A_hh - A_hn M A_nh + 1),    M = (A_nn + Sigma^-1)^-1,

beside the energy over the total sigma (E), what no parameter explains (U), and a narrow band between 1 Hz and a third
of the sampling rate (L). All of them are sums over windows, hence differences of running sums.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from logparsers.compiled import compiled
from servofd.aircraft.priors import FITTED, PRIORS
from servofd.estimate.family import PATTERNS

if TYPE_CHECKING:
    from servofd.aircraft.noise import Noise
    from servofd.core.types import FloatArray

GRID_S: Final = 0.25
WINDOWS_S: Final = (2.0, 5.0, 10.0, 30.0, 60.0)
_ENERGY_S: Final = (0.5, 1.0, 2.0, 5.0)
_LEFT_S: Final = (2.0, 5.0, 10.0, 30.0)
_BAND_S: Final = (4.0, 10.0)
_TESTED: Final = ("loss", "bias", *PATTERNS)
STATISTICS: Final = (
    "triple",
    *(f"energy_{w:g}s" for w in _ENERGY_S),
    *(f"left_{w:g}s" for w in _LEFT_S),
    *(f"{name}_{w:g}s" for w in WINDOWS_S for name in _TESTED),
    *(f"band_{w:g}s" for w in _BAND_S),
)
"""Names of all statistics, in order."""
_WIDTH: Final = FITTED + len(PATTERNS)
_MATRIX: Final = _WIDTH * _WIDTH
_FIRST_HZ, _SPACING_HZ, _LAST_HZ = 1.0, 0.1, 12.0
_BLOCKS: Final = 256
_COLUMNS: Final = len(STATISTICS) + 6 * len(WINDOWS_S) + 2 * len(_BAND_S)
_LARGEST, _LARGEST_LOSSY = 6.0, 4.0
"""Times its sigma that a residual counts for. A command that went and came back unseen is in several positions."""
_UNITS = np.array([*(prior.between for prior in PRIORS), 1.0, 1.0, 1.0, 1.0])


class Tests(NamedTuple):
    """What the tests of one surface need to know."""

    colour: FloatArray
    """Two coefficients of the noise's colour, its innovation, and the largest ratio to sigma that counts."""
    root: FloatArray
    """Cholesky factor of the covariance between flights, in units of `PRIORS.between`."""
    precision: FloatArray
    """Its inverse."""
    spectrum: FloatArray
    """Of the noise over its sigma, at each frequency of the narrow band."""
    period_s: float

    @classmethod
    def of(cls, noise: Noise, between: FloatArray, period_s: float, *, is_lossy: bool = False) -> Tests:
        """From a calibration: its noise and its covariance between flights (13, 13); lossy: most commands are lost."""
        noise = noise.at(period_s)
        scaled = between / np.outer(_UNITS[:FITTED], _UNITS[:FITTED])
        first, second = noise.colour
        hz = np.arange(_FIRST_HZ, min(_LAST_HZ, 1.0 / period_s / 3.0) + 1e-9, _SPACING_HZ)
        turn = np.exp(-2j * np.pi * hz * period_s)
        spectrum = (noise.innovation / np.abs(1.0 - first * turn - second * turn**2)) ** 2
        colour = np.array([first, second, noise.innovation, _LARGEST_LOSSY if is_lossy else _LARGEST])
        root = np.asarray(np.linalg.cholesky(scaled), dtype=np.float64)
        inverse = np.asarray(np.linalg.inv(scaled), dtype=np.float64)
        return cls(colour, root, inverse, spectrum, period_s)


class Memory:
    """Running sums of one surface."""

    def __init__(self, tests: Tests) -> None:
        self.before = np.zeros((2, _WIDTH + 1))
        self.runs = np.zeros(8)
        self.runs[0], self.runs[3] = -np.inf, -1.0
        self.sums = np.zeros(_MATRIX + _WIDTH + 4 + 2 * tests.spectrum.size)
        self.ring = np.zeros((_BLOCKS, self.sums.size))


def follow(
    tests: Tests, memory: Memory, time_s: FloatArray, error_deg: FloatArray, slopes: FloatArray, noise_deg: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Take the next samples.

    Parameters
    ----------
    memory : Memory
        Of this surface; is carried on.
    time_s, error_deg, noise_deg : ndarray, shape (m,)
        Times [s], residuals [deg], NaN where none is to be judged, and sigma of their noise [deg].
    slopes : ndarray, shape (m, 17)
        Sensitivities and patterns.

    Returns
    -------
    sigma_deg, triple : ndarray, shape (m,)
        Total sigma, and the least of three residuals in a row on one side over it.
    grid_s : ndarray, shape (g,)
        Sample times at which a block of a quarter second was complete.
    statistics : ndarray, shape (g, 75)
        Of `STATISTICS` at these times; behind them, what information each test had of a unit of its change, and of
        narrow bands the number of samples and the sum of one over the total sigma.
    """
    m = time_s.size
    if not m:
        return np.empty(0), np.empty(0), np.empty(0), np.empty((0, _COLUMNS))
    since = memory.runs[0] if np.isfinite(memory.runs[0]) else time_s[0]
    room = int(min((time_s[-1] - since) / GRID_S + 3, m + 3))
    grid_s, statistics = np.empty(room), np.zeros((room, _COLUMNS))
    sigma_deg, triple = np.empty(m), np.empty(m)
    count = _follow(
        *tests[:4], memory.before, memory.runs, memory.sums, memory.ring, _UNITS, tests.period_s,
        time_s, error_deg, slopes, noise_deg, sigma_deg, triple, grid_s, statistics,
    )  # fmt: skip
    return sigma_deg, triple, grid_s[:count], statistics[:count]


@partial(compiled, error_model="numpy")
def _follow(  # noqa: C901, PLR0912, PLR0915 - one loop over time
    colour: FloatArray, root: FloatArray, precision: FloatArray, spectrum: FloatArray, before: FloatArray,
    runs: FloatArray, sums: FloatArray, ring: FloatArray, units: FloatArray, period_s: float, time_s: FloatArray,
    error_deg: FloatArray, slopes: FloatArray, noise_deg: FloatArray, sigma_deg: FloatArray, triple: FloatArray,
    grid_s: FloatArray, statistics: FloatArray,
) -> int:  # fmt: skip
    """Take all samples, and tell how many blocks were complete.

    `runs`: time of the last sample, of the last valid one, how many valid ones in a row, block, the last two residuals
    over their sigma, best triple of this block.
    """
    width = units.shape[0]
    fitted = root.shape[0]
    bands = spectrum.shape[0]
    after_a = width * width
    after_b = after_a + width
    z, w = np.empty(width + 1), np.empty(width + 1)
    count = 0
    for i in range(time_s.shape[0]):
        t = time_s[i]
        block = np.floor(t / 0.25)
        if runs[3] < 0.0:
            runs[3] = block
        if block > runs[3]:
            pushed = int(min(block - runs[3], ring.shape[0]))
            for k in range(pushed):
                ring[int(block - 1 - k) % ring.shape[0]] = sums
            runs[3] = block
            _evaluate(ring, int(block) - 1, precision, spectrum, width, period_s, statistics[count])
            statistics[count, 0] = runs[6]
            runs[6] = 0.0
            grid_s[count] = t
            count += 1
        runs[0] = t
        inner = 0.0
        for j in range(fitted):
            part = 0.0
            for k in range(j, fitted):
                part += root[k, j] * slopes[i, k] * units[k]
            inner += part * part
        total = np.sqrt(noise_deg[i] ** 2 + inner)
        sigma_deg[i] = total
        triple[i] = 0.0
        if np.isnan(error_deg[i]):
            continue
        sigma = noise_deg[i]
        for k in range(width):
            z[k] = slopes[i, k] * units[k] / sigma
        z[width] = error_deg[i] / sigma
        fresh = t - runs[1] > 2.6 * period_s
        if fresh:
            runs[2] = 0.0
        u = error_deg[i] / total
        if runs[2] >= 2.0 and u * runs[4] > 0.0 and u * runs[5] > 0.0:
            triple[i] = min(abs(u), abs(runs[4]), abs(runs[5]))
            runs[6] = max(runs[6], triple[i])
        runs[5] = runs[4]
        runs[4] = u
        if runs[2] >= 2.0:
            for k in range(width + 1):
                w[k] = (z[k] - colour[0] * before[0, k] - colour[1] * before[1, k]) / colour[2]
            w[width] = min(colour[3], max(-colour[3], w[width]))
            for j in range(width):
                for k in range(j + 1):
                    sums[j * width + k] += w[j] * w[k]
                sums[after_a + j] += w[j] * w[width]
            sums[after_b] += w[width] ** 2
            sums[after_b + 1] += 1.0
        u = min(colour[3], max(-colour[3], u))
        sums[after_b + 2] += u * u
        sums[after_b + 3] += 1.0 / total
        turn = np.exp(-2j * np.pi * 0.1 * t)
        phase = np.exp(-2j * np.pi * 1.0 * t) * u
        for k in range(bands):
            sums[after_b + 4 + 2 * k] += phase.real
            sums[after_b + 5 + 2 * k] += phase.imag
            phase *= turn
        before[1] = before[0]
        before[0] = z
        runs[1] = t
        runs[2] += 1.0
    return count


@partial(compiled, error_model="numpy")
def _evaluate(  # noqa: C901, PLR0912, PLR0915 - all statistics at one time
    ring: FloatArray, last: int, precision: FloatArray, spectrum: FloatArray, width: int, period_s: float,
    out: FloatArray,
) -> None:  # fmt: skip
    fitted = precision.shape[0]
    after_a = width * width
    after_b = after_a + width
    rows = ring.shape[0]
    end = ring[last % rows]
    place = 1
    for seconds in (0.5, 1.0, 2.0, 5.0):
        begin = ring[(last - int(4.0 * seconds)) % rows]
        n = max(_count(end, begin, after_b), 0.5 * seconds / period_s, 3.0)
        out[place] = (end[after_b + 2] - begin[after_b + 2]) / n
        place += 1
    a = np.empty((fitted, fitted))
    x, y = np.empty(fitted), np.empty(fitted)
    for seconds in (2.0, 5.0, 10.0, 30.0, 60.0):
        begin = ring[(last - int(4.0 * seconds)) % rows]
        for j in range(fitted):
            for k in range(j + 1):
                a[j, k] = end[j * width + k] - begin[j * width + k] + precision[j, k]
        for j in range(fitted):  # Cholesky
            for k in range(j + 1):
                part = a[j, k]
                for p in range(k):
                    part -= a[j, p] * a[k, p]
                a[j, k] = np.sqrt(max(part, 1e-12)) if j == k else part / a[k, k]
        explained = 0.0
        for j in range(fitted):
            part = end[after_a + j] - begin[after_a + j]
            for p in range(j):
                part -= a[j, p] * x[p]
            x[j] = part / a[j, j]
            explained += x[j] * x[j]
        if seconds <= 30.0:
            n = max(_count(end, begin, after_b), 0.5 * seconds / period_s, 10.0)
            out[place] = (end[after_b] - begin[after_b] - explained) / n
        base = 9 + 6 * (
            0 if seconds == 2.0 else 1 if seconds == 5.0 else 2 if seconds == 10.0 else 3 if seconds == 30.0 else 4
        )
        for test in range(6):
            h = test if test < 2 else fitted + test - 2
            known, score = 0.0, end[after_a + h] - begin[after_a + h]
            for j in range(fitted):
                high, low = max(h, j), min(h, j)
                part = end[high * width + low] - begin[high * width + low]
                for p in range(j):
                    part -= a[j, p] * y[p]
                y[j] = part / a[j, j]
                known += y[j] * y[j]
                score -= y[j] * x[j]
            own = end[h * width + h] - begin[h * width + h]
            free = max(own - known, 0.0)
            value = score / np.sqrt(free + 1.0)
            out[base + test + 32] = free
            out[base + test] = -value if test == 0 else abs(value) if test == 1 else value
        place += 1
    place = 39
    for seconds in (4.0, 10.0):
        begin = ring[(last - int(4.0 * seconds)) % rows]
        n = _count(end, begin, after_b)
        best = 0.0
        if n >= 0.5 * seconds / period_s:
            energy = end[after_b + 2] - begin[after_b + 2]
            weight = end[after_b + 3] - begin[after_b + 3]
            for k in range(spectrum.shape[0]):
                real = end[after_b + 4 + 2 * k] - begin[after_b + 4 + 2 * k]
                imag = end[after_b + 5 + 2 * k] - begin[after_b + 5 + 2 * k]
                power = real * real + imag * imag
                if 2.0 * power > 0.2 * n * energy and 2.0 * np.sqrt(power) > 0.2 * weight:
                    best = max(best, power / (n * spectrum[k]))
        out[place] = np.sqrt(best)
        out[71 + 2 * (place - 39)] = n
        out[72 + 2 * (place - 39)] = end[after_b + 3] - begin[after_b + 3]
        place += 1


@partial(compiled, error_model="numpy")
def _count(end: FloatArray, begin: FloatArray, after_b: int) -> float:
    return float(end[after_b + 1] - begin[after_b + 1])

"""Residuals over their total sigma, and tests of changed parameters, over windows that end every quarter of a second.

With e the residual, s its sensitivities to the parameters of the servo and Sigma what those may differ by between good
flights, a residual of a good flight has the variance

    sigma_tot^2 = sigma_noise^2 + s' Sigma s.

A changed parameter h is tested by what of its pattern the others cannot explain (score test, nuisances with their
covariance; A = sum s s', b = sum s e, both whitened by the noise):

    z_h = (b_h - A_hn M b_n) / sqrt(A_hh - A_hn M A_nh + 1),    M = (A_nn + Sigma^-1)^-1,

beside the energy over the total sigma (E), what no parameter explains (U), and a narrow band between 1 Hz and a third
of the sampling rate (L), over the noise and what a servo that is late would leave in it. All of them are sums over
windows, hence differences of running sums. Where the model is known to miss up to delta deg of how a sound servo moves,
the size of a pattern of rms d scatters by delta / rms d, and its score by that times the information I that is left of
it: z has sqrt(I + (delta / rms d)^2 I^2 + 1) below the line.

Whole logs and streams are tested sample by sample the same; `servofd.detection.faults` makes faults of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.priors import FITTED, NAMES, PRIORS
from servofd.core.evidence import Detectable
from servofd.estimate.family import PATTERNS
from servofd.estimate.record import LONGEST_S
from servofd.servo.loops import compiled, inner

if TYPE_CHECKING:
    from collections.abc import Iterable

    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.core.types import BoolArray, FloatArray

GRID_S: Final = 0.25
"""Time between two evaluations of the windows [s]."""
WINDOWS_S: Final = (2.0, 10.0, 30.0)
"""Lengths of the windows of the tests of changed parameters [s]."""
_ENERGY_S: Final = (0.5, 2.0)
_BAND_S: Final = 10.0
"""Length of the window of the narrow-band test [s]."""
_SCORES: Final = (("loss", 0), ("loss", 1), ("bias", 1), ("weak", 1), ("loss", 2), ("play", 2))
"""What is tested for in which window. Of the 41 tests of six changes in windows of 2 to 60 s, these and the six beside
them raise the same alarms: 52 of 54 large faults and 31 of 36 medium ones after 0.5 and 1.6 s (0.5 and 1.25 with all),
2 of 510 good flights (six aircraft of even seed of `benchmarks/calibration_campaign.py`)."""
STATISTICS: Final = (
    "triple",
    *(f"energy_{w:g}s" for w in _ENERGY_S),
    *(f"left_{w:g}s" for w in WINDOWS_S[:2]),
    *(f"{name}_{WINDOWS_S[w]:g}s" for name, w in _SCORES),
    f"band_{_BAND_S:g}s",
)
"""Names of all statistics, in order."""
_WIDTH: Final = FITTED + len(PATTERNS)
_MATRIX: Final = _WIDTH * _WIDTH
_FIRST_HZ, _SPACING_HZ, _LAST_HZ = 1.0, 0.1, 12.0
"""Lowest line of its spectrum, distance of two lines, and the highest one [Hz]."""
_BLOCKS: Final = 128
"""Sums that are kept, one every `GRID_S`: more than the longest window holds."""
_LEFT, _FIRST, _BAND = 3, 5, len(STATISTICS) - 1
"""Places among the statistics: what no parameter explains, the first test of a change, and the narrow band."""
_EACH, _COUNT, _WEIGHT = _BAND + 1, _BAND + 1 + len(_SCORES), _BAND + 2 + len(_SCORES)
_COLUMNS: Final = _WEIGHT + 1
_WINDOW_OF: Final = tuple(window for _, window in _SCORES)
_CHANGE_OF: Final = tuple(
    FITTED + PATTERNS.index(name) if name in PATTERNS else NAMES.index({"loss": "gain", "bias": "bias_deg"}[name])
    for name, _ in _SCORES
)
"""Column of what each test looks for."""
_LATE: Final = 0.22
"""A line passes its limit of 6.4 where it is three times what a servo that is late by one standard deviation leaves
there: (3 / 6.4)^2."""
_LARGEST, _LARGEST_UNSEEN, UNSEEN_S = 6.0, 3.0, 0.05
"""Times its sigma that a residual counts for; the second where a command may have gone and come back unseen, for most
are lost or positions lie further apart than the last [s]: it is in several positions, or in one that is far off."""
_MOST_SHARE: Final = 0.64
"""Of the most that a mean square can be: a limit beyond it would never be passed, and one that is there all the time is
loud. Where a residual counts for 3 sigma, that is 5.8; good flights at 10 Hz reach 4.6 (80 surfaces of 20 aircraft of
even seed, nothing given)."""
SQUARES = np.array([name.startswith(("energy", "left")) for name in STATISTICS])
"""Which statistics are mean squares."""
_ROW: Final = 2.6
"""Periods by which two residuals in a row may lie apart: two that came late, or one that was lost, between them."""
_BLURRED: Final = 0.16
"""Share of its variance that a residual owes to the servo and its reading, below which it tells of lost commands: its
sigma is 2.5 times what all commands would leave. On the link of six failed elevon servos that is so for 13 to 32 % of
20 s where 30 % of all frames are lost at random, and for half where 45 % are: there the first fault is missed."""
_NOTICED: Final = 0.1
"""Share of a surface's travel below which no pilot notices that it is off."""
_DELAY: Final = NAMES.index("delay_s")
_UNITS = np.array([*(prior.between for prior in PRIORS), *(1.0 for _ in PATTERNS)])


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
    missed_deg: float
    """What the model is known to miss of how a sound servo moves."""
    limits: FloatArray
    """Threshold of each of the `STATISTICS`."""
    enough_deg: float = 0.0
    """Total sigma at which three residuals in a row that an aircraft notices pass their threshold."""
    row_s: float = 0.0
    """How far two residuals in a row may lie apart where a link loses some between them [s]; 0: as far as usual."""

    @classmethod
    def of(cls, known: CalibratedServo, period_s: float, *, is_lossy: bool = False, missed_deg: float = 0.0) -> Tests:
        """From the noise of a healthy servo and its covariance between flights; lossy: most commands are lost."""
        noise = known.noise.at(period_s)
        scaled = known.covariance / np.outer(_UNITS[:FITTED], _UNITS[:FITTED])
        first, second = noise.colour
        hz = np.arange(_FIRST_HZ, min(_LAST_HZ, 1.0 / period_s / 3.0) + 1e-9, _SPACING_HZ)
        turn = np.exp(-2j * np.pi * hz * period_s)
        spectrum = (noise.innovation / np.abs(1.0 - first * turn - second * turn**2)) ** 2
        largest = _LARGEST_UNSEEN if is_lossy or period_s > UNSEEN_S else _LARGEST
        colour = np.array([first, second, noise.innovation, largest])
        root = np.asarray(np.linalg.cholesky(scaled), dtype=np.float64)
        inverse = np.asarray(np.linalg.inv(scaled), dtype=np.float64)
        limits = thresholds_of(known)
        limits = np.where(SQUARES, np.minimum(limits, _MOST_SHARE * largest**2), limits)
        enough_deg = _NOTICED * (known.reach_deg[1] - known.reach_deg[0]) / float(limits[0])
        row_s = max(_ROW * period_s, LONGEST_S) if is_lossy else 0.0
        return cls(colour, root, inverse, spectrum, period_s, missed_deg, limits, enough_deg, row_s)


class Tested(NamedTuple):
    """Samples after the tests."""

    sigma_deg: FloatArray
    """Total, shape (m,)."""
    triple: FloatArray
    """Least of three residuals in a row on one side, over their total sigma, shape (m,)."""
    sharp: BoolArray
    """Where what is seen tells of the servo, and not mostly of the commands that were lost, (m,)."""
    grid_s: FloatArray
    """When a block of a quarter second was complete, shape (g,)."""
    statistics: FloatArray
    """`STATISTICS` at these times (g, 20), behind which stand the score that a unit of each change would have, and of
    narrow bands the number of samples and the sum of one over the total sigma."""


class Memory:
    """Running sums of one surface."""

    def __init__(self, tests: Tests) -> None:
        self.before = np.zeros((2, _WIDTH + 1))
        self.runs = np.zeros(9)
        self.runs[0], self.runs[3] = -np.inf, -1.0
        self.sums = np.zeros(_MATRIX + _WIDTH + 4 + 4 * tests.spectrum.size + 2)
        self.ring = np.zeros((_BLOCKS, self.sums.size))
        self.room = np.zeros((FITTED + 2, _WIDTH + 1))
        """For what is worked out at one time; an array that the compiled loop makes would take a second to compile."""


def follow(
    tests: Tests, memory: Memory, time_s: FloatArray, error_deg: FloatArray, slopes: FloatArray, noise_deg: FloatArray,
    lost_deg: FloatArray,
) -> Tested:  # fmt: skip
    """Take the next samples: times [s], residuals [deg], NaN where none is judged, and sigma of their noise, (m,) each.

    `slopes` (m, parameters + patterns) are sensitivities and patterns; `lost_deg` (m,) is how much of the noise comes
    of lost commands.
    """
    m = time_s.size
    if not m:
        return Tested(np.empty(0), np.empty(0), np.empty(0, dtype=bool), np.empty(0), np.empty((0, _COLUMNS)))
    since = memory.runs[0] if np.isfinite(memory.runs[0]) else time_s[0]
    room = int(min((time_s[-1] - since) / GRID_S + 3, m + 3))
    grid_s, statistics = np.empty(room), np.zeros((room, _COLUMNS))
    sigma_deg, triple, sharp = np.empty(m), np.empty(m), np.empty(m, dtype=np.bool_)
    count = _follow(
        *tests[:4], memory.before, memory.runs, memory.sums, memory.ring, memory.room, _UNITS, tests.period_s,
        tests.missed_deg, tests.enough_deg, tests.row_s or _ROW * tests.period_s, time_s, error_deg, slopes, noise_deg,
        lost_deg, sigma_deg, triple, sharp, grid_s, statistics,
    )  # fmt: skip
    return Tested(sigma_deg, triple, sharp, grid_s[:count], statistics[:count])


@compiled
def _follow(  # noqa: C901, PLR0912, PLR0915 - one loop over time
    colour: FloatArray, root: FloatArray, precision: FloatArray, spectrum: FloatArray, before: FloatArray,
    runs: FloatArray, sums: FloatArray, ring: FloatArray, room: FloatArray, units: FloatArray, period_s: float,
    missed_deg: float, enough_deg: float, row_s: float, time_s: FloatArray, error_deg: FloatArray, slopes: FloatArray,
    noise_deg: FloatArray, lost_deg: FloatArray, sigma_deg: FloatArray, triple: FloatArray, sharp: BoolArray,
    grid_s: FloatArray, statistics: FloatArray,
) -> int:  # fmt: skip
    """Take all samples, and tell how many blocks were complete.

    `runs`: time of the last sample, of the last valid one, how many valid ones in a row, block, the last two residuals
    over their sigma that make a row, best triple of this block, time of the later of those two, how many make the row.
    """
    width = units.shape[0]
    fitted = root.shape[0]
    bands = spectrum.shape[0]
    after_a = width * width
    after_b = after_a + width
    z, w = room[0], room[1]
    count = 0
    for i in range(time_s.shape[0]):
        t = time_s[i]
        block = np.floor(t / GRID_S)
        if runs[3] < 0.0:
            runs[3] = block
        if block > runs[3]:
            pushed = int(min(block - runs[3], ring.shape[0]))
            for k in range(pushed):
                for j in range(sums.shape[0]):
                    ring[int(block - 1 - k) % ring.shape[0], j] = sums[j]
            runs[3] = block
            _evaluate(ring, room, int(block) - 1, precision, spectrum, width, period_s, statistics[count])
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
        sharp[i] = total <= enough_deg or (1.0 - _BLURRED) * total**2 >= lost_deg[i] ** 2
        triple[i] = 0.0
        if np.isnan(error_deg[i]):
            continue
        sigma = noise_deg[i]
        for k in range(width):
            z[k] = slopes[i, k] * units[k] / sigma
        z[width] = error_deg[i] / sigma
        fresh = t - runs[1] > _ROW * period_s
        if fresh:
            runs[2] = 0.0
        u = error_deg[i] / total
        triple[i] = _in_a_row(runs, row_s, t, u, error_deg[i], total, lost_deg[i], sharp[i])
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
            sums[-1] += (missed_deg / (colour[2] * sigma)) ** 2
        u = min(colour[3], max(-colour[3], u))
        sums[-2] += 1.0  # these sums are of every judged sample, those above of samples that follow two others
        sums[after_b + 2] += u * u
        sums[after_b + 3] += 1.0 / total
        turn_cos, turn_sin = np.cos(2.0 * np.pi * _SPACING_HZ * t), np.sin(2.0 * np.pi * _SPACING_HZ * t)
        cos, sin = np.cos(2.0 * np.pi * _FIRST_HZ * t), np.sin(2.0 * np.pi * _FIRST_HZ * t)
        late = root[_DELAY, _DELAY] * units[_DELAY] * slopes[i, _DELAY] / total
        for k in range(bands):
            place = after_b + 4 + 4 * k
            sums[place] += cos * u
            sums[place + 1] += sin * u
            sums[place + 2] += cos * late
            sums[place + 3] += sin * late
            cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
        for k in range(width + 1):
            before[1, k] = before[0, k]
            before[0, k] = z[k]
        runs[1] = t
        runs[2] += 1.0
    return count


@inner
def _in_a_row(
    runs: FloatArray, row_s: float, time_s: float, u: float, error_deg: float, total_deg: float, lost_deg: float,
    is_sharp: bool,
) -> float:  # fmt: skip
    """Least of this residual over its sigma, and the two that make a row with it; 0 if they are not on one side."""
    if time_s - runs[7] > row_s:
        runs[8] = 0.0
    least: float = min(abs(runs[4]), abs(runs[5]))
    passed = 0.0
    if runs[8] >= 2.0 and u * runs[4] > 0.0 and u * runs[5] > 0.0:
        passed = min(abs(u), least)
        runs[6] = max(runs[6], passed)
        known_deg = max(total_deg**2 - lost_deg**2, 0.0) ** 0.5
        # What would be as far off as the two before it but for lost commands, or tells of these alone, breaks no row.
        if abs(u) < least and (not is_sharp or abs(error_deg) >= least * known_deg):
            return passed
    runs[5], runs[4], runs[7], runs[8] = runs[4], u, time_s, runs[8] + 1.0
    return passed


@inner
def _evaluate(
    ring: FloatArray, room: FloatArray, last: int, precision: FloatArray, spectrum: FloatArray, width: int,
    period_s: float, out: FloatArray,
) -> None:  # fmt: skip
    """All statistics at one time."""
    after_b = width * width + width
    end = ring[last % ring.shape[0]]
    for place in range(2):
        seconds = _ENERGY_S[place]
        begin = ring[(last - int(4.0 * seconds)) % ring.shape[0]]
        n = max(end[-2] - begin[-2], 0.5 * seconds / period_s, 3.0)
        out[1 + place] = (end[after_b + 2] - begin[after_b + 2]) / n
    for place in range(3):
        begin = ring[(last - int(4.0 * WINDOWS_S[place])) % ring.shape[0]]
        _test(end, begin, room, place, precision, width, period_s, out)
    begin = ring[(last - int(4.0 * _BAND_S)) % ring.shape[0]]
    out[_BAND] = _line(end, begin, after_b, spectrum, period_s)
    out[_COUNT] = _count(end, begin, after_b)
    out[_WEIGHT] = end[after_b + 3] - begin[after_b + 3]


@inner
def _test(
    end: FloatArray, begin: FloatArray, room: FloatArray, window: int, precision: FloatArray, width: int,
    period_s: float, out: FloatArray,
) -> None:  # fmt: skip
    """What no parameter explains of a window, and the scores of its changes."""
    fitted = precision.shape[0]
    after_a = width * width
    after_b = after_a + width
    x, y, root = room[0], room[1], room[2:]
    for j in range(fitted):  # Cholesky
        for k in range(j + 1):
            part = end[j * width + k] - begin[j * width + k] + precision[j, k]
            for p in range(k):
                part -= root[j, p] * root[k, p]
            root[j, k] = np.sqrt(max(part, 1e-12)) if j == k else part / root[k, k]
    explained = 0.0
    for j in range(fitted):
        part = end[after_a + j] - begin[after_a + j]
        for p in range(j):
            part -= root[j, p] * x[p]
        x[j] = part / root[j, j]
        explained += x[j] * x[j]
    if window < 2:
        n = max(_count(end, begin, after_b), 0.5 * WINDOWS_S[window] / period_s, 10.0)
        out[_LEFT + window] = (end[after_b] - begin[after_b] - explained) / n
    for test in range(6):
        if _WINDOW_OF[test] != window:
            continue
        h = _CHANGE_OF[test]
        known, score = 0.0, end[after_a + h] - begin[after_a + h]
        for j in range(fitted):
            high, low = max(h, j), min(h, j)
            part = end[high * width + low] - begin[high * width + low]
            for p in range(j):
                part -= root[j, p] * y[p]
            y[j] = part / root[j, j]
            known += y[j] * y[j]
            score -= y[j] * x[j]
        own = end[h * width + h] - begin[h * width + h]
        free = max(own - known, 0.0)
        spread = np.sqrt(free + (end[-1] - begin[-1]) / max(own, 1e-12) * free * free + 1.0)
        value = score / spread
        out[_EACH + test] = free / spread
        # Travel is lost where the gain falls; an offset has either sign.
        out[_FIRST + test] = -value if h == 0 else abs(value) if h == 1 else value


@inner
def _line(end: FloatArray, begin: FloatArray, after_b: int, spectrum: FloatArray, period_s: float) -> float:
    """The strongest line of a window."""
    n = end[-2] - begin[-2]
    if n < 0.5 * _BAND_S / period_s:
        return 0.0
    energy, weight = end[after_b + 2] - begin[after_b + 2], end[after_b + 3] - begin[after_b + 3]
    best = 0.0
    for k in range(spectrum.shape[0]):
        at = after_b + 4 + 4 * k
        power = (end[at] - begin[at]) ** 2 + (end[at + 1] - begin[at + 1]) ** 2
        late = (end[at + 2] - begin[at + 2]) ** 2 + (end[at + 3] - begin[at + 3]) ** 2
        if 2.0 * power > 0.2 * n * energy and 2.0 * np.sqrt(power) > 0.2 * weight:
            best = max(best, power / (n * spectrum[k] + _LATE * late))
    return float(np.sqrt(best))


@inner
def _count(end: FloatArray, begin: FloatArray, after_b: int) -> float:
    return float(end[after_b + 1] - begin[after_b + 1])


MARGIN: Final = 1.25
"""Factor of a threshold over the floor of its statistic."""
FLOORS: Final = dict(zip(STATISTICS, (4.8, 9.2, 7.6, 5.0, 2.7, 3.0, 3.3, 2.5, 9.0, 3.9, 11.0, 5.1), strict=True))
"""Each 1.15 times the second largest of 640 good surface flights of 32 simulated aircraft of even seed (of 1280 for
three residuals in a row); those of lost travel a third higher (small motion on the ground, real ArduPlane flights),
those of slow servos a tenth lower. None of those flights passes `MARGIN` times them."""
_AT_ONCE: Final = 1.2
"""Times its threshold that a statistic need not reach twice: it raises no alarm in those flights either."""
_OFTEN: Final = 0.9
"""Quantile of the windows whose sensitivity counts for the smallest fault."""
_BETWEEN_LINES: Final = 1.4
"""An oscillation between two lines of the spectrum shows less in each, and the autopilot works against it (83 % of 66
found on aircraft of even seed where the least one was 0.3 deg)."""
_BENT: Final = 2.5
"""A motor of half its torque has 0.17 to 0.8 of the score that its sensitivity promises (12 flights of even seed)."""
_POWER: Final = 1.64
"""Standard deviations by which a fault passes its threshold 19 times in 20."""
_SLOWEST: Final = 0.1
"""Share of the speed below which a servo stands."""
_LEAST_WAVE_DEG: Final = 0.4
"""Smallest amplitude of an oscillation that is promised [deg]."""
_PLAY_DEG: Final = 2.4
"""Play of 2 deg is the pattern; the air holds a loose surface to one side for some time, so that a fifth more is needed
(66 flights of even seed: 85 % found without it, 92 % with it)."""


def thresholds_of(known: CalibratedServo) -> FloatArray:
    """Threshold of each statistic, in their order."""
    return np.array([known.thresholds.get(name, FLOORS[name] * MARGIN) for name in STATISTICS])


def exceeded(limits: FloatArray, before: FloatArray, statistics: FloatArray) -> FloatArray:
    """By how much the worst statistic exceeds its threshold at each time of the grid, (g,); an alarm from 1 on.

    `before` is each statistic as it was at the last time; three residuals in a row are asked sample by sample.
    """
    ratios = np.concatenate([before[None], statistics])[:, 1:] / limits[1:]
    twice = np.minimum(ratios[1:], ratios[:-1])
    worst: FloatArray = np.maximum(twice, ratios[1:] / _AT_ONCE).max(axis=1, initial=0.0)
    return worst


def first_over(
    limits: FloatArray, before: FloatArray, rows: tuple[FloatArray, FloatArray], windows: tuple[FloatArray, FloatArray]
) -> tuple[float, float]:
    """When residuals in a row, and when windows, first pass their thresholds [s]; infinite where they never do.

    `rows` are times, and by how much residuals in a row pass, (m,) each; `windows` the times of the grid (g,), and the
    statistics there (g, k), which `before` precedes.
    """
    ratios = exceeded(limits, before, windows[1])
    over_s = rows[0][rows[1] >= 1.0], windows[0][ratios >= 1.0]
    by_level_s, by_windows_s = (float(each[0]) if each.size else np.inf for each in over_s)
    return by_level_s, by_windows_s


def detectable(flights: Iterable[tuple[Tests, Tested, BoolArray]]) -> Detectable:
    """The smallest change of each kind that some window of these flights would have shown, 19 times in 20.

    A change shows where its score, of unit variance, passes its threshold by 1.64 standard deviations. Of each flight
    its tests, what came of them, and which samples they took, shape (m,).
    """
    sizes: dict[str, float] = dict.fromkeys(("loss", "bias", "weak", "play", "band"), np.inf)
    for tests, tested, judged in flights:
        limits, table = tests.limits, tested.statistics
        if not len(table):
            continue
        for test, (kind, _) in enumerate(_SCORES):
            each = float(np.quantile(table[:, _EACH + test], _OFTEN))
            size = (limits[_FIRST + test] + _POWER) / each if each > 0.0 else np.inf
            sizes[kind] = min(sizes[kind], size * (_BENT if kind == "weak" else 1.0))
        total_deg = float(np.median(tested.sigma_deg[judged])) if judged.any() else np.inf
        seen_deg = total_deg * (np.sqrt(limits[2]) + _POWER / np.sqrt(_ENERGY_S[-1] / tests.period_s))
        sizes["bias"] = min(sizes["bias"], seen_deg / PRIORS[1].between)
        count, weight = np.median(table[:, [_COUNT, _WEIGHT]], axis=0)
        needed = (limits[_BAND] + _POWER) * np.sqrt(count * np.median(tests.spectrum))
        if weight > 0.0:
            sizes["band"] = min(sizes["band"], _BETWEEN_LINES * max(2.0 * needed / weight, _LEAST_WAVE_DEG))
    units = dict(zip(NAMES, (prior.between for prior in PRIORS), strict=True))
    share = 0.5 ** sizes["weak"]
    found = {
        "bias_deg": (units["bias_deg"] * sizes["bias"], 10.0),
        "slow_share": (share, 1.0 if share > _SLOWEST else 0.0),
        "loss_share": (units["gain"] * sizes["loss"], 1.0),
        "deadband_deg": (_PLAY_DEG * sizes["play"], 8.0),
        "oscillation_deg": (sizes["band"], 8.0),
    }
    return Detectable(**{name: float(f"{size:.2g}") if size <= most else None for name, (size, most) in found.items()})

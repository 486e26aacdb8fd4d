"""Transfer functions of a servo: poles, gain, bandwidth, and modes, for the residual filter and the script on board."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from servofd.core.errors import DesignError
from servofd.core.types import ComplexArray, FloatArray

BANDWIDTH_DROP_DB = 3.0
"""Below dc. Exactly 3.00 dB reproduces the bandwidth column of thesis Fig. 3.10; 3.0103 dB does not."""

_LARGEST_RATIO = 1e200
"""Of coefficients, whose quotients and products must be numbers."""
_SLOWEST_RAD_S, _FASTEST_RAD_S = 1e-5, 1e5
"""A day, and 10 us: no servo needs the one to move, or swings within the other; to follow it would take as long."""
_ROUND_OFF = 2.2e-16
"""Relative spacing of numbers in double precision."""
_WHOLE_SAMPLE = 1e-9
"""Share of a sample below which a delay is whole samples."""
_LARGEST_CANCELLATION = 1e9
"""Sum of the modes' weights; times round-off it is the error of the simulation, relative to the deflection."""


class Modes(NamedTuple):
    r"""Parallel form :math:`G(s) = \mathrm{Re} \sum_i w_i \, a_i / (s + a_i)`.

    One entry per real pole and one per complex pair (the member with positive imaginary part, its weight
    doubled), so that a step response needs one exponential per entry.
    """

    decay_rad_s: ComplexArray
    """Negated poles a_i, of shape (m,)."""
    weight: ComplexArray
    """Share of each mode in the output, of shape (m,); the real parts sum to the dc gain."""


@dataclass(frozen=True, slots=True)
class TransferFunction:
    """Ratio of two polynomials in s.

    Parameters
    ----------
    numerator, denominator : tuple of float
        Coefficients, highest power first, time in seconds.

    Raises
    ------
    DesignError
        If the denominator is zero or a coefficient is not finite.

    Examples
    --------
    The HS-225BB of thesis Eq. 3.1:

    >>> servo = TransferFunction((122300.0,), tuple(np.polymul([1, 24.84], [1, 70.04, 4921])))
    >>> round(servo.bandwidth_rad_s, 2)
    28.49
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("numerator", "denominator"):
            coefficients = [float(c) for c in getattr(self, name)]
            if not all(map(math.isfinite, coefficients)):
                raise DesignError(f"{name} {coefficients} has a coefficient that is not finite")
            while coefficients and not coefficients[0]:
                del coefficients[0]
            object.__setattr__(self, name, tuple(coefficients) or (0.0,))
        if self.denominator == (0.0,):
            raise DesignError("the denominator of a transfer function must not be zero")
        largest = max(abs(c) for c in (*self.numerator, *self.denominator))
        for name, leading in (("numerator", self.numerator[0]), ("denominator", self.denominator[0])):
            if leading and not largest / _LARGEST_RATIO < abs(leading):
                raise DesignError(f"{name}: the first coefficient, {leading:g}, is nothing beside {largest:g}")

    @classmethod
    def from_control(cls, system: Any) -> TransferFunction:  # noqa: ANN401 - python-control is untyped
        """Take a single-input single-output system of python-control; its delay must be given apart."""
        import control

        transfer = control.tf(system)
        return cls(tuple(transfer.num[0][0]), tuple(transfer.den[0][0]))

    def to_control(self) -> Any:  # noqa: ANN401 - python-control is untyped
        """Return the same system for python-control.

        Examples
        --------
        >>> float(TransferFunction((2.0,), (1.0, 4.0)).to_control().dcgain())
        0.5
        """
        import control

        return control.tf(list(self.numerator), list(self.denominator))

    @property
    def poles_rad_s(self) -> ComplexArray:
        """Roots of the denominator [rad/s], shape (n,), real ones first, then by size."""
        if len(self.denominator) == 3:
            return _pair(*self.denominator)
        roots = np.roots(self.denominator).astype(complex)
        order = np.lexsort((roots.imag, np.abs(roots), roots.imag != 0.0))
        return roots[order]

    @property
    def dc_gain(self) -> float:
        """Gain at zero frequency [deg/deg]; infinite for an integrator."""
        bottom = self.denominator[-1]
        return self.numerator[-1] / bottom if bottom else float("inf")

    @property
    def bandwidth_rad_s(self) -> float:
        """First frequency at which the gain is 3.00 dB below dc, on its way down [rad/s].

        Solved exactly, as the smallest positive root of a polynomial in the squared frequency.
        Infinite if the gain never falls that far.
        """
        top = _squared_magnitude(self.numerator)
        bottom = _squared_magnitude(self.denominator)
        level = 10.0 ** (-BANDWIDTH_DROP_DB / 10.0) * self.dc_gain**2
        roots = np.roots(np.polysub(top, level * bottom))
        crossings = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
        return float(np.sqrt(crossings.min())) if crossings.size else float("inf")

    def with_unity_dc(self) -> TransferFunction:
        """Scale the numerator to a dc gain of one, as thesis Appendix A does ("a0 = b0")."""
        return TransferFunction(tuple(c / self.dc_gain for c in self.numerator), self.denominator)

    def with_bandwidth_scaled(self, scale: float) -> TransferFunction:
        """Multiply every pole and zero by `scale`, keeping the dc gain.

        Examples
        --------
        >>> TransferFunction((4.0,), (1.0, 4.0)).with_bandwidth_scaled(0.5)
        TransferFunction(numerator=(2.0,), denominator=(1.0, 2.0))
        """
        order = len(self.denominator) - 1
        top = tuple(c * scale ** (order - (len(self.numerator) - 1 - i)) for i, c in enumerate(self.numerator))
        return TransferFunction(top, tuple(c * scale**i for i, c in enumerate(self.denominator)))

    def at(self, s: ComplexArray) -> ComplexArray:
        """Evaluate at complex frequencies `s` [rad/s], any shape."""
        return np.polyval(self.numerator, s) / np.polyval(self.denominator, s)

    @functools.lru_cache(maxsize=512)  # noqa: B019 - a residual asks three times, a fit for its grid once a surface
    def modes(self) -> Modes:
        """Split into first-order modes (partial fractions).

        Repeated poles are moved apart on a small circle first: the polynomial then changes by less than
        the cancellation that equal poles would cause (about 1e-10 of the deflection).

        Raises
        ------
        DesignError
            If the system is unstable or not strictly proper: no servo jumps, and none runs away.
        """
        if len(self.numerator) >= len(self.denominator):
            raise DesignError("a servo's transfer function must have more poles than zeros")
        poles = self.poles_rad_s
        if not all(pole.real < 0.0 for pole in poles.tolist()):
            raise DesignError(f"a servo's poles must have negative real parts, not {poles}")
        if any(abs(pole) < _SLOWEST_RAD_S or abs(pole.imag) > _FASTEST_RAD_S for pole in poles.tolist()):
            raise DesignError(
                f"a servo moves within {1.0 / _SLOWEST_RAD_S:g} s and swings no faster than {_FASTEST_RAD_S:g} rad/s, "
                f"with these poles it would not: {poles}"
            )
        poles = _separated(poles)
        upper = poles[poles.imag >= 0.0]
        # Number by number: of so few, arrays would take most of the time of a fit, which asks a thousand times.
        residues = [_at(self.numerator, pole) / (self.denominator[0] * _apart(pole, poles)) for pole in upper]
        shares = [residue / pole for residue, pole in zip(residues, upper, strict=True)]
        if not sum(map(abs, shares)) <= _LARGEST_CANCELLATION:
            raise DesignError("poles lie too close for so high an order: use a simpler model of this servo")
        return Modes(-upper, np.where(upper.imag > 0.0, -2.0, -1.0) * np.array(shares))

    def sampled(self, delay_s: float, sample_time_s: float) -> tuple[FloatArray, FloatArray]:
        """Numerator and denominator in z⁻¹ of the exact response to a held and delayed command, on samples."""
        whole, fraction_s = split_delay(delay_s, sample_time_s)
        modes = self.modes()
        poles, residues = -modes.decay_rad_s, modes.weight * modes.decay_rad_s
        pairs = poles.imag > 0.0
        residues = np.where(pairs, residues / 2.0, residues)
        poles = np.concatenate([poles, poles[pairs].conj()])
        residues = np.concatenate([residues, residues[pairs].conj()])
        factors = np.exp(poles * sample_time_s)
        early = np.expm1(poles * (sample_time_s - fraction_s)) / poles
        late = np.exp(poles * (sample_time_s - fraction_s)) * np.expm1(poles * fraction_s) / poles
        b = np.zeros(whole + poles.size + 2)
        for i in range(poles.size):
            term = residues[i] * np.convolve([0.0, early[i], late[i]], product_of(np.delete(factors, i)))
            b[whole:] += np.real(term)
        return b, np.real(product_of(factors))


def split_delay(delay_s: float, sample_time_s: float) -> tuple[int, float]:
    """Whole samples of a delay, and the rest [s]."""
    samples = delay_s / sample_time_s
    whole = int(np.floor(samples + _WHOLE_SAMPLE))
    return whole, max(0.0, samples - whole) * sample_time_s


def product_of(factors: ComplexArray) -> ComplexArray:
    """Coefficients of the product of (1 - f z⁻¹)."""
    coefficients = np.ones(1, dtype=complex)
    for factor in factors:
        coefficients = np.convolve(coefficients, [1.0, -factor])
    return coefficients


def _pair(square: float, linear: float, constant: float) -> ComplexArray:
    """Roots of a quadratic, real ones by size."""
    half, product = -0.5 * linear / square, constant / square
    spread = half * half - product
    if spread < 0.0:
        return np.array([complex(half, -math.sqrt(-spread)), complex(half, math.sqrt(-spread))])
    large = half + math.copysign(math.sqrt(spread), half)  # the other would lose digits
    return np.array([product / large if large else 0.0, large], dtype=complex)


def _at(coefficients: tuple[float, ...], s: complex) -> complex:
    """A polynomial at a frequency."""
    value: complex = 0.0 * s
    for coefficient in coefficients:
        value = value * s + coefficient
    return value


def _apart(pole: complex, poles: ComplexArray) -> complex:
    """Product of the distances of a pole from all others."""
    product: complex = math.prod(pole - other for other in poles if other != pole)
    return product


def _squared_magnitude(coefficients: tuple[float, ...]) -> ComplexArray:
    """Polynomial in w² whose value is |P(jw)|²."""
    flipped = [c * (-1) ** i for i, c in enumerate(reversed(coefficients))][::-1]
    product = np.polymul(coefficients, flipped)[::-1][::2][::-1]
    alternating: ComplexArray = product * np.array([(-1) ** i for i in range(product.size)])[::-1]
    return alternating


def _separated(poles: ComplexArray) -> ComplexArray:
    """Move clusters of equal poles onto small circles, keeping conjugate pairs conjugate."""
    scatter = 20.0 * _ROUND_OFF ** (1.0 / max(poles.size, 1))  # of the computed roots of an exact multiple pole
    size, apart = np.abs(poles), np.abs(poles[:, None] - poles)
    if np.count_nonzero(apart <= scatter * size) == poles.size:  # each is near to itself
        return poles
    result, remaining = poles.copy(), list(range(poles.size))
    while remaining:
        seed = remaining[0]
        near = np.abs(poles[remaining] - poles[seed]) <= scatter * abs(poles[seed])
        cluster = [k for k, same in zip(remaining, near, strict=True) if same]
        remaining = [k for k in remaining if k not in cluster]
        count = len(cluster)
        if count == 1:
            continue
        centre = poles[cluster].mean()
        if abs(centre.imag) < 1e-3 * abs(centre):
            centre = np.complex128(centre.real)
        radius = abs(centre) * _ROUND_OFF ** (1.0 / (2 * count - 1))
        # Angles symmetric about the real axis, so that the set stays closed under conjugation.
        angles = 2.0 * np.pi * (np.arange(count) + 0.5 * (count % 2 == 0)) / count
        if centre.imag < 0.0:
            angles = -angles
        result[cluster] = centre + radius * np.exp(1j * angles)
    result.imag[np.abs(result.imag) < 1e-14 * np.abs(result)] = 0.0
    return result

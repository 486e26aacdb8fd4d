r"""Nullspace filters: residuals that no command can reach (thesis 4.1 and Appendix B).

For a plant :math:`y = G u` the rows :math:`[D \;\; -N]` with :math:`G = D^{-1} N` annihilate every command.
Divided by a polynomial with chosen poles (Eq. 4.7) they become stable, strictly proper filters
:math:`r = Q [y; u]` that only a fault can excite. This module designs them in continuous time;
`servofd.detection.pulse` is what runs on samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.core.errors import DesignError
from servofd.servo.transfer import TransferFunction

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from servofd.core.types import ComplexArray, FloatArray

_SAME_ROOT = 1e-6
"""Relative distance of two roots below which they are one."""
_ON_AXIS = 1e-9
"""Distance from the imaginary axis, relative, below which a zero is on it; and size below which a coefficient is
zero."""
_SLOWEST_RAD_S, _FASTEST_RAD_S = 1e-5, 1e6
"""Poles of filters: time constants from more than a day to a microsecond, so that their powers are still numbers."""


@dataclass(frozen=True, slots=True)
class FilterRow:
    """One residual: a row of Q.

    Coefficients are in s, highest power first, over the common denominator given by `poles_rad_s`.
    """

    output: int
    """Which measured output this row uses."""
    qy: tuple[float, ...]
    """Numerator from that output to the residual."""
    qu: tuple[tuple[float, ...], ...]
    """Numerators from each command to the residual."""
    poles_rad_s: tuple[complex, ...]
    removed_zeros_rad_s: tuple[complex, ...]
    """Stable zeros of the plant that the filter cancels in the fault-to-residual response."""
    faults: tuple[TransferFunction, ...]
    """Response of the residual to an additive fault on each command (thesis Eq. 4.11)."""
    normalised_input: int
    """Command whose fault reaches the residual with a dc gain of +1."""
    scale: float

    @property
    def denominator(self) -> tuple[float, ...]:
        """Common denominator, highest power first."""
        return tuple(np.real(np.poly(np.array(self.poles_rad_s))).tolist())

    @property
    def dc_qy(self) -> float:
        """Gain from a constant output error to the residual [deg/deg]."""
        return self.qy[-1] / self.denominator[-1]

    @property
    def dc_qu(self) -> tuple[float, ...]:
        """Gains from constant commands to the residual [deg/deg]."""
        return tuple(numerator[-1] / self.denominator[-1] for numerator in self.qu)


@dataclass(frozen=True, slots=True)
class NullspaceFilter:
    """A filter Q = [Qy Qu] with one row per measured output, and the plant it was designed for."""

    rows: tuple[FilterRow, ...]
    plant: tuple[tuple[TransferFunction, ...], ...]

    def leakage(self, frequencies_rad_s: FloatArray) -> float:
        """Largest gain from any command to any residual of a healthy plant: the proof of the design."""
        s: ComplexArray = 1j * np.asarray(frequencies_rad_s, dtype=float)
        worst = 0.0
        for row in self.rows:
            denominator = np.polyval(row.denominator, s)
            measured = np.polyval(row.qy, s) / denominator
            for qu, entry in zip(row.qu, self.plant[row.output], strict=True):
                gain = measured * entry.at(s) + np.polyval(qu, s) / denominator
                worst = max(worst, float(np.max(np.abs(gain))))
        return worst


def design_nullspace_filter(
    plant: TransferFunction | Sequence[Sequence[TransferFunction]], pole_rad_s: float
) -> NullspaceFilter:
    """Design a fault detection filter with all free poles at one place (thesis Appendix B, getbasicQ).

    Parameters
    ----------
    plant : TransferFunction, or rows of them
        From commands (columns) to measured outputs (rows), without delays.
    pole_rad_s : float
        Where the filter's poles shall be [rad/s]; its sign does not matter.

    Returns
    -------
    NullspaceFilter
        One row per output, of order n + 1 where n is the order of the common denominator of that output's row.
        With a single command, stable zeros of the plant are removed from the fault-to-residual response.

    Raises
    ------
    DesignError
        If the pole is of no use (`checked_pole_rad_s`), or no fault on any command reaches an output at zero frequency.

    See Also
    --------
    NullspaceFilter.leakage : Proof that the design does what it promises.

    Notes
    -----
    Where the printed code and its purpose part, the purpose is followed: each row has its own denominator
    (the printed code takes that of the first entry, which does not decouple rows with others), the smallest
    non-zero dc gain is normalised with its own sign (the printed code gives zero for two outputs and two
    commands), and poles at +|p| and -|p| mean the same.

    Examples
    --------
    Thesis Eq. 4.10:

    >>> servo = TransferFunction((122300.0,), (1.0, 94.88, 6660.7936, 122237.64))
    >>> eq_4_10 = design_nullspace_filter(servo, 50.0)
    >>> np.round(eq_4_10.rows[0].qy, 4).tolist()
    [51.1038, 4848.7326, 340392.1504, 6246813.1643]
    >>> eq_4_10.leakage(np.geomspace(0.1, 300.0, 50)) < 1e-12
    True
    """
    pole = checked_pole_rad_s(pole_rad_s)
    entries = ((plant,),) if isinstance(plant, TransferFunction) else tuple(tuple(row) for row in plant)
    return NullspaceFilter(tuple(_row(i, row, pole) for i, row in enumerate(entries)), entries)


def checked_pole_rad_s(pole_rad_s: float) -> float:
    """Size of a filter's pole [rad/s]."""
    pole = abs(pole_rad_s)
    if not _SLOWEST_RAD_S <= pole <= _FASTEST_RAD_S:
        raise DesignError(
            f"a filter pole of {pole_rad_s} rad/s is no use: it must lie between {_SLOWEST_RAD_S:g} and "
            f"{_FASTEST_RAD_S:g} rad/s"
        )
    return pole


def _row(output: int, entries: tuple[TransferFunction, ...], pole: float) -> FilterRow:
    denominator, numerators = common_denominator(entries)
    gains = np.array([numerator[-1] for numerator in numerators])
    sizes = np.array(
        [
            abs(gain) / max(np.abs(numerator)) if np.any(numerator) else 0.0
            for gain, numerator in zip(gains, numerators, strict=True)
        ]
    )
    reaching = np.flatnonzero(sizes > _ON_AXIS)
    if reaching.size == 0:
        raise DesignError(f"output {output}: no command reaches it at zero frequency, so no fault gain can be set")
    chosen = int(reaching[np.argmin(np.abs(gains[reaching]))])
    removed = _stable_zeros(numerators[0]) if len(entries) == 1 else ()
    order = len(denominator) - 1
    if order + 1 < len(removed):
        raise DesignError(f"output {output}: more zeros than poles")
    poles = (*removed, *([complex(-pole)] * (order + 1 - len(removed))))
    shaping = float(np.real(np.prod(-np.array(poles))))
    scale = 1.0 / gains[chosen]
    faults = tuple(_fault(numerator, removed, poles, scale * shaping) for numerator in numerators)
    return FilterRow(
        output=output,
        qy=tuple((scale * shaping * denominator).tolist()),
        qu=tuple(tuple((-scale * shaping * numerator).tolist()) for numerator in numerators),
        poles_rad_s=poles,
        removed_zeros_rad_s=removed,
        faults=faults,
        normalised_input=chosen,
        scale=float(scale),
    )


def common_denominator(entries: tuple[TransferFunction, ...]) -> tuple[FloatArray, list[FloatArray]]:
    """Least common denominator of a row, and the numerators over it, highest power first."""
    common = np.array(entries[0].denominator)
    for entry in entries[1:]:
        missing = _roots_not_in(np.roots(entry.denominator), np.roots(common))
        if missing.size:
            common = np.polymul(common, np.real(np.poly(missing)))
    numerators = []
    for entry in entries:
        extra = _roots_not_in(np.roots(common), np.roots(entry.denominator))
        lead = common[0] / entry.denominator[0]
        numerators.append(lead * np.polymul(entry.numerator, np.real(np.poly(extra)) if extra.size else [1.0]))
    return common, numerators


def _roots_not_in(roots: NDArray[Any], others: NDArray[Any]) -> ComplexArray:
    """Roots left over after each of `others` has taken its match."""
    left = list(roots)
    for other in others:
        distances = [abs(root - other) for root in left]
        if distances and min(distances) <= _SAME_ROOT * max(1.0, abs(other)):
            left.pop(int(np.argmin(distances)))
    return np.array(left, dtype=complex)


def _stable_zeros(numerator: FloatArray) -> tuple[complex, ...]:
    zeros = np.roots(numerator).astype(complex)
    stable = zeros[zeros.real < -_ON_AXIS * np.maximum(1.0, np.abs(zeros))]
    return tuple(complex(z) for z in sorted(stable, key=lambda z: (z.real, z.imag)))


def _fault(
    numerator: FloatArray, removed: tuple[complex, ...], poles: tuple[complex, ...], gain: float
) -> TransferFunction:
    """Fault-to-residual response, with the removed zeros cancelled."""
    if not removed:
        return TransferFunction(tuple(gain * numerator), tuple(np.real(np.poly(np.array(poles)))))
    lead = numerator[np.flatnonzero(numerator)[0]]
    kept = np.real(np.poly(_roots_not_in(np.roots(numerator), np.array(removed))))
    rest = np.array(poles[len(removed) :])
    return TransferFunction(tuple(np.atleast_1d(gain * lead * kept)), tuple(np.real(np.poly(rest))))

"""Shape of an all-pole servo, in parameters that cannot go wrong, and its exact response to held commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.servo.transfer import TransferFunction

if TYPE_CHECKING:
    from servofd.core.types import ComplexArray, FloatArray

HIGHEST_ORDER = 3
"""Of thesis Fig. 3.10."""
LARGEST_LOG_GAIN = 14.0
"""Logarithm: a dc gain is within 1e-6 and 1e6, whatever the units."""
LONGEST_DELAY_S = 0.2
"""Of a servo with its link: the slowest that was measured needs 0.06 s."""
_SLOWEST_RAD_S, _NYQUIST_FREQUENCIES = 0.01, 20.0
"""Poles that a test can show: a slower one does not move within it, a faster one has come to rest before the next
sample (the fastest of thesis Fig. 3.10, 5074 rad/s, is 16 times the Nyquist frequency of its 100 Hz)."""
_LOG_RANGE = 14.0
"""Poles are kept within 1e-6 and 1e6 rad/s."""


@dataclass(frozen=True, slots=True)
class LinearServo:
    r"""Servo :math:`g\,a_0 e^{-\tau s} / (s^n + \dots + a_0)`, driven through a zero-order hold.

    Parameters
    ----------
    shape : tuple of float
        Logarithms: of the pole p (order 1), of wn² and 2 zeta wn of a second-order factor (order 2), of all three
        (order 3). Every value is a stable servo; a real pair of poles needs no other form than a complex one.
    delay_s : float
        Transport delay without the hold [s].
    gain : float
        dc gain [deg/deg]; negative if the position runs against the command.

    Examples
    --------
    >>> LinearServo.of(TransferFunction((800.0,), (1.0, 28.0, 800.0)), 0.01).order
    2
    """

    shape: tuple[float, ...]
    delay_s: float
    gain: float = 1.0

    @classmethod
    def of(cls, transfer: TransferFunction, delay_s: float) -> LinearServo:
        """From a transfer function without zeros, of order 1 to 3."""
        denominator = np.array(transfer.denominator) / transfer.denominator[0]
        order = denominator.size - 1
        if order == 3:
            real = float(min(transfer.poles_rad_s, key=lambda p: (abs(p.imag), abs(p))).real)
            (_, a1, a0), _ = np.polydiv(denominator, [1.0, -real])
            shape = (np.log(-real), np.log(a0), np.log(a1))
        else:
            shape = tuple(np.log(denominator[:0:-1]))
        return cls(tuple(float(value) for value in shape), delay_s, transfer.dc_gain)

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.shape)

    @property
    def transfer(self) -> TransferFunction:
        """Linear dynamics with the dc gain, without the delay."""
        values = np.exp(np.clip(self.shape, -_LOG_RANGE, 2.0 * _LOG_RANGE))
        if self.order == 1:
            denominator = np.array([1.0, values[0]])
        elif self.order == 2:
            denominator = np.array([1.0, values[1], values[0]])
        else:
            denominator = np.convolve([1.0, values[0]], [1.0, values[2], values[1]])
        return TransferFunction((self.gain * float(denominator[-1]),), tuple(denominator.tolist()))

    @property
    def poles_rad_s(self) -> ComplexArray:
        """Poles [rad/s], shape (order,)."""
        return self.transfer.poles_rad_s

    @property
    def lag_s(self) -> float:
        """Delay and a1/a0 together: how late a slow ramp is followed [s]; known even where its parts are not."""
        denominator = self.transfer.denominator
        return self.delay_s + denominator[-2] / denominator[-1]

    def sampled_response(self, frequency_rad_s: FloatArray, sample_time_s: float) -> ComplexArray:
        """Exact response of sampled position to sampled, held command (modified z-transform).

        Parameters
        ----------
        frequency_rad_s : ndarray, shape (m,)
            Below the Nyquist frequency [rad/s].

        Returns
        -------
        ndarray, shape (m,)
            Complex gain [deg/deg].

        Examples
        --------
        A slow sine is followed after the delay, half a hold and the lag of the pole:

        >>> servo = LinearServo((np.log(50.0),), 0.004)
        >>> phase = np.angle(servo.sampled_response(np.array([0.1]), 0.01))[0]
        >>> round(float(-phase) / 0.1, 3)
        0.029
        """
        poles = self._distinct_poles()
        transfer = self.transfer
        residues = transfer.numerator[0] / np.array([np.prod(p - poles[poles != p]) for p in poles])
        whole = np.floor(max(self.delay_s, 0.0) / sample_time_s)
        rest_s = self.delay_s - whole * sample_time_s
        z = np.exp(1j * frequency_rad_s * sample_time_s)[:, np.newaxis]
        late, full = np.exp(poles * (sample_time_s - rest_s)), np.exp(poles * sample_time_s)
        parts = residues / poles * ((late - 1.0) + (full - late) / z) / (z - full)
        response: ComplexArray = parts.sum(axis=1) * z[:, 0] ** -whole
        return response

    def _distinct_poles(self) -> ComplexArray:
        """Poles moved apart by a thousandth where they coincide; the response changes by a millionth."""
        poles = self.poles_rad_s.copy()
        for k in range(1, poles.size):
            if np.min(np.abs(poles[:k] - poles[k])) < 1e-3 * abs(poles[k]):
                poles[k] *= 1.0 + 1e-3 * k
        return poles


def shape_bounds(order: int, sample_time_s: float) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest `LinearServo.shape` whose poles a test can show.

    Parameters
    ----------
    order : int
        Number of poles, 1 to 3.

    Returns
    -------
    lower, upper : ndarray, shape (order,)
        No pole within is faster than 20 times the Nyquist frequency.

    Examples
    --------
    >>> np.exp(shape_bounds(1, 0.01)[1]).round()
    array([6283.])
    """
    powers = np.array({1: [1.0], 2: [2.0, 1.0], 3: [1.0, 2.0, 1.0]}[order])
    return powers * np.log(_SLOWEST_RAD_S), powers * np.log(_NYQUIST_FREQUENCIES * np.pi / sample_time_s)

r"""Nullspace filters for sampled signals, discretised plant first.

Discretising Eq. 4.10 directly leaves residuals of up to 1.6 deg on a healthy servo, because the command is held
between samples and delayed by a fraction of one. Instead the *plant* is discretised exactly (zero-order hold
and delay, :math:`b(z)/a(z)`), and the nullspace is taken in z:

.. math:: r = g \, \frac{a(z)\, y - b(z)\, u}{M_d(z)}, \qquad M_d = (1 - e^{-|p|T} z^{-1})^{n+1}, \qquad
          g = M_d(1) / b(1)

so that the residual of a healthy servo is round-off, and the fault-to-residual response is that of Eq. 4.11.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import DesignError
from servofd.detection.nullspace import checked_pole_rad_s, common_denominator
from servofd.servo.transfer import TransferFunction, product_of, split_delay

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import ComplexArray, FloatArray

PREFERRED_POLES_RAD_S = (120.0, 80.0, 50.0, 30.0, 20.0, 15.0, 10.0, 5.0)
"""Poles to choose from, fastest first; 50 rad/s is that of thesis Eq. 4.10."""

LARGEST_NOISE_GAIN = 0.5
"""Noise gain that the fastest pole which is taken may have."""
_USELESS_NOISE_GAIN = 5.0
"""Noise gain above which no filter is of use."""
_MOST_SAMPLES = 2e7
"""Of an impulse response, 160 MB: the slowest preferred pole at a million samples a second has 18 million."""


@dataclass(frozen=True, slots=True, eq=False)
class PulseFilter:
    """A residual filter on uniform samples; polynomials in z⁻¹, lowest power first."""

    b: tuple[FloatArray, ...]
    """Numerators of the healthy plant, one per command, each of shape (n + k + 2,) for k to k + 1 samples of delay."""
    a: FloatArray
    """Their common denominator, of shape (n + 1,)."""
    md: FloatArray
    """Denominator of the filter, of shape (n + 2,)."""
    g: float
    pole_rad_s: float
    sample_time_s: float
    plant: tuple[TransferFunction, ...]
    delay_s: tuple[float, ...]

    @property
    def noise_gain(self) -> float:
        """Standard deviation of the residual per unit of white noise on the measured deflection."""
        return float(np.linalg.norm(self.impulse_response()))

    def impulse_response(self) -> FloatArray:
        """Residual after a measurement error of 1 deg in a single sample, shape (k,), until it has died out."""
        multiplicity = self.md.size - 1
        decay = np.exp(-self.pole_rad_s * self.sample_time_s)
        samples = 2.0 + np.ceil((40.0 + 10.0 * multiplicity) / (self.pole_rad_s * self.sample_time_s))
        if samples > _MOST_SAMPLES:
            raise DesignError(
                f"a filter pole of {self.pole_rad_s:g} rad/s is no use at {1.0 / self.sample_time_s:g} Hz: "
                f"the residual of one sample lasts for {samples:.0e} samples"
            )
        k = np.arange(int(samples))
        ladder = np.ones(k.size)
        for i in range(1, multiplicity):
            ladder *= (k + i) / i
        return self.g * np.convolve(self.a, ladder * decay**k)

    def autocorrelation(self, lags: int) -> FloatArray:
        """Correlation of the residual with itself under white measurement noise, shape (lags,), from lag 0."""
        h = self.impulse_response()
        rho = np.array([h[: h.size - i] @ h[i:] for i in range(lags)])
        scaled: FloatArray = rho / rho[0]
        return scaled

    def fault_step(self, samples: int, command: int = 0) -> FloatArray:
        """Residual after a constant fault of 1 deg on a command, from the sample at which it sets in."""
        from scipy.signal import lfilter

        return lfilter(self.g * self.b[command], self.md, np.ones(samples))

    def residual(self, measured_deg: FloatArray, *command_deg: FloatArray) -> FloatArray:
        """Residual of uniform samples [deg], shape (n,), starting from rest at the first commands."""
        from scipy.signal import lfilter

        offset = sum(u[0] * float(b.sum() / self.a.sum()) for u, b in zip(command_deg, self.b, strict=True))
        residual: FloatArray = lfilter(self.g * self.a, self.md, measured_deg - offset)
        for u, b in zip(command_deg, self.b, strict=True):
            residual = residual - lfilter(self.g * b, self.md, u - u[0])
        return residual

    def leakage(self, frequencies_rad_s: FloatArray) -> float:
        """Largest gain from any command to the residual of a healthy plant: the proof of the design.

        The plant is evaluated apart from the filter's own polynomials: as a state-space model whose held and
        delayed command is carried through matrix exponentials.
        """
        z = np.exp(1j * np.asarray(frequencies_rad_s) * self.sample_time_s)
        inverse, worst = 1.0 / z, 0.0
        for entry, delay_s, b in zip(self.plant, self.delay_s, self.b, strict=True):
            response = _frequency_response(entry, delay_s, self.sample_time_s, z)
            gain = np.polyval(self.a[::-1], inverse) * response - np.polyval(b[::-1], inverse)
            worst = max(worst, float(np.max(np.abs(self.g * gain / np.polyval(self.md[::-1], inverse)))))
        return worst


def design_pulse_filter(
    plant: TransferFunction | Sequence[TransferFunction],
    delay_s: float | Sequence[float],
    sample_time_s: float,
    pole_rad_s: float,
) -> PulseFilter:
    """Design the residual filter of one measured output for uniform samples.

    Parameters
    ----------
    plant : TransferFunction, or one for each command
        Healthy response of the output to its commands.
    delay_s : float, or one for each command
        Transport delays [s].
    sample_time_s : float
        Sample time [s].
    pole_rad_s : float
        Where the filter's poles shall be [rad/s]; its sign does not matter.

    Raises
    ------
    DesignError
        If the pole is of no use (`checked_pole_rad_s`) or no command has a gain at zero frequency.

    Notes
    -----
    Zeros are never removed: those of a sampled plant are mostly artefacts of the sampling, often unstable.

    Examples
    --------
    >>> from servofd.servo.library import servo_named
    >>> servo = servo_named("hs225bb-eq31").printed
    >>> round(design_pulse_filter(servo, 0.004, 0.01, 50.0).noise_gain, 3)
    0.418
    """
    pole = checked_pole_rad_s(pole_rad_s)
    entries = (plant,) if isinstance(plant, TransferFunction) else tuple(plant)
    delays = (delay_s,) * len(entries) if isinstance(delay_s, float | int) else tuple(delay_s)
    denominator, numerators = common_denominator(entries)
    polynomials = [
        TransferFunction(tuple(numerator), tuple(denominator)).sampled(delay, sample_time_s)
        for numerator, delay in zip(numerators, delays, strict=True)
    ]
    b, a = tuple(pair[0] for pair in polynomials), polynomials[0][1]
    gains = np.array([float(polynomial.sum()) for polynomial in b])
    if not gains.any():
        raise DesignError("no command moves this output at zero frequency, so no fault gain can be set")
    smallest = gains[np.argmin(np.where(gains == 0.0, np.inf, np.abs(gains)))]
    md = np.real(product_of(np.full(a.size, np.exp(-pole * sample_time_s), dtype=complex)))
    # From the factors, not from the sum of md: that would lose ten digits at high sample rates.
    g = float(-np.expm1(-pole * sample_time_s)) ** a.size / float(smallest)
    return PulseFilter(b, a, md, g, pole, sample_time_s, entries, delays)


def fastest_pole_rad_s(transfer: TransferFunction, sample_time_s: float) -> float:
    """Fastest of the preferred poles whose noise gain stays at or below 0.5 [rad/s].

    Examples
    --------
    >>> from servofd.servo.library import servo_named
    >>> [fastest_pole_rad_s(servo_named(name).transfer, 0.01) for name in ("hs225bb-eq31", "s3151")]
    [50.0, 30.0]
    """
    noise_gain = float("inf")
    for pole in PREFERRED_POLES_RAD_S:
        noise_gain = design_pulse_filter(transfer, 0.0, sample_time_s, pole).noise_gain
        if noise_gain <= LARGEST_NOISE_GAIN:
            return pole
    if not noise_gain <= _USELESS_NOISE_GAIN:
        raise DesignError(f"even the slowest filter would amplify noise {noise_gain:.1g} times: use a simpler model")
    return PREFERRED_POLES_RAD_S[-1]


def _frequency_response(
    transfer: TransferFunction, delay_s: float, sample_time_s: float, z: ComplexArray
) -> ComplexArray:
    """Sampled response from a state-space model and matrix exponentials, for `PulseFilter.leakage`."""
    from scipy.linalg import expm

    whole, fraction_s = split_delay(delay_s, sample_time_s)
    order = len(transfer.denominator) - 1
    lead = transfer.denominator[0]
    # Controllable canonical form, with the held command as one more state.
    system = np.zeros((order + 1, order + 1))
    system[: order - 1, 1:order] = np.eye(order - 1)
    system[order - 1, :order] = -np.array(transfer.denominator[:0:-1]) / lead
    system[order - 1, order] = 1.0
    c = np.zeros(order)
    c[: len(transfer.numerator)] = np.array(transfer.numerator[::-1]) / lead
    after, before = expm(system * (sample_time_s - fraction_s)), expm(system * fraction_s)
    phi = (after @ before)[:order, :order]
    old = after[:order, :order] @ before[:order, order]
    new = after[:order, order]
    states = np.linalg.solve(
        z[:, None, None] * np.eye(order) - phi, (new[None, :] + old[None, :] / z[:, None])[:, :, None]
    )
    return (states[:, :, 0] @ c) * z ** (-whole)

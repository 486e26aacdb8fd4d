"""The noise of a healthy residual: its size and its colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from logparsers.records import own
from servofd.core.errors import NoMeasurement

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.pulse import PulseFilter

_FEWEST_SAMPLES = 100
_FEWEST_LAGS = 5
_AR_ORDER = 30
_WARM_UP = 1000
_WHITE_SHARE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Stationary noise of one residual.

    Parameters
    ----------
    sigma_deg : float
        Standard deviation [deg], above zero.
    autocorrelation : ndarray, shape (k,)
        Correlation with itself after 0, 1, ... samples, until it has died out; starts with 1.
    sample_time_s : float
        Sample time [s].
    mean_deg : float
        Mean [deg]; it takes its size off the margin to the threshold.

    Examples
    --------
    >>> from servofd.detection.pulse import design_pulse_filter
    >>> from servofd.servo.library import servo_named
    >>> design = design_pulse_filter(servo_named("hs225bb-eq31").printed, 0.004, 0.01, 50.0)
    >>> noise = Noise.designed(design, noise_deg=0.1)
    >>> round(noise.sigma_deg, 4), round(noise.correlation, 5), round(noise.long_run_factor, 2)
    (0.0418, 0.62066, 5.71)
    """

    sigma_deg: float
    autocorrelation: FloatArray
    sample_time_s: float
    mean_deg: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "autocorrelation", own(self.autocorrelation))
        if not (self.sigma_deg > 0.0 and self.sample_time_s > 0.0 and self.autocorrelation.size > 1):
            raise ValueError("noise needs a standard deviation, a sample time and at least one lag")

    @classmethod
    def designed(cls, design: PulseFilter, noise_deg: float) -> Noise:
        """Noise of a residual whose measured deflection carries white noise of this standard deviation [deg]."""
        lags = design.impulse_response().size // 2
        return cls(design.noise_gain * noise_deg, design.autocorrelation(lags), design.sample_time_s)

    @classmethod
    def measured(cls, residual_deg: FloatArray, sample_time_s: float, lags: int) -> Noise:
        """Noise of a healthy residual as it was measured.

        Parameters
        ----------
        residual_deg : ndarray, shape (n,)
            Residual [deg]; NaN where it was not judged, and between one log and the next.
        lags : int
            Most lags after lag 0 to look at; at least the time in which the filter forgets.
        """
        from scipy.signal import correlate

        known = np.isfinite(residual_deg)
        count = int(np.count_nonzero(known))
        if count < _FEWEST_SAMPLES:
            raise NoMeasurement(f"only {count} healthy samples; {_FEWEST_SAMPLES} are needed to tell the noise")
        mean = float(np.mean(residual_deg[known]))
        # Zeros for what is missing, and one divisor for all lags: the estimate stays positive definite.
        centred = np.where(known, residual_deg - mean, 0.0)
        power = float(centred @ centred)
        if not power > 0.0:
            raise NoMeasurement("the residual never changes: there is no noise to judge by")
        products = correlate(np.append(centred, np.zeros(lags)), centred, mode="valid", method="fft")
        scaled = products / power
        scaled[0] = 1.0
        # From the first correlation that is not positive on there is more estimation error than correlation.
        end = max(int(np.argmax(np.append(scaled, -1.0) <= 0.0)), _FEWEST_LAGS + 1)
        return cls(float(np.sqrt(power / count)), scaled[:end], sample_time_s, mean)

    @property
    def correlation(self) -> float:
        """Correlation of neighbouring samples."""
        return float(self.autocorrelation[1])

    @property
    def long_run_factor(self) -> float:
        """Variance of a long mean, relative to that of white noise: S = 1 + 2 sum of all correlations; at least 1."""
        return max(1.0, 1.0 + 2.0 * float(self.autocorrelation[1:].sum()))

    def margin_deg(self, threshold_deg: float) -> float:
        """What the mean leaves of a threshold, on the side where it leaves less [deg]."""
        return max(threshold_deg - abs(self.mean_deg), 0.0)

    @property
    def order(self) -> int:
        """Number of earlier samples that tell about the next one."""
        return min(_AR_ORDER, self.autocorrelation.size - 1)

    def prediction(self, known: int) -> tuple[FloatArray, float]:
        """Best forecast of a sample from those before it (Yule and Walker).

        Parameters
        ----------
        known : int
            How many earlier samples are used, at most `order`.

        Returns
        -------
        weights, spread
            Weights of the earlier samples, latest first, shape (known,), and the standard deviation of what remains,
            as a share of `sigma_deg`.

        Examples
        --------
        >>> weights, spread = Noise(1.0, np.array([1.0, 0.6, 0.5]), 0.01).prediction(2)
        >>> weights.round(6).tolist(), round(spread, 6)
        ([0.46875, 0.21875], 0.780625)
        """
        from scipy.linalg import solve_toeplitz

        if known == 0:
            return np.empty(0), 1.0
        rho = self.autocorrelation[: known + 1]
        # A trace of white noise keeps the equations of a very smooth residual from being singular.
        weights: FloatArray = solve_toeplitz(np.append(1.0 + _WHITE_SHARE, rho[1:-1]), rho[1:])
        return weights, float(np.sqrt(max(1.0 - float(weights @ rho[1:]), 0.0)))

    def sample(self, shape: tuple[int, int], seed: int) -> FloatArray:
        """Gaussian noise of this size and colour, without mean [deg], shape (runs, samples)."""
        from scipy.signal import lfilter

        weights, spread = self.prediction(self.order)
        white = np.random.default_rng(seed).standard_normal((shape[0], shape[1] + _WARM_UP))
        coloured: FloatArray = lfilter([self.sigma_deg * spread], np.append(1.0, -weights), white)[:, _WARM_UP:]
        return coloured

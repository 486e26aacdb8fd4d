r"""First signs of a fault: which models of the bank are silent within its first second.

As in Varga's model detection, each hypothesis has a residual of its own, :math:`r_i = Q_y (y - \hat y_i)`, evaluated
by Narendra's filter,

.. math:: \theta_k = \frac{\alpha |r_k| + \beta x_k}{\alpha + \beta/(1-\gamma)}, \qquad x_{k+1} = \gamma x_k + |r_k|

(scaled so that :math:`\theta` is in degrees). A hypothesis is possible while its :math:`\theta` stays within the noise.
After a second there are data enough to compare likelihoods instead (`servofd.detection.bank.classify`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.bank.classify import BANK

if TYPE_CHECKING:
    from servofd.detection.bank.window import Window
    from servofd.detection.residual import ResidualGenerator
    from servofd.types import FloatArray

_ALPHA, _BETA, _GAMMA = 0.0, 1.0, 0.9
"""Defaults of Varga's FaultDetectionTools."""
_FORGOTTEN = 350
"""Samples after which less than 1e-16 of one is left."""
_QUIET = 1.5
"""Levels this much above that of noise alone are still quiet: the mean of ten or so coloured samples scatters."""
_MEAN_OF_ABSOLUTE = float(np.sqrt(2.0 / np.pi))


def narendra(residual_deg: FloatArray) -> FloatArray:
    """Evaluate a residual by Narendra's filter [deg]; both of shape (n,).

    Examples
    --------
    >>> float(narendra(np.full(200, -0.5))[-1].round(6))
    0.5
    """
    size_deg = np.abs(residual_deg)
    # The sum of what came before, forgotten by the power of its age; scipy.signal takes longer to load than all else.
    remembered_deg = np.convolve(np.append(0.0, size_deg[:-1]), _GAMMA ** np.arange(_FORGOTTEN))[: size_deg.size]
    level_deg: FloatArray = (_ALPHA * size_deg + _BETA * remembered_deg) / (_ALPHA + _BETA / (1.0 - _GAMMA))
    return level_deg


def first_signs(window: Window, generator: ResidualGenerator, sigma_deg: float) -> tuple[str, ...]:
    """Kinds of faults that a short window admits, the likeliest first.

    Parameters
    ----------
    window : Window
        A second or less, from shortly after the onset on.
    generator : ResidualGenerator
        Its filter evaluates the misfits.
    sigma_deg : float
        Standard deviation of the healthy residual [deg].

    Returns
    -------
    tuple of str
        Empty if nothing explains the window.
    """
    restart = np.zeros(window.time_s.size, dtype=np.int8)
    restart[0] = 1
    limit_deg = _QUIET * _MEAN_OF_ABSOLUTE * sigma_deg
    quiet = {}
    for hypothesis in BANK:
        explanation = hypothesis.explain(window)
        if explanation is not None and hypothesis.kind != "healthy":
            misfit_deg = window.measured_deg - explanation.predicted_deg
            if narendra(generator.filtered(window.time_s, misfit_deg, restart))[-1] <= limit_deg:
                quiet[hypothesis.kind] = window.score(explanation)
    return tuple(sorted(quiet, key=quiet.__getitem__))

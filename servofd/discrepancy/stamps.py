"""Time stamps that scatter: an error that grows with the speed, and has no sign."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.maps import is_told, speed_deg_s
from servofd.discrepancy.noise import long_run_factor

if TYPE_CHECKING:
    from servofd.discrepancy.record import Record
    from servofd.types import FloatArray

__all__ = ["scatter_s"]

_CHI_SQUARED = 30.0
"""Chance passes it once in 2e7 records: one degree of freedom."""


def scatter_s(record: Record, error_deg: FloatArray, least_share: float) -> float:
    r"""Standard deviation of time stamps that explains how the error of a simulation grows with its speed [s].

    A position stamped off by :math:`\delta t` is wrong by :math:`v\,\delta t`, so that the error's variance is
    :math:`\sigma^2 + \sigma_t^2 v^2`. The slope is tested as Koenker's form of the Breusch-Pagan test does:
    :math:`n R^2` of the squared errors on the squared speed, for which the noise floor need not be known. 0 if that
    could be chance, if it is less than a share of the noise, or if command or motion tell most of the error with its
    sign: then it is no scatter.

    Parameters
    ----------
    record : Record
        What was compared.
    error_deg : ndarray, shape (n,)
        Measured minus simulated position [deg].
    least_share : float
        Of the variance of the noise at rest.

    Examples
    --------
    >>> from servofd.discrepancy.record import record_of
    >>> from servofd.models.servo_model import ServoModel
    >>> from servofd.segment import Segment
    >>> from servofd.servos import servo_named
    >>> t, rng = np.arange(0.0, 60.0, 0.01), np.random.default_rng(0)
    >>> moved, late_s = 5.0 * np.sin(3.0 * t), 0.005 * rng.standard_normal(t.size)
    >>> error = 0.05 * rng.standard_normal(t.size) + 15.0 * np.cos(3.0 * t) * late_s
    >>> record = record_of(Segment("x", t, moved, t, moved + error), ServoModel.of(servo_named("s9254")))
    >>> round(scatter_s(record, error, 0.15), 3)
    0.005
    """
    where = record.counts
    # Far outside of both distributions nothing is told about either: a spike is no time stamp.
    squared = np.minimum(error_deg[where] ** 2, 25.0 * np.mean(error_deg[where] ** 2))
    speed = speed_deg_s(record, error_deg)[where] ** 2
    spread = speed - speed.mean()
    power = float(spread @ spread)
    if power <= 0.0 or float(squared.std()) <= 0.0:
        return 0.0
    slope = float(spread @ squared) / power
    rest = float(squared.mean()) - slope * float(speed.mean())
    told = slope**2 * power / float(np.sum((squared - squared.mean()) ** 2))
    likely = told * squared.size / long_run_factor(squared - squared.mean())
    if slope <= 0.0 or likely < _CHI_SQUARED or slope * float(speed.mean()) < least_share * max(rest, 0.0):
        return 0.0
    excess = float(squared.mean()) - max(rest, 0.0)
    if is_told(record, error_deg, float(np.sqrt(max(squared.mean() - excess, 1e-12)))):
        return 0.0
    return float(np.sqrt(slope))

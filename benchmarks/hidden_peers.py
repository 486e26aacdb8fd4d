"""What others make of the same logs: a linear and a non-linear regression, and PySINDy if it is installed.

The regressions close a gap without saying what it is: the yardstick of how much the data hold. PySINDy is asked for a
name: of the term with which the sparse regression explains most, mapped to the group of effects that it belongs to.
"""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.signal import savgol_filter

from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from hidden_physics import HiddenRecord
    from servofd.core.types import BoolArray, FloatArray

__all__ = ["GROUPS", "has_pysindy", "regression_closure", "residual_deg", "sindy_group"]

GROUPS = {
    "delay": "dynamics", "slow_dynamics": "dynamics", "sensor_lag": "dynamics", "pwm_frame": "dynamics",
    "clock_offset": "dynamics", "resonance": "dynamics", "rate_limit": "rate", "voltage_rate": "rate",
    "current_limit": "rate",
    "deadband": "hysteresis", "backlash": "hysteresis", "friction": "hysteresis", "load_friction": "hysteresis",
    "gain": "static", "bias": "bias", "airload": "static", "gravity_load": "static", "linkage_nonlinearity": "static",
    "position_limit": "static",
}  # fmt: skip
"""Group of each effect: what a polynomial or a sign can at best tell apart. Converter steps are in none."""
_LAGS = 25
_RIDGE = 1e-3
_BLOCK_S = 1.0


def residual_deg(record: HiddenRecord) -> FloatArray:
    """Measured minus what the healthy servo would do [deg], shape (n,)."""
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    return record.measured_deg - model.simulate(record.time_s, record.command_deg, record.time_s)


def regression_closure(record: HiddenRecord, floor_deg: float, *, nonlinear: bool) -> float:
    """Share of the gap that a regression on 0.25 s of commands closes in blocks of 1 s it has not seen.

    Non-linear adds squares, cubes, signs of the rate and products with dynamic pressure: a polynomial NARX model of
    the residual without its past, so that nothing can run away.
    """
    gap_deg = residual_deg(record)
    columns = [np.ones(gap_deg.size), *(np.roll(record.command_deg, lag) for lag in range(_LAGS))]
    if nonlinear:
        smooth = np.roll(record.command_deg, 6)
        rate = np.gradient(smooth, record.time_s)
        pressure = record.airspeed_m_s**2 / 400.0
        columns += [smooth**2, smooth**3, np.sign(rate), np.tanh(rate / 50.0), rate * abs(rate), pressure * smooth]
    table = np.column_stack(columns)
    scale = np.maximum(np.std(table, axis=0), 1e-9)
    scale[0] = 1.0
    table /= scale
    train = _even_blocks(record.time_s)
    inside = table[train]
    ridge = _RIDGE * inside.shape[0] * np.eye(table.shape[1])
    weights = np.linalg.solve(inside.T @ inside + ridge, inside.T @ gap_deg[train])
    left = float(np.mean((gap_deg - table @ weights)[~train] ** 2))
    before = float(np.mean(gap_deg[~train] ** 2)) - floor_deg**2
    return 1.0 - (left - floor_deg**2) / before


def has_pysindy() -> bool:
    """Whether the peer is there (``pip install pysindy``)."""
    return importlib.util.find_spec("pysindy") is not None


def sindy_group(record: HiddenRecord) -> str:
    """Group of effects that PySINDy's largest term belongs to: discrepancy of the dynamics, sparse regression."""
    import pysindy

    gap = savgol_filter(residual_deg(record), 15, 3)
    rate = savgol_filter(record.command_deg, 15, 3, deriv=1, delta=0.01)
    pressure = record.airspeed_m_s**2 / 400.0
    terms = {
        "bias": np.ones(gap.size),
        "static": record.command_deg,
        "static, bent": record.command_deg**2,
        "static, air": pressure * record.command_deg,
        "dynamics": rate,
        "dynamics, second": np.gradient(rate, record.time_s),
        "hysteresis": np.sign(rate) * (np.abs(rate) > 0.5),
        "rate": rate * np.abs(rate),
    }
    table = np.column_stack(list(terms.values()))
    scale = np.maximum(np.sqrt(np.mean(table**2, axis=0)), 1e-9)
    optimizer: Any = pysindy.STLSQ(threshold=0.02, alpha=1e-3)
    optimizer.fit(table / scale, gap[:, None])
    return list(terms)[int(np.argmax(np.abs(np.ravel(optimizer.coef_))))].split(",")[0]


def _even_blocks(time_s: FloatArray) -> BoolArray:
    even: BoolArray = (time_s // _BLOCK_S).astype(int) % 2 == 0
    return even

"""A slow, readable servo to check the fast one against: matrix exponentials and small steps, nothing clever."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm
from scipy.signal import tf2ss

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.servo.transfer import TransferFunction


def linear_deflection(
    transfer: TransferFunction, delay_s: float, command_s: FloatArray, command_deg: FloatArray, at_s: FloatArray
) -> FloatArray:
    """Deflection at `at_s` under a held, delayed command, from rest, by one matrix exponential per event."""
    a, b, c, _ = tf2ss(transfer.numerator, transfer.denominator)
    order = a.shape[0]
    augmented = np.zeros((order + 1, order + 1))
    augmented[:order, :order], augmented[:order, order:] = a, b
    events = sorted(
        [(t + delay_s, 0, u) for t, u in zip(command_s, command_deg, strict=True)] + [(t, 1, 0.0) for t in at_s]
    )
    held = command_deg[0]
    state = np.linalg.solve(-a, b[:, 0] * held)
    now, result = events[0][0], []
    for when, kind, value in events:
        step = expm(augmented * (when - now))
        state = step[:order, :order] @ state + step[:order, order] * held
        now = when
        if kind == 0:
            held = value
        else:
            result.append(float((c @ state)[0]))
    return np.array(result)


def limited_deflection(linear_deg: FloatArray, step_s: float, rate_deg_s: float) -> FloatArray:
    """Rate limit in small uniform steps: the output runs after the linear motion, never faster than the limit."""
    result = np.empty_like(linear_deg)
    result[0] = linear_deg[0]
    for k in range(1, linear_deg.size):
        result[k] = result[k - 1] + np.clip(linear_deg[k] - result[k - 1], -rate_deg_s * step_s, rate_deg_s * step_s)
    return result

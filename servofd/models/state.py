"""What the compiled kernel works on: parameters that stay, and memory that changes."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numba import njit

from servofd.types import ComplexArray, FloatArray

if TYPE_CHECKING:
    from numpy.typing import NDArray

Kind = TypeVar("Kind", np.float64, np.int8)

SLOTS = 4
"""Step lengths whose exponentials are kept. A uniform log with a fractional delay alternates between two."""

compiled = partial(njit, cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, _nrt=False)()
inlined = partial(
    njit, cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, _nrt=False, inline="always"
)()
"""No reference counting inside: nothing here allocates, and it would take 9/10 of the time (measured)."""


class ServoParameters(NamedTuple):
    """A servo as the kernel sees it; an effect that is absent has its neutral value."""

    decay_rad_s: ComplexArray
    weight: ComplexArray
    rate_down_deg_s: float
    rate_up_deg_s: float
    lower_deg: float
    upper_deg: float


class FilterParameters(NamedTuple):
    """The measured branch ``Qy`` of a nullspace filter."""

    pole_rad_s: float
    decay_rad_s: ComplexArray
    """All poles of the servo, negated, both members of each pair, of shape (n,)."""
    dc_gain: float


class Memory(NamedTuple):
    """Everything that changes from sample to sample; arrays, so that it can be updated in place and copied."""

    modes: ComplexArray
    """Of shape (m,): position each mode would reach [deg]."""
    motion: FloatArray
    """Of shape (6,): time [s], held command [deg], its slope [deg/s], position [deg], rate-limited (-1, 0, 1), and
    the fastest that the linear motion can become under this command [deg/s]."""
    lags: FloatArray
    """Of shape (n + 1,): successive lags of the simulation error [deg]."""
    lag_weights: FloatArray
    """Of shape (n + 1,): shares of the lags in the residual for the step length below."""
    lag_step: FloatArray
    """Of shape (3,): step length [s] of the weights, its lag factor, time of the last filtered sample [s]."""
    polynomial: ComplexArray
    """Of shape (n + 1,): room for the calculation of the weights."""
    cursor: np.ndarray[tuple[int], np.dtype[np.int64]]
    """Of shape (2,): next command to take effect, next exponential slot to overwrite."""
    slot_step_s: FloatArray
    """Of shape (slots,)."""
    slot_factor: ComplexArray
    """Of shape (slots, m)."""


def fixed(values: NDArray[Kind]) -> NDArray[Kind]:
    """The same values, contiguous and read-only: compiled for them alone, a function is compiled once.

    Examples
    --------
    >>> fixed(np.arange(6.0)[::2]).flags.writeable
    False
    """
    view = np.ascontiguousarray(values).view()
    view.setflags(write=False)
    return view


def new_memory(servo: ServoParameters, residual_filter: FilterParameters) -> Memory:
    """Memory before the first sample."""
    modes, order = servo.decay_rad_s.size, residual_filter.decay_rad_s.size
    return Memory(
        modes=np.zeros(modes, dtype=np.complex128),
        motion=np.zeros(6),
        lags=np.zeros(order + 1),
        lag_weights=np.zeros(order + 1),
        lag_step=np.array([-1.0, 0.0, 0.0]),
        polynomial=np.zeros(order + 1, dtype=np.complex128),
        cursor=np.zeros(2, dtype=np.int64),
        slot_step_s=np.full(SLOTS, -1.0),
        slot_factor=np.zeros((SLOTS, modes), dtype=np.complex128),
    )

"""What the compiled kernel works on: parameters that stay, and memory that changes."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from logparsers import compiled as compiler
from servofd.core.types import ComplexArray, FloatArray

if TYPE_CHECKING:
    from numpy.typing import NDArray

Kind = TypeVar("Kind", np.float64, np.int8, np.bool_)

SAME_STEP_S = 1e-7
"""Steps this close share an exponential, corrected by a three-term series (error below 1e-15)."""
SLOTS = 4
"""Step lengths whose exponentials are kept. A uniform log with a fractional delay alternates between two."""

compiled = partial(compiler.compiled, error_model="numpy", fastmath={"contract"}, _nrt=False)
inlined = partial(compiler.compiled, error_model="numpy", fastmath={"contract"}, _nrt=False, inline="always")
inner = partial(compiled, no_cpython_wrapper=True)
"""No reference counting inside: nothing here allocates, and it would take 9/10 of the time (measured). What only other
compiled functions call needs no door for Python, which takes as long to compile as the function."""


class ServoParameters(NamedTuple):
    """A servo without effects, as the kernel sees it; a limit that is absent is infinite."""

    decay_rad_s: ComplexArray
    weight: ComplexArray
    rate_down_deg_s: float
    rate_up_deg_s: float
    lower_deg: float
    upper_deg: float

    def slower(self, bandwidth_scale: float) -> ServoParameters:
        """The servo with every pole scaled: its modes keep their weights."""
        return self._replace(decay_rad_s=self.decay_rad_s * bandwidth_scale)

    def limited(self, rate_deg_s: float) -> ServoParameters:
        """The servo that turns no faster than this [deg/s]."""
        up, down = min(rate_deg_s, self.rate_up_deg_s), min(rate_deg_s, self.rate_down_deg_s)
        return self._replace(rate_up_deg_s=up, rate_down_deg_s=down)

    def weaker(self, share: float) -> ServoParameters:
        """The servo with every rate limit lower by a share."""
        up, down = (1.0 - share) * self.rate_up_deg_s, (1.0 - share) * self.rate_down_deg_s
        return self._replace(rate_up_deg_s=up, rate_down_deg_s=down)


class Memory(NamedTuple):
    """Everything that changes from sample to sample; arrays, so that it can be updated in place and copied."""

    modes: ComplexArray
    """Of shape (m,): position each mode would reach [deg]."""
    motion: FloatArray
    """Of shape (7,): time [s], held command [deg], its slope [deg/s], position [deg], rate-limited (-1, 0, 1), the
    fastest that the linear motion can become under this command [deg/s], NaN if that is not known yet, and whether any
    command came."""
    cursor: np.ndarray[tuple[int], np.dtype[np.int64]]
    """Of shape (1,): next exponential slot to overwrite."""
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


def new_memory(servo: ServoParameters) -> Memory:
    """Memory before the first sample."""
    modes = servo.decay_rad_s.size
    return Memory(
        modes=np.zeros(modes, dtype=np.complex128),
        motion=np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.nan, 0.0]),
        cursor=np.zeros(1, dtype=np.int64),
        slot_step_s=np.full(SLOTS, -1.0),
        slot_factor=np.zeros((SLOTS, modes), dtype=np.complex128),
    )

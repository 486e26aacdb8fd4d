"""One flight as an axis model sees it: commands and motion on one uniform grid of time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.core.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What was asked of an aircraft and how it moved, in body axes forward, right, down.

    Parameters
    ----------
    name : str
        Of the flight, for messages.
    day : str
        On which it was flown; flights of one day share their trim, air and payload.
    time_s : ndarray, shape (n,)
        Uniform [s].
    commands_us : mapping of str to ndarray, shape (n,)
        For ``"roll"``, ``"pitch"``, ``"yaw"`` what was asked of the axis, as pulse width about trim [us]; never what a
        servo received or did.
    rates_deg_s : ndarray, shape (3, n)
        Body rates [deg/s].
    accelerations_m_s2 : ndarray, shape (3, n)
        Specific force [m/s2].
    roll_deg, pitch_deg : ndarray, shape (n,)
        Attitude [deg].
    airspeed_m_s : ndarray, shape (n,)
        From a sensor, or from ground speed and wind [m/s].
    throttle : ndarray, shape (n,)
        What was asked of the engine, 0 to 1.
    present : ndarray of bool, shape (n,)
        False where a channel has a gap.
    airspeed_source : str
        In words.
    members : mapping of str to tuple of str
        Surfaces that serve each axis.
    parameters : mapping of str to float
        SERVOn_... of the outputs that do.
    lifted_share : float
        Share of the log in which motors lifted a VTOL aircraft, which is not `present`.
    """

    name: str
    day: str
    time_s: FloatArray
    commands_us: Mapping[str, FloatArray]
    rates_deg_s: FloatArray
    accelerations_m_s2: FloatArray
    roll_deg: FloatArray
    pitch_deg: FloatArray
    airspeed_m_s: FloatArray
    throttle: FloatArray
    present: BoolArray
    airspeed_source: str = "sensor"
    members: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    lifted_share: float = 0.0

    @property
    def asked(self) -> frozenset[str]:
        """What is commanded: axes, and the throttle."""
        return frozenset((*self.commands_us, "throttle"))

    @property
    def rate_hz(self) -> float:
        """Samples in a second."""
        return (self.time_s.size - 1) / float(self.time_s[-1] - self.time_s[0])

    def within(self, spans_s: Sequence[tuple[float, float]]) -> Motion:
        """The same flight, present only in some parts."""
        inside = np.zeros(self.time_s.size, dtype=bool)
        for start_s, end_s in spans_s:
            inside |= (self.time_s >= start_s) & (self.time_s <= end_s)
        return replace(self, present=self.present & inside)

    def until(self, end_s: float) -> Motion:
        """The part before a time."""
        last = int(np.searchsorted(self.time_s, end_s))
        return replace(
            self,
            time_s=self.time_s[:last],
            commands_us={axis: values[:last] for axis, values in self.commands_us.items()},
            rates_deg_s=self.rates_deg_s[:, :last],
            accelerations_m_s2=self.accelerations_m_s2[:, :last],
            roll_deg=self.roll_deg[:last],
            pitch_deg=self.pitch_deg[:last],
            airspeed_m_s=self.airspeed_m_s[:last],
            throttle=self.throttle[:last],
            present=self.present[:last],
        )

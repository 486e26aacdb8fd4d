"""What acts on a servo beside its command: airstream, supply, current and temperature, as far as they were logged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from logparsers.records import own
from servofd.types import FloatArray

AIR_KG_M3: Final = 1.225
"""Density of the standard atmosphere at sea level."""


def _nothing() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """Airspeed, supply voltage, current and temperature, each on its own time stamps; empty where a log holds none.

    Examples
    --------
    >>> context = Context(airspeed_s=np.array([0.0, 1.0]), airspeed_m_s=np.array([10.0, 20.0]))
    >>> context.pressure_pa(np.array([0.0, 5.0]))
    array([ 61.25, 245.  ])
    >>> context.supply_v(np.zeros(1))
    array([inf])
    """

    airspeed_s: FloatArray = field(default_factory=_nothing)
    airspeed_m_s: FloatArray = field(default_factory=_nothing)
    voltage_s: FloatArray = field(default_factory=_nothing)
    voltage_v: FloatArray = field(default_factory=_nothing)
    current_s: FloatArray = field(default_factory=_nothing)
    current_a: FloatArray = field(default_factory=_nothing)
    temperature_s: FloatArray = field(default_factory=_nothing)
    temperature_c: FloatArray = field(default_factory=_nothing)

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            object.__setattr__(self, name, own(getattr(self, name)))

    @property
    def logged(self) -> frozenset[str]:
        """Which of ``airspeed_m_s``, ``servo_voltage_v``, ``servo_current_a``, ``servo_temperature_c`` are there."""
        sizes = {
            "airspeed_m_s": self.airspeed_s.size,
            "servo_voltage_v": self.voltage_s.size,
            "servo_current_a": self.current_s.size,
            "servo_temperature_c": self.temperature_s.size,
        }
        return frozenset(name for name, size in sizes.items() if size)

    def pressure_pa(self, at_s: FloatArray) -> FloatArray:
        """Dynamic pressure [Pa], shape (n,): held before the first and after the last sample; 0 if never logged."""
        if not self.airspeed_s.size:
            return np.zeros(at_s.size)
        pressure_pa: FloatArray = 0.5 * AIR_KG_M3 * np.interp(at_s, self.airspeed_s, self.airspeed_m_s) ** 2
        return pressure_pa

    def supply_v(self, at_s: FloatArray) -> FloatArray:
        """Supply of the servo [V], shape (n,), likewise; infinite, which limits no speed, if never logged."""
        if not self.voltage_s.size:
            return np.full(at_s.size, np.inf)
        return np.interp(at_s, self.voltage_s, self.voltage_v)

    def drawn_a(self, at_s: FloatArray) -> FloatArray:
        """Current of the servo [A], shape (n,), likewise; 0 if never logged."""
        return np.interp(at_s, self.current_s, self.current_a) if self.current_s.size else np.zeros(at_s.size)

    def warmth_c(self, at_s: FloatArray) -> FloatArray:
        """Temperature of the servo [°C], shape (n,), likewise; NaN if never logged."""
        if not self.temperature_s.size:
            return np.full(at_s.size, np.nan)
        return np.interp(at_s, self.temperature_s, self.temperature_c)


NO_CONTEXT = Context()
"""Of a log that holds none."""

"""What acts on a servo beside its command: airstream, supply, current, temperature and load, as far as logged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from logparsers.records import own
from servofd.core.types import FloatArray

_LONG_S, _INSTANT_S = 1e3, 1e-4
"""A load holds so long before its first and after its last stamp; what is shorter is an instant."""
_AIR_KG_M3: Final = 1.225
"""Density of the standard atmosphere at sea level."""


_STAMPS: Final = {
    "airspeed_m_s": "airspeed_s",
    "servo_voltage_v": "voltage_s",
    "servo_current_a": "current_s",
    "servo_temperature_c": "temperature_s",
    "servo_load": "load_s",
}
"""By the names of columns, where their time stamps stand."""


def pressure_pa(airspeed_m_s: FloatArray | float) -> FloatArray:
    """Dynamic pressure at an airspeed [Pa], of the same shape."""
    return np.asarray(0.5 * _AIR_KG_M3 * airspeed_m_s**2)


def _nothing() -> FloatArray:
    return np.zeros(0)


def _between(time_s: FloatArray, values: FloatArray, at_s: FloatArray, missing: float) -> FloatArray:
    return np.interp(at_s, time_s, values) if time_s.size else np.full(at_s.size, missing)


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """Airspeed, supply, current, temperature and load, each on its own time stamps; empty where a log holds none.

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
    load_s: FloatArray = field(default_factory=_nothing)
    load: FloatArray = field(default_factory=_nothing)
    """Force or torque on the shaft from outside, in whatever unit it was logged."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            object.__setattr__(self, name, own(getattr(self, name)))

    @property
    def logged(self) -> frozenset[str]:
        """Which of airspeed, supply, current, temperature and load are there, by the names of their columns."""
        return frozenset(column for column, stamps in _STAMPS.items() if getattr(self, stamps).size)

    def pressure_pa(self, at_s: FloatArray) -> FloatArray:
        """Dynamic pressure [Pa], shape (n,): held before the first and after the last sample; 0 if never logged."""
        return pressure_pa(_between(self.airspeed_s, self.airspeed_m_s, at_s, 0.0))

    def supply_v(self, at_s: FloatArray) -> FloatArray:
        """Supply of the servo [V], shape (n,), likewise; infinite, which limits no speed, if never logged."""
        return _between(self.voltage_s, self.voltage_v, at_s, np.inf)

    def drawn_a(self, at_s: FloatArray) -> FloatArray:
        """Current of the servo [A], shape (n,), likewise; 0 if never logged."""
        return _between(self.current_s, self.current_a, at_s, 0.0)

    def warmth_c(self, at_s: FloatArray) -> FloatArray:
        """Temperature of the servo [°C], shape (n,), likewise; NaN if never logged."""
        return _between(self.temperature_s, self.temperature_c, at_s, np.nan)

    def pushed(self, at_s: FloatArray, late_s: float = 0.0) -> FloatArray:
        """Mean load since the instant before, shape (n,), if each value holds until the next; 0 if never logged.

        It acts so much later than it is stamped. At the first instant it is the value in force.

        Examples
        --------
        >>> Context(load_s=np.array([0.0, 1.0, 2.0]), load=np.array([0.0, 4.0, 0.0])).pushed(np.arange(4.0), 0.5)
        array([0., 0., 2., 2.])
        """
        if not self.load_s.size:
            return np.zeros(at_s.size)
        ends_s = np.concatenate([[self.load_s[0] - _LONG_S], self.load_s[1:], [self.load_s[-1] + _LONG_S]])
        so_far = np.concatenate([[0.0], np.cumsum(self.load * np.diff(ends_s))])
        begin_s = np.concatenate([at_s[:1] - _INSTANT_S, at_s[:-1]])
        begin_s = np.minimum(begin_s, at_s - _INSTANT_S)
        both = [np.interp(each - late_s, ends_s, so_far) for each in (begin_s, at_s)]
        mean: FloatArray = (both[1] - both[0]) / (at_s - begin_s)
        return mean


NO_CONTEXT = Context()
"""Of a log that holds none."""

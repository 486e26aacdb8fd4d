"""Flights simulated, which are logs for every verb."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

from servofd.core.errors import needs
from servofd.jobs import simulating
from servofd.results.shown import fields_of, shown
from servofd.simulation.flight import SimulatedFlight

if TYPE_CHECKING:
    import pandas as pd


class Flown(SimulatedFlight):
    """A simulated flight, which is a log for every verb."""

    __slots__ = ()

    @classmethod
    def _of(cls, found: Any) -> Self:  # noqa: ANN401 - the data type that it extends
        return cls(**fields_of(found))

    def to_pandas(self) -> pd.DataFrame:
        """As a plain table: time, and command and measured position of each surface [deg]."""
        needs("pandas")
        import pandas as pd

        columns = {"time_s": self.time_s}
        for k, name in enumerate(self.surfaces):
            columns |= {f"{name}_cmd_deg": self.command_deg[:, k], f"{name}_pos_deg": self.measured_deg[:, k]}
        return pd.DataFrame(columns)

    def __repr__(self) -> str:
        return f"Flown: {', '.join(self.surfaces)}, {self.time_s[-1]:.1f} s"


simulate = shown("simulate", simulating.simulate, Flown)

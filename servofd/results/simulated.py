"""Flights simulated, which are logs for every verb."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from servofd.core.errors import needs
from servofd.jobs.simulating import simulated
from servofd.results.shown import fields_of, in_words_of_python
from servofd.simulation.flight import SimulatedFlight

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from servofd.aircraft.schema import Aircraft


class Flown(SimulatedFlight):
    """A simulated flight, which is a log for every verb."""

    __slots__ = ()

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


@in_words_of_python
def simulate(
    output: str | Path | None = None,
    aircraft: Aircraft | str | Path | None = None,
    *,
    servo: str | None = None,
    command: str = "flight",
    duration_s: float = 60.0,
    rate_hz: float | None = None,
    seed: int = 0,
    fault: str | Sequence[str] = (),
    effect: str | Sequence[str] = (),
    noise_deg: float = 0.1,
) -> Flown:
    """Fly an aircraft whose faults are known, and write its log if `output` names a file.

    Parameters
    ----------
    output : str or Path, optional
        Log to write: ``.csv``, ``.mat``, ``.bin``, ``.tlog`` or ``.ulg``.
    aircraft, servo
        As for `audit`; three surfaces of one servo if left out.
    command : {"flight", "chirp", "steps", "doublets"}
        What is asked of the surfaces.
    duration_s, rate_hz : float
        Length [s], and sample rate [Hz].
    seed : int
        The same seed gives the same flight.
    fault, effect : str or sequence of str
        ``"elevator:stuck@30"``, ``"elevator:delay:delay_s=0.02"``.
    noise_deg : float
        Standard deviation of noise on what is measured [deg].

    Examples
    --------
    >>> from servofd import audit
    >>> flown = simulate(duration_s=40.0, fault="rudder:stuck@20", seed=1)
    >>> audit(flown, servo="hs225bb-eq31").rudder.faults[0].kind
    'stuck'
    """
    made = simulated(
        output, aircraft, servo=servo, command=command, duration_s=duration_s, rate_hz=rate_hz, seed=seed,
        fault=_several(fault), effect=_several(effect), noise_deg=noise_deg,
    )  # fmt: skip
    return Flown(**fields_of(made.flight))


def _several(texts: str | Sequence[str]) -> Sequence[str]:
    return (texts,) if isinstance(texts, str) else texts

"""What the script on board saw of each servo: its messages ``SFD`` in an autopilot's log."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from logparsers.records import FlightLog
from servofd.aircraft.outputs import output_of
from servofd.aircraft.schema import Aircraft
from servofd.core.types import FloatArray

_RESIDUAL = re.compile(r"SFD\[(\d+)\]\.Res")


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One surface; all arrays of shape (n,)."""

    output: int
    """Of the autopilot, from 1."""
    time_s: FloatArray
    residual_deg: FloatArray
    """NaN where it was not judged."""
    threshold_deg: FloatArray

    @property
    def peak_share(self) -> float:
        """Largest residual as a share of its threshold; NaN if none was judged."""
        share = np.abs(self.residual_deg) / self.threshold_deg
        return float(np.nanmax(share)) if np.isfinite(share).any() else float("nan")

    @property
    def crossed_s(self) -> FloatArray:
        """When the residual went over its threshold [s], of shape (k,)."""
        over = np.abs(self.residual_deg) >= self.threshold_deg
        crossed: FloatArray = self.time_s[over & ~np.concatenate([[False], over[:-1]])]
        return crossed


def seen_on_board(log: FlightLog) -> tuple[Seen, ...]:
    """Every surface that a script on board watched, by output; none if the log has no messages of it.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers import Channel, FlightLog
    >>> t = np.arange(3.0)
    >>> channels = {f"SFD[2].{n}": Channel(f"SFD[2].{n}", t, np.array(v), "deg", "") for n, v in
    ...             {"Res": [np.nan, 0.3, -1.8], "Thr": [1.5, 1.5, 1.5]}.items()}
    >>> (seen,) = seen_on_board(FlightLog(Path("flight.bin"), "dataflash", channels))
    >>> seen.output, round(seen.peak_share, 3), seen.crossed_s
    (2, 1.2, array([2.]))
    """
    found = []
    for name in log.channels:
        match = _RESIDUAL.fullmatch(name)
        level = f"SFD[{match[1]}].Thr" if match else ""
        if match and level in log.channels:
            residual = log[name]
            found.append(Seen(int(match[1]), residual.time_s, residual.values, log[level].values))
    return tuple(sorted(found, key=lambda seen: seen.output))


def seen_of(log: FlightLog, aircraft: Aircraft) -> dict[str, Seen]:
    """What the script saw of each surface of an aircraft, as far as it watched them."""
    seen = {one.output: one for one in seen_on_board(log)}
    outputs = {name: output_of(surface) for name, surface in aircraft.surfaces.items()}
    return {name: seen[output] for name, output in outputs.items() if output in seen}

"""What every reader returns: channels on their own time stamps, and the damage that was found."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from logparsers.errors import MissingChannel

__all__ = ["Channel", "Damage", "FlightLog", "own"]

FloatArray = NDArray[np.float64]


def own(values: ArrayLike) -> FloatArray:
    """Copy to a read-only float64 array, so that no record can change behind its owner's back.

    Examples
    --------
    >>> own([1, 2]).flags.writeable
    False
    """
    if (
        isinstance(values, np.ndarray)
        and values.dtype == np.float64
        and values.base is None
        and not values.flags.writeable
    ):
        return values  # nobody else can change it either
    array: FloatArray = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One logged scalar series.

    Parameters
    ----------
    name : str
        Name within the log, for example ``"de_pos"``.
    time_s : ndarray, shape (n,)
        Time stamps [s], strictly increasing.
    values : ndarray, shape (n,)
        Samples in `unit`; NaN where the log has no value.
    unit : str
        Unit of `values` as it was logged: ``"deg"``, ``"rad"``, ``"us"``, ``"count"``, ``""`` if unknown.
    origin : str
        Where the values come from, for example ``"SERVO_OUTPUT_RAW.servo3_raw"``.

    Raises
    ------
    ValueError
        If the shapes differ.

    Examples
    --------
    >>> Channel("de", [0.0, 0.02], [0.1, 0.1], "rad", "de").is_constant
    True
    """

    name: str
    time_s: FloatArray
    values: FloatArray
    unit: str
    origin: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", own(self.time_s))
        object.__setattr__(self, "values", own(self.values))
        if self.time_s.ndim != 1 or self.time_s.shape != self.values.shape:
            raise ValueError(f"channel {self.name!r}: {self.time_s.shape} times, {self.values.shape} values")

    @property
    def is_constant(self) -> bool:
        """True if no finite value ever differs from another; such a channel measures nothing."""
        finite = self.values[np.isfinite(self.values)]
        return finite.size == 0 or bool(np.ptp(finite) == 0.0)


@dataclass(frozen=True, slots=True)
class Damage:
    """One defect of a log, kept instead of repaired in silence.

    Parameters
    ----------
    kind : str
        ``"gap"``, ``"clock_jump"``, ``"out_of_order"``, ``"truncated"``, ``"non_finite"``, ``"not_numeric"`` or
        ``"wrong_length"``.
    note : str
        What happened, in words, with numbers.
    count : int
        Samples, rows or cells concerned.
    start_s, end_s : float or None
        Where it happened [s], if it can be placed.
    """

    kind: str
    note: str
    count: int = 1
    start_s: float | None = None
    end_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FlightLog:
    """One log, or one run of a bench file: what was recorded, and what is wrong with it.

    Parameters
    ----------
    source : Path
        The file.
    format : str
        ``"faser"`` or ``"table"``.
    channels : Mapping[str, Channel]
        By name, in the order of the file.
    damage : tuple of Damage
        Everything that was found to be wrong.
    run : str
        Which experiment of a file that holds several; empty otherwise.
    """

    source: Path
    format: str
    channels: Mapping[str, Channel]
    damage: tuple[Damage, ...] = ()
    run: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", MappingProxyType(dict(self.channels)))

    def __getitem__(self, name: str) -> Channel:
        """Channel by name.

        Raises
        ------
        MissingChannel
            If the log has no such channel; the message names the nearest ones.
        """
        try:
            return self.channels[name]
        except KeyError:
            near = difflib.get_close_matches(name, self.channels, n=3, cutoff=0.4)
            known = ", ".join(near or list(self.channels)[:12])
            raise MissingChannel(
                f"{self.label}: no channel {name!r}; it has {len(self.channels)}, among them {known}"
            ) from None

    @property
    def label(self) -> str:
        """File name, and the run where there are several."""
        return f"{self.source} (run {self.run})" if self.run else str(self.source)

    @property
    def duration_s(self) -> float:
        """From the first to the last time stamp of any channel [s]."""
        spans = [(c.time_s[0], c.time_s[-1]) for c in self.channels.values() if c.time_s.size]
        return float(max(s[1] for s in spans) - min(s[0] for s in spans)) if spans else 0.0

    def __repr__(self) -> str:
        kinds = Counter(d.kind for d in self.damage)
        damage = ", ".join(f"{n} {kind}" for kind, n in kinds.items()) or "no damage"
        return (
            f"<FlightLog {self.label}: {self.format}, {self.duration_s:.1f} s, {len(self.channels)} channels, {damage}>"
        )

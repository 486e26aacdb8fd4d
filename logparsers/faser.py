"""FASER flight logs: MATLAB of any level, and the HDF5 of its successor RAPTRS.

One variable per channel, all as long as ``time``. Commands are logged ahead of the saturation in the PWM code, so
deflections beyond 25 deg are legal; positions may be raw counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from logparsers.assemble import Column, assemble
from logparsers.errors import MissingChannel
from logparsers.matlab4 import level4
from logparsers.matlab5 import level5
from logparsers.records import Damage
from logparsers.source import decoding
from logparsers.units import COMMANDS, faser_unit, is_faser

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from logparsers.records import FlightLog, FloatArray
    from logparsers.source import Source
    from logparsers.table import TableLayout

__all__ = ["from_variables", "read_hdf5", "read_level4", "read_level5"]

CLOCKS = {"time": 1.0, "Time_us": 1e-6}
"""Seconds per unit of the variables that carry time stamps, FASER's and RAPTRS'."""

COMMAND_GROUP = "/Control/"
"""Where RAPTRS keeps its commands; they keep their short names where other groups repeat them."""


def read_level4(source: Source, _: TableLayout | None = None) -> tuple[FlightLog, ...]:
    """Read a MATLAB level-4 file, as the flight computer writes it; see `from_variables`."""
    return (from_variables(source.path, level4(source.path, source.content())),)


def read_level5(source: Source, _: TableLayout | None = None) -> tuple[FlightLog, ...]:
    """Read a MATLAB level-5 or level-7 file, plain variables or structures; see `from_variables`."""
    with decoding(source, "MATLAB level-5 file"):
        variables = level5(source.path, source.content())
    return (from_variables(source.path, variables),)


def read_hdf5(source: Source, _: TableLayout | None = None) -> tuple[FlightLog, ...]:
    """Read a MATLAB 7.3 or RAPTRS file; see `from_variables`."""
    from logparsers.hdf5 import vectors

    return (from_variables(source.path, vectors(source)),)


def from_variables(path: Path, variables: Mapping[str, FloatArray]) -> FlightLog:
    """Make a log from vectors: the clock, and every vector of its length.

    Parameters
    ----------
    path : Path
        The file, for messages.
    variables : mapping of str to ndarray, shape (n,)
        By path; the last component becomes the name of the channel, unless an earlier one has it.

    Raises
    ------
    MissingChannel
        If there is no clock, or no surface command and no position.

    Examples
    --------
    >>> import numpy as np
    >>> from pathlib import Path
    >>> variables = {"time": np.arange(3.0), "de": np.zeros(3), "mode": np.array([1.0])}
    >>> from_variables(Path("a.mat"), variables)
    <FlightLog a.mat: faser, 2.0 s, 1 channels, no damage>
    """
    clock = _clock(path, variables)
    time_s = variables[clock] * CLOCKS[_leaf(clock)]
    home = clock.rpartition("/")[0] + "/"
    sizes = {key: values.size for key, values in variables.items() if key != clock}
    odd = {key: size for key, size in sizes.items() if size not in (time_s.size, 1)}  # single numbers are settings
    fitting = [key for key, size in sizes.items() if size == time_s.size]
    columns = _columns(variables, sorted(fitting, key=lambda key: _rank(key, home)))
    if not any(is_faser(column.name) for column in columns):
        raise _no_surface(path, variables, odd)
    return assemble(path, kind="faser", time_s=time_s, columns=columns, damage=_odd(odd, time_s.size))


def _leaf(path: str) -> str:
    return path.rpartition("/")[2]


def _clock(path: Path, variables: Mapping[str, FloatArray]) -> str:
    clocks = [key for key in variables if _leaf(key) in CLOCKS]
    if not clocks:
        raise MissingChannel(f"{path}: no variable 'time' (nor 'Time_us'); it has {_some(variables)}")
    homes = [key.rpartition("/")[0] for key in variables if is_faser(_leaf(key))]
    return max(clocks, key=lambda key: (homes.count(key.rpartition("/")[0]), "/Sensors/Fmu/" in key))


def _rank(path: str, home: str) -> int:
    """RAPTRS' commands come first, then channels beside the clock, then the rest as the file has them."""
    groups = (COMMAND_GROUP, home)
    return next((rank for rank, group in enumerate(groups) if path.startswith(group)), len(groups))


def _columns(variables: Mapping[str, FloatArray], paths: Iterable[str]) -> list[Column]:
    taken: set[str] = set()
    columns = []
    for path in paths:
        name = _leaf(path) if _leaf(path) not in taken else path.strip("/")
        taken.add(name)
        columns.append(Column(name, variables[path], faser_unit(_leaf(path)), path))
    return columns


def _no_surface(path: Path, variables: Mapping[str, FloatArray], odd: Mapping[str, int]) -> MissingChannel:
    commands = ", ".join(COMMANDS)
    found = next((key for key in odd if is_faser(_leaf(key))), None)
    if found is not None:
        return MissingChannel(f"{path}: {found!r} has {odd[found]} values, not as many as the clock has stamps")
    return MissingChannel(
        f"{path}: no surface command ({commands} or RAPTRS' cmdElev_rad ...); it has {_some(variables)}"
    )


def _odd(odd: Mapping[str, int], length: int) -> tuple[Damage, ...]:
    if not odd:
        return ()
    names = _some([f"{path} ({size})" for path, size in odd.items()])
    return (Damage("wrong_length", f"left out, because they do not have {length} values: {names}", len(odd)),)


def _some(names: Iterable[str]) -> str:
    known = list(names)
    more = f" and {len(known) - 12} more" if len(known) > 12 else ""
    return (", ".join(known[:12]) or "no numeric variables") + more

"""MATLAB files of any level and HDF5: vectors beside a clock, as FASER and RAPTRS log them.

FASER logs its commands ahead of the saturation in the PWM code, so that deflections beyond 25 deg are legal; its
positions may be raw counts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.assemble import Column, assemble
from logparsers.channels import Made
from logparsers.errors import MissingChannel, decoding
from logparsers.mat import level4, level5
from logparsers.records import Damage, FlightLog
from logparsers.text import check_names
from logparsers.units import SECONDS, faser_unit, is_faser, suffix_unit

if TYPE_CHECKING:
    from logparsers.only import Only
    from logparsers.source import Source
    from logparsers.table import TableLayout

CLOCKS: Final = {"time": 1.0, "Time_us": 1e-6, "time_s": 1.0, "Time": 1.0, "t": 1.0, "time_us": 1e-6, "TimeUS": 1e-6}
"""Seconds per unit of the variables that carry time stamps: FASER's, RAPTRS', and what others like to call them."""

COMMAND_GROUP: Final = "/Control/"
"""Where RAPTRS keeps its commands; they keep their short names where other groups repeat them."""

MOST_COLUMNS: Final = 64
"""Of a matrix; one with more is a picture or a table of something else."""


def read_level4(source: Source, layout: TableLayout | None, _: Only) -> tuple[FlightLog, ...]:
    """Read a MATLAB level-4 file, as the flight computer writes it; see `from_variables`."""
    return (from_variables(source.path, level4(source.path, source.mapped().data), layout),)


def read_level5(source: Source, layout: TableLayout | None, _: Only) -> tuple[FlightLog, ...]:
    """Read a MATLAB level-5 or level-7 file: plain variables and structures."""
    with decoding(source.path, "MATLAB level-5 file"):
        variables = level5(source.path, source.mapped().data)
    return (from_variables(source.path, variables, layout),)


def read_hdf5(source: Source, layout: TableLayout | None, _: Only) -> tuple[FlightLog, ...]:
    """Read a MATLAB 7.3 or RAPTRS file; see `from_variables`."""
    from logparsers.hdf5 import arrays

    return (from_variables(source.path, arrays(source), layout),)


def from_variables(path: Path, variables: Mapping[str, Any], layout: TableLayout | None = None) -> FlightLog:
    """Make a log from vectors and the columns of matrices: each beside the clock of its own structure, or the main one.

    `variables`: by path; the last component becomes the name of the channel, unless an earlier one has it. A column of
    a matrix has its number behind that, as in ``pos[2]``. `layout`: name and unit of the clock, or a rate without one.
    """
    vectors = dict(_vectors(variables, ""))
    check_names(path, len(vectors))
    clocks = _clocks(path, vectors, layout)
    main = next(iter(clocks))
    at_home: dict[str, list[str]] = {}
    for clock in clocks:
        at_home.setdefault(_home(clock).strip("/"), []).append(clock)
    clock_of, odd = {}, {}
    for key in sorted(vectors, key=lambda key: _rank(key, _home(main))):
        size = vectors[key].size
        near = next((clock for clock in _nearest(key, at_home, main) if clocks[clock].size == size), None)
        if near is None and size > 1 and not key.endswith("]"):  # single numbers are settings, matrices anything
            odd[key] = size
        elif near is not None and key not in clocks:
            clock_of[key] = near
    if not clock_of:
        raise _nothing(path, vectors, odd)
    names = _names(clock_of)
    is_of_faser = any(is_faser(name) for name in names.values())
    kind, unit = ("faser", faser_unit) if is_of_faser else ("table", suffix_unit)
    damage = _odd(odd, clocks[main].size)
    logs = {}
    keys_of: dict[str, list[str]] = {}
    for key, near in clock_of.items():
        keys_of.setdefault(near, []).append(key)
    for clock, keys in keys_of.items():
        columns = [Column(names[key], vectors[key], unit(_leaf(key)), key) for key in keys]
        logs[clock] = assemble(path, kind=kind, time_s=clocks[clock], columns=columns, damage=damage)
        damage = ()
    if len(logs) == 1:
        return next(iter(logs.values()))
    homes = {names[key]: logs[clock].channels for key, clock in clock_of.items()}
    channels = Made(homes, lambda name: homes[name][name])
    return FlightLog(path, kind, channels, tuple(d for log in logs.values() for d in log.damage))


def _vectors(value: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Every vector of numbers, whether stored as (n,), (n, 1) or (1, n), and every column of a matrix."""
    for name, inner in value.items():
        key = prefix + name
        if isinstance(inner, dict):
            yield from _vectors(inner, f"{key}/")
        elif isinstance(inner, np.ndarray) and inner.dtype.kind in "iuf" and inner.size:
            if inner.size == max(inner.shape):
                yield key, inner.reshape(-1)
            elif inner.ndim == 2 and min(inner.shape) <= MOST_COLUMNS:
                columns = inner if inner.shape[0] > inner.shape[1] else inner.T
                yield from ((f"{key}[{k}]", columns[:, k]) for k in range(columns.shape[1]))


def _clocks(path: Path, vectors: Mapping[str, NDArray[Any]], layout: TableLayout | None) -> dict[str, NDArray[Any]]:
    """Time stamps [s] of every clock, the main one first."""
    if layout is not None and layout.sample_rate_hz is not None:
        longest = max((values.size for values in vectors.values()), default=0)
        return {"": np.arange(longest) / layout.sample_rate_hz}
    if layout is not None:
        scale = {layout.time.strip("/"): SECONDS[layout.time_unit]}
        found = {key: scale.get(key.strip("/"), scale.get(_leaf(key))) for key in vectors}
    else:
        found = {key: CLOCKS.get(_leaf(key)) for key in vectors}
    clocks = {key: vectors[key] * factor for key, factor in found.items() if factor is not None}
    if not clocks:
        wanted = "'time' (nor 'Time_us')" if layout is None else f"{layout.time!r}"
        raise MissingChannel(
            f"{path}: no variable {wanted}; it has {_some(vectors)}; name its clock or its rate in a table layout"
        )
    homes = Counter([_home(key) for key in vectors if is_faser(_leaf(key))] or map(_home, vectors))
    order = list(CLOCKS)

    def claim(key: str) -> tuple[object, ...]:
        rank = order.index(_leaf(key)) if _leaf(key) in order else 0
        return homes[_home(key)], "/Sensors/Fmu/" in key, -rank, clocks[key].size

    return {key: clocks[key] for key in sorted(clocks, key=claim, reverse=True)}


def _nearest(key: str, at_home: Mapping[str, Sequence[str]], main: str) -> list[str]:
    """Clocks that a vector may belong to: of its own structure, of those around it, the main one."""
    path = key.strip("/")
    homes = [path[:at] for at in range(len(path), 0, -1) if path[at : at + 1] == "/"]
    return [*(clock for home in (*homes, "") for clock in at_home.get(home, ())), main]


def _leaf(path: str) -> str:
    return path.rpartition("/")[2]


def _home(path: str) -> str:
    return path.rpartition("/")[0] + "/"


def _rank(path: str, home: str) -> int:
    """RAPTRS' commands come first, then channels beside the clock, then the rest as the file has them."""
    groups = (COMMAND_GROUP, home)
    return next((rank for rank, group in enumerate(groups) if path.startswith(group)), len(groups))


def _names(paths: Iterable[str]) -> dict[str, str]:
    names: dict[str, str] = {}
    taken: set[str] = set()
    for path in paths:
        name = _leaf(path)
        names[path] = name if name not in taken else path.strip("/")
        taken.add(names[path])
    return names


def _nothing(path: Path, vectors: Mapping[str, NDArray[Any]], odd: Mapping[str, int]) -> MissingChannel:
    found = next((key for key in odd if is_faser(_leaf(key))), next(iter(odd), None))
    if found is not None:
        return MissingChannel(f"{path}: {found!r} has {odd[found]} values, not as many as the clock has stamps")
    return MissingChannel(f"{path}: nothing but a clock in it; it has {_some(vectors)}")


def _odd(odd: Mapping[str, int], length: int) -> tuple[Damage, ...]:
    if not odd:
        return ()
    names = _some([f"{path} ({size})" for path, size in odd.items()])
    return (Damage("wrong_length", f"left out, because they do not have {length} values: {names}", len(odd)),)


def _some(names: Iterable[str]) -> str:
    known = list(names)
    more = f" and {len(known) - 12} more" if len(known) > 12 else ""
    return (", ".join(known[:12]) or "no numeric variables") + more

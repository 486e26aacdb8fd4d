"""An aircraft from the columns of a table: which is the time, what was asked of each surface, and where it was."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from servofd.aircraft.schema import Aircraft, Surface, Table
from servofd.core.errors import ConfigError, suggest

_TIME = re.compile(r"time_(s|ms|us|ns)")
_PART = re.compile(r"(?P<surface>.+)_(?P<what>cmd|pos)_(?P<unit>deg|rad|us)")
UNITS = ("deg", "rad", "us")
"""Of a command or a position: degrees, radians, or microseconds of pulse."""
TIME_UNITS = ("s", "ms", "us", "ns")
_NEUTRAL_US, _SLOPE_DEG_PER_US = 1500.0, 0.09
"""Of a hobby servo, 90 deg over a millisecond; the fit of the servo finds the scale that this log has."""
_FORMS = "time_s (or _ms, _us, _ns), run, <surface>_cmd_deg and <surface>_pos_deg (or _rad, _us)"


def aircraft_of_columns(columns: Mapping[str, str]) -> Aircraft:
    """The aircraft that a table with these columns describes.

    `columns`: what columns of the table are, as `pandas.DataFrame.rename` takes it: ``{"t": "time_ms", "de":
    "elevator_cmd_rad", "de_meas": "elevator_pos_rad"}``. A time is in s, ms, us or ns; a command or position in
    degrees, radians, or microseconds of pulse, whose scale is that of a hobby servo until it is fitted. Raises
    `ConfigError` if a name is of no such form, or a surface has no command.

    Examples
    --------
    >>> found = aircraft_of_columns({"t": "time_ms", "de": "elevator_cmd_rad", "de_meas": "elevator_pos_rad"})
    >>> found.table.time_unit, found.surfaces["elevator"].measured.channel
    ('ms', 'de_meas')
    """
    layout: dict[str, Any] = {}
    surfaces: dict[str, dict[str, dict[str, Any]]] = {}
    meant: dict[str, str] = {}
    for column, meaning in columns.items():
        if meaning in meant:
            raise ConfigError(f"columns: {meant[meaning]!r} and {column!r} are both {meaning}")
        meant[meaning] = column
        if time := _TIME.fullmatch(meaning):
            if "time" in layout:
                raise ConfigError(f"columns: {layout['time']!r} and {column!r} are both the time")
            layout |= {"time": column, "time_unit": time[1]}
        elif meaning == "run":
            layout["run"] = column
        elif part := _PART.fullmatch(meaning):
            scale = {"trim_us": _NEUTRAL_US, "slope_deg_per_us": _SLOPE_DEG_PER_US} if part["unit"] == "us" else {}
            parts = surfaces.setdefault(part["surface"], {})
            parts[part["what"]] = {"channel": column, "unit": part["unit"], **scale}
        else:
            raise ConfigError(f"columns: {column!r} is {meaning!r}, which is none of {_FORMS}")
    for name, parts in surfaces.items():
        if "cmd" not in parts:
            raise ConfigError(f"columns: {name} has a position and no command; name its {name}_cmd_deg")
    if not surfaces:
        raise ConfigError(f"columns: none is a command; say of each column that counts what it is: {_FORMS}")
    try:
        return Aircraft(
            surfaces={
                name: Surface.model_validate({"command": parts["cmd"], "measured": parts.get("pos")})
                for name, parts in surfaces.items()
            },
            table=Table(**layout),
        )
    except ValidationError as error:
        raise ConfigError(f"columns: {error.errors()[0]['msg']}") from None


def check_columns(columns: Mapping[str, str], known: list[str]) -> None:
    """Refuse columns that a table does not have.

    Raises `ConfigError` for the first of them.
    """
    for name in columns:
        if name not in known:
            raise ConfigError(f"columns: {suggest('column', name, known)}")

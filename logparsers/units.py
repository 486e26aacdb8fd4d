"""Units, from the names of channels; and types of numbers."""

from __future__ import annotations

S_PER_MS, S_PER_US, S_PER_NS = 1e-3, 1e-6, 1e-9
"""Seconds in a millisecond, a microsecond and a nanosecond."""
MS_PER_S, US_PER_S = 1e3, 1e6
"""The inverses, which are exact: a time is multiplied by them, and not divided by the ones above."""
S_PER_HOUR = 3600.0
"""Seconds in an hour."""
SECONDS = {"s": 1.0, "ms": S_PER_MS, "us": S_PER_US, "ns": S_PER_NS}
"""Length of a tick of a clock [s], by its unit."""
C_NUMBERS = {
    "int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4",
    "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8",
}  # fmt: skip
"""Types of numbers as MAVLink and PX4 call them, and as numpy does."""

COMMANDS = ("de", "dr", "da_l", "da_r", "df_l", "df_r")
"""FASER's surface commands [rad]: elevator, rudder, ailerons, flaps; ``_pos`` behind them is the measured position."""

RAPTRS_COMMANDS = ("cmdElev_rad", "cmdRud_rad", "cmdAilL_rad", "cmdAilR_rad", "cmdFlapL_rad", "cmdFlapR_rad")

SUFFIXES = {
    "_deg_s": "deg/s", "_rad_s": "rad/s", "_m_s": "m/s", "_m_s2": "m/s^2",
    "_rps": "rad/s", "_dps": "deg/s", "_mps": "m/s", "_mps2": "m/s^2",
    "_deg": "deg", "_rad": "rad", "_us": "us", "_ms": "ms", "_s": "s", "_m": "m", "_mm": "mm",
    "_v": "V", "_V": "V", "_A": "A", "_c": "degC", "_C": "degC", "_pa": "Pa", "_Pa": "Pa", "_kpa": "kPa", "_kPa": "kPa",
    "_hz": "Hz", "_Hz": "Hz", "_g": "g", "_nd": "",
}  # fmt: skip

POSITION_UNIT = "rad_or_count"
"""Documented in rad, but FASER's data acquisition wrote raw counts of its converter: only a calibration can tell."""

FASER_UNITS = {
    "time": "s", "ias": "m/s", "ias_filt": "m/s", "Pd": "kPa",
    **dict.fromkeys(COMMANDS, "rad"),
    **{name + "_pos": POSITION_UNIT for name in COMMANDS},
    **{name + cmd: "rad" for name in ("phi", "theta", "psi") for cmd in ("", "_cmd")},
    **{name + cmd: "rad/s" for name in ("p", "q", "r") for cmd in ("", "_cmd")},
}  # fmt: skip


def suffix_unit(name: str) -> str:
    """Unit in the last words of a name, empty if there is none.

    Examples
    --------
    >>> suffix_unit("airspeed_m_s"), suffix_unit("elevator_pos_deg"), suffix_unit("mode")
    ('m/s', 'deg', '')
    """
    words = name.split("_")
    for count in (3, 2, 1):  # the longest suffix first: _m_s is no _s
        suffix = "_" + "_".join(words[-count:])
        if len(words) > count and suffix in SUFFIXES:
            return SUFFIXES[suffix]
    return ""


def faser_unit(name: str) -> str:
    """Unit of a channel of a FASER or RAPTRS log, empty if it is not documented.

    Examples
    --------
    >>> faser_unit("de"), faser_unit("de_pos"), faser_unit("cmdElev_rad"), faser_unit("Input_V"), faser_unit("mode")
    ('rad', 'rad_or_count', 'rad', 'V', '')
    """
    if name in FASER_UNITS:
        return FASER_UNITS[name]
    return POSITION_UNIT if name.endswith("_pos") else suffix_unit(name)


def is_faser(name: str) -> bool:
    """Tell whether this is the name of a surface command or measured position, in FASER or RAPTRS."""
    return name.removesuffix("_pos") in COMMANDS or name in RAPTRS_COMMANDS

"""The Lua scripts themselves."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from logparsers.units import US_PER_S
from servofd.core.errors import ConfigError
from servofd.onboard.plan import LONGEST_NAME

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.onboard.plan import OnboardPlan, OnboardSurface

_FOLDED_AT = 112
"""Columns of a line of the script at most."""
_STREAM_HZ = 25.0
"""Rate at which the script sends positions [Hz]."""


def watch_script(plan: OnboardPlan, file_name: str = "servofd.lua") -> str:
    """Text of the script that watches every surface of a plan.

    Examples
    --------
    >>> from servofd.aircraft.schema import load_aircraft
    >>> from servofd.onboard.plan import plan_onboard
    >>> text = watch_script(plan_onboard(load_aircraft("simulated")))
    >>> [line[:60] for line in text.splitlines() if "RUDDER" in line]
    ['   { name = "RUDDER", output = 4, gain = 0.09, offset = 0.0,']
    """
    return _rendered(
        "watch.lua",
        plan=plan,
        file=_comment(file_name),
        aircraft=_comment(plan.aircraft),
        longest_name=LONGEST_NAME,
    )


def stream_script(outputs: Sequence[int], file_name: str = "servofd.lua") -> str:
    """Text of the script that only sends the measured positions of some outputs (from 1) to the ground.

    Examples
    --------
    >>> "ipairs({ 1, 4 })" in stream_script([4, 1])
    True
    """
    if not outputs:
        raise ConfigError("no output to send the position of")
    return _rendered(
        "stream.lua", outputs=sorted(set(outputs)), file=_comment(file_name), period_ms=round(1e3 / _STREAM_HZ)
    )


@cache
def _environment() -> Any:  # noqa: ANN401 - jinja2 is imported where it is used
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(  # noqa: S701 - Lua is no HTML
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    environment.filters["lua_entry"] = _entry
    return environment


def _rendered(template: str, **values: Any) -> str:  # noqa: ANN401 - whatever the template shows
    from servofd.version import __version__

    text: str = _environment().get_template(template).render(version=__version__, **values)
    return text


def _comment(text: str) -> str:
    """Text that ends no comment of Lua."""
    return "".join(letter if " " <= letter <= "~" and letter != "]" else "_" for letter in text)


def _entry(surface: OnboardSurface) -> str:
    """Settings of a surface as the inside of a Lua table, folded."""
    start, slope, square, cubic = surface.command
    settings: dict[str, Any] = {
        "name": surface.name,
        "output": surface.output,
        "gain": slope,
        "offset": start,
        "sense": surface.position[0],
        "zero": surface.position[1],
        "delay_us": round(US_PER_S * surface.delay_s),
        "dc_gain": surface.dc_gain,
        "pole": surface.filter_pole_rad_s,
        "gap_us": round(US_PER_S * surface.longest_gap_s),
        "tolerance": list(surface.tolerances),
        "noise": surface.noise_deg,
        "sigmas": surface.sigmas * surface.noise_gain,
        "persistence": surface.persistence,
        "modes": [[mode.decay_rad_s, mode.turn_rad_s, mode.weight, mode.weight_turn] for mode in surface.modes],
    }
    if surface.threshold_deg is not None:
        settings["threshold"] = surface.threshold_deg
    if surface.from_servo:
        settings["telemetry"] = True
    if square or cubic:
        settings["curve"] = [square, cubic]
    if surface.saturation_deg is not None:
        settings["bounds"] = list(surface.saturation_deg)
    if surface.stops_deg is not None:
        settings["stops"] = list(surface.stops_deg)
    if surface.rates_deg_s is not None:
        settings["rates"] = [*surface.rates_deg_s, surface.weak_rate_deg_s]
    lines = [""]
    for key, value in settings.items():
        item = f"{key} = {_lua(value)},"
        if lines[-1] and len(lines[-1]) + len(item) > _FOLDED_AT:
            lines.append("")
        lines[-1] = f"{lines[-1]} {item}".lstrip()
    return "\n     ".join(lines).removesuffix(",")


def _lua(value: Any) -> str:  # noqa: ANN401 - whatever Lua has
    """Literal of a value, with as many digits as 32 bits hold.

    >>> _lua([1.0, 0.1]), _lua(3), _lua(True), _lua("a")
    ('{ 1.0, 0.1 }', '3', 'true', '"a"')
    """
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "{ " + ", ".join(_lua(item) for item in value) + " }"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, int):
        return str(value)
    text = f"{value:.9g}"
    return text if any(letter in text for letter in ".e") else f"{text}.0"

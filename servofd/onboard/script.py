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
    ['   { "name=RUDDER output=4 gain=0.09 offset=0.0 sense=1.0 ze']
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
    """Settings of a surface as lines of text: what is wired, its servo, and how far good ones differ."""
    start, slope, square, cubic = surface.command
    modes = [(mode.decay_rad_s, mode.turn_rad_s, mode.weight, mode.weight_turn) for mode in surface.modes]
    wired: dict[str, Any] = {
        "name": surface.name,
        "output": surface.output,
        "gain": slope,
        "offset": start,
        "curve": (square, cubic) if square or cubic else None,
        "bounds": surface.saturation_deg,
        "sense": surface.position[0],
        "zero": surface.position[1],
        "telemetry": int(surface.from_servo) or None,
    }
    servo: dict[str, Any] = {
        "delay_us": round(US_PER_S * surface.delay_s),
        "dc_gain": surface.dc_gain,
        "lag": surface.lag_s,
        "rates": surface.rates_deg_s,
        "stops": surface.stops_deg,
        "modes": [number for mode in modes for number in mode],
    }
    doubt: dict[str, Any] = {
        "noise": surface.noise_deg,
        "jitter": surface.jitter_s,
        "limit": surface.limit,
        "energies": surface.energies,
        "persistence": surface.persistence,
        "doubt": [float(f"{number:.5g}") for number in surface.doubt],
    }
    lines = (" ".join(f"{k}={_text(v)}" for k, v in each.items() if v is not None) for each in (wired, servo, doubt))
    return ",\n     ".join(f'"{line}"' for line in lines)


def _text(value: Any) -> str:  # noqa: ANN401 - whatever a setting is
    """A setting, with as many digits as 32 bits hold.

    >>> _text([1.0, 0.1]), _text(3), _text("a")
    ('1.0,0.1', '3', 'a')
    """
    if isinstance(value, list | tuple):
        return ",".join(_text(item) for item in value)
    if isinstance(value, str | int):
        return str(value)
    text = f"{value:.9g}"
    return text if any(letter in text for letter in ".e") else f"{text}.0"

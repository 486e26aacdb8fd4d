"""The Lua scripts themselves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from servofd.core.errors import ConfigError
from servofd.onboard.plan import LONGEST_NAME, OnboardPlan, OnboardSurface, Setting

_STREAM_HZ = 25.0
"""Rate at which the script sends positions [Hz]."""
_DIGITS, _DIGITS_OF_DOUBT = 9, 5
"""As many digits of a setting as 32 bits hold; of the doubt as many as tell a standard deviation to 1e-4 of itself,
which takes 0.3 kB less memory a surface while a script is read."""


def watch_script(plan: OnboardPlan, file_name: str = "servofd.lua") -> str:
    """Text of the script that watches every surface of a plan."""
    return _rendered(
        "watch.lua",
        plan=plan,
        file=_comment(file_name),
        aircraft=_comment(plan.aircraft),
        longest_name=LONGEST_NAME,
    )


def stream_script(outputs: Sequence[int], file_name: str = "servofd.lua") -> str:
    """Text of the script that only sends positions and currents of the servos on some outputs (from 1) to the ground.

    Examples
    --------
    >>> "local outputs = { 1, 4 }" in stream_script([4, 1])
    True
    """
    if not outputs:
        raise ConfigError("no output to send the position of")
    return _rendered(
        "stream.lua", outputs=sorted(set(outputs)), file=_comment(file_name), period_ms=round(1e3 / _STREAM_HZ)
    )


def _rendered(template: str, **values: Any) -> str:  # noqa: ANN401 - whatever the template shows
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    from servofd.version import __version__

    files = FileSystemLoader(Path(__file__).parent / "templates")
    environment = Environment(loader=files, undefined=StrictUndefined, keep_trailing_newline=True)  # noqa: S701 - no HTML
    environment.filters["lua_entry"] = _entry
    return environment.get_template(template).render(version=__version__, **values)


def _comment(text: str) -> str:
    """Text that ends no comment of Lua."""
    return "".join(letter if " " <= letter <= "~" and letter != "]" else "_" for letter in text)


def _entry(surface: OnboardSurface) -> str:
    """Settings of a surface as lines of text."""
    lines = [
        " ".join(
            f"{key}={_text(value, _DIGITS_OF_DOUBT if key == 'doubt' else _DIGITS)}"
            for key, value in each.items()
            if value is not None
        )
        for each in surface.settings
    ]
    lines[0] = f"name={surface.name} output={surface.output} {lines[0]}"
    return ",\n     ".join(f'"{line}"' for line in lines)


def _text(value: Setting, digits: int = _DIGITS) -> str:
    """A setting, with so many digits.

    >>> _text((1.0, 0.1)), _text(3)
    ('1.0,0.1', '3')
    """
    if isinstance(value, tuple):
        return ",".join(_text(item, digits) for item in value)
    if isinstance(value, int):
        return str(value)
    text = f"{value:.{digits}g}"
    return text if any(letter in text for letter in ".e") else f"{text}.0"

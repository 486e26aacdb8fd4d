"""TOML files: read whole, and pieces of those that people will read and edit."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from importlib.resources.abc import Traversable
from pathlib import Path
from types import MappingProxyType
from typing import Any

from servofd.core.errors import ConfigError

_ACTS = re.compile(r"[\x7f-\x9f\u200b-\u200f\u2028-\u202e\ud800-\udfff]")
"""What JSON leaves as it is, and no reader of TOML should meet."""
_NO_CHARACTER = "\ufffd"


def read_toml(source: Path | Traversable, name: str, what: str) -> dict[str, Any]:
    """Content of a TOML file.

    Examples
    --------
    >>> from pathlib import Path
    >>> read_toml(Path("no.toml"), "no.toml", "servo file")
    Traceback (most recent call last):
    servofd.core.errors.ConfigError: no.toml: cannot read the servo file: No such file or directory
    """
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:  # ValueError: other letters than UTF-8's, or a NUL in the name
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise ConfigError(f"{name}: cannot read the {what}: {reason}") from None
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{name}: not valid TOML: brackets within brackets, too deep to read") from None
    except ValueError as error:  # tomllib's own, and Python's for a number of thousands of digits
        raise ConfigError(f"{name}: not valid TOML: {error}") from None


def toml_key(name: str) -> str:
    """Key of a table, in quotes where it needs them.

    Examples
    --------
    >>> toml_key("aileron_left"), toml_key("servo 1")
    ('aileron_left', '"servo 1"')
    """
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else toml_value(name)


def toml_comment(text: str) -> str:
    r"""Text as a comment holds it: on one line, and without what acts.

    Examples
    --------
    >>> toml_comment("flight\n1.bin")
    'flight 1.bin'
    """
    return _ACTS.sub(_NO_CHARACTER, re.sub(r"[\x00-\x1f\s]+", " ", text)).strip()


def toml_lines(table: Mapping[str, Any], comments: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Entries of a table, one a line, with a comment behind those that have one; None is left out.

    Examples
    --------
    >>> toml_lines({"rate_hz": 10.0, "day": None, "own": {"x": 1}}, {"rate_hz": "samples a second"})
    ['rate_hz = 10.0  # samples a second', 'own = { x = 1 }']
    """
    return [
        f"{toml_key(key)} = {toml_value(value)}" + (f"  # {comments[key]}" if comments.get(key) else "")
        for key, value in table.items()
        if value is not None
    ]


def toml_value(value: Any) -> str:  # noqa: ANN401 - anything a TOML file can hold here
    """Value as TOML writes it.

    Examples
    --------
    >>> toml_value(True), toml_value("a"), toml_value({"unit": "deg", "correction": (1e-05, 0.5)})
    ('true', '"a"', '{ unit = "deg", correction = [1e-05, 0.5] }')
    """
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml_key(key)} = {toml_value(each)}" for key, each in value.items()) + " }"
    if isinstance(value, bool | str | list | tuple):
        text = json.dumps(value, ensure_ascii=False)
        return _ACTS.sub(lambda found: _NO_CHARACTER if found[0] >= "\ud800" else f"\\u{ord(found[0]):04x}", text)
    return repr(value)

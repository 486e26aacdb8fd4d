"""Pieces of TOML files that people will read and edit."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["toml_inline", "toml_key", "toml_value"]


def toml_key(name: str) -> str:
    """Key of a table, in quotes where it needs them.

    Examples
    --------
    >>> toml_key("aileron_left"), toml_key("servo 1")
    ('aileron_left', '"servo 1"')
    """
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else json.dumps(name)


def toml_inline(table: Mapping[str, Any]) -> str:
    """Table on one line.

    Examples
    --------
    >>> toml_inline({"unit": "deg", "correction": (1.0, 0.5)})
    '{ unit = "deg", correction = [1.0, 0.5] }'
    """
    return "{ " + ", ".join(f"{toml_key(key)} = {toml_value(value)}" for key, value in table.items()) + " }"


def toml_value(value: Any) -> str:  # noqa: ANN401 - anything a TOML file can hold here
    """Value as TOML writes it.

    Examples
    --------
    >>> toml_value(True), toml_value("a"), toml_value(1e-05)
    ('true', '"a"', '1e-05')
    """
    if isinstance(value, dict):
        return toml_inline(value)
    if isinstance(value, bool | str | list | tuple):
        return json.dumps(value, ensure_ascii=False)
    return repr(value)

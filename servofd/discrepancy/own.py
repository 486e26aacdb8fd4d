"""Effects of a user's own: a Python file with one class of `servofd.servo.effect.Effect`."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from pathlib import Path

from servofd.core.errors import ConfigError
from servofd.servo.effect import Effect
from servofd.servo.generate import check
from servofd.servo.registry import check_name


def load_own_effect(path: str | Path) -> type[Effect]:
    """Run a Python file and return the one effect that it defines.

    Raises `ConfigError` if the file cannot be read or run, defines no effect or several, or an effect that cannot be
    simulated.
    """
    path = Path(path)
    name = f"servofd_own_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path) if path.suffix == ".py" else None
    if spec is None or spec.loader is None:
        raise ConfigError(f"{path}: cannot read the effect: not a Python file (.py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the effect: {error.strerror}") from None
    except Exception as error:
        raise ConfigError(f"{path}: {_where(error)}") from None
    made = [
        each for each in vars(module).values()
        if isinstance(each, type) and issubclass(each, Effect) and each.__module__ == name
    ]  # fmt: skip
    if len(made) != 1:
        found = "no effect" if not made else f"{len(made)} effects"
        raise ConfigError(f"{path}: defines {found}; one is needed: a class of servofd.Effect, see docs/explain.md")
    try:
        check_name(made[0])
        check(made[0])
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return made[0]


def _where(error: Exception) -> str:
    """Kind, message and line of an error in the user's file."""
    if isinstance(error, ConfigError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    line = error.lineno if isinstance(error, SyntaxError) else frames[-1].lineno if len(frames) > 1 else None
    return f"{f'line {line}: ' if line else ''}{type(error).__name__}: {error}"

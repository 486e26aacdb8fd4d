"""What can be wrong with a request. Every message says what, where, and what would have worked."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from importlib.util import find_spec
from types import MappingProxyType


class ServofdError(Exception):
    """Base of everything servofd raises on purpose."""


class ConfigError(ServofdError):
    """An aircraft or servo file does not say what it must."""


class UnknownName(ServofdError):  # noqa: N818 - reads better without "Error" where it is raised
    """A servo, surface, fault or effect that does not exist."""


class NoMeasurement(ServofdError):  # noqa: N818
    """Nothing in the log tells where a surface was."""


class CalibrationError(ServofdError):
    """Flights that a calibration must not be made from."""


class DesignError(ServofdError):
    """No filter with the wanted properties exists for this model."""


class RecordingError(ServofdError):
    """A recording that servofd did not write, or cannot read."""


class IdentificationError(ServofdError):
    """A test does not show what a servo is like."""


EXTRAS = MappingProxyType(
    {
        "matplotlib": "view",
        "rerun": "view",
        "rerun_cli": "view",
        "pyarrow": "view",
        "pandas": "view",
        "starlette": "serve",
        "uvicorn": "serve",
        "control": "control",
        "h5py": "hdf5",
        "fsspec": "remote",
    }
)
"""Packages that not everybody needs, and the optional part of servofd that brings each."""


def needs(*packages: str) -> None:
    """Refuse what packages are needed for that are not installed, and say how to get them.

    `*packages`: some of `EXTRAS`.
    """
    for package in packages:
        if find_spec(package) is None:
            raise ConfigError(without(package))


def without(package: str) -> str:
    """What to say where a package is not installed.

    Examples
    --------
    >>> without("rerun")
    'this needs rerun, which is not installed: pip install "servofd[view]"'
    """
    return f'this needs {package}, which is not installed: pip install "servofd[{EXTRAS[package]}]"'


def suggest(kind: str, name: str, known: Iterable[str]) -> str:
    """Sentence for an unknown name: the nearest known ones first, or all of them.

    Examples
    --------
    >>> suggest("surface", "elevtor", ["elevator", "rudder"])
    "unknown surface 'elevtor'; did you mean elevator? known: elevator, rudder"
    """
    names = list(known)
    near = difflib.get_close_matches(name, names, n=2, cutoff=0.6)
    hint = f"; did you mean {' or '.join(near)}?" if near else ";"
    return f"unknown {kind} {name!r}{hint} known: {', '.join(names)}"

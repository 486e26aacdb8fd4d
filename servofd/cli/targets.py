"""Where results go: refuses outputs that cannot be written, before the work starts, and gives documents as JSON."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


def give_json(target: str | None, document: dict[str, Any]) -> bool:
    """Write a document to the file that ``--json`` names; or print it, where that is ``-``, and tell so.

    Examples
    --------
    >>> give_json(None, {"schema": "servofd.audit/1"})
    False
    """
    from servofd.core.files import write_whole
    from servofd.outputs.json_report import to_json

    if target and target != "-":
        write_whole(target, to_json(document).encode())
    elif target:
        print(to_json(document), end="")
    return target == "-"


def check_targets(
    outputs: Iterable[str | None], inputs: Mapping[str, Iterable[str | None]], *, folder: str | None = None
) -> None:
    """Refuse outputs that cannot be written, or would overwrite an input or each other.

    Parameters
    ----------
    outputs : iterable of str or None
        Files to be written; ``None`` and ``-`` are none.
    inputs : mapping of str to iterable of str or None
        What each kind of input is called (``"a log"``), and the files of that kind.
    folder : str, optional
        Folder that will be made if it is not there.

    Examples
    --------
    >>> check_targets(["-", None], {"a log": ["flight.csv"]})
    >>> check_targets(["flight.csv"], {"a log": ["flight.csv"]})
    Traceback (most recent call last):
    servofd.core.errors.ConfigError: flight.csv: is a log already; choose another file for this output
    """
    from servofd.core.errors import ConfigError

    taken = {Path(name).resolve(): what for what, names in inputs.items() for name in names if name}
    for name in outputs:
        if name is None or name == "-":
            continue
        target = Path(name).resolve()
        if not target.parent.is_dir():
            raise ConfigError(f"{name}: the folder {target.parent} does not exist")
        if target.is_dir():
            raise ConfigError(f"{name}: is a folder; give the name of a file in it")
        if not os.access(target if target.exists() else target.parent, os.W_OK):
            raise ConfigError(f"{name}: cannot write here: permission denied")
        if target in taken:
            raise ConfigError(f"{name}: is {taken[target]} already; choose another file for this output")
        taken[target] = "another output"
    if folder is not None and Path(folder).exists() and not Path(folder).is_dir():
        raise ConfigError(f"{folder}: is a file; give the name of a folder")

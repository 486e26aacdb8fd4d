"""What an answer of `servofd explain` is worth, against what is hidden in the log."""

from __future__ import annotations

import contextlib
import io
import json
import math
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hidden_physics import CATALOGUE, Effects

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

__all__ = ["ALIKE", "Answer", "Score", "Seconds", "ask", "score", "seconds_found"]

ALIKE = {
    "lugre_friction": ("friction", "deadband", "backlash"),
    "set_point_speed": ("rate_limit", "voltage_rate"),
    "hard_deadband": ("deadband", "friction", "backlash"),
    "bearing_load": ("load_friction", "friction"),
    "hard_stop": ("position_limit",),
}
"""Names that are right for physics by another law: the same thing to the user."""
KNOWN_SERVO = "hs225bb-eq31"
"""What the hidden logs are logs of, which their user knows."""
_FROM_ONE = ("gain", "bandwidth_scale")
"""Parameters that do nothing at 1: their error is relative to the deviation from there."""
_SCATTER = ("gain", "slow_dynamics", "damping", "delay")
_COULD_NOT_TELL = 2
_LOST = "torque_lost"
"""What belongs to no effect: a run in which the motor does nothing from an instant on."""
_LATE_S, _LAW_ERROR = 0.3, 0.1
"""By how much that instant may be wrong, and both ends of a size that goes with a load."""
_TOLD = 0.6
"""Over the noise: the rms of an effect that half of the seconds of 100 samples show which have it, when 1 % of the
seconds that are called bad may be so by chance."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What the command line said."""

    code: int
    seconds: float
    """Of one core."""
    said: Mapping[str, Any] | None
    """The JSON of the contract; None if there is none."""
    complaint: str
    """Last line on stderr."""


class Seconds(NamedTuple):
    """Seconds of a log, by what is hidden in them and what is said of them."""

    rightly_bad: int = 0
    wrongly_bad: int = 0
    missed: int = 0
    rightly_good: int = 0


@dataclass(frozen=True, slots=True)
class Score:
    """One answer against the truth; all shares are for the log alone."""

    conclusion: str
    """Of the contract, or `could_not_tell`."""
    named: tuple[str, ...]
    """In the order in which they were named."""
    hidden: tuple[str, ...]
    first: bool
    """All that the catalogue has of what is hidden is named, and before anything else."""
    in_set: bool
    """The same, if what is declared indistinguishable from a name counts."""
    found: int
    """How many of the hidden effects are named or declared indistinguishable from a name."""
    extra: tuple[str, ...]
    """Named, though neither they nor what is declared indistinguishable from them is hidden."""
    fault: bool
    """From some time on, the log is said to hold a fault and no missing effect."""
    silently_wrong: bool
    """The gap is said to be explained, or not to exist, and a name is wrong or missing; and no fault is told of."""
    set_size: float
    """Mean number of names offered for a step; 0 without steps."""
    errors: Mapping[str, float]
    """Relative error of each parameter of a named effect, by `effect.parameter`."""
    covered: Mapping[str, bool]
    """Whether its interval holds the truth."""
    floor_ratio: float
    """Held-out rms of the final model, over the noise that is really there."""
    closure: float
    """Share of the gap, in mean squares on held-out data, that is gone; NaN if there was none."""


def ask(path: Path, surface: str, *options: str) -> Answer:
    """Have `servofd explain` explain a log, as a user would who knows which servo it is.

    Parameters
    ----------
    path : Path
        Log.
    surface : str
        Surface to explain.
    *options : str
        Further words of the command line.
    """
    from servofd.cli import main

    with tempfile.TemporaryDirectory() as folder:
        file, silence, errors = Path(folder) / "answer.json", io.StringIO(), io.StringIO()
        begin_s = time.process_time()
        with contextlib.redirect_stdout(silence), contextlib.redirect_stderr(errors):
            try:
                known = () if "--servo" in options else ("--servo", KNOWN_SERVO)
                code = main(["explain", str(path), "-s", surface, "--json", str(file), *known, *options])
            except SystemExit as left:
                code = left.code if isinstance(left.code, int) else _COULD_NOT_TELL
        seconds = time.process_time() - begin_s
        said = json.loads(file.read_text()) if file.exists() else None
    return Answer(code, seconds, said, (errors.getvalue().strip().splitlines() or [""])[-1])


def score(
    said: Mapping[str, Any] | None,
    truth: Effects,
    noise_deg: float,
    *,
    scattered: bool = False,
    unseen: Collection[str] = (),
) -> Score:
    """Score one answer.

    Parameters
    ----------
    said : mapping or None
        JSON of the contract; None if the command line could not tell.
    truth : mapping
        Parameters of all that is hidden, by name.
    noise_deg : float
        Noise that is really there, with that of the converter [deg].
    scattered : bool
        Whether the servo itself differs from the known one: that may be named, too.
    unseen : collection of str
        Effects that were put in and hardly show: nobody has to name them, and whoever does is right.

    Examples
    --------
    >>> step = {"effect": "gain", "parameters": {"gain": {"value": 0.79, "low": 0.78, "high": 0.81}}}
    >>> said = {"conclusion": "explained", "nominal": {"held_out_rms_deg": 0.7}, "steps": [step],
    ...         "indistinguishable": [["gain", "airload"]], "final": {"held_out_rms_deg": 0.1}}
    >>> one = score(said, {"gain": {"gain": 0.8}}, 0.1)
    >>> one.first, one.set_size, round(one.errors["gain.gain"], 6), one.covered["gain.gain"], one.silently_wrong
    (True, 2.0, 0.05, True, False)
    """
    said = said or {"conclusion": "could_not_tell", "steps": []}
    steps: Sequence[Mapping[str, Any]] = said.get("steps", [])
    untold = _untold(said, truth)
    named = tuple(step["effect"] for step in steps)
    offered = [_offered(name, said.get("indistinguishable", [])) for name in named]
    known = tuple(name for name in truth if name in CATALOGUE)
    nameless = tuple(name for name in truth if name not in (*CATALOGUE, _LOST))
    right = {*known, *(alike for name in nameless for alike in ALIKE.get(name, ()))}
    right |= {*unseen, *(_SCATTER if scattered else ())}
    found = sum(any(name in names for names in offered) for name in known)
    extra = tuple(name for name, names in zip(named, offered, strict=True) if not right & names)
    missed = found < len(known) or (bool(nameless) and not named) or untold
    fault = said.get("fault_s") is not None
    settled = said["conclusion"] in ("explained", "nothing_missing") and not fault
    errors, covered = _sizes(steps, truth)
    return Score(
        conclusion=said["conclusion"],
        named=named,
        hidden=tuple(truth),
        first=bool(known) and set(named[: len(known)]) == set(known),
        in_set=found == len(known) and not untold,
        found=found,
        extra=extra,
        fault=fault,
        silently_wrong=settled and (bool(extra) or missed),
        set_size=sum(map(len, offered)) / len(offered) if offered else 0.0,
        errors=errors,
        covered=covered,
        floor_ratio=_held_out(said, "final") / noise_deg,
        closure=_closure(_held_out(said, "nominal"), _held_out(said, "final"), noise_deg),
    )


def _untold(said: Mapping[str, Any], truth: Effects) -> bool:
    """Whether a loss of torque is not found where it is, or a size that goes with a load is not told with its slope."""
    lost = truth.get(_LOST)
    stretches = [(each["run"], each["start_s"]) for each in said.get("not_driven", [])]
    if lost is None and stretches:
        return True
    if lost is not None and not (
        len(stretches) == 1 and stretches[0][0] == lost["run"] and abs(stretches[0][1] - lost["start_s"]) <= _LATE_S
    ):
        return True
    laws = {each["effect"]: each for each in said.get("varying", [])}
    hidden = {name: parameters for name, parameters in truth.items() if "slope" in parameters}
    return laws.keys() != hidden.keys() or any(
        abs(laws[name][key] / parameters[key] - 1.0) > _LAW_ERROR
        for name, parameters in hidden.items()
        for key in ("at_zero", "slope")
    )


def seconds_found(
    said: Mapping[str, Any] | None, time_s: FloatArray, change_deg: FloatArray, noise_deg: float
) -> Seconds:
    """Compare the seconds that are called bad with those in which the effects change the position.

    Parameters
    ----------
    said : mapping or None
        JSON of the contract.
    time_s, change_deg : ndarray, shape (n,)
        Samples [s] and what the effects do to each of them [deg].
    noise_deg : float
        Noise that is really there [deg].

    Examples
    --------
    >>> time_s = np.arange(0.0, 3.0, 0.01)
    >>> seconds_found({"bad_seconds": [0.0, 1.0]}, time_s, np.where(time_s < 1.0, 0.2, 0.0), 0.1)
    Seconds(rightly_bad=1, wrongly_bad=1, missed=0, rightly_good=1)
    """
    second = (time_s - time_s[0]).astype(int)
    rms_deg = np.sqrt(np.bincount(second, weights=change_deg**2) / np.maximum(np.bincount(second), 1))
    bad = rms_deg > _TOLD * noise_deg
    called = np.zeros(bad.size, dtype=bool)
    called[[round(start_s - time_s[0]) for start_s in (said or {}).get("bad_seconds", [])]] = True
    return Seconds(*(int(np.sum(both)) for both in (bad & called, ~bad & called, bad & ~called, ~bad & ~called)))


def _offered(name: str, groups: Sequence[Sequence[str]]) -> set[str]:
    """An effect with all that cannot be told from it."""
    return {name}.union(*(group for group in groups if name in group))


def _sizes(steps: Sequence[Mapping[str, Any]], truth: Effects) -> tuple[dict[str, float], dict[str, bool]]:
    """Errors of parameters and whether their intervals hold the truth, where name and parameter exist on both sides."""
    errors, covered = {}, {}
    for step in steps:
        for key, found in step.get("parameters", {}).items():
            true = truth.get(step["effect"], {}).get(key)
            if true is None:
                continue
            name = f"{step['effect']}.{key}"
            errors[name] = abs(found["value"] - true) / abs(true - (1.0 if key in _FROM_ONE else 0.0))
            if found.get("low") is not None and found.get("high") is not None:
                covered[name] = found["low"] <= true <= found["high"]
    return errors, covered


def _held_out(said: Mapping[str, Any], model: str) -> float:
    value = said.get(model, {}).get("held_out_rms_deg")
    return math.nan if value is None else float(value)


def _closure(before_deg: float, after_deg: float, noise_deg: float) -> float:
    """Share of what is not noise that is gone."""
    gap = before_deg**2 - noise_deg**2
    return 1.0 - max(after_deg**2 - noise_deg**2, 0.0) / gap if gap > 0.02 * noise_deg**2 else math.nan

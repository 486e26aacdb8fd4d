"""From the classes of effects to the compiled stepper: which sizes a servo has, and what is compiled.

The functions of the slots are written from the classes, together with the text of `servofd.servo.stepper`, into one
module in the user's cache folder, where the compiler keeps its machine code beside it. A new effect is a new text.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import inspect
import math
import os
import sys
import tempfile
import textwrap
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers import compiled as compiler
from servofd.core.errors import ConfigError
from servofd.servo.catalogue import fields_of
from servofd.servo.effect import Effect, Now, Slot

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from servofd.core.types import FloatArray

STEPPED = (Slot.COMMAND, Slot.ERROR, Slot.LOAD, Slot.GRIP, Slot.SPEED, Slot.STOP, Slot.OUTPUT, Slot.READING)
"""Slots whose effects are compiled, in their order."""
INSIDE_LOOP = STEPPED[:6]
_COMPILED = {"nudge": "inlined", "advance": "inlined", "advance_any": "inner", "run": "outer"}
_BEGIN, _END = "# Slots begin here.\n", "# Slots end here.\n"
_SEEN_FROM_OUTSIDE = "GAIN = BIAS = -1"


@dataclass(frozen=True, slots=True, eq=False)
class Act:
    """One function of the stepper, which several forms of an effect may share."""

    effect: type[Effect]
    switches: tuple[str, ...]
    """Sizes of which one at least is not off where it acts."""
    first: int
    """Its first number in the memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Stepper:
    """The stepper for some effects, and the layout of its arrays."""

    fields: tuple[str, ...]
    off: FloatArray
    """Size of each field of a servo without effects, shape (fields,)."""
    acts: tuple[Act, ...]
    memory: int
    run: Callable[..., int]

    def index(self, field: str) -> int:
        """Where a field stands among the sizes."""
        return self.fields.index(field)


def _acts_of(effects: Sequence[type[Effect]]) -> tuple[tuple[Act, ...], int]:
    """Functions of the effects, each once, and how many numbers they remember."""
    by_function: dict[Any, list[type[Effect]]] = {}
    for effect in effects:
        if effect.slot in STEPPED:
            if effect.act is None:
                raise ConfigError(f"effect {effect.name}: act, which says what it does, is missing")
            by_function.setdefault(effect.act, []).append(effect)
    acts, first = [], 1
    for forms in by_function.values():
        switches = dict.fromkeys(
            f for form in forms for p in form.parameters if not p.aside for f in p.fields if f in forms[0].sees
        )
        acts.append(Act(forms[0], tuple(switches), first))
        first += forms[0].memory
    return tuple(acts), first


@lru_cache(maxsize=8)
def stepper_of(effects: tuple[type[Effect], ...], *, is_compiled: bool = True) -> Stepper:
    """The stepper for some effects; for none, linear servos alone.

    It is compiled, and the machine code kept in the user's cache folder; without a compiler, or where `is_compiled` is
    false, it is plain Python with the same numbers.

    Raises
    ------
    ConfigError
        If what an effect does cannot be compiled.
    """
    off = fields_of(effects)
    acts, memory = _acts_of(effects)
    fields = tuple(off)
    text = text_of(acts, off)
    module = _module(text) if is_compiled else _executed(text)
    return Stepper(fields, np.array([off[f] for f in fields]), acts, memory, module.run)


def check(effect: type[Effect]) -> None:
    """Refuse an effect that cannot be simulated, in one sentence.

    Raises
    ------
    ConfigError
        If its source cannot be compiled, or it does not return finite numbers at its typical size.
    """
    acts, _ = _acts_of([effect])
    for act in acts:
        source = _function(0, act)
        space: dict[str, Any] = {"math": math}
        sizes = {f: p.neutral + p.typical for p in effect.parameters for f in p.fields}
        now = Now(1.0, 1e-3, 1.0, 1.0, 0.05, 1.0, 0.0, 300.0, 5.0, 1.0, 0.1, 0.0)
        try:
            exec(source, space)  # noqa: S102 - the user asked for this effect
            result = space["act_0"](1.0, now, *(sizes[f] for f in effect.sees), *([0.0] * effect.memory))
        except Exception as error:
            raise ConfigError(f"effect {effect.name}: act: {type(error).__name__}: {error}") from None
        made = result if isinstance(result, tuple) else (result,)
        if len(made) != 1 + effect.memory or not all(isinstance(v, int | float) and math.isfinite(v) for v in made):
            what = f"{1 + effect.memory} finite numbers" if effect.memory else "a finite number"
            raise ConfigError(f"effect {effect.name}: act must return {what}, not {result!r}")


def text_of(acts: Sequence[Act], off: Mapping[str, float]) -> str:
    """Source of the stepper with the functions of its slots.

    Examples
    --------
    >>> "def run(" in text_of((), {})
    True
    """
    source = resources.files("servofd.servo").joinpath("stepper.py").read_text(encoding="utf-8")
    before, rest = source.split(_BEGIN)
    _, after = rest.split(_END)
    fields = list(off)
    where = {name: fields.index(field) if field in fields else -1 for name, field in (("GAIN", "gain"), ("BIAS", "bias_deg"))}
    before = before.replace(_SEEN_FROM_OUTSIDE, "\n".join(f"{name} = {k}" for name, k in where.items()))
    slots = "\n\n".join([*(_function(n, act) for n, act in enumerate(acts)), *(_slot(s, acts, off) for s in STEPPED)])
    slots += "\n\n" + _rest(acts, off)
    names = [*(f"act_{n}" for n in range(len(acts))), *(slot.name.lower() for slot in STEPPED), "rest"]
    header = "from logparsers.compiled import compile_steps\n"
    before = before.replace("from servofd.core.types", header + "from servofd.core.types")
    for name in names:
        slots = slots.replace(f"def {name}(", f"@compile_steps(kind='inlined')\ndef {name}(")
    for name, kind in _COMPILED.items():
        after = after.replace(f"\ndef {name}(", f"\n@compile_steps(kind={kind!r})\ndef {name}(")
    return f"{before}{slots}\n{after}"


def _function(number: int, act: Act) -> str:
    """Source of what an effect does, by its number."""
    function, name = act.effect.act, act.effect.name
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))  # type: ignore[arg-type]
    except (OSError, TypeError, SyntaxError):
        raise ConfigError(f"effect {name}: the source of its act cannot be read; define it in a file") from None
    define = tree.body[0]
    if not isinstance(define, ast.FunctionDef):
        raise ConfigError(f"effect {name}: act must be a function, a static method of its class")
    define.name, define.decorator_list, define.returns = f"act_{number}", [], None
    for argument in define.args.args:
        argument.annotation = None
    local = {n.id for n in ast.walk(define) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    local |= {argument.arg for argument in define.args.args}
    given = getattr(function, "__globals__", {})
    constants = []
    for used in sorted({n.id for n in ast.walk(define) if isinstance(n, ast.Name)} - local):
        if used in ("math", "abs", "min", "max", "int", "float", "bool", "range", "round"):
            continue
        value = given.get(used)
        if not isinstance(value, int | float):
            raise ConfigError(f"effect {name}: act may use math and numbers of its module, not {used}")
        constants.append(f"{used}_{number} = {value!r}")
        for node in ast.walk(define):
            if isinstance(node, ast.Name) and node.id == used:
                node.id = f"{used}_{number}"
    return "\n".join([*constants, ast.unparse(define)]) + "\n"


def _number(value: float) -> str:
    return repr(value) if math.isfinite(value) else "math.inf" if value > 0.0 else "-math.inf"


def _called(number: int, act: Act, off: Mapping[str, float]) -> tuple[str, str, str]:
    """Condition under which an effect acts, what its function is given, and where its memory goes."""
    effect, fields = act.effect, list(off)
    where = " or ".join(f"p[v, {fields.index(f)}] != {_number(off[f])}" for f in act.switches)
    kept = [f"m[v, {act.first + k}]" for k in range(effect.memory)]
    given = ", ".join(["x", "now", *(f"p[v, {fields.index(f)}]" for f in effect.sees), *kept])
    return where, f"act_{number}({given})", ", ".join(["x", *kept])


def _slot(slot: Slot, acts: Sequence[Act], off: Mapping[str, float]) -> str:
    """Source of a slot: all its effects one after the other."""
    lines = [f"def {slot.name.lower()}(x, now, p, v, m):"]
    for number, act in enumerate(acts):
        if act.effect.slot is slot:
            where, call, into = _called(number, act, off)
            lines += [f"    if {where}:", f"        {into} = {call}"]
    return "\n".join([*lines, "    return x", ""])


def _rest(acts: Sequence[Act], off: Mapping[str, float]) -> str:
    """Source of what rests: every memory, and the reading of a shaft at rest."""
    lines = ["def rest(x, u, now, p, v, m):"]
    for number, act in enumerate(acts):
        effect = act.effect
        if effect.slot not in (Slot.COMMAND, Slot.OUTPUT):
            continue
        passes = "u" if effect.slot is Slot.COMMAND else "x"
        lines += [f"    m[v, {act.first + k}] = {passes if k == 0 else '0.0'}" for k in range(effect.memory)]
        if effect.slot is Slot.OUTPUT and not effect.memory:
            where, call, into = _called(number, act, off)
            lines += [f"    if {where}:", f"        {into} = {call}"]
    return "\n".join([*lines, "    m[v, 0] = x", ""])


def _executed(text: str) -> Any:  # noqa: ANN401 - a module
    """The text as plain Python."""
    module = type(sys)("servofd_stepper")
    plain = text.replace("from logparsers.compiled import compile_steps\n", "")
    lines = [line for line in plain.split("\n") if not line.startswith("@compile_steps")]
    exec(compile("\n".join(lines), "<stepper>", "exec"), module.__dict__)  # noqa: S102 - our own text
    return module


def _module(text: str) -> Any:  # noqa: ANN401 - a module
    """The text as a module in the cache folder, beside which the compiler keeps what it made."""
    name = f"servofd_stepper_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    path = _written(compiler.cache_folder(), name, text)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        return _executed(text)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def _written(folder: Path, name: str, text: str) -> Path:
    """The file of a module, in the cache folder or, where nothing can be written there, in one that goes."""
    for place in (folder, Path(tempfile.gettempdir()) / f"servofd-{os.getuid() if hasattr(os, 'getuid') else 0}"):
        path = place / f"{name}.py"
        try:
            if path.is_file() and path.read_text(encoding="utf-8") == text:
                return path
            place.mkdir(parents=True, exist_ok=True)
            part = path.with_suffix(f".{os.getpid()}")
            part.write_text(text, encoding="utf-8")
            part.replace(path)
        except OSError:
            continue
        return path
    raise ConfigError(f"no folder to write to, tried {folder}; say one with XDG_CACHE_HOME")

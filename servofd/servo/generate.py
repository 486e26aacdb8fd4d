"""From the classes of effects to the compiled stepper: which sizes a servo has, and what is compiled.

The functions of the slots are written from the classes, together with the text of `servofd.servo.stepper`, into one
module in the user's cache folder, where the compiler keeps its machine code beside it. A new effect is a new text.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import math
import os
import subprocess
import sys
import tempfile
import textwrap
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from logparsers import compiled as compiler
from servofd.core.errors import ConfigError
from servofd.servo.effect import Effect, Now, Slot
from servofd.servo.effects.commands import Commands
from servofd.servo.registry import fields_of

STEPPED = (Slot.COMMAND, Slot.ERROR, Slot.LOAD, Slot.GRIP, Slot.SPEED, Slot.STOP, Slot.OUTPUT, Slot.READING)
"""Slots whose effects are compiled, in their order."""
INSIDE_LOOP = STEPPED[:6]
"""Slots in which an effect changes what drives the loop, so that steps must be short."""
_BEGIN, _END = "# Slots begin here.\n", "# Slots end here.\n"
_STATES = "x.shape[1] // 3"
"""How the stepper counts the states of a servo."""


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

    off: Mapping[str, float]
    """Size of each field of a servo without effects, in the order of the stepper's sizes."""
    acts: tuple[Act, ...]
    memory: int
    run: Callable[..., int]


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
        switches = dict.fromkeys(f for form in forms for f in form.switches if f in forms[0].sees)
        acts.append(Act(forms[0], tuple(switches), first))
        first += forms[0].memory
    return tuple(acts), first


@lru_cache(maxsize=8)
def stepper_of(effects: tuple[type[Effect], ...], *, any_order: bool = False, is_compiled: bool = True) -> Stepper:
    """The stepper for some effects, and servos of three states or of any number.

    It is compiled, and the machine code kept in the user's cache folder; without a compiler, or where `is_compiled` is
    false, it is plain Python with the same numbers.

    Raises `ConfigError` if what an effect does cannot be compiled.
    """
    off = fields_of(effects)
    acts, memory = _acts_of(effects)
    with _ONE_AT_A_TIME:
        text = text_of(acts, off, any_order=any_order)
        module = _module(text) if is_compiled else _executed(text)
    return Stepper(off, acts, memory, module.run)


def check(effect: type[Effect]) -> None:
    """Refuse an effect that cannot be simulated, in one sentence.

    Raises `ConfigError` if its source cannot be compiled, or it does not return finite numbers at its typical size; of
    one that acts on the commands, if it does not take and return their times, values and slopes.
    """
    sizes = {f: p.neutral + p.typical for p in effect.parameters for f in p.fields}
    if effect.slot is Slot.EVENTS and effect.act is not None:
        commands = Commands(np.array([0.0, 0.02, 0.04]), np.array([0.0, 1.0, 1.0]), np.zeros(3))
        try:
            time_s, command_deg, slope_deg_s = effect.act(commands, *(sizes[f] for f in effect.sees))
            columns = np.stack([time_s, command_deg, slope_deg_s])
        except Exception as error:
            raise ConfigError(
                f"effect {effect.name}: act takes the commands (times, values, slopes; arrays) and its parameters, and "
                f"returns such commands: {type(error).__name__}: {error}"
            ) from None
        if not np.isfinite(columns).all():
            raise ConfigError(f"effect {effect.name}: act must return finite commands, not {columns.tolist()!r}")
    for act in _acts_of([effect])[0]:
        source = _Source.of(act, 0)
        space: dict[str, Any] = {"math": math}
        now = Now(1e-3, 1.0, 1.0, 0.05, 1.0, 0.0, 300.0, 5.0, 1.0, 0.1, 0.0, 1e-3, 1.0)
        try:
            exec(_text((*source.called, source.tree)), space)  # noqa: S102 - the user asked for this effect
            result = space["act_0"](1.0, now, *(sizes[f] for f in effect.sees), *([0.0] * effect.memory))
        except Exception as error:
            raise ConfigError(f"effect {effect.name}: act: {type(error).__name__}: {error}") from None
        made = result if isinstance(result, tuple) else (result,)
        if len(made) != 1 + effect.memory or not all(isinstance(v, int | float) and math.isfinite(v) for v in made):
            what = f"{1 + effect.memory} finite numbers" if effect.memory else "a finite number"
            raise ConfigError(f"effect {effect.name}: act must return {what}, not {result!r}")


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """What an effect does, as text."""

    act: Act
    tree: ast.FunctionDef
    """Its names are those of no other effect."""
    called: tuple[ast.FunctionDef, ...]
    """Functions of its module that it calls."""

    @classmethod
    def of(cls, act: Act, number: int) -> _Source:
        name, given = act.effect.name, getattr(act.effect.act, "__globals__", {})
        define = _parsed(act.effect.act, name)
        if len(define.args.args) != 2 + len(act.effect.sees) + act.effect.memory:
            expected = ", ".join(["x", "now", *act.effect.sees, *["memory"] * act.effect.memory])
            raise ConfigError(f"effect {name}: act is called with ({expected})")
        own = {n.id: given.get(n.id) for n in ast.walk(define) if isinstance(n, ast.Name)}
        called = [_parsed(each, name) for each in own.values() if isinstance(each, FunctionType)]
        names = {each.name: f"{each.name}_{number}" for each in called}
        # The value that passes and the step keep their names in every slot.
        passes = dict(zip([argument.arg for argument in define.args.args], ("x", "now"), strict=False))
        for each, known in (*((each, {}) for each in called), (define, names | passes)):
            each.name = names.get(each.name, f"act_{number}")
            local = {n.id for n in ast.walk(each) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
            local |= {argument.arg for argument in each.args.args}
            _Renamed({**{name: f"{name}_{number}" for name in local}, **known}, given, name).visit(each)
        return cls(act, define, tuple(called))

    @property
    def is_plain(self) -> bool:
        """Whether it returns at its end alone, and can stand where it is called: a function takes 0.1 s to compile."""
        returns = [node for node in ast.walk(self.tree) if isinstance(node, ast.Return)]
        return len(returns) == 1 and self.tree.body[-1] is returns[0]

    def lines(self, off: Mapping[str, float]) -> list[str]:
        """Where it acts: its condition, and what becomes of the value that passes and of its memory."""
        effect, fields = self.act.effect, list(off)
        where = " or ".join(f"p[v, {fields.index(f)}] != {_number(off[f])}" for f in self.act.switches)
        kept = [f"m[v, {self.act.first + k}]" for k in range(effect.memory)]
        given = ["x", "now", *(f"p[v, {fields.index(f)}]" for f in effect.sees), *kept]
        into = ", ".join(["x", *kept])
        if not self.is_plain:
            return [f"    if {where}:", f"        {into} = {self.tree.name}({', '.join(given)})"]
        names = [argument.arg for argument in self.tree.args.args]
        taken = [f"{name} = {value}" for name, value in zip(names, given, strict=True) if name != value]
        result = _text(self.tree.body).removesuffix("\n").rpartition("return ")
        inside = textwrap.indent("\n".join([*taken, f"{result[0]}{into} = {result[2]}"]), 8 * " ")
        return [f"    if {where}:", inside]


def _text(nodes: Sequence[ast.stmt]) -> str:
    return "".join(ast.unparse(each) + "\n" for each in nodes)


def _parsed(function: Any, effect: str) -> ast.FunctionDef:  # noqa: ANN401 - what a user wrote
    """Syntax of a function, without what is no step of it."""
    try:
        define = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    except (OSError, TypeError, SyntaxError):
        raise ConfigError(f"effect {effect}: the source of its act cannot be read; define it in a file") from None
    if not isinstance(define, ast.FunctionDef):
        raise ConfigError(f"effect {effect}: act must be a function, a static method of its class")
    define.decorator_list, define.returns = [], None
    for argument in define.args.args:
        argument.annotation = None
    if ast.get_docstring(define) is not None:
        del define.body[0]
    return define


_BUILT_IN = ("math", "abs", "min", "max", "int", "float", "bool", "range", "round")


class _Renamed(ast.NodeTransformer):
    """Give the names of a function others, and put in the numbers of its module."""

    def __init__(self, names: Mapping[str, str], given: Mapping[str, Any], effect: str) -> None:
        self._names, self._given, self._effect = names, given, effect

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.arg = self._names.get(node.arg, node.arg)
        return node

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if node.id in self._names:
            return ast.Name(self._names[node.id], node.ctx)
        value = self._given.get(node.id)
        if node.id in _BUILT_IN:
            return node
        if not isinstance(value, int | float):
            what = "math, numbers and functions of its module"
            raise ConfigError(f"effect {self._effect}: act may use {what}, not {node.id}")
        return ast.Constant(value)


def text_of(acts: Sequence[Act], off: Mapping[str, float], *, any_order: bool = False) -> str:
    """Source of the stepper with the functions of its slots; for servos of three states, or of any number."""
    text = resources.files("servofd.servo").joinpath("stepper.py").read_text(encoding="utf-8")
    before, _, rest = text.partition(_BEGIN)
    after = rest.partition(_END)[2]
    if not any_order:
        after = after.replace(_STATES, "3")
    fields = list(off)
    seen = [
        f"{name} = {fields.index(field) if field in fields else -1}\n"
        for name, field in (("GAIN", "gain"), ("BIAS", "bias_deg"))
    ]
    sources = [_Source.of(act, number) for number, act in enumerate(acts)]
    functions = [_text([called]) for each in sources for called in each.called]
    functions += [_text([each.tree]) for each in sources if not each.is_plain]
    functions += [_slot(slot, sources, off) for slot in STEPPED]
    functions.append(_rest(sources, off))
    slots = "\n\n".join(f"@compile_steps(kind='inlined')\n{each}" for each in functions)
    return f"{before}{''.join(seen)}\n\n{slots}\n{after}"


def _number(value: float) -> str:
    return repr(value) if math.isfinite(value) else "math.inf" if value > 0.0 else "-math.inf"


def _slot(slot: Slot, sources: Sequence[_Source], off: Mapping[str, float]) -> str:
    """Source of a slot: all its effects one after the other."""
    lines = [line for each in sources if each.act.effect.slot is slot for line in each.lines(off)]
    return "\n".join([f"def {slot.name.lower()}(x, now, p, v, m):", *lines, "    return x", ""])


def _rest(sources: Sequence[_Source], off: Mapping[str, float]) -> str:
    """Source of what rests: every memory, and the deflection of a shaft at rest."""
    lines = ["def rest(x, u, now, p, v, m):"]
    for each in sources:
        effect = each.act.effect
        passes = {Slot.COMMAND: "u", Slot.OUTPUT: "x"}.get(effect.slot, "0.0")
        lines += [f"    m[v, {each.act.first + k}] = {passes if k == 0 else '0.0'}" for k in range(effect.memory)]
        if effect.slot is Slot.OUTPUT and not effect.memory:
            lines += each.lines(off)
    return "\n".join([*lines, "    m[v, 0] = x", ""])


def _executed(text: str) -> ModuleType:
    """The text as plain Python."""
    module = ModuleType("servofd_stepper")
    lines = [line for line in text.split("\n") if "compile_steps" not in line]
    exec(compile("\n".join(lines), "<stepper>", "exec"), module.__dict__)  # noqa: S102 - our own text
    return module


def path_of(effects: tuple[type[Effect], ...]) -> Path | None:
    """File of the stepper for some effects; None where nothing is compiled."""
    if not compiler.has_compiler():
        return None
    return _written(text_of(_acts_of(effects)[0], fields_of(effects)))


def is_kept(path: Path) -> bool:
    """Whether machine code of a stepper is kept that this processor and this compiler made."""
    try:
        return path.with_suffix(".kept").read_text(encoding="utf-8") == compiler.made_by()
    except (OSError, UnicodeDecodeError):
        return False


def mark_kept(path: Path) -> None:
    """Note that it is."""
    with suppress(OSError):
        path.with_suffix(".kept").write_text(compiler.made_by(), encoding="utf-8")


compiling: list[subprocess.Popen[bytes]] = []
"""Processes that compile ahead; the first that needs the stepper waits for them."""
_ONE_AT_A_TIME = threading.Lock()
"""Surfaces are judged in threads of their own, and more than one may be the first to need a stepper; Python 3.11 cannot
parse the source of effects in two threads at once (SystemError: AST constructor recursion depth mismatch)."""


def _module(text: str) -> ModuleType:
    """The text as a module in the cache folder, beside which the compiler keeps what it made."""
    for process in compiling:
        process.wait()
    path = _written(text)
    if path.stem not in sys.modules:
        module = ModuleType(path.stem)
        SourceFileLoader(path.stem, str(path)).exec_module(module)
        sys.modules[path.stem] = module
    return sys.modules[path.stem]


def _written(text: str) -> Path:
    """The file of a module, in the cache folder or, where nothing can be written there, in one that goes."""
    name = f"servofd_stepper_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    folder = compiler.cache_folder()
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

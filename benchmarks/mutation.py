"""Do the tests notice a wrong sign? ``python benchmarks/mutation.py FOLDER [--mutants N] [--seed S]``.

Changes one comparison, one operator or one number of the package at a time, in a copy of the checkout, and runs the
tests that execute the changed line, quickest first, until one fails. A mutant that none of them notices has survived.
The mutants are drawn at random from all that can be made; the score is the share that is noticed. Error messages, type
hints and docstrings are left alone. A mutant that makes a test last a minute and ten times as long as in the sound
program is noticed as well, and told apart; one that cannot be judged in ten minutes counts as not noticed.

A mutant is bytecode in place of that of the sound file: the file itself stays, and so does what numba has compiled of
it, which would otherwise be compiled anew and spend the time that a test is given.

A changed function that numba compiles is run uncompiled, and so is every compiled caller, which would go on using the
sound one; everything else stays compiled. To compile the position loop anew for each mutant would take 30 s of
processor time; 26 tests of all its effects take 5 s uncompiled. Tests that are too slow (2 s, uncompiled and traced)
are left out. Needs ``pip install coverage``, and the kernels at hand: run the fast tests once before.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib.util
import itertools
import marshal
import os
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from types import FrameType

    import pytest
    from coverage import Coverage

ROOT = Path(__file__).resolve().parent.parent
KERNEL_TESTS = (
    "tests/laws/test_bench_physics.py",
    "tests/laws/test_servo.py",
    "tests/laws/test_stepper.py",
    "tests/laws/test_observe.py",
    "tests/laws/test_residual.py",
    "tests/golden/test_golden.py",
    "tests/recovery/test_extended.py",
    "tests/recovery/test_fine.py",
)
COMPILED_TESTS = (
    "tests/laws/test_faults.py",
    "tests/laws/test_residual.py",
    "tests/golden/test_golden.py",
    "tests/detection",
)
TESTS = (
    "tests/detection",
    "tests/laws",
    "tests/golden",
    "tests/recovery/test_explain.py",
    "tests/recovery/test_extended.py",
    "tests/recovery/test_fine.py",
    "tests/recovery/test_hidden_physics.py",
    "tests/recovery/test_separate.py",
    "tests/cli/test_naming.py",
    "tests/replay/test_extending.py",
)
SLOWEST_S, LEAST_LIMIT_S, PATIENCE = 2.0, 60.0, 10.0
MOST_S = 600
"""Of processor time for all tests of a mutant."""
MOST_BYTES = 4 << 30
"""A mutant that fills the memory would take the machine along."""
DECORATORS = {"njit", "compiled", "inlined"}
COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}

VERDICTS = {0: "SURVIVED", 1: "noticed ", -signal.SIGVTALRM: "noticed , never ended", -signal.SIGXCPU: "UNDECIDED"}


class Mutant(NamedTuple):
    """One change of one file."""

    path: str
    number: int
    line: int
    what: str
    compiled: bool


def changed(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """What a node may be changed to."""
    match node:
        case ast.Compare(ops=[op]) if type(op) in COMPARISONS:
            other = copy.deepcopy(node)
            other.ops = [COMPARISONS[type(op)]()]
            yield f"{ast.unparse(node)} -> {ast.unparse(other)}", other
        case ast.BinOp(op=op) if type(op) in OPERATORS:
            turned = ast.BinOp(node.left, OPERATORS[type(op)](), node.right)
            yield f"{ast.unparse(node)} -> {ast.unparse(turned)}", turned
        case ast.BoolOp(op=op, values=values):
            swapped = ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
            yield f"{ast.unparse(node)} -> {ast.unparse(swapped)}", swapped
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield f"{ast.unparse(node)} -> {ast.unparse(operand)}", operand
        case ast.Constant(value=bool(value)):
            yield f"{value} -> {not value}", ast.Constant(not value)
        case ast.Constant(value=int(value) | float(value)):
            more = value + 1 if isinstance(value, int) else 2.0 * value if value else 1.0
            yield f"{value} -> {more}", ast.Constant(more)


def sites(tree: ast.AST) -> Iterator[tuple[ast.AST, str, Any, ast.AST]]:
    """Every node of code with its parent and place; no annotation, decorator or message."""
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns", "decorator_list", "type_params", "exc"):
            continue
        for key, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            if isinstance(child, ast.Assign) and DECORATORS & {ast.unparse(target) for target in child.targets}:
                continue
            yield tree, name, key, child
            yield from sites(child)


def name_of(decorator: ast.expr) -> str:
    """Without its options."""
    return ast.unparse(decorator.func if isinstance(decorator, ast.Call) else decorator)


def compiled_lines(tree: ast.Module) -> set[int]:
    """Lines of a file that numba compiles; the constants that it compiles in are among them."""
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    theirs = [node for node in functions if DECORATORS & {name_of(decorator) for decorator in node.decorator_list}]
    constants = [node for node in tree.body if isinstance(node, ast.Assign)] if theirs else []
    return {line for node in [*theirs, *constants] for line in range(node.lineno, (node.end_lineno or 0) + 1)}


def altered(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and kind of one change after the other; until the next is asked for, the tree is changed."""

    def put(parent: ast.AST, name: str, key: int | None, node: ast.AST) -> None:
        if key is None:
            setattr(parent, name, node)
        else:
            getattr(parent, name)[key] = node

    for parent, name, key, child in sites(tree):
        for what, other in changed(child):
            put(parent, name, key, other)
            yield child.lineno, what if len(what) < 90 else f"{what[:87]}..."  # type: ignore[attr-defined]
            put(parent, name, key, child)


def mutants(path: Path) -> list[Mutant]:
    """All that can be made of a file."""
    tree, where = ast.parse(path.read_text()), path.relative_to(ROOT).as_posix()
    compiled = compiled_lines(tree)
    return [Mutant(where, k, line, what, line in compiled) for k, (line, what) in enumerate(altered(tree))]


def bytecode_of(mutant: Mutant) -> bytes:
    """Of the whole file, as Python keeps it, with the stamp of the sound one."""
    path = Path(mutant.path)
    tree, stat = ast.parse(path.read_text()), path.stat()
    next(itertools.islice(altered(tree), mutant.number, None))
    code = compile(ast.fix_missing_locations(tree), str(path.resolve()), "exec")
    stamp = struct.pack("<III", 0, int(stat.st_mtime) & 0xFFFFFFFF, stat.st_size & 0xFFFFFFFF)
    return importlib.util.MAGIC_NUMBER + stamp + marshal.dumps(code)


def module_of(path: str) -> str:
    """As it is imported."""
    return path.removesuffix(".py").replace("/", ".")


def callers(path: str) -> set[str]:
    """The module of a file, and the compiled ones that take something from it, or from one that does."""
    files = {module_of(file.relative_to(ROOT).as_posix()): file for file in (ROOT / "servofd").rglob("*.py")}
    texts = {name: file.read_text() for name, file in files.items()}
    texts = {name: text for name, text in texts.items() if any(f"@{word}" in text for word in DECORATORS)}
    found, new = set[str](), {module_of(path)}
    while new:
        found |= new
        new = {name for name, text in texts.items() if any(f"from {one} import" in text for one in new)} - found
    return found


def leave_uncompiled(is_plain: Callable[[str], bool]) -> None:
    """What numba is to compile in some modules stays Python; nothing of these may have been imported yet."""
    import numba

    njit = numba.njit

    def chosen(*functions: Callable[..., object], **options: object) -> object:
        if not functions:
            return lambda function: chosen(function, **options)
        return functions[0] if is_plain(functions[0].__module__) else njit(**options)(functions[0])

    numba.njit = chosen


def forget() -> None:
    """What a test has left in a cache would be run by that test alone."""
    modules = [module for name, module in sys.modules.items() if name.startswith("servofd.")]
    for kept in [value for module in modules for value in vars(module).values() if hasattr(value, "cache_clear")]:
        kept.cache_clear()


class Tests:
    """Measures each test, or runs them in order of what they take."""

    def __init__(self, taken_s: dict[str, float], told: Path, coverage: Coverage | None = None) -> None:
        self.taken_s, self.told, self.coverage = taken_s, told, coverage
        self.failed: set[str] = set()

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """The quickest first; those that noticed something before are the sooner tried again."""
        before = self.told.read_text().splitlines() if self.told.exists() else []
        items.sort(key=lambda item: self.taken_s.get(item.nodeid, 0.0) / (1 + before.count(item.nodeid)) ** 2)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Lines that run from here on are run by this test."""
        if self.coverage:
            forget()
            self.begun_s = time.process_time()
            self.coverage.switch_context(nodeid)
            signal.setitimer(signal.ITIMER_VIRTUAL, SLOWEST_S)
        else:  # the end of the process, if nobody handles it
            signal.setitimer(signal.ITIMER_VIRTUAL, max(LEAST_LIMIT_S, PATIENCE * self.taken_s.get(nodeid, 0.0)))

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """Note the time."""
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        if self.coverage:
            self.taken_s[nodeid] = time.process_time() - self.begun_s

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A test that fails on the sound program proves nothing."""
        if not report.passed:
            self.failed.add(report.nodeid)


def pytest_run(arguments: list[str], plugin: Tests) -> int:
    """In this process; failures are not shrunk, only noticed."""
    import hypothesis
    import pytest

    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    hypothesis.settings.register_profile("plain", phases=phases, report_multiple_bugs=False, database=None)
    hypothesis.settings.load_profile("plain")
    plain = ["-o", "addopts=--import-mode=importlib --doctest-modules", "-p", "no:cacheprovider", "-m", "not slow"]
    plain += ["--assert=plain"]  # else pytest makes its own bytecode of modules with doctests, from the sound file
    plain += ["-W", "ignore::RuntimeWarning"]  # compiled code would not tell of an overflow
    return int(pytest.main([*plain, "-q", "--tb=no", "--no-header", *arguments], plugins=[plugin]))


def silenced() -> None:
    """The output of tests is of no interest."""
    with Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)


def too_slow(_: int, frame: FrameType | None) -> None:
    """Break off a test; a moment later if coverage is at work, which would never give its lock back."""
    if frame and "coverage" in Path(frame.f_code.co_filename).parts:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.01)
        return
    raise TimeoutError


def measured(folders: list[str], tests: tuple[str, ...], lines: Path, plain: bool) -> dict[str, float]:
    """Processor time of each test that passes [s], maybe uncompiled; which lines it runs goes to a file."""
    import coverage

    reader, writer = os.pipe()
    if os.fork() == 0:
        silenced()
        if plain:
            leave_uncompiled(lambda name: name.startswith(tuple(module_of(folder) for folder in folders)))
        signal.signal(signal.SIGVTALRM, too_slow)
        cover = coverage.Coverage(data_file=str(lines), source=folders, config_file=False)
        cover.start()
        plugin = Tests({}, lines.with_name("told"), cover)
        pytest_run([*tests, *folders], plugin)
        cover.stop()
        cover.save()
        with os.fdopen(writer, "w") as out:
            sound = {name: taken_s for name, taken_s in plugin.taken_s.items() if name not in plugin.failed}
            out.writelines(f"{taken_s}\t{name}\n" for name, taken_s in sound.items())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as inp:
        rows = [row.rstrip("\n").split("\t") for row in inp]
    os.wait()
    return {name: float(taken_s) for taken_s, name in rows}


def verdict(mutant: Mutant, tests: list[str], taken_s: dict[str, float], told: Path) -> str:
    """Whether a test fails, or the program hangs; which test it was is told to those that come after."""
    kept = Path(importlib.util.cache_from_source(str(Path(mutant.path).resolve())))
    kept.parent.mkdir(exist_ok=True)
    kept.write_bytes(bytecode_of(mutant))
    try:
        if (child := os.fork()) == 0:
            silenced()
            resource.setrlimit(resource.RLIMIT_CPU, (MOST_S, MOST_S + 1))
            resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, MOST_BYTES))
            if mutant.compiled:
                leave_uncompiled(callers(mutant.path).__contains__)
            plugin = Tests(taken_s, told)
            code = pytest_run(["-x", *tests], plugin)
            with told.open("a") as out:
                out.writelines(f"{name}\n" for name in plugin.failed)
            os._exit(int(code != 0))
        return VERDICTS.get(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), "noticed , crashed")
    finally:
        kept.unlink()


def imports(test: str, module: str) -> bool:
    """Whether the file of a test takes something from a module, at the first level of its code."""
    return f"\nfrom {module} import" in Path(test.split("::", maxsplit=1)[0]).read_text()


def judged(folders: list[str], chosen: list[Mutant], tests: tuple[str, ...], lines: Path) -> None:
    """Print a line for each mutant."""
    import coverage

    taken_s, told = measured(folders, tests, lines, chosen[0].compiled), lines.with_name("told")
    print(f"{len(taken_s)} tests take {sum(taken_s.values()):.0f} s of processor time", flush=True)
    data = coverage.CoverageData(str(lines))
    data.read()
    for mutant in chosen:
        contexts = data.contexts_by_lineno(str(Path(mutant.path).resolve()))
        here = {test for test in contexts.get(mutant.line, []) if test in taken_s}
        # What runs while modules are imported belongs to no test: then all that run anything of the file, or name it.
        there = here or {test for those in contexts.values() for test in those if test in taken_s}
        if not here:
            there |= {test for test in taken_s if imports(test, module_of(mutant.path))}
        begun_s = os.times().children_user
        found = verdict(mutant, sorted(there), taken_s, told) if there else "SURVIVED, no test runs it:"
        spent = f"[{len(there)} tests, {os.times().children_user - begun_s:.0f} s]"
        print(f"{found} {mutant.path}:{mutant.line} {mutant.what} {spent}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+")
    parser.add_argument("--mutants", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--compiled", choices=("yes", "no"), help="only what numba compiles, or only what it does not")
    parser.add_argument("--tests", nargs="+", help="only these: sooner measured, and what is noticed is a lower bound")
    parser.add_argument("--inside", choices=("yes", "no"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    files = [path for folder in options.folders for path in sorted((ROOT / folder).rglob("*.py"))]
    every = [mutant for path in files for mutant in mutants(path)]
    if options.compiled:
        every = [mutant for mutant in every if mutant.compiled == (options.compiled == "yes")]
    chosen = random.Random(options.seed).sample(every, min(options.mutants, len(every)))  # noqa: S311
    if options.inside is None:
        print(f"{len(chosen)} of {len(every)} mutants of {' '.join(options.folders)}, seed {options.seed}", flush=True)
        noticed_, total = 0, 0
        for mode in ("no", "yes"):
            with tempfile.TemporaryDirectory() as folder:
                checkout = Path(folder) / "checkout"
                shutil.copytree(ROOT, checkout, ignore=shutil.ignore_patterns(".git", ".venv", "out"))
                environment = os.environ | {"PYTHONPATH": str(checkout)}
                environment.pop("PYTHONDONTWRITEBYTECODE", None)  # every mutant imports the same tests
                command = [sys.executable, str(checkout / "benchmarks" / "mutation.py"), *sys.argv[1:]]
                with subprocess.Popen(
                    [*command, "--inside", mode], cwd=checkout, env=environment, stdout=subprocess.PIPE, text=True
                ) as process:
                    for line in process.stdout or ():
                        print(line, end="", flush=True)
                        total += line.startswith(("noticed", "SURVIVED", "UNDECIDED"))
                        noticed_ += line.startswith("noticed")
                if process.returncode:
                    sys.exit(process.returncode)
        print(f"noticed {noticed_} of {total}: {noticed_ / max(total, 1):.0%}")
        return
    mine = [mutant for mutant in chosen if mutant.compiled == (options.inside == "yes")]
    if mine:
        # What a mutant cannot reach is imported once for all.
        import hypothesis.extra.numpy  # noqa: F401
        import numba  # noqa: F401
        import pandas as pd  # noqa: F401
        import pytest  # noqa: F401
        import scipy.optimize
        import scipy.signal
        import scipy.stats  # noqa: F401

        compiled = KERNEL_TESTS if any("models" in folder for folder in options.folders) else COMPILED_TESTS
        tests = options.tests or (compiled if options.inside == "yes" else TESTS)
        judged(options.folders, mine, tuple(tests), ROOT.parent / "lines")


if __name__ == "__main__":
    main()

"""Arrows point one way, and the public names are what they claim to be."""

from __future__ import annotations

import ast
import functools
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MODULES = sorted([*ROOT.glob("servofd/**/*.py"), *ROOT.glob("logparsers/**/*.py")])

ONLY_IN = {
    "rerun": {
        "servofd/outputs/live_recording.py",
        *(f"servofd/outputs/recording/{name}.py" for name in ("layout", "read", "stream")),
    },
    "matplotlib": {
        "servofd/outputs/figure.py",
        *(f"servofd/results/{name}.py" for name in ("audits", "models", "shown")),
    },
    "jinja2": {"servofd/outputs/page.py", "servofd/onboard/script.py"},
    "argparse": {"servofd/cli/options.py"},
    "numba": {"logparsers/compiled.py"},
    "pymavlink": {"logparsers/codec.py", "logparsers/mavlink.py"},
    "serial": {"logparsers/link.py"},
    "h5py": {"logparsers/hdf5.py"},
    "control": {"servofd/servo/transfer.py"},
    "starlette": {f"servofd/serve/{name}.py" for name in ("app", "guard")},
    "uvicorn": {"servofd/serve/guard.py"},
}


@functools.cache
def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def name_of(path: Path) -> str:
    return relative(path).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@functools.cache
def arrows() -> dict[str, set[str]]:
    """Which modules each imports, for its types as well; the lists of public names are left out."""
    modules = {name_of(path): path for path in MODULES if name_of(path) not in ("servofd", "logparsers")}
    found: dict[str, set[str]] = {}
    for name, path in modules.items():
        used = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                used |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                used |= {each if each in modules else node.module for each in inner}
        found[name] = used & set(modules) - {name}
    return found


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of nodes that reach each other."""
    reach = {node: set(to) for node, to in graph.items()}
    for middle, beyond in reach.items():
        for reached in reach.values():
            if middle in reached:
                reached.update(beyond)
    groups = {
        frozenset(other for other in reach[node] if node in reach[other]) for node in graph if node in reach[node]
    }
    return sorted(sorted(group) for group in groups)


def test_circles_are_seen() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == [["b", "c"]]


@pytest.mark.slow
def test_imports_point_one_way() -> None:
    assert not [
        name
        for name, used in arrows().items()
        if name.startswith("logparsers") and any(u.startswith("servofd") for u in used)
    ]
    assert circles(arrows()) == []


def test_rooms_stand_on_those_that_are_named_before_them() -> None:
    """The list in docs/architecture.md is the order of the rooms, and holds each of them."""
    listed = (ROOT / "docs" / "architecture.md").read_text().split("no arrow runs back:")[1].split("\n- ")[0]
    floors = [set(re.findall(r"`([a-z_]+)`", floor)) for floor in re.split(r"\n\d\. ", listed)[1:]]
    height = {room: k for k, floor in enumerate(floors) for room in floor}
    rooms: dict[str, set[str]] = {}
    for name, used in arrows().items():
        rooms.setdefault(room_of(name), set()).update(map(room_of, used))
    assert set(rooms) - {"__main__", "version"} <= set(height)
    assert circles({room: used - {room} for room, used in rooms.items()}) == []
    back = {
        (room, u)
        for room, used in rooms.items()
        for u in used & set(height) - {room}
        if height.get(room, 99) < height[u]
    }
    assert back == set()


def test_the_house_has_at_most_ten_floors() -> None:
    rooms: dict[str, set[str]] = {}
    for name, used in arrows().items():
        rooms.setdefault(room_of(name), set()).update({room_of(one) for one in used} - {room_of(name)})

    @functools.cache
    def floor(room: str) -> int:
        return 1 + max((floor(under) for under in rooms.get(room, ())), default=0)

    assert floor("cli") <= 10


def room_of(module: str) -> str:
    package, _, rest = module.partition(".")
    return package if package == "logparsers" else rest.partition(".")[0]


@pytest.mark.slow
@pytest.mark.parametrize("package", ONLY_IN)
def test_heavy_packages_have_one_home(package: str) -> None:
    users = {relative(path) for path in MODULES if package in {name.split(".")[0] for name in imports(path)}}
    assert users == ONLY_IN[package]


@pytest.mark.slow
def test_every_module_can_be_imported_and_has_what_it_lists() -> None:
    pytest.importorskip("starlette")  # an extra
    for path in MODULES:
        module = importlib.import_module(name_of(path))
        assert all(getattr(module, name, None) is not None for name in getattr(module, "__all__", ())), path


def test_servofd_exports_what_it_lists() -> None:
    import servofd

    assert set(servofd.__all__) <= set(dir(servofd))
    for name in servofd.__all__:
        assert getattr(servofd, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        servofd.nonsense  # noqa: B018


def test_import_and_help_load_no_heavy_package() -> None:
    """Half a second is the promise; what would break it is one of these."""
    heavy = (
        "numba",
        "scipy",
        "pandas",
        "matplotlib",
        "rerun",
        "control",
        "pydantic",
        "rich",
        "h5py",
        "pymavlink",
        "serial",
        "shtab",
    )
    code = (
        "import sys, servofd, servofd.cli; servofd.cli.build_parser().format_help();"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_a_monitor_loads_nothing_of_scipy() -> None:
    """It takes a while to load, for little. The bare package is there for numba."""
    heavy = ("scipy.fft", "scipy.linalg", "scipy.special", "scipy.signal", "scipy.optimize", "scipy.stats")
    code = f"import sys, servofd.cli.monitor; print([name for name in {heavy!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"

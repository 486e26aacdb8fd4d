"""Arrows point one way, files stay small, and the public names are what they claim to be."""

from __future__ import annotations

import ast
import functools
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MODULES = sorted([*ROOT.glob("servofd/**/*.py"), *ROOT.glob("logparsers/**/*.py")])

# Who may import which part of servofd; a part may always import itself.
PARTS = {
    "errors": set(),
    "types": set(),
    "tolerance": set(),
    "limits": set(),
    "models": {"errors", "types", "servos"},
    "servos": {"errors", "types", "models", "toml_text"},
    "calibration": {"errors", "types"},
    "aircraft": {"errors", "types", "models", "servos", "calibration", "tolerance", "limits", "toml_text"},
    "frozen": {"types"},
    "segment": {"errors", "types", "aircraft", "frozen", "models"},
    "feedback": {"errors", "types", "aircraft", "servos", "models", "segment", "detection", "toml_text"},
    "toml_text": {"errors"},
    "calibrating": {
        "errors",
        "types",
        "aircraft",
        "servos",
        "models",
        "segment",
        "detection",
        "tolerance",
        "toml_text",
    },
    "sweep": {"errors", "types", "aircraft", "models", "segment", "detection", "tolerance"},
    "survey": {"errors", "aircraft", "segment", "feedback", "workflow"},
    "odds": {"errors", "types", "aircraft", "detection", "segment"},
    "detection": {"errors", "types", "models", "servos", "aircraft", "segment", "tolerance"},
    "simulation": {"errors", "types", "models", "calibration", "aircraft", "outputs"},
    "identification": {"errors", "types", "models", "servos", "segment"},
    "discrepancy": {"errors", "types", "models", "segment", "detection"},
    "explaining": {
        "errors",
        "types",
        "aircraft",
        "bench",
        "models",
        "servos",
        "segment",
        "detection",
        "discrepancy",
        "workflow",
    },
    "bench": {"errors", "types", "aircraft", "segment", "identification", "workflow"},
    "outputs": {
        "errors",
        "types",
        "aircraft",
        "calibration",
        "models",
        "detection",
        "segment",
        "identification",
        "discrepancy",
        "sweep",
        "odds",
        "toml_text",
    },
    "fleet": {"errors", "aircraft", "servos", "detection", "workflow", "outputs"},
    "trend": {
        "errors",
        "types",
        "aircraft",
        "models",
        "segment",
        "detection",
        "calibrating",
        "workflow",
        "fleet",
    },
    "review": {"errors", "types", "detection", "outputs"},
    "live": {"errors", "types", "aircraft", "detection"},
    "workflow": {"errors", "aircraft", "servos", "detection", "feedback", "segment", "calibrating"},
    "cli": {
        "errors",
        "types",
        "live",
        "aircraft",
        "servos",
        "models",
        "detection",
        "simulation",
        "outputs",
        "workflow",
        "feedback",
        "survey",
        "odds",
        "calibrating",
        "sweep",
        "identification",
        "bench",
        "explaining",
        "fleet",
        "review",
        "trend",
    },
}
ONLY_IN = {
    "rerun": {
        "servofd/outputs/live_recording.py",
        *(
            f"servofd/outputs/recording/{name}.py"
            for name in ("clock", "layout", "read", "scene", "stream", "views", "write")
        ),
    },
    "matplotlib": {
        "servofd/outputs/figure.py",
        "servofd/outputs/audit_figures.py",
        "servofd/outputs/explain_figures.py",
        "servofd/outputs/identify_figures.py",
        "servofd/outputs/odds_figure.py",
        "servofd/outputs/picture.py",
        "servofd/outputs/trend_page.py",
        "servofd/cli/design.py",
    },
    "jinja2": {"servofd/outputs/page.py"},
    "argparse": {
        f"servofd/cli/{name}.py"
        for name in (
            "__init__",
            "audit",
            "audit_fleet",
            "calibrate",
            "completion",
            "config",
            "design",
            "explain",
            "fleet",
            "identify",
            "importer",
            "info",
            "manual",
            "monitor",
            "monitor_outputs",
            "odds",
            "review",
            "servos",
            "simulate",
            "stream",
            "sweep",
            "trend",
            "view",
        )
    },
    "numba": {
        "servofd/models/state.py",
        "servofd/models/play.py",
        "servofd/detection/probability/cusum.py",
        "servofd/detection/starts.py",
        "servofd/detection/bank/altered.py",
        "servofd/models/loop_steps.py",
        "servofd/models/position_loop.py",
        "logparsers/compiled.py",
    },
    "pymavlink": {"logparsers/codec.py", "logparsers/mavlink.py"},
    "serial": {"logparsers/link.py"},
    "shtab": {"servofd/cli/completion.py"},
    "pyulog": {"logparsers/ulog/bounded.py"},
    "h5py": {"logparsers/hdf5.py"},
    "control": {"servofd/models/transfer.py"},
    "distributed": {"servofd/fleet/cluster.py"},
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


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_imports_point_one_way(path: Path) -> None:
    parts = relative(path).removesuffix(".py").split("/")
    used = imports(path)
    if parts[0] == "logparsers":
        assert not {name for name in used if name.split(".")[0] == "servofd"}
        return
    part = parts[1]
    if part in ("__init__", "__main__"):
        return
    own = {name.split(".")[1] for name in used if name.startswith("servofd.")}
    assert own <= PARTS[part] | {part}, f"{part} may not import {own - PARTS[part] - {part}}"


def test_the_page_on_architecture_tells_the_same() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    table = page.partition("| part | may import |\n|---|---|\n")[2].partition("\n\n")[0]
    rows = [f"| `{part}` | {', '.join(f'`{name}`' for name in sorted(PARTS[part])) or 'nothing'} |" for part in PARTS]
    assert table.splitlines() == rows, "replace the table by\n" + "\n".join(rows)


@pytest.mark.parametrize("package", ONLY_IN)
def test_heavy_packages_have_one_home(package: str) -> None:
    users = {relative(path) for path in MODULES if package in {name.split(".")[0] for name in imports(path)}}
    assert users == ONLY_IN[package]


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_files_stay_small(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400


@pytest.mark.parametrize("path", MODULES, ids=relative)
def test_every_public_name_exists_and_is_documented(path: Path) -> None:
    module = importlib.import_module(relative(path).removesuffix(".py").removesuffix("/__init__").replace("/", "."))
    assert module.__doc__
    for name in getattr(module, "__all__", ()):
        thing = getattr(module, name)
        if callable(thing) and getattr(thing, "__module__", "").startswith(("servofd", "logparsers")):
            assert thing.__doc__, f"{name} has no docstring"


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
        "pyulog",
        "serial",
        "shtab",
    )
    code = (
        "import sys, servofd, servofd.cli; servofd.cli.build_parser().format_help();"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"

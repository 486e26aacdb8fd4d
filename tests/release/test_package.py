"""What a stranger gets: the wheel and the source archive hold what they must, and start in an empty environment."""

from __future__ import annotations

import json
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import servofd

ROOT = Path(__file__).parent.parent.parent
DATA = {
    "servofd/py.typed",
    "logparsers/py.typed",
    "servofd/servo/library.toml",
    *(f"servofd/configs/{path.name}" for path in ROOT.glob("configs/*.toml")),
    *(path.relative_to(ROOT).as_posix() for path in ROOT.glob("servofd/outputs/templates/*")),
}


def test_the_version_is_written_once() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["hatch"]["version"]["path"] == "servofd/version.py"
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is not None
    assert cited[1] == servofd.__version__


def test_every_python_that_is_named_is_tried() -> None:
    """The lowest one by the whole tests, the others by the wheel."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    tried = re.search(r"^for version in (.+); do$", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    assert tried is not None
    assert named == [project["requires-python"].removeprefix(">="), *tried[1].split()]
    assert named[-1] == "3.14"


def test_the_container_is_small_its_own_user_and_made_of_what_is_there() -> None:
    """What a linter asks: a slim base, sources that exist, no cache of packages, no root, words instead of a shell."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    steps = [(word, rest) for word, _, rest in (line.partition(" ") for line in lines)]
    bases = [rest for word, rest in steps if word == "FROM"]
    assert all(re.match(r"python:3\.\d+-slim( AS \w+)?$", base) for base in bases)
    sources = [name for word, rest in steps if word == "COPY" and "--from" not in rest for name in rest.split()[:-1]]
    assert sources
    assert all((ROOT / name).exists() for name in sources)
    assert all("--no-cache-dir" in rest for word, rest in steps if word == "RUN" and "pip install" in rest)
    last = steps[max(at for at, (word, _) in enumerate(steps) if word == "FROM") :]
    assert next(rest for word, rest in last if word == "USER") != "root"
    assert all(isinstance(json.loads(rest), list) for word, rest in last if word in ("ENTRYPOINT", "CMD"))
    assert {word for word, _ in steps} <= {
        "FROM",
        "WORKDIR",
        "COPY",
        "RUN",
        "ENV",
        "USER",
        "EXPOSE",
        "ENTRYPOINT",
        "CMD",
    }


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd")
def test_the_service_of_a_companion_passes_the_lint_of_systemd(tmp_path: Path) -> None:
    """With a program that exists in place of the installed one: systemd asks for that, too."""
    text = (ROOT / "examples" / "servofd-monitor.service").read_text(encoding="utf-8")
    assert "/opt/servofd/bin/servofd monitor" in text
    unit = tmp_path / "servofd-monitor.service"
    unit.write_text(text.replace("/opt/servofd/bin/servofd", sys.executable), encoding="utf-8")
    analyze = shutil.which("systemd-analyze")
    assert analyze is not None
    done = subprocess.run([analyze, "verify", str(unit)], capture_output=True, text=True, timeout=60, check=False)
    assert "servofd-monitor" not in done.stderr, done.stderr


def test_every_lowest_version_is_given() -> None:
    """`pip install` on an old machine upgrades what is too old instead of failing later."""
    for needed in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]:
        assert re.search(r">=\d", needed), needed


CHECK = ROOT / ".ci" / "dependencies.py"


@pytest.mark.skipif(not CHECK.exists(), reason="a source archive does not hold it")
@pytest.mark.parametrize(
    ("entries", "code", "told"),
    [
        ([{"skip_reason": "not found"}], 0, "not checked"),  # pip-audit itself says: no known vulnerabilities
        ([{"version": "1.0", "vulns": []}], 0, "1 of 1 checked"),
        ([{"version": "1.0", "vulns": [{"id": "CVE-1", "fix_versions": ["1.1"]}]}], 1, "repaired in 1.1"),
        ([{"version": "1.0", "vulns": [{"id": "CVE-1", "fix_versions": []}]}], 0, "no release yet"),
    ],
)
def test_vulnerabilities_fail_only_if_they_are_known_and_repaired(
    entries: list[dict[str, object]], code: int, told: str
) -> None:
    found, lines = runpy.run_path(str(CHECK))["verdict"]({"dependencies": [{"name": "a"} | each for each in entries]})
    assert found == code
    assert told in "\n".join(lines)


def built(source: Path, kind: str, target: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(target)]
    subprocess.run(command, cwd=source, capture_output=True, check=True)
    (path,) = target.iterdir()
    return path


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Source archive, and the wheel that is built from it, as `pip` does where it finds no wheel."""
    folder = tmp_path_factory.mktemp("release")
    source = built(ROOT, "sdist", folder / "sdist")
    with tarfile.open(source) as archive:
        archive.extractall(folder, filter="data")
    return source, built(folder / source.name.removesuffix(".tar.gz"), "wheel", folder / "wheel")


@pytest.mark.slow
def test_the_wheel_holds_code_types_and_data_and_nothing_else(archives: tuple[Path, Path], tmp_path: Path) -> None:
    names = set(zipfile.ZipFile(archives[1]).namelist())
    assert names >= DATA
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"servofd", "logparsers"}
    assert not any(re.search(r"tests|benchmarks|sample_logs|\.pyc$", name) for name in names)
    code = {
        path.relative_to(ROOT).as_posix() for part in ("servofd", "logparsers") for path in ROOT.glob(f"{part}/**/*.py")
    }
    assert {name for name in names if name.endswith(".py")} == code
    assert set(zipfile.ZipFile(built(ROOT, "wheel", tmp_path / "direct")).namelist()) == names


@pytest.mark.slow
def test_the_source_archive_holds_what_its_tests_need(archives: tuple[Path, Path]) -> None:
    with tarfile.open(archives[0]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "tests/conftest.py", "docs/index.md"} <= names
    assert not any(name.startswith((".ci", "out/", ".venv")) or name.endswith(".pyc") for name in names)


@pytest.mark.nightly
def test_the_wheel_starts_in_an_empty_environment(archives: tuple[Path, Path], tmp_path: Path) -> None:
    """No dependency is there: importing, help and version need none."""
    venv.create(tmp_path / "venv", with_pip=True)
    programs = tmp_path / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
    install = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-index", str(archives[1])]
    subprocess.run([programs / "python", *install], check=True)
    for words, expected in (
        (["--version"], f"servofd {servofd.__version__}"),
        (["audit", "--help"], "--threshold-deg"),
    ):
        run = subprocess.run(
            [programs / "servofd", *words], cwd=tmp_path, env={}, capture_output=True, text=True, check=True
        )
        assert expected in run.stdout


@pytest.mark.nightly
def test_the_wheel_audits_with_all_it_depends_on(archives: tuple[Path, Path], tmp_path: Path) -> None:
    """Away from the checkout, with the shipped aircraft files and templates of the wheel itself."""
    with zipfile.ZipFile(archives[1]) as wheel:
        wheel.extractall(tmp_path / "site")  # noqa: S202 - our own
    log = ROOT / "sample_logs" / "faser_stuck_flight.mat"
    code = "import sys, servofd.cli; print(servofd.__file__); sys.exit(servofd.cli.main(sys.argv[1:]))"
    run = subprocess.run(
        [sys.executable, "-c", code, "audit", str(log), "-c", "faser", "--html", str(tmp_path / "page.html")],
        cwd=tmp_path / "site",
        env={"PYTHONPATH": str(tmp_path / "site"), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 1, run.stderr
    assert run.stdout.startswith(str(tmp_path / "site"))
    assert "stuck" in run.stdout
    assert (tmp_path / "page.html").stat().st_size > 10_000

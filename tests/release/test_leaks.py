"""What is done again and again in one process leaves open files, threads and memory as they were."""

from __future__ import annotations

import gc
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from servofd.batch.find import find_logs
from servofd.batch.key import Job
from servofd.cli import main
from servofd.fleets.run import audit_fleet
from tests.fuzz.seeds import drafted
from tests.live.vehicles import free_port, plane_file

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are counted in /proc")

SAMPLES = Path(__file__).resolve().parents[2] / "sample_logs"
AGAIN = 3
LEFT_BYTES = 40_000
"""By one turn; a log that stays in memory is ten times that. Caches that fill slowly take a few kilobytes."""


def open_files() -> set[str]:
    return {f"{fd.name} {fd.readlink()}" for fd in Path("/proc/self/fd").iterdir() if fd.is_symlink()}


def leaves_nothing(work: Callable[[], object]) -> None:
    """Do it twice to warm up, then again and again."""
    work()
    work()
    gc.collect()
    files, threads = open_files(), threading.active_count()
    tracemalloc.start()
    try:
        work()
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(AGAIN):
            work()
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert open_files() == files
    assert threading.active_count() == threads
    assert grown < AGAIN * LEFT_BYTES, f"{grown / AGAIN:.0f} bytes are left by each turn"


@pytest.fixture
def flight(tmp_path: Path) -> Callable[[str], str]:
    """Write a short flight of a format."""

    def write(suffix: str) -> str:
        path = tmp_path / f"flight{suffix}"
        assert main(["simulate", "-o", str(path), "--duration", "10", "--fault", "elevator:stuck@4"]) == 0
        return str(path)

    return write


@pytest.mark.nightly
@pytest.mark.parametrize("suffix", [".csv", ".mat", ".bin", ".tlog", ".ulg"])
def test_audits(suffix: str, flight: Callable[[str], str]) -> None:
    path = Path(flight(suffix))
    words = ["audit", str(path), "--json", "-"]
    if suffix in (".tlog", ".ulg"):  # a file of the aircraft; without one, as for .bin, it is fitted each time
        plane = path.with_name("plane.toml")
        plane.write_bytes(drafted(path.read_bytes()))
        words += ["-c", str(plane)]
    leaves_nothing(lambda: main(words))


@pytest.mark.nightly
def test_refusals(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mat"
    broken.write_bytes((SAMPLES / "faser_stuck_flight.mat").read_bytes()[:5000])
    leaves_nothing(lambda: main(["audit", str(broken)]))


@pytest.mark.nightly
def test_recordings_written_and_read(flight: Callable[[str], str], tmp_path: Path) -> None:
    path, recording = flight(".csv"), str(tmp_path / "flight.rrd")

    def turn() -> None:
        assert main(["audit", path, "-s", "elevator", "--rrd", recording, "--html", str(tmp_path / "page.html")]) == 1
        assert main(["review", recording]) == 1

    leaves_nothing(turn)


@pytest.mark.nightly
def test_monitors_of_logs(flight: Callable[[str], str], tmp_path: Path) -> None:
    path, plane = flight(".tlog"), tmp_path / "plane.toml"
    plane.write_text(plane_file())
    leaves_nothing(lambda: main(["monitor", path, "-c", str(plane), "--speed", "0", "--plain", "--no-alert"]))


@pytest.mark.nightly
def test_monitors_of_links(tmp_path: Path) -> None:
    plane = tmp_path / "plane.toml"
    plane.write_text(plane_file())
    words = ["-c", str(plane), "--duration", "0.1", "--plain", "--tlog", str(tmp_path / "kept.tlog")]
    leaves_nothing(lambda: main(["monitor", f"udpin:127.0.0.1:{free_port()}", *words]))


@pytest.mark.nightly
def test_fleets_in_processes() -> None:
    logs = find_logs([str(SAMPLES / "faser_*_chirp.mat")]).logs
    leaves_nothing(lambda: list(audit_fleet(logs[:1], Job(), workers=1)))


@pytest.mark.nightly
def test_fleets_kept_in_a_folder(flight: Callable[[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "servofd.fleets.run.run_local", lambda task, items, _workers: ((item, task(item)) for item in items)
    )
    path = flight(".csv")
    leaves_nothing(lambda: main(["audit", path, "--workers", "1", "-o", str(tmp_path / "results")]))

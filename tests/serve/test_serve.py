"""The local page: what is dropped on it is judged, whatever it is, and nobody else gets in."""

from __future__ import annotations

import gzip
import json
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPMessage
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlencode

import numpy as np
import pandas as pd
import pytest

from logparsers import EmptyLog
from servofd.batch.key import Job
from servofd.core.files import make_folder
from servofd.serve.flights import RESULTS, Flight, Flights, TooLarge, Upload
from servofd.serve.judge import SUMMARY, Summary, judge, kept

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
STUCK = SAMPLES / "faser_stuck_flight.mat"
LARGEST = 10_000_000


def one_surface() -> bytes:
    """The rudder of the sample table alone, which is judged three times as fast."""
    return pd.read_csv(SAMPLES / "table_three_faults.csv")[["time_s", "rudder_cmd_deg", "rudder_pos_deg"]].to_csv(
        index=False
    ).encode()  # fmt: skip


@contextmanager
def flights_of(folder: Path, *, most_bytes: int = LARGEST, apart: bool = False) -> Iterator[Flights]:
    """Flights of a folder, judged by a thread that knows servofd already; apart, by a process, as the program does."""
    with pytest.MonkeyPatch.context() as patch:
        if not apart:
            patch.setattr("servofd.serve.flights.processes", ThreadPoolExecutor)
        with Flights(folder, Job(), most_bytes=most_bytes, workers=1) as flights:
            yield flights


@dataclass
class Answer:
    status: int
    headers: HTTPMessage
    content: bytes

    @property
    def text(self) -> str:
        return self.content.decode()

    def json(self) -> Any:
        return json.loads(self.content)


class Client:
    """Asks a page on this machine, as a browser does."""

    def __init__(self, port: int) -> None:
        self.port = port

    def ask(self, method: str, path: str, content: bytes | Iterable[bytes] | None = None, **headers: str) -> Answer:
        connection = HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request(method, path, content, headers)
        answer = connection.getresponse()
        found = Answer(answer.status, answer.headers, answer.read())
        connection.close()
        return found

    def get(self, path: str, **headers: str) -> Answer:
        return self.ask("GET", path, None, **headers)

    def put(self, path: str, content: bytes | Iterable[bytes], **headers: str) -> Answer:
        return self.ask("PUT", path, content, **headers)


@contextmanager
def client_of(flights: Flights) -> Iterator[Client]:
    """The page itself, served by a thread."""
    import uvicorn

    from servofd.serve.app import application

    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = uvicorn.Server(uvicorn.Config(application(flights), log_level="critical", lifespan="off"))
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        try:
            yield Client(listening.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join()


def taken(upload: Upload) -> Flight:
    flight, _ = upload.finish()
    assert flight is not None
    return flight


def uploads(folder: Path) -> list[Path]:
    """What is on its way."""
    return list((folder / RESULTS).glob(".upload-*"))


def until(known: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60.0
    while not known():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def done(flights: Flights, flight_id: str) -> Flight:
    deadline = time.monotonic() + 120.0
    while (flight := flights.get(flight_id)) is None or flight.state != "done":
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return flight


@pytest.mark.slow
def test_a_dropped_log_gets_its_verdict_page_json_and_recording(tmp_path: Path) -> None:
    with flights_of(tmp_path / "club", apart=True) as flights, client_of(flights) as client:
        answer = client.put("/flights?name=../../my%20flight.mat", STUCK.read_bytes())
        assert answer.status == 201
        taken = answer.json()
        assert (taken["name"], taken["state"]) == ("my_flight.mat", "waiting")
        assert (tmp_path / "club" / "my_flight.mat").read_bytes() == STUCK.read_bytes()
        assert done(flights, taken["id"]).summary is not None
        (row,) = client.get("/flights").json()
        assert (row["status"], row["sentence"]) == ("fault", "ELEVATOR JAMMED at 0:05 (-0.2 deg). Do not fly.")
        assert not (tmp_path / "club" / "servofd" / taken["id"] / "progress.txt").exists()
        place = f"/flights/{taken['id']}"
        page = client.get(f"{place}/page.html")
        assert "ELEVATOR JAMMED" in page.text
        document = client.get(f"{place}/audit.json").json()
        assert document["logs"][0]["surfaces"]["elevator"]["status"] == "fault"
        assert client.get(f"{place}/recording.rrd").content[:3] == b"RRF"
        assert "Look at it in Rerun" in client.get(place).text
        for text in (page.text, json.dumps(document), client.get("/").text, client.get("/flights").text):
            assert str(tmp_path) not in text
        again = client.put("/flights?name=copy.mat", STUCK.read_bytes()).json()
        assert (again["id"], again["state"], again["name"]) == (taken["id"], "done", "my_flight.mat")
    # A new start knows it, and judges nothing twice.
    with flights_of(tmp_path / "club") as flights:
        deadline = time.monotonic() + 60.0
        while not flights.all():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert [flight.state for flight in flights.all()] == ["done"]


@pytest.mark.slow
def test_what_is_not_a_log_says_so_and_tells_no_folder(tmp_path: Path) -> None:
    for name, content, says in (
        ("empty.bin", b"", "Not a log: the file is empty (0 bytes); was the log copied completely?"),
        ("shopping.txt", b"milk\neggs\nbread 2 pieces\n", "Not a log: text that begins with “milk”, and not a table"),
        ("names.csv", b"name,age\nJo,x\n", "Not a log: text that begins with “name,age”"),
        ("picture.png", b"\x89PNG\r\n\x1a\n0000", "Not a log: it is a PNG image"),
        ("<img src=x onerror=alert(1)>.csv", b"\x00\xff" * 400, "Not a log: its first bytes"),
    ):
        log = tmp_path / name
        log.write_bytes(content)
        summary = judge(str(log), str(tmp_path / "results"), Job())
        assert summary.status == "not_a_log"
        assert summary.sentence.startswith(says)
        page = (tmp_path / "results" / "page.html").read_text()
        assert "<img" not in page
        assert str(tmp_path) not in page + (tmp_path / "results" / "audit.json").read_text() + summary.sentence
        assert kept(Summary, tmp_path / "results" / SUMMARY) == summary


def test_a_log_of_another_name_is_never_written_over(tmp_path: Path) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST)
    for k in range(3):
        upload = flights.upload("flight.csv", 0)
        upload.write(b"%d" % k)
        upload.finish()
    contents = {path.name: path.read_text() for path in tmp_path.glob("*.csv")}
    assert contents == {"flight.csv": "0", "flight~2.csv": "1", "flight~3.csv": "2"}
    assert not list((tmp_path / RESULTS).glob(".upload-*"))


def test_what_is_too_large_is_refused_before_and_while_it_comes(tmp_path: Path) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=1000)
    with client_of(flights) as client:
        for content in (b"x" * 1001, iter([b"x" * 600, b"x" * 600])):
            answer = client.put("/flights?name=large.bin", content)
            assert answer.status == 413
            assert answer.json() == {"error": "large.bin: larger than 0 MB, which this page takes"}
    with pytest.raises(TooLarge, match="no room"):
        Flights(tmp_path, Job(), most_bytes=10**20).upload("large.bin", 10**19)
    assert flights.all() == []
    assert [path.name for path in (tmp_path / RESULTS).iterdir()] == ["fleet.json"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/flights/../../etc/passwd", 404),
        ("/flights/%2e%2e", 404),
        ("/flights/" + 32 * "0", 404),
        ("/flights/" + 32 * "0" + "/page.html", 404),
        ("/viewer/../../pyproject.toml", 404),
        ("/viewer/%2e%2e%2f%2e%2e%2fpyproject.toml", 404),
        ("/compare?flight=a&flight=b", 404),
        ("/nothing", 404),
    ],
)
def test_no_path_leads_out(path: str, status: int, tmp_path: Path) -> None:
    with client_of(Flights(tmp_path, Job(), most_bytes=1)) as client:
        answer = client.get(path)
    assert answer.status == status
    assert "Traceback" not in answer.text
    assert str(tmp_path) not in answer.text


def test_an_error_of_the_page_shows_no_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=1)
    monkeypatch.setattr(Flights, "all", lambda _: 1 / 0)
    with client_of(flights) as client:
        answer = client.get("/")
    assert answer.status == 500
    assert "ZeroDivision" not in answer.text
    assert "This did not work" in answer.text


@pytest.mark.slow
def test_other_sites_get_nothing(tmp_path: Path) -> None:
    with client_of(Flights(tmp_path, Job(), most_bytes=LARGEST)) as client:
        assert client.get("/").status == 200
        for host in (
            "evil.example:8787",
            "localhost:x@evil.example",
            "localhost:1@evil.example",
            "127.0.0.1.evil.example",
        ):
            assert client.get("/", Host=host).status == 421
        assert client.get("/", Origin="http://evil.example").status == 403
        assert client.put("/flights?name=a.csv", b"x", Origin="http://evil.example").status == 403
        assert client.get("/", Host="localhost:1", Origin="http://localhost:1").status == 200
        policy = client.get("/").headers["content-security-policy"]
    assert "default-src 'self'" in policy
    assert "http" not in policy


@pytest.mark.slow
def test_what_is_at_work_says_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST, workers=1)  # whose processes were not begun
    upload = flights.upload("long.csv", 0)
    upload.write(b"time_s\n")
    flight = taken(upload)
    told: list[str] = []

    def audit(*_: object, progress: Callable[[str], None], **__: object) -> list[Any]:
        with client_of(flights) as client:
            for surface in ("", "aileron_left", "rudder"):
                if surface:
                    progress(surface)
                told.append(client.get("/flights").json()[0]["sentence"])
                assert told[-1] in client.get(f"/flights/{flight.id}").text
        raise EmptyLog("no rows")

    flights._set(flight.id, "at work", None)
    monkeypatch.setattr("servofd.jobs.workflow.audit", audit)
    judge(str(flight.log), str(flights.results(flight.id)), flights.job)
    assert told == ["Being read.", "Judged so far: aileron left.", "Judged so far: aileron left, rudder."]


@pytest.mark.slow
def test_a_flight_that_no_browser_could_show_gets_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servofd.serve.judge._MOST_RECORDED", 1000)
    folder = tmp_path / "servofd" / ("0" * 32)
    summary = judge(str(STUCK), str(folder), Job(surfaces=("elevator",)))
    assert summary.too_long
    assert not (folder / "recording.rrd").exists()
    assert kept(Summary, folder / SUMMARY) == summary


@pytest.mark.slow
def test_a_process_that_dies_takes_only_its_flight_with_it(tmp_path: Path) -> None:
    with flights_of(tmp_path, apart=True) as flights:
        upload = flights.upload("good.mat", 0)
        upload.write(STUCK.read_bytes())
        first = taken(upload)
        killer = threading.Thread(target=_kill_the_first_worker)
        killer.start()
        died = done(flights, first.id)
        killer.join()
        assert died.summary is not None
        assert "its process ended" in died.summary.sentence
        upload = flights.upload("next.csv", 0)
        upload.write(one_surface())
        after = done(flights, taken(upload).id)
        assert after.summary is not None
        assert after.summary.status == "fault"


def _kill_the_first_worker() -> None:
    import multiprocessing

    while not (workers := multiprocessing.active_children()):
        time.sleep(0.005)
    workers[0].kill()


@contextmanager
def running(folder: Path, *words: str) -> Iterator[str]:
    """The program itself, on a free port."""
    command = [sys.executable, "-m", "servofd", "serve", "--folder", str(folder), "--port", "0", "--no-open", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        link = re.match(r"(http://\S+)", process.stdout.readline())
        assert link is not None
        try:
            yield link[1]
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0


def ticked(do: str, *flights: str, **fields: str) -> bytes:
    return urlencode([("do", do), *(("flight", one) for one in flights), *fields.items()]).encode()


FORM = {"Content-Type": "application/x-www-form-urlencoded"}


def dropped(client: Client, log: Path, name: str = "") -> Any:
    return client.put(f"/flights?name={quote(name or log.name)}", log.read_bytes()).json()


@pytest.mark.slow
def test_every_file_that_is_dropped_is_a_row_or_a_notice(tmp_path: Path) -> None:
    """Twenty files of all kinds, twice; a server that is begun again shows the same rows."""
    few = b"\n".join(one_surface().splitlines()[:200])
    kinds = [b"", b"milk\neggs\n", b"\x89PNG\r\n\x1a\n", few, gzip.compress(b"", mtime=0), b"a,b\n1,2\n3,4\n"]
    files = {f"{k}.bin": kinds[k % 6] + (b"\n" * k if 0 < k % 6 < 4 else b"") for k in range(20)}
    with flights_of(tmp_path) as flights, client_of(flights) as client:
        notices = []
        for name, content in [*files.items(), *files.items()]:
            said = client.put(f"/flights?name={name}", content).json()
            notices += [said["notice"]] if said["notice"] else []
        rows = client.get("/flights").json()
        assert len(rows) + len(notices) == 40
        assert len(rows) == len(set(files.values()))
        assert "6.bin holds the same bytes as 0.bin, which is here already." in notices
        assert "1.bin is here already." in notices
        until(lambda: all(row["state"] == "done" for row in client.get("/flights").json()))
        rows = {row["name"]: row["status"] for row in client.get("/flights").json()}
        assert {rows[name] for name in ("0.bin", "1.bin", "2.bin", "4.bin")} == {"not_a_log"}
        assert rows["3.bin"] != "not_a_log"
        assert rows["5.bin"] == "unknown"  # a table, whose columns may be chosen
    with flights_of(tmp_path) as flights:
        until(lambda: len(flights.all()) == len(rows))
        assert {one.name: one.summary and one.summary.status for one in flights.all()} == rows


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ['a"b.csv', "a'b.csv", "../../etc/x.csv", "\\\\host\\x.csv", "🛩️.csv", "x" * 300 + ".csv", ".csv", "<b>.csv"]
)
def test_a_name_leads_nowhere_and_breaks_no_page(name: str, tmp_path: Path) -> None:
    flights = Flights(tmp_path / "club", Job(), most_bytes=LARGEST)
    with client_of(flights) as client:
        said = client.put(f"/flights?name={quote(name, safe='')}", b"time_s\n").json()
        text = client.get("/").text + client.get(f"/flights/{said['id']}").text
    assert (tmp_path / "club" / said["name"]).read_bytes() == b"time_s\n"
    assert {path.name for path in tmp_path.iterdir()} == {"club"}
    assert "<b>.csv" not in text


@pytest.mark.slow
def test_what_two_browsers_delete_is_in_the_bin_once(tmp_path: Path) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST)
    with client_of(flights) as client:
        for name in ("a.csv", "a.csv"):  # of another content, deleted before
            said = client.put(f"/flights?name={name}", f"{len(flights.all())}{time.monotonic_ns()}".encode()).json()
            first = client.ask("POST", "/do", ticked("delete", said["id"]), **FORM)
            second = client.ask("POST", "/do", ticked("delete", said["id"]), **FORM)
            assert "a.csv is in the bin (the folder servofd/bin)." in first.text
            assert "This flight is gone already." in second.text
            back = client.ask("POST", "/do", ticked("restore", said["id"]), **FORM)
            assert re.search(r"a(~2)?\.csv is in the list again\.", back.text)
            assert [one["id"] for one in client.get("/flights").json()] == [said["id"]]
            client.ask("POST", "/do", ticked("delete", said["id"]), **FORM)
        assert client.get("/flights").json() == []
        assert client.get(f"/flights/{said['id']}").status == 404
        assert client.ask("POST", "/do", ticked("delete"), **FORM).status == 400
    assert {path.name for path in (tmp_path / RESULTS / "bin").iterdir()} == {"a.csv", "a~2.csv"}
    assert list(tmp_path.glob("*.csv")) == []


def test_what_was_dropped_is_in_the_list_though_the_server_was_killed_before_it_was_judged(tmp_path: Path) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST)  # whose workers never begin
    with client_of(flights) as client:
        for name, content in (("notes.pdf", b"%PDF-1.4 x"), ("broken.toml", b"name ="), ("flight.csv", b"a,b\n1,2\n")):
            client.put(f"/flights?name={name}", content)
    with flights_of(tmp_path) as again:
        until(lambda: {one.name for one in again.all()} == {"notes.pdf", "broken.toml", "flight.csv"})


def test_what_a_killed_server_left_is_removed(tmp_path: Path) -> None:
    make_folder(tmp_path / RESULTS)
    (tmp_path / RESULTS / ".upload-1a2b").write_bytes(b"half of it")
    assert uploads(tmp_path)
    Flights(tmp_path, Job(), most_bytes=LARGEST)
    assert not uploads(tmp_path)


def test_a_disk_that_fills_is_said_and_leaves_nothing(tmp_path: Path) -> None:
    """The system lets no file grow any more."""
    resource = pytest.importorskip("resource")
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with client_of(flights) as client:
            answer = client.put("/flights?name=flight.bin", b"x" * 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert answer.status == 413
    assert answer.json()["error"].startswith("flight.bin: there is no room for it on the disk")
    assert not uploads(tmp_path)
    assert flights.all() == []


@pytest.mark.slow
def test_the_page_of_an_earlier_choice_is_not_shown_for_a_later_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "flight.csv"
    log.write_text("time_s,rudder_cmd_deg,rudder_pos_deg\n0,0,0\n1,1,1\n")
    judge(str(log), str(tmp_path / "results"), Job())
    assert (tmp_path / "results" / "page.html").is_file()

    def fails(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("servofd.serve.judge.judged", fails)
    with pytest.raises(ZeroDivisionError):
        judge(str(log), str(tmp_path / "results"), Job())
    assert not (tmp_path / "results" / "page.html").exists()


@pytest.mark.slow
def test_columns_and_aircraft_are_chosen_on_the_page(tmp_path: Path) -> None:
    table = one_surface().decode()
    renamed = table.replace("time_s", "clock").replace("rudder_cmd_deg", "u").replace("rudder_pos_deg", "y")
    lines = renamed.splitlines()
    (tmp_path / "mine.csv").write_text("\n".join([f"{lines[0]},note", *(f"{line},a" for line in lines[1:])]))
    (tmp_path / "plane.toml").write_text('servo = "hs225bb-eq31"\n')
    with flights_of(tmp_path / "club") as flights, client_of(flights) as client:
        row = dropped(client, tmp_path / "mine.csv")
        place, identity = f"/flights/{row['id']}", row["id"]
        flight = done(flights, identity)
        assert flight.summary is not None
        assert flight.summary.sentence.startswith("A table of numbers (clock,")
        assert '<select name="time">' in client.get(place).text
        fields = {"by": "columns", "time": "clock", "time_unit": "s", "surface0": "fin", "cmd0": "u", "pos0": "y"}
        assert client.ask("POST", f"{place}/choose", urlencode(fields).encode(), **FORM).status == 303
        flight = done(flights, identity)
        assert flight.summary is not None
        assert flight.summary.surfaces == ("fin",)
        assert "<option selected>clock</option>" in client.get(place).text
        for change, says in (
            ({"pos0": "u"}, "column &#39;u&#39; was chosen for two things"),
            ({"time": ""}, "choose the column of the time"),
            ({"pos0": "note"}, "column &#39;note&#39; holds no numbers"),
            ({"cmd0": ""}, "has a position and no command"),
            ({"pos0": ""}, "choose the position of fin as well"),
            ({"by": "aircraft", "aircraft": "../plane.toml"}, "there is no such aircraft file"),
        ):
            answer = client.ask("POST", f"{place}/choose", urlencode(fields | change).encode(), **FORM)
            assert answer.status == 400
            assert says in answer.text
    # A new start judges it by the same columns.
    with flights_of(tmp_path / "club") as flights:
        assert done(flights, identity).choice.columns["u"] == "fin_cmd_deg"


@pytest.mark.slow
def test_good_flights_are_calibrated_followed_and_explained_at_a_click(tmp_path: Path) -> None:
    from servofd.cli import main

    logs = [tmp_path / f"good{k}.csv" for k in range(2)]
    for k, log in enumerate(logs):
        assert main(["simulate", "-o", str(log), "--rate-hz", "50", "--duration", "40", "--seed", str(k)]) == 0
        flight = pd.read_csv(log)  # one surface shows it
        flight[["time_s", "elevator_cmd_deg", "elevator_pos_deg"]].to_csv(log, index=False)
    with flights_of(tmp_path / "club") as flights, client_of(flights) as client:

        def told(content: bytes) -> str:
            place = client.ask("POST", "/do", content, **FORM).headers["location"]
            until(lambda: (task := flights.task(place.rpartition("/")[2])) and task.state == "done")
            return client.get(place).text

        ids = [dropped(client, log)["id"] for log in logs]
        for one in ids:
            done(flights, one)
        place = f"/compare?flight={ids[0]}&flight={ids[1]}"
        together = client.get(f"{place}&at=5&at=7.5").text
        assert together.count('class="chart"') == 1
        assert {round(float(first)) for first in re.findall(r'data-first="(.*?)"', together)} <= {-8, -7}
        assert client.get(f"{place}&at=x&at=1").status == client.get(f"{place}&at=nan&at=1").status == 400
        assert client.ask("POST", "/do", ticked("trend", *ids), **FORM).status == 400
        assert "aircraft-1.toml" in told(ticked("calibrate", *ids))
        assert "aircraft-1.toml" in client.get("/").text
        trend = told(ticked("trend", *ids, aircraft="aircraft-1.toml"))
        assert "over its flights" in trend
        assert {f'<a href="/flights/{one}">' in trend for one in ids} == {True}
        explained = told(ticked("explain", ids[0], surface="elevator"))
        assert "What the model lacks" in explained
        assert "--save" not in explained
        alone = client.get(f"/flights/{ids[1]}").text  # the way back
        assert re.findall(r">(Calibration|Trend|Explanation) ", alone) == ["Trend", "Calibration"]
        fields = urlencode({"by": "aircraft", "aircraft": "aircraft-1.toml"}).encode()
        assert client.ask("POST", f"/flights/{ids[0]}/choose", fields, **FORM).status == 303
        done(flights, ids[0])
        document = json.loads((flights.results(ids[0]) / "audit.json").read_text())
        assert document["logs"][0]["surfaces"]["elevator"]["model"]["origin"] == "calibrated"
        again = flights.upload("mine.toml", 0)
        again.write((tmp_path / "club" / "aircraft-1.toml").read_bytes())
        assert again.finish() == (None, "mine.toml is an aircraft file: choose it on the page of a flight.")
    with flights_of(tmp_path / "club") as flights:
        until(lambda: len(flights.tasks()) == 3)


@pytest.mark.slow
def test_two_flights_lie_over_each_other_from_their_take_offs_on(tmp_path: Path) -> None:
    """One taxies for 8 s, the other for 20 s; both fly for 40 s."""
    with flights_of(tmp_path / "club") as flights, client_of(flights) as client:
        ids = []
        for taxis_s in (8.0, 20.0):
            time_s = np.arange(0.0, taxis_s + 40.0, 0.02)
            command_deg = 8.0 * np.sin(1.3 * time_s) + 4.0 * np.sign(np.sin(0.7 * time_s))
            position_deg = np.interp(time_s - 0.05, time_s, command_deg) + 0.05 * np.sin(40.0 * time_s)
            airspeed_m_s = np.where(time_s < taxis_s, 3.0, 18.0) + np.sin(time_s)
            log = tmp_path / f"taxis_{taxis_s:.0f}.csv"
            columns = np.column_stack([time_s, command_deg, position_deg, airspeed_m_s])
            header = "time_s,rudder_cmd_deg,rudder_pos_deg,airspeed_m_s"
            np.savetxt(log, columns, "%.4f", ",", header=header, comments="")
            ids.append(dropped(client, log)["id"])
        for one in ids:
            done(flights, one)
        document = json.loads((flights.results(ids[1]) / "audit.json").read_text())
        assert document["logs"][0]["take_off_s"] == pytest.approx(20.0, abs=0.03)
        page = client.get(f"/compare?flight={ids[0]}&flight={ids[1]}").text
        assert re.findall(r'name="at" [^>]*value="(.*?)"', page) == ["8", "20"]
        (first,) = re.findall(r'data-first="(.*?)"', page)
        assert float(first) == pytest.approx(-20.0, abs=1.5)


@pytest.mark.slow
def test_the_list_is_searched_and_two_flights_are_asked_for(tmp_path: Path) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST)
    with client_of(flights) as client:
        for name in ("alpha.csv", "beta.csv"):
            client.put(f"/flights?name={name}", name.encode())
        found = client.get("/?q=ALPHA").text
        assert ("alpha.csv" in found, "beta.csv" in found) == (True, False)
        assert "1 more" in found
        assert "None of the 2 flights is like that" in client.get("/?q=zzz").text
        asks = client.get(f"/compare?flight={flights.all()[0].id}")
        assert (asks.status, "Which two flights?" in asks.text) == (200, True)


def asked(address: str, method: str = "GET", data: bytes | None = None) -> Any:
    request = urllib.request.Request(address, data, method=method)  # noqa: S310 - this machine's own
    with urllib.request.urlopen(request) as answer:  # noqa: S310
        return json.load(answer)


@pytest.mark.nightly
@pytest.mark.parametrize("each", [2, 100])
def test_two_users_with_many_logs_at_once_lose_nothing(each: int, tmp_path: Path) -> None:
    rows = (SAMPLES / "table_three_faults.csv").read_bytes().splitlines(keepends=True)
    table = b"".join(rows[:1200])
    with running(tmp_path) as link:
        sent: list[str] = []

        def user(name: str) -> None:
            for k in range(each):
                content = table + b"\n" * (k + 1) + (b"\n" * 200 if name == "a" else b"")
                sent.append(asked(f"{link}flights?name={name}{k}.csv", "PUT", content)["id"])

        users = [threading.Thread(target=user, args=(name,)) for name in "ab"]
        for one in users:
            one.start()
        for one in users:
            one.join()
        assert len(set(sent)) == 2 * each
        deadline = time.monotonic() + 60.0 + 5.0 * each
        seen = asked(f"{link}flights")
        while any(flight["state"] != "done" for flight in seen):
            assert time.monotonic() < deadline
            time.sleep(0.1)
            seen = asked(f"{link}flights")
        assert {flight["id"] for flight in seen} == set(sent)
        assert {flight["status"] for flight in seen} == {"fault"}


def test_an_upload_that_breaks_off_leaves_nothing(tmp_path: Path) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST)
    with client_of(flights) as client:
        with socket.create_connection(("127.0.0.1", client.port)) as line:
            head = f"PUT /flights?name=lost.csv HTTP/1.1\r\nHost: 127.0.0.1:{client.port}\r\nContent-Length: 100000"
            line.sendall(head.encode() + b"\r\n\r\n" + b"time_s\n" * 1000)
            until(lambda: uploads(tmp_path))
        until(lambda: not uploads(tmp_path))
        assert client.get("/flights").json() == []
        assert client.put("/flights?name=lost.csv", b"time_s\n").status == 201
    assert [path.name for path in tmp_path.glob("*.csv")] == ["lost.csv"]


@pytest.mark.slow
def test_a_second_user_gets_a_verdict_while_the_log_of_the_first_still_comes(tmp_path: Path) -> None:
    judged = threading.Event()
    rows = one_surface().splitlines(keepends=True)

    def slowly() -> Iterator[bytes]:
        yield from rows[:400]
        assert judged.wait(120.0)
        yield from rows[400:]

    with flights_of(tmp_path) as flights, client_of(flights) as client:
        answers: list[Answer] = []
        first = threading.Thread(target=lambda: answers.append(client.put("/flights?name=first.csv", slowly())))
        first.start()
        until(lambda: uploads(tmp_path))
        second = client.put("/flights?name=second.mat", STUCK.read_bytes()).json()
        summary = done(flights, second["id"]).summary
        assert summary is not None
        assert summary.status == "fault"
        assert uploads(tmp_path)
        judged.set()
        first.join()
        assert answers[0].status == 201
        # While the first is judged, the second reads its page.
        assert "ELEVATOR JAMMED" in client.get(f"/flights/{second['id']}/page.html").text
        summary = done(flights, answers[0].json()["id"]).summary
        assert summary is not None
        assert summary.status == "fault"


@pytest.mark.nightly
@pytest.mark.parametrize("megabytes", [20, 1000])
def test_a_log_of_one_gigabyte_is_judged_and_keeps_nobody_waiting(megabytes: int, tmp_path: Path) -> None:
    """A flight, and raw samples of its gyroscopes, which are what makes logs long."""
    shape = struct.pack("<3sBB4s16s64s", b"\xa3\x95\x80", 250, 203, b"RAWG", b"Qaaa", b"TimeUS,x,y,z")
    time_us = struct.pack("<Q", 20_000_000)
    piece = (b"\xa3\x95\xfa" + time_us + bytes(192)) * 4926  # 1 MB
    flight = (SAMPLES / "ardupilot_volz_stuck.bin").read_bytes()

    def content() -> Iterator[bytes]:
        yield flight + shape
        for _ in range(megabytes):
            yield piece

    answers: list[Answer] = []
    longest_s = 0.0
    with flights_of(tmp_path, most_bytes=2_000_000_000, apart=True) as flights, client_of(flights) as client:
        first = threading.Thread(target=lambda: answers.append(client.put("/flights?name=long.bin", content())))
        first.start()
        while first.is_alive() or flights.all()[0].state != "done":
            begun = time.monotonic()
            assert client.get("/flights").status == 200
            longest_s = max(longest_s, time.monotonic() - begun)
            time.sleep(0.05)
        assert answers[0].status == 201
        (row,) = client.get("/flights").json()
    assert row["sentence"].startswith("ELEVATOR JAMMED at 0:20")
    assert row["size"] == f"{(len(flight) + len(shape) + megabytes * len(piece)) / 1e6:.1f} MB"
    assert longest_s < 5.0


def test_two_flights_are_beside_each_other_surface_by_surface(tmp_path: Path) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST)
    residual = {"max_abs_deg": 1.25, "mean_deg": -0.004, "std_deg": 0.1, "outline": [0.1, 1.0, None]}
    jam = {"status": "fault", "reason": "jammed at 3.1 deg", "residual": residual}
    good = {"status": "healthy", "reason": "followed its command", "residual": residual}
    weak = {"status": "suspect", "reason": "lost 10 % (3 to 17 %)"}
    runs = (
        [{"surfaces": {"rudder": good, "elevator": good}}],
        [{"surfaces": {"elevator": good}, "axes": {"roll": weak}}, {"surfaces": {"elevator": jam}, "axes": {}}],
        [{"error": "no rows", "surfaces": {}}],
    )
    ids = []
    for k, logs in enumerate(runs):
        upload = flights.upload(f"flight{k}.csv", 0)
        upload.write(b"%d" % k)
        ids.append(taken(upload).id)
        if k < 2:
            make_folder(flights.results(ids[k]))
            (flights.results(ids[k]) / "audit.json").write_text(json.dumps({"logs": logs}))
    with client_of(flights) as client:
        text = client.get(f"/compare?flight={ids[0]}&flight={ids[1]}").text
        waiting = client.get(f"/compare?flight={ids[0]}&flight={ids[2]}")
        make_folder(flights.results(ids[2]))
        (flights.results(ids[2]) / "audit.json").write_text(json.dumps({"logs": runs[2]}))
        unread = client.get(f"/compare?flight={ids[0]}&flight={ids[2]}")
    names = re.findall(r'<th scope="row">(.*?)</th>', text)
    assert names == ["elevator", "roll axis", "rudder"]  # the worst first
    for words in ("jammed at 3.1 deg", "lost 10 % (3 to 17 %)", "largest residual 1.25 deg, mean +0.00"):
        assert words in text
    assert text.count("not in this flight") == 2
    assert waiting.status == 409
    assert "not judged yet" in waiting.text
    assert unread.status == 200
    assert unread.text.count("not in this flight") == 2


def test_a_port_that_is_taken_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from servofd.cli import main

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", "--folder", str(tmp_path), "--port", str(port), "--no-open"]) == 2
    assert re.fullmatch(rf"servofd: 127.0.0.1:{port}: cannot listen here: .*; --port 0 .*\n", capsys.readouterr().err)


def test_a_folder_with_logs_is_its_history(tmp_path: Path) -> None:
    shutil.copy(STUCK, tmp_path)
    (tmp_path / "notes.txt").write_text("no log\n")
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST)
    flights._find()
    assert [flight.name for flight in flights.all()] == ["faser_stuck_flight.mat"]

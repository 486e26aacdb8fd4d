"""The local page: what is dropped on it is judged, whatever it is, and nobody else gets in."""

from __future__ import annotations

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
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPMessage
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from logparsers import EmptyLog
from servofd.batch.key import Job
from servofd.core.files import make_folder
from servofd.serve.flights import RESULTS, Flight, Flights, TooLarge
from servofd.serve.judge import Summary, judge

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
STUCK = SAMPLES / "faser_stuck_flight.mat"
LARGEST = 10_000_000


@contextmanager
def flights_of(folder: Path, *, most_bytes: int = LARGEST) -> Iterator[Flights]:
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
def client_of(flights: Flights, token: str = "") -> Iterator[Client]:
    """The page itself, served by a thread."""
    import uvicorn

    from servofd.serve.app import application

    with socket.create_server(("127.0.0.1", 0)) as listening:
        server = uvicorn.Server(uvicorn.Config(application(flights, token), log_level="critical", lifespan="off"))
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        try:
            yield Client(listening.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join()


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
    with flights_of(tmp_path / "club") as flights, client_of(flights) as client:
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
def test_what_is_no_log_says_so_and_tells_no_folder(tmp_path: Path) -> None:
    for name, content, says in (
        ("empty.bin", b"", "empty"),
        ("notes.txt", b"hello\n", "Could not be read"),
        ("<img src=x onerror=alert(1)>.csv", b"\x00\xff" * 400, "Could not be read"),
    ):
        log = tmp_path / name
        log.write_bytes(content)
        summary = judge(str(log), str(tmp_path / "results"), Job())
        assert summary.status == "unknown"
        assert says in summary.sentence
        page = (tmp_path / "results" / "page.html").read_text()
        assert "<img" not in page
        assert str(tmp_path) not in page + (tmp_path / "results" / "audit.json").read_text() + summary.sentence
        assert Summary.read(tmp_path / "results") == summary


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
        ("/compare", 400),
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


def test_other_sites_get_nothing(tmp_path: Path) -> None:
    with client_of(Flights(tmp_path, Job(), most_bytes=LARGEST)) as client:
        assert client.get("/").status == 200
        assert client.get("/", Host="evil.example:8787").status == 421
        assert client.get("/", Origin="http://evil.example").status == 403
        assert client.put("/flights?name=a.csv", b"x", Origin="http://evil.example").status == 403
        assert client.get("/", Host="localhost:1", Origin="http://localhost:1").status == 200
        policy = client.get("/").headers["content-security-policy"]
    assert "default-src 'self'" in policy
    assert "http" not in policy


def test_colleagues_need_the_token(tmp_path: Path) -> None:
    with client_of(Flights(tmp_path, Job(), most_bytes=LARGEST), "secret") as client:
        for path in ("/", "/flights", "/?token=guess", "/?token=", "/viewer/index.html"):
            assert client.get(path, Host="club.example").status == 401
        assert client.get("/", Cookie="servofd_token=guess").status == 401
        assert client.put("/flights?name=a.csv", b"x").status == 401
        let_in = client.get("/?token=secret&a=b", Host="club.example")
        assert (let_in.status, let_in.headers["location"]) == (303, "/?a=b")
        cookie = let_in.headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        assert client.get("/", Host="club.example", Cookie=cookie.partition(";")[0]).status == 200


def test_what_is_at_work_says_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flights = Flights(tmp_path, Job(), most_bytes=LARGEST, workers=1)  # whose processes were not begun
    upload = flights.upload("long.csv", 0)
    upload.write(b"time_s\n")
    flight = upload.finish()
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
    summary = judge(str(SAMPLES / "table_three_faults.csv"), str(folder), Job())
    assert summary.too_long
    assert not (folder / "recording.rrd").exists()
    assert Summary.read(folder) == summary


@pytest.mark.slow
def test_a_process_that_dies_takes_only_its_flight_with_it(tmp_path: Path) -> None:
    with flights_of(tmp_path) as flights:
        upload = flights.upload("good.mat", 0)
        upload.write(STUCK.read_bytes())
        first = upload.finish()
        killer = threading.Thread(target=_kill_the_first_worker)
        killer.start()
        died = done(flights, first.id)
        killer.join()
        assert died.summary is not None
        assert "its process ended" in died.summary.sentence
        upload = flights.upload("next.csv", 0)
        upload.write((SAMPLES / "table_three_faults.csv").read_bytes())
        after = done(flights, upload.finish().id)
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


def asked(address: str, method: str = "GET", data: bytes | None = None) -> Any:
    request = urllib.request.Request(address, data, method=method)  # noqa: S310 - this machine's own
    with urllib.request.urlopen(request) as answer:  # noqa: S310
        return json.load(answer)


@pytest.mark.parametrize(
    "each", [pytest.param(2, marks=pytest.mark.nightly), pytest.param(100, marks=pytest.mark.nightly)]
)
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
    rows = (SAMPLES / "table_three_faults.csv").read_bytes().splitlines(keepends=True)

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


@pytest.mark.parametrize(
    "megabytes", [pytest.param(40, marks=pytest.mark.slow), pytest.param(1000, marks=pytest.mark.nightly)]
)
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
    with flights_of(tmp_path, most_bytes=2_000_000_000) as flights, client_of(flights) as client:
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
        ids.append(upload.finish().id)
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

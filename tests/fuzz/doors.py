"""Every way in: what comes through it, and what may become of it.

An input ends in a result, or in one line of a `LogError` or `ServofdError`; whatever else a door raises is a defect.
"""

from __future__ import annotations

import contextlib
import io
import json
import random
import shutil
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from logparsers import LogError
from logparsers.codec import Codec, signing_key
from logparsers.endpoint import parse_endpoint
from servofd import audit
from servofd.aircraft.schema import load_aircraft
from servofd.batch.find import find_logs
from servofd.batch.key import Job
from servofd.cli import main
from servofd.core.errors import ServofdError
from servofd.fleets.overview import overview
from servofd.fleets.store import FleetStore, read_logs
from servofd.live.session import Session
from servofd.outputs.fleet_report import fleet_report
from servofd.outputs.json_report import audit_document, to_json
from servofd.outputs.page import html_page
from servofd.outputs.recording.read import contradictions, read_recording, rejudged
from servofd.servo.library import find_servo
from tests.fuzz import mutate, seeds
from tests.fuzz.harness import outcome

if TYPE_CHECKING:
    from collections.abc import Mapping

    from servofd.detection.verdict import LogAudit
    from tests.fuzz.mutate import Shape

__all__ = ["DOORS", "Door", "entered"]

Refusal = (LogError, ServofdError)
_PLANES = {kind: kind for kind in ("dataflash", "dataflash_text", "tlog", "ulog")} | {"packed": "dataflash"}
"""Logs that have an aircraft file beside them, and the kind of log that it is drafted from."""
_JUDGED, _DRAFTED, _SHOWN, _USED = 50, 2500, 1000, 5
"""One in so many sound logs is judged, and one with an aircraft drafted from it, which takes a second, as does the page
of a fleet; and one in so many sound aircraft files is used."""


@dataclass(frozen=True, slots=True)
class Door:
    """One way in.

    Parameters
    ----------
    seeds : callable
        Makes sound inputs; it may write into the folder that it is given, which `enter` gets as well.
    enter : callable
        Takes an input in, as a user's call would; names what became of it.
    shape : Shape
        What its inputs are made of.
    """

    seeds: Callable[[Path], list[bytes]]
    enter: Callable[[bytes, Path], str]
    shape: Shape


def entered(door: Door, content: bytes, folder: Path) -> str:
    """Let one input in; names what became of it.

    Raises
    ------
    AssertionError
        If a refusal is more than a line.
    """
    try:
        return door.enter(content, folder)
    except Refusal as error:
        refusal = error
    assert str(refusal).strip(), "a refusal without a word"
    return type(refusal).__name__


def _log(content: bytes, folder: Path) -> str:
    """Every channel, as `info` looks at them; of some the verdict as JSON, and of few without an aircraft file."""
    read = outcome(content)
    if isinstance(read, LogError):
        return type(read).__name__
    chance = zlib.crc32(content)
    if chance % _JUDGED:
        return "read"
    path = folder / "log"
    path.write_bytes(content)
    plane = folder / "plane.toml"
    results: list[LogAudit] = list(audit(path, plane if plane.exists() and chance % _DRAFTED else None))
    return _told(results)


def _log_seeds(kind: str, folder: Path) -> list[bytes]:
    """Files of a kind; beside them the aircraft of those that would have to be fitted to each of them."""
    found = seeds.logs_of(kind)
    plane = _PLANES.get(kind)
    if plane:
        (folder / "plane.toml").write_bytes(seeds.drafted(found[0] if plane == kind else seeds.logs_of(plane)[0]))
    return found


def _told(results: list[LogAudit]) -> str:
    """Whether anything was judged; the verdicts must be JSON."""
    json.loads(to_json(audit_document(results)), parse_constant=_refused)
    return "judged" if any(s.statistics for result in results for s in result.surfaces) else "not judged"


def _refused(word: str) -> None:
    raise AssertionError(f"{word} is no JSON")


def _aircraft(content: bytes, folder: Path) -> str:
    """The models of all surfaces; of one that belongs to the table, a verdict."""
    path = folder / "aircraft.toml"
    path.write_bytes(content)
    aircraft = load_aircraft(path)
    for name in aircraft.surfaces:
        aircraft.model(name)
    if zlib.crc32(content) % _USED:
        return "loaded"
    results: list[LogAudit] = list(audit(folder / "flight.csv", aircraft))
    return _told(results)


def _aircraft_seeds(folder: Path) -> list[bytes]:
    (folder / "flight.csv").write_bytes(seeds.logs_of("table")[0])
    return seeds.planes()


def _servo(content: bytes, folder: Path) -> str:
    path = folder / "servo.toml"
    path.write_bytes(content)
    find_servo(str(path))
    if zlib.crc32(content) % _USED:
        return "loaded"
    results: list[LogAudit] = list(audit(folder / "flight.csv", servo=str(path)))
    return _told(results)


def _servo_seeds(folder: Path) -> list[bytes]:
    _aircraft_seeds(folder)
    return [seeds.SERVO]


def _recording(content: bytes, folder: Path) -> str:
    path = folder / "flight.rrd"
    path.write_bytes(content)
    recording = read_recording(path)
    contradictions(recording)
    again = rejudged(recording)
    json.loads(to_json(audit_document([again.audit])), parse_constant=_refused)
    return "read"


def _results_seeds(folder: Path) -> list[bytes]:
    """Files of a folder of results; the first byte says which."""
    parts = seeds.fleet_parts(folder)
    (folder / "parts.json").write_text(json.dumps(list(parts)))
    html_page(fleet_report(overview(read_logs(folder / "results")).document()))  # opens fonts, which stay open
    return [bytes([number]) + part for number, part in enumerate(parts.values()) if part]


def _results(content: bytes, folder: Path) -> str:
    """A folder of results of which one file is damaged: shown, and used to go on."""
    names = json.loads((folder / "parts.json").read_text())
    damaged = folder / "damaged"
    shutil.rmtree(damaged, ignore_errors=True)
    shutil.copytree(folder / "results", damaged)
    (damaged / names[content[0] % len(names) if content else 0]).write_bytes(content[1:])
    seen = overview(read_logs(damaged)).document()
    if zlib.crc32(content) % _SHOWN == 1:  # that of nothing is 0
        html_page(fleet_report(seen))
    with FleetStore(damaged, Job().key) as store:
        store.forget_not_judged()
        return "done" if store.done(find_logs([str(folder / "flight.csv")]).logs[0]) else "to do"


def _live_seeds(folder: Path) -> list[bytes]:
    (folder / "plane.toml").write_text(seeds.ONE_SURFACE)
    return seeds.frames()


def _live(content: bytes, folder: Path) -> str:
    """Bytes of a link in the pieces in which they may come, late or twice; requests and alerts are encoded."""
    rng = random.Random(zlib.crc32(content))  # noqa: S311 - a seed, not a secret
    plane = load_aircraft(folder / "plane.toml")
    session = Session(Codec(0, 191), {0: plane}, remote_log=rng.random() < 0.3)
    answers = Codec(1, 191)

    def say(_: int, name: str, fields: dict[str, Any]) -> None:
        answers.encode(name, fields)

    session.send = session.alert = say
    now_s, at, events = 1.7e9, 0, 0
    while at < len(content):
        size = rng.choice([1, 40, 280, 280, 1500])
        events += len(session.take(now_s, content[at : at + size]))
        now_s += rng.choice([0.0, 0.02, 0.02, 0.1, 3.0]) if rng.random() < 0.5 else 0.02
        events += len(session.step(now_s))
        at += size
    events += len(session.finish(now_s))
    assert session.frames >= 0
    return "events" if events else "silence"


_MONITOR = ["--speed", "0", "--plain", "--no-alert", "--json-lines", "-"]


def _said(words: list[str]) -> str:
    """What a command says, with its exit code; wrong words end in argparse's own way."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code: Any = main(words)
        except SystemExit as ended:
            code = ended.code
    assert code in (0, 1, 2), f"exit code {code}"
    assert code != 2 or err.getvalue().strip(), "exit code 2 without a reason"
    assert "Traceback" not in err.getvalue()
    return f"exit {code}"


def _monitored(content: bytes, folder: Path) -> str:
    """A log replayed through the monitor as fast as it goes."""
    path = folder / "log"
    path.write_bytes(content)
    return _said(["monitor", str(path), "-c", str(folder / "plane.toml"), *_MONITOR])


def _monitored_seeds(folder: Path) -> list[bytes]:
    (folder / "plane.toml").write_text(seeds.ONE_SURFACE)
    return seeds.telemetry()


WORDS = (
    (
        "fault",
        "elevator:stuck@0.5",
        "rudder:oscillation@1:amplitude_deg=2:frequency_hz=3",
        "elevator:bias@1:bias_deg=-2",
    ),
    ("effect", "elevator:backlash:width_deg=1", "rudder:friction:friction_deg=0.3:torque_share=0.5"),
    ("effect", "elevator:rate_limit:rate_limit_deg_s=60:form=output", "elevator:deadband:width_deg=0.5"),
    ("simulate", "--duration", "2", "--rate-hz", "50", "--noise-deg", "0.1", "--seed", "3", "--command", "steps"),
    ("audit", "--threshold-deg", "1.5", "--servo", "s9254", "-s", "elevator", "--threshold", "interval"),
    ("filter", "s9254", "--pole", "50", "--rate-hz", "100"),
    ("endpoint", "udpin:127.0.0.1:14550", "tcp:localhost:5760", "/dev/ttyACM0,57600", "tcpin:5760"),
    ("key", "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff", "a passphrase"),
    ("aircraft", "faser", "no/such.toml"),
)
"""A verb, then words; of those with a dash any may be left out, of the others each is tried."""


def _worded_seeds(folder: Path) -> list[bytes]:
    _aircraft_seeds(folder)
    return ["\n".join(words).encode() for words in WORDS]


def _worded(content: bytes, folder: Path) -> str:
    """Words of a call, one a line."""
    verb, *words = content.decode("utf-8", "surrogateescape").split("\n")
    simulate = ["simulate", "-o", str(folder / "simulated.csv")]
    match verb:
        case "fault" | "effect":
            return _said([*simulate, "--duration", "2", *(f"--{verb}={word}" for word in words[:2])])
        case "simulate":
            return _said([*simulate, *words])
        case "audit":
            return _said([verb, str(folder / "flight.csv"), *words])
        case "filter":
            return _said(["config", "--filter", *words])
        case "key":
            signing_key(content)
        case "aircraft":
            for word in words:
                load_aircraft(word)
        case _:
            for word in words:
                parse_endpoint(word)
    return "understood"


def _logs(kind: str, shape: Shape) -> Door:
    return Door(partial(_log_seeds, kind), _log, shape)


DOORS: Mapping[str, Door] = MappingProxyType(
    {
        "matlab4": _logs("matlab4", mutate.BYTES),
        "matlab5": _logs("matlab5", mutate.BYTES),
        "hdf5": _logs("hdf5", mutate.BYTES),
        "table": _logs("table", mutate.LINES),
        "dataflash": _logs("dataflash", mutate.DATAFLASH),
        "dataflash_text": _logs("dataflash_text", mutate.LINES),
        "tlog": _logs("tlog", mutate.TELEMETRY),
        "packed": _logs("packed", mutate.BYTES),
        "old_text": _logs("old_text", mutate.LINES),
        "one_frame": _logs("one_frame", mutate.TELEMETRY),
        "ulog": _logs("ulog", mutate.ULOG),
        "aircraft": Door(_aircraft_seeds, _aircraft, mutate.LINES),
        "servo": Door(_servo_seeds, _servo, mutate.LINES),
        "recording": Door(seeds.recordings, _recording, mutate.RECORDS),
        "results": Door(_results_seeds, _results, mutate.BYTES),
        "live": Door(_live_seeds, _live, mutate.FRAMES),
        "monitor": Door(_monitored_seeds, _monitored, mutate.TELEMETRY),
        "words": Door(_worded_seeds, _worded, mutate.LINES),
    }
)
"""By name."""

"""What can be typed: verbs, their options, how a wrong call is reported. What a verb does is in its own file."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

from servofd.outputs.page import FLEET_PAGE
from servofd.outputs.plain import plain
from servofd.version import __version__

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

Options = argparse.Namespace
"""Of one call; a verb's function takes them."""
COULD_NOT_TELL = 2
SERVE_PORT, MOST_MB = 8787, 4096
"""Port of `servofd serve`, and the largest log that it takes [MB]."""
SIMULATED = ".csv (plain table), .mat (FASER), .bin (ArduPilot DataFlash), .tlog (MAVLink) or .ulg (PX4)"
_LARGEST, _SMALLEST = 1.7e308, 5e-324
"""Of the numbers that are finite, and of those above zero."""
_DIGITS = 10
"""A whole number has fewer digits than this."""
_JUDGED = "Exit code 0: healthy; 1: a fault was found; 2: could not tell."
_AIRCRAFT, _SERVO = (
    "aircraft file, or the name of a shipped one",
    "servo of all surfaces: of the library, FILE.toml, or ",
)


class _Parser(argparse.ArgumentParser):
    """Reports a wrong call in one line; options must be spelt out."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 - whatever argparse takes
        super().__init__(**(options | {"allow_abbrev": False}))

    def error(self, message: str) -> NoReturn:
        self.exit(COULD_NOT_TELL, f"{self.prog}: {message} (see '{self.prog} --help')\n")

    def _print_message(self, message: str, file: SupportsWrite[str] | None = None) -> None:
        super()._print_message(plain(message), file)

    def value(
        self,
        name: str,
        about: str,
        unit: str = "FILE",
        read: Callable[[str], object] = str,
        **more: Any,  # noqa: ANN401
    ) -> None:
        """Declare an option with a value; `read` makes it of what was typed."""
        self.add_argument(name, type=read, metavar=unit, help=about, **more)

    def flag(self, name: str, about: str, **more: Any) -> None:  # noqa: ANN401 - of argparse
        self.add_argument(name, action="store_true", help=about, **more)

    def logs(self, about: str | None = None, nargs: str | None = "+") -> None:
        self.add_argument("log" if nargs is None else "logs", nargs=nargs, metavar="LOG", help=about)

    def config(self, about: str = _AIRCRAFT, unit: str = "AIRCRAFT.toml", **more: Any) -> None:  # noqa: ANN401
        self.add_argument("-c", "--config", metavar=unit, help=about, **more)

    def servo(self, about: str = f"{_SERVO}unknown (fitted)") -> None:
        self.value("--servo", about, "NAME")

    def output(self, about: str, unit: str = "FILE", **more: Any) -> None:  # noqa: ANN401 - of argparse
        self.add_argument("-o", "--output", metavar=unit, help=about, **more)

    def surface(self, about: str, unit: str = "NAME") -> None:
        self.add_argument("-s", "--surface", action="append", default=[], metavar=unit, help=about)

    def json(self, what: str = "result", instead: str = "table") -> None:
        self.value("--json", f"write the {what} as JSON; - prints it instead of the {instead}")

    def workers(self) -> None:
        self.value("--workers", "processes for many logs (default: one per core)", "N", _WORKERS)


def _number(what: str, least: float, most: float = math.inf, *, whole: bool = False) -> Callable[[str], float]:
    """Reader of an option that takes a number within bounds, which it calls so; whole ones have at most nine digits."""

    def read(text: str) -> float:
        is_whole = text.isascii() and text.isdigit() and len(text) < _DIGITS
        try:
            value = float(text) if is_whole or not whole else math.nan
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"must be {what}, not {text}")
        return int(value) if whole else value

    return read


def _span(text: str) -> tuple[float, float]:
    first, colon, last = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"must be two times in seconds such as 10:93.5, not {text}")
    from_s, to_s = _SECONDS(first) if first else -math.inf, _SECONDS(last) if last else math.inf
    if not from_s < to_s:
        raise argparse.ArgumentTypeError(f"must be an earlier and a later time such as 10:93.5, not {text}")
    return from_s, to_s


_DEGREES = _number("a positive number of degrees", _SMALLEST, _LARGEST)
_POSITIVE, _SECONDS = _number("a positive number", _SMALLEST, _LARGEST), _number("a time in seconds", -1e12, 1e12)
"""Readers of a positive number and of a time."""
_LASTING, _SPEED = _number("a positive number of seconds", _SMALLEST), _number("a positive number, or 0", 0.0, _LARGEST)
_PER_HOUR = _number("a number of false alarms per hour between 1e-12 and 1000", 1e-12, 1e3)
_WORKERS = _number("a number of processes from 1 to 1024", 1, 1024, whole=True)
_ADDRESS = _number("an id from 1 to 255", 1, 255, whole=True)
_PORT, _FREE_PORT = (_number(f"a port from {least} to 65535", least, 65_535, whole=True) for least in (1, 0))
"""Readers of the port of a server, and of one that may be 0 for a free one."""
_SIZE = _number("a number from 1 to 1000000", 1, 1_000_000, whole=True)


def _audit(parser: _Parser) -> None:
    many = "folders, patterns, addresses such as s3://bucket/logs"
    parser.logs(f"flight log, recognised by its content; or many of them: {many}")
    parser.config()
    parser.servo()
    parser.surface("judge only this surface")
    parser.value("--threshold-deg", "alarm where the residual exceeds X deg, and nowhere else", "X", _DEGREES)
    kinds = "kind of threshold (default: that of the aircraft file)"
    parser.add_argument("--threshold", choices=["constant", "interval"], help=kinds)
    parser.json()
    parser.value("--html", "write a page that can be sent by mail")
    parser.value("--rrd", "write a Rerun recording (of one log)")
    of_many = "of many logs, tables (Parquet) and a page, to which the next call adds what is new"
    parser.output(f"write page, figures, recordings and audit.json to a folder; {of_many}", "DIR")
    parser.workers()
    parser.set_defaults(pages=None, looks=False)


def _info(parser: _Parser) -> None:
    parser.logs("any log that audit reads", nargs=None)
    parser.config()
    parser.flag("--channels", "list every channel, not only those of surfaces")
    parser.flag("--json", "print JSON instead of text")


def _explain(parser: _Parser) -> None:
    parser.logs("any log that audit reads; several are fitted together")
    parser.surface("only this surface (default: all)")
    parser.config()
    parser.servo()
    parser.value("--effect", "try an effect of your own as well (docs/explain.md)", "FILE.py")
    also = "judge the model on these flights as well, without fitting it to them"
    parser.value("--also", also, "LOG", nargs="+", action="extend", default=[])
    parser.json(instead="text")
    parser.value("--save", "write the aircraft with the better model, for audit -c", "MODEL.toml")
    parser.value("--rrd", "write a Rerun recording of both simulations (of one surface)")
    parser.value("--html", "write a page: the gap before and after")


def _view(parser: _Parser) -> None:
    parser.add_argument("file", metavar="LOG|RECORDING", help="a log that audit reads, or an .rrd file")
    parser.config()
    parser.servo()


def _review(parser: _Parser) -> None:
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help="an .rrd file, or a folder of them")
    parser.json(instead="text")
    parser.value("--compare", "show the verdicts of another recording beside these", "OTHER.rrd")


def _fleet(parser: _Parser) -> None:
    parser.add_argument("folder", metavar="DIR", help="folder of results")
    parser.value("--html", f"page to write (default: {FLEET_PAGE} in the folder)")
    parser.json("overview")


def _trend(parser: _Parser) -> None:
    parser.logs("logs, folders, patterns or addresses")
    parser.config(required=True)
    parser.surface("follow only this surface")
    parser.json(instead="tables")
    parser.value("--html", "write a page that can be sent by mail")
    parser.workers()


def _serve(parser: _Parser) -> None:
    parser.value("--folder", "folder of logs (default: flights)", "DIR", default="flights")
    parser.config()
    parser.servo()
    port = f"port of the page (default: {SERVE_PORT}; 0: a free one)"
    parser.value("--port", port, "PORT", _FREE_PORT, default=SERVE_PORT)
    parser.value("--most-mb", f"largest log that is taken (default: {MOST_MB})", "MB", _SIZE, default=MOST_MB)
    parser.value("--workers", "processes (default: one per core)", "N", _SIZE)
    parser.flag("--no-open", "do not open the page")


def _config(parser: _Parser) -> None:
    parser.logs("ArduPilot .bin or .log, MAVLink .tlog, PX4 .ulg, or a plain table", nargs=None)


def _calibrate(parser: _Parser) -> None:
    parser.logs("flights of one aircraft, all of them good")
    parser.config("what is known of the aircraft (default: drafted from the logs)")
    parser.flag(
        "--motion", "calibrate the axes by the aircraft's motion (which is what happens where no servo reports)"
    )
    parser.output("aircraft file to write", "CALIBRATED.toml", required=True)
    rate = (
        "rate of all axes together that is aimed at where motion is calibrated (default: 1); where servos report "
        "their position the measured rate is printed"
    )
    parser.value("--false-alarms-per-hour", rate, "X", _PER_HOUR)
    parser.surface("calibrate only this one")
    many: dict[str, Any] = {"action": "append", "default": []}
    between = "use only the seconds from A to B; either may be left out; may be repeated"
    parser.value("--between", between, "A:B", _span, **many)
    parser.value("--run", "of a table of several runs, use only this", "NAME", dest="runs", **many)
    parser.flag(
        "--force", "calibrate also where the loss of a third of travel and of two thirds of speed would not show"
    )


def _identify(parser: _Parser) -> None:
    parser.logs("bench test: any log that audit reads, or one of ArduPilot's chirp applet (SCRP)")
    parser.add_argument("-s", "--surface", metavar="NAME", help="which surface, if the logs hold several")
    parser.config("aircraft file, which names columns and calibration, or the name of a shipped one")
    parser.add_argument("--order", type=int, choices=[1, 2, 3], help="number of poles (default: the data choose)")
    parser.json(instead="text")
    parser.value("--save", "write a servo file, for --servo and aircraft files", "SERVO.toml")
    parser.value("--html", "write a page with all figures")


def _sweep(parser: _Parser) -> None:
    parser.logs("log of the sweep", nargs=None)
    parser.config()
    parser.surface("judge only this surface")
    parser.json()


def _servos(parser: _Parser) -> None:
    parser.flag("--notes", "corrections and cautions for each servo")
    parser.flag("--json", "print JSON instead of a table")


def _odds(parser: _Parser) -> None:
    parser.config()
    parser.value("--log", "healthy flights", "LOG", nargs="+", action="extend", default=[])
    parser.servo("library servo of all surfaces; unknown: fitted to the flights")
    parser.surface("only this surface")
    parser.value("--false-alarms-per-hour", "wanted rate (default: 1e-3)", "X", _POSITIVE, default=1e-3)
    parser.value("--noise-deg", "noise of the position [deg], without logs (default: 0.1)", "X", _POSITIVE)
    parser.value("--rate-hz", "sample rate of the position, without logs (default: 100)", "HZ", _POSITIVE)
    parser.json()


def _design(parser: _Parser) -> None:
    parser.add_argument("servo", metavar="SERVO", help="name from 'servofd config --servos'")
    parser.value("--pole", "filter pole (default: fastest, noise gain <= 0.5)", "RAD_S", float)
    parser.value("--rate-hz", "sample rate (default: 100)", "HZ", float, default=100.0)
    parser.flag("--printed-gain", "keep the dc gain as its source prints it, do not scale it to 1")


def _monitor(parser: _Parser) -> None:
    endpoint = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT, a serial device, or a log file"
    parser.add_argument("endpoint", metavar="ENDPOINT", help=endpoint)
    several = "aircraft file; of several vehicles one each, as ID=FILE by system id"
    parser.config(several, "[ID=]AIRCRAFT.toml", action="append", required=True)
    parser.value("--duration", "end after so long [s]", "S", _LASTING, default=math.inf)
    parser.value("--speed", "speed of a replay; 0: as fast as it goes (default: 1)", "X", _SPEED)
    parser.value("--rrd", "write a Rerun recording")
    parser.flag("--serve", "let Rerun viewers on this machine connect")
    parser.value("--viewer-port", "port for these viewers (default: 9876)", "PORT", _PORT, default=9876)
    parser.value("--tlog", "write all that is received as a telemetry log")
    parser.value("--alert-to", "send alerts there (default: back to the stream)", "ENDPOINT")
    parser.flag("--no-alert", "send no alerts")
    parser.flag("--no-request", "send nothing at all to the stream")
    parser.flag("--dataflash", "ask for the autopilot's own log (CSRV, RCOU) as well")
    parser.value("--system", "system id to speak as (default: the vehicle's)", "ID", _ADDRESS)
    parser.value("--component", "component id to speak as (default: 191)", "ID", _ADDRESS, default=191)
    parser.value("--signing-key", "file with the key that frames are signed with")
    parser.value("--json-lines", "write each event as a line of JSON; - prints them")
    parser.flag("--plain", "print lines instead of a changing picture")


def _onboard(parser: _Parser) -> None:
    aircraft = "aircraft file, best a calibrated one; --stream-only does without"
    parser.add_argument("aircraft", metavar="AIRCRAFT.toml", nargs="?", help=aircraft)
    parser.output("script to write", "FILE.lua", required=True)
    parser.surface("watch only this surface")
    parser.flag("--stream-only", "only send measured positions, for a log or a monitor on the ground")
    parser.value("--rate-hz", "how often each servo is judged (default: 50)", "HZ", float, default=50.0)
    count = "SCR_VM_I_COUNT of the autopilot, the instructions of one call (default: 10000, as ArduPilot's)"
    parser.value("--instructions", count, "N", int, default=10_000)


def _simulate(parser: _Parser) -> None:
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("-o", "--output", metavar="FILE", help=SIMULATED)
    stream = (
        "udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or a serial device: be an ArduPlane "
        "there, in real time"
    )
    where.add_argument("--stream", metavar="ENDPOINT", help=stream)
    usual = "(default: elevator, aileron and rudder; of a .mat faser)"
    parser.config(f"{_AIRCRAFT} {usual}")
    parser.servo("library servo of all surfaces (default: that of the aircraft)")
    parser.value("--duration", "length [s] (default: 60; of a stream 600, with --airframe 180)", "S", float)
    rate = "sample rate (default: 100; in a .tlog 40; of a stream 50, the main loop of an ArduPlane)"
    parser.value("--rate-hz", rate, "HZ", float)
    parser.value("--seed", "the same seed gives the same flight (default: 0)", "N", int, default=0)
    command = "flight, calm, gusty, cruise or hand_flown; on the bench chirp, steps or doublets (default: flight)"
    parser.add_argument("--command", help=command)
    parser.value("--noise-deg", "noise of the position [deg] (default: 0.1)", "X", float)
    fault = (
        "stuck, bias, hardover, floating, oscillation, deadband, slow, loss_of_effectiveness or intermittent, from "
        "START [s] on (until end_s=... if it passes); may be given again, on one surface for a later time"
    )
    parser.add_argument("--fault", action="append", default=[], metavar="SURFACE:KIND@START[:KEY=VALUE]", help=fault)
    effect = (
        "anything that explain can find, in its words, e.g. elevator:backlash:width_deg=1; delay is the total, "
        "limits replace those of the servo; form=... as in an aircraft file"
    )
    parser.add_argument("--effect", action="append", default=[], metavar="SURFACE:EFFECT[:KEY=VALUE]", help=effect)
    generation = (
        "servo telemetry of a .bin: volz (ArduPilot 4.7: degrees, with the command; default) or dronecan "
        "(up to 4.6: radians)"
    )
    parser.add_argument("--generation", metavar="NAME", help=generation)
    airframe = (
        "an aeroplane without servo feedback that answers its surfaces, into a .bin at 25 Hz: plain, elevon or vtail; "
        "faults stuck, loss_of_effectiveness, slow and bias, each with value=... (deg, share left, s, deg); beside "
        "them only --seed and --duration count"
    )
    parser.add_argument("--airframe", metavar="MIXER", help=airframe)
    # Options of a vehicle that is simulated live; none has a default, so that they can be refused for a file.
    live = parser.add_argument_group("with --stream")
    feedback = (
        "how it sends positions: named (NAMED_VALUE_FLOAT, default), port (SERVO_OUTPUT_RAW, port 2) or array "
        "(DEBUG_FLOAT_ARRAY); DataFlash over MAVLink, for whoever asks, is there in each case"
    )
    trouble = (
        "late, pause, silence, sequence, reboot, stall, freeze or parameter, from START [s] on, as seen on a real "
        "ArduPilot, e.g. late@30:by_s=4 or parameter@60:name=SERVO_VOLZ_RANGE:value=160; may be given again"
    )
    key = "sign with this key (32 bytes, 64 hex digits, or a passphrase)"
    rate = "rate of SERVO_OUTPUT_RAW until another is asked for (default: 1, as ArduPlane)"
    grant = "grant rates up to that of the main loop; ArduPlane gives 0.8 of it"
    clock = "what its clock shows at the start [s]; with 4290 the microseconds of SERVO_OUTPUT_RAW overflow after 5 s"
    flag: dict[str, Any] = {"action": "store_true", "default": None}
    live.add_argument("--speed", type=float, metavar="X", help="seconds of flight per second (default: 1)")
    live.add_argument("--wait", **flag, help="take off when the first message has arrived")
    live.add_argument("--system", type=int, metavar="N", help="number of the vehicle, 1 to 255 (default: 1)")
    live.add_argument("--feedback", metavar="NAME", help=feedback)
    live.add_argument("--message-hz", type=float, metavar="HZ", help=rate)
    live.add_argument("--any-rate", **flag, help=grant)
    live.add_argument("--mavlink1", **flag, help="send frames of MAVLink 1")
    live.add_argument("--signing-key", metavar="FILE", help=key)
    live.add_argument("--trouble", action="append", metavar="KIND@START[:KEY=VALUE]", help=trouble)
    live.add_argument("--clock-s", type=float, metavar="S", help=clock)


def _help(parser: _Parser) -> None:
    parser.add_argument("about", nargs="?", metavar="VERB", help="verb to describe (default: all of them)")


_GROUPS: dict[str, dict[Callable[[_Parser], None], tuple[str, str, str]]] = {
    "Look at flights": {
        _audit: (
            "judge every surface of a flight log",
            "Judges every surface of one or more flight logs, and prints why; servofd LOG prints what it comes to, "
            f"and opens a page. {_JUDGED}",
            "audit flight.mat -c configs/faser.toml -o report/",
        ),
        _info: (
            "tell what is in a log, and whether it can be audited",
            "Prints format, duration, damage, vehicle, the rate and gaps of the channels that matter, which "
            "surfaces can be audited, and for the others what would have to be logged.",
            "info flight.bin",
        ),
        _explain: (
            "name the effect that a servo's model lacks",
            "Finds where simulation and measurement disagree on a servo that is well, names the missing "
            "effect, adds it and shows the gap shrink on data that it was not fitted to. Exit code 0: nothing is "
            "missing, or it was found; 1: something stays unexplained; 2: could not tell.",
            "explain flight.csv -s elevator --save better.toml",
        ),
        _review: (
            "read recordings back: verdicts, events, statistics",
            "Reads recordings (.rrd) of servofd back, without the logs. Exit code 0: healthy; 1: a fault is "
            "recorded; 2: could not tell.",
            "review flight.rrd --json -",
        ),
        _fleet: (
            "show what an audit of many logs found",
            "Prints the overview of a folder of results that servofd audit LOGS/ -o DIR made, and writes it "
            "as a page. Exit code 0: all healthy; 1: a fault was found; 2: some logs could not be judged.",
            "audit flights/ -o results && servofd fleet results",
        ),
        _trend: (
            "follow the servos of one aircraft over many flights",
            "Estimates bias, dead band, delay, bandwidth, rate limit, noise and threshold margin of each servo in each "
            "flight, finds what changes, separates wear from a swap, and forecasts when a limit is crossed. Exit code "
            "0: no limit in sight; 1: one is exceeded or will be; 2: some logs could not be judged.",
            "trend flights/ -c plane.toml --html trend.html",
        ),
        _serve: (
            "serve a local page: drop logs on it, see their verdicts",
            "Serves a page on this computer: logs that are dropped on it, or lie in its folder, are judged one "
            "after the other; each gets its page, JSON and recording. Ctrl-C ends it.",
            "serve --folder flights",
        ),
    },
    "Model an aircraft": {
        _config: (
            "draft an aircraft file from a log",
            "Prints a commented aircraft file: the surfaces of the log, each with a servo fitted to it.",
            "config flight.bin > plane.toml && servofd audit flight.bin -c plane.toml",
        ),
        _calibrate: (
            "fit an aircraft file to flights that are known to be good",
            "Fits each servo with its effects (scale, offset, delay, bandwidth, largest speed, dead band, "
            "friction, play, load of the air) to flights that are known to be good, measures how far these differ from "
            "each other, and writes a new aircraft file. Flights that look faulty are refused. Exit code 0: the file "
            "is written; 2: it is not.",
            "calibrate good1.bin good2.bin -o plane.toml",
        ),
        _identify: (
            "identify a servo from bench tests",
            "Identifies a servo from chirps, steps or other motion: poles, dc gain, delay, bandwidth, rate "
            "limits and dead band, with 95% intervals. Several logs: tests of one servo, or servos of one kind, which "
            "gives their mean. Exit code 2: the test does not show what the servo is like.",
            "identify chirp.csv step.csv --save my_servo.toml --html my_servo.html",
        ),
    },
    "Fly": {
        _monitor: (
            "watch a flying aircraft on its MAVLink stream",
            f"Watches the servos of a flying aircraft and raises alarms. Never commands the vehicle. {_JUDGED}",
            "monitor udpin:127.0.0.1:14550 -c plane.toml",
        ),
        _onboard: (
            "write the same watch as a script for an ArduPilot autopilot",
            "Writes one Lua script for ArduPilot 4.6 or newer: it watches the servos of an aircraft file on "
            "the autopilot itself, tells the ground station which one fails, logs what it saw and sends the positions.",
            "onboard plane.toml -o servofd.lua; then copy it to APM/scripts and set SCR_ENABLE = 1",
        ),
        _simulate: (
            "write a log of a simulated flight, or fly it live",
            "Simulates an aircraft's servos, healthy or with faults, and writes the log of the flight, or "
            "flies it as a vehicle on a MAVLink link.",
            "simulate -o flight.csv --fault elevator:deadband@20:width_deg=3",
        ),
    },
    "And": {
        _help: (
            "show the manual of a verb",
            "Shows the options of a verb, or the list of verbs, with a pager where stdout is a terminal.",
            "help audit",
        )
    },
}
"""In the order in which the help shows them: what declares a verb's options; its help, description and example."""
WAYS: dict[str, tuple[str, str, Callable[[_Parser], None], str, str, str]] = {
    "view": (
        *("review", "--view", _view),
        "look at a flight in the Rerun viewer: of a log, after an audit, or of a recording",
        "Audits a log, if it is given one, and opens the Rerun viewer on the recording.",
        "sample_logs/faser_stuck_flight.mat",
    ),
    "sweep": (
        *("audit", "--sweep", _sweep),
        "pre-flight check: go or no-go from a short sweep on the ground",
        "Judges a log in which each surface was moved to both sides on the ground, by a script or with the "
        "sticks. Exit code 0: go for all of which the log holds channels; 1: at least one no-go; 2: could not tell.",
        "ground.bin -c plane.toml",
    ),
    "servos": (
        *("config", "--servos", _servos),
        "print the servo library",
        "Prints the servos that can be used by name: poles, bandwidth, rate limit, delay, source.",
        "--notes",
    ),
    "odds": (
        *("config", "--odds", _odds),
        "false alarms per flight hour of an aircraft file, and the smallest offset that is seen",
        "Tells how often noise alone would raise an alarm, which offsets are seen in time, and which "
        "threshold gives a wanted rate of false alarms: from the design alone, or from healthy flights. "
        "Exit code 0: done; 2: could not tell.",
        "-c faser --log flight1.mat flight2.mat",
    ),
    "design": (
        *("config", "--filter", _design),
        "design the residual filter of a servo",
        "Prints the nullspace filter of a servo: Q in continuous time (thesis Eq. 4.10), its poles, "
        "gains and noise gain, and how a fault shows in the residual.",
        "hs225bb-eq31 --pole 50",
    ),
}
"""Other ways of a verb, by file: verb and option that choose it, what declares its options, and its texts as above."""
VERBS = tuple(declare.__name__[1:] for group in _GROUPS.values() for declare in group)


class _WholeParser(_Parser):
    """Its help lists the verbs by what one wants to do."""

    def format_help(self) -> str:
        """What to type first, then the verbs in their groups."""
        lines = [
            "usage: servofd LOG... [-c AIRCRAFT.toml] [options]     judge, and open the page",
            "       servofd VERB ...                                (see servofd help VERB)",
            str(self.description),
            "LOG: a flight log (.bin, .log, .tlog, .ulg, .mat, .csv, ...), a folder of them,",
            "a recording (.rrd), or the endpoint of an aircraft (udpin:127.0.0.1:14550).",
        ]
        for title, group in _GROUPS.items():
            lines += [f"{title}:", *(f"  {one.__name__[1:]:<11}{about}" for one, (about, _, _) in group.items())]
        return "\n".join(lines) + "\n"


def build_parser() -> argparse.ArgumentParser:
    """All verbs and their options."""
    parser = _WholeParser(prog="servofd", description="Tells which servo of an aircraft is lying, from its flight log.")
    parser.add_argument("--version", action="version", version=f"servofd {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", parser_class=_Parser)
    for group in _GROUPS.values():
        for declare, (short, description, example) in group.items():
            name = declare.__name__[1:]
            verb = verbs.add_parser(name, help=short, description=description, epilog=f"Example: servofd {example}")
            declare(verb)
            ways = [way for way in WAYS.values() if way[0] == name]
            other = verb.add_argument_group("another way to use it") if ways else verb
            for _, option, _, what, _, _ in ways:
                about = f"{what} (options: servofd {name} {option} --help)"
                other.add_argument(option, action="store_true", help=about)
    parser.set_defaults(whole=parser, manuals=verbs.choices)  # of which `servofd help` shows one
    return parser


def way_parser(way: str) -> argparse.ArgumentParser:
    """Options of another way of a verb."""
    verb, option, declare, _, description, example = WAYS[way]
    parser = _Parser(
        prog=f"servofd {verb} {option}", description=description, epilog=f"Example: servofd {verb} {option} {example}"
    )
    declare(parser)
    parser.set_defaults(verb=way)
    return parser


def look_parser() -> argparse.ArgumentParser:
    """Options of ``servofd FILE``: those of an audit, and whether to open the page."""
    parser = _Parser(
        prog="servofd",
        description="Judges every surface of a flight log, writes a page beside it (or into -o DIR) and opens it. "
        f"A folder is many logs, an endpoint such as udpin:127.0.0.1:14550 a flying aircraft. {_JUDGED}",
        epilog="All verbs: servofd --help",
    )
    _audit(parser)
    parser.flag("--no-open", "write the page, and do not open it")
    parser.set_defaults(verb="audit", looks=True)
    return parser

"""The routes of the page: flights, what was found in each, and what is done with them at a click."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any, cast, get_args
from urllib.parse import parse_qsl, quote

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import ImmutableMultiDict
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from servofd.aircraft.columns import TIME_UNITS, UNITS
from servofd.core.errors import ConfigError
from servofd.jobs.prepare import is_prepared
from servofd.outputs.compare_report import charts, compare_report
from servofd.outputs.document import Cell, Document, Table
from servofd.outputs.fleet_report import FLIGHTS_HEAD, flight_row
from servofd.outputs.page import html_page
from servofd.outputs.sentence import LEAST_CLEARED
from servofd.serve.flights import RESULTS, Choice, Flight, Flights, TooLarge, Upload
from servofd.serve.guard import Guard
from servofd.serve.judge import AUDIT, PAGE, PROGRESS, RECORDING, Summary, Verb, curves_in, text_in
from servofd.serve.preview import preview
from servofd.serve.viewer import FILES, viewer_files

_KINDS = {AUDIT: "application/json", PAGE: "text/html; charset=utf-8", RECORDING: "application/octet-stream"}
_STATUSES = (*LEAST_CLEARED, "not_a_log")
"""Of flights in the list, the one to look at first."""
_ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 16 16"><circle cx="8" cy="8" r="7" fill="#1f5f8b"/>'
    '<path d="M2 9h3l2-5 2 8 2-4h3" fill="none" stroke="#fff" stroke-width="1.5"/></svg>'
)
_PAIRS = 8
"""Surfaces of a table that can be chosen on its page."""
_MOST_BYTES = 1_000_000
"""Largest form [bytes]."""


_refused = partial(HTTPException, HTTPStatus.BAD_REQUEST)
"""What to raise where a request makes no sense."""
_not_there = partial(HTTPException, HTTPStatus.NOT_FOUND)


async def _fields_of(request: Request) -> ImmutableMultiDict[str, str]:
    """Fields of a form."""
    body = b""
    async for some in request.stream():
        body += some
        if len(body) > _MOST_BYTES:
            raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "More than a form holds.")
    return ImmutableMultiDict(parse_qsl(body.decode(errors="replace"), keep_blank_values=True))


def application(flights: Flights) -> ASGIApp:
    """The page as an ASGI application."""
    routes = _Routes(flights)
    app = Starlette(
        routes=[
            Route("/", routes.index),
            Route("/flights", routes.listed),
            Route("/flights", routes.take, methods=["PUT"]),
            Route("/do", routes.act, methods=["POST"]),
            Route("/flights/{id}", routes.flight),
            Route("/flights/{id}/choose", routes.choose, methods=["POST"]),
            Route("/flights/{id}/{file}", routes.result),
            Route("/compare", routes.compare),
            Route("/tasks/{id}", routes.task),
            Route("/favicon.ico", _icon),
            Route("/viewer/{file:path}", routes.viewer),
        ],
        exception_handlers={HTTPException: _failed, Exception: _failed},
    )
    return Guard(app)


async def _icon(_request: Request) -> Response:
    return Response(_ICON, media_type="image/svg+xml", headers={"Cache-Control": "max-age=86400"})


async def _failed(_request: Request, error: Exception) -> Response:
    """What is wrong with a request; of the page itself, which prints it where it runs, only that there is something."""
    if not isinstance(error, HTTPException):
        shown = Document("An error", "unknown", "This did not work; the terminal says why.")
        return _page(shown, HTTPStatus.INTERNAL_SERVER_ERROR)
    title = "Not done" if error.status_code == HTTPStatus.BAD_REQUEST else "Nothing here"
    return _page(Document(title, "unknown", error.detail or "Not found."), error.status_code)


def _page(document: Document, status: int = HTTPStatus.OK, template: str = "serve.html", **values: object) -> Response:
    return HTMLResponse(html_page(document, template, **values), status)


class _Routes:
    def __init__(self, flights: Flights) -> None:
        self._flights = flights

    async def index(self, request: Request) -> Response:
        asked, status = request.query_params.get("q", ""), request.query_params.get("status", "")
        every = [self._row(flight) for flight in self._flights.all()]
        rows = []
        for one in every:
            shown = one["status"] if one["state"] == "done" else one["state"]
            if asked.lower() not in f"{one['name']} {one['sentence']}".lower() or status not in ("", shown):
                continue
            rank = _STATUSES.index(shown) if shown in _STATUSES else None
            name, _, *cells = flight_row(one["name"], one["status"], one, f"/flights/{one['id']}", rank)
            verdict = Cell(status=shown, order=rank) if one["state"] == "done" else shown
            rows.append((name, verdict, *cells, Cell(choice=one["id"], soft=one["name"])))
        caption = "Flights by their date, the latest first; those without one at the end"
        if not rows:
            caption = f"None of the {len(every)} flights is like that" if every else "No flight is here yet"
        flights = Table(caption, (*FLIGHTS_HEAD, "tick"), rows, long=True, id="flights")
        done: list[tuple[str | Cell, ...]] = []
        for task in self._flights.tasks():
            has_verdict = task.state == "done" and task.verb == "trend"
            state = Cell(status=task.status) if has_verdict else task.state
            done.append((Cell(task.title, link=f"/tasks/{task.id}"), state, task.sentence))
        tasks = Table("Calibrations, trends and explanations", ("what", "state", "found"), done)
        kinds = "Flight logs: .bin, .log, .tlog, .ulg, .mat, .csv, packed or not; and aircraft files."
        where = f"{kinds} They stay on this computer."
        return _page(
            Document("Flights", "no_data", "Which servo is lying?", where, [flights, tasks]),
            flights=rows,
            hidden=len(every) - len(rows),
            asked=asked,
            verdict=status,
            statuses=_STATUSES,
            aircraft=self._flights.aircraft(),
            preparing=not is_prepared(),
        )

    async def listed(self, _request: Request) -> Response:
        return JSONResponse([self._row(flight) for flight in self._flights.all()])

    async def take(self, request: Request) -> Response:
        """The bytes of one log, as they come: no more of them is in memory than one piece."""
        name = request.query_params.get("name", "") or "flight"
        expected = request.headers.get("content-length", "0")
        upload: Upload | None = None
        try:
            upload = await run_in_threadpool(self._flights.upload, name, int(expected) if expected.isdecimal() else 0)
            async for some in request.stream():
                await run_in_threadpool(upload.write, some)
            (flight, notice), upload = await run_in_threadpool(upload.finish), None
        except TooLarge as error:
            return JSONResponse({"error": str(error)}, HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        except OSError as error:
            return JSONResponse({"error": f"{name}: cannot be kept: {error.strerror}"}, HTTPStatus.INSUFFICIENT_STORAGE)
        except ClientDisconnect:
            return JSONResponse({"error": f"{name}: did not arrive completely"}, HTTPStatus.BAD_REQUEST)
        finally:
            if upload is not None:
                upload.abandon()
        return JSONResponse((self._row(flight) if flight else {}) | {"notice": notice}, HTTPStatus.CREATED)

    async def act(self, request: Request) -> Response:
        """Something to do with the flights that are ticked."""
        form = await _fields_of(request)
        verb, aircraft = form.get("do", ""), form.get("aircraft", "")
        ticked = form.getlist("flight")
        if verb in ("delete", "restore"):
            if not ticked:
                raise _refused("Tick the flights to delete first.")
            title, act, deleted = "Taken back", self._flights.restore, []
            if verb == "delete":
                title, act, deleted = "Deleted", self._flights.remove, ticked
            said = [await run_in_threadpool(act, one) for one in ticked]
            return _page(Document(title, "no_data", " ".join(said)), deleted=deleted)
        flights = [flight for one in ticked if (flight := self._flights.get(one)) is not None]
        if verb not in get_args(Verb):
            raise _refused("There is nothing of that name to do.")
        if not flights:
            raise _refused(f"Tick the flights to {'follow' if verb == 'trend' else verb} first.")
        if verb == "trend" and not (aircraft or self._flights.job.aircraft or flights[0].choice.aircraft):
            raise _refused("A trend follows one aircraft: choose its file beside the button first.")
        try:
            task = self._flights.begin(cast("Verb", verb), flights, aircraft=aircraft, surface=form.get("surface", ""))
        except ConfigError as error:
            raise _refused(f"{error}.") from None
        return RedirectResponse(f"/tasks/{task.id}", HTTPStatus.SEE_OTHER)

    async def choose(self, request: Request) -> Response:
        """Aircraft file or columns of one flight."""
        flight, form = self._known(request.path_params["id"]), await _fields_of(request)
        try:
            by_columns = form.get("by") == "columns"
            columns = await run_in_threadpool(_columns, form, flight.log) if by_columns else {}
            choice = Choice(form.get("aircraft", ""), columns)
            await run_in_threadpool(self._flights.choose, flight.id, choice)
        except ConfigError as error:
            raise _refused(f"{flight.name}: {error}.") from None
        return RedirectResponse(f"/flights/{flight.id}", HTTPStatus.SEE_OTHER)

    async def flight(self, request: Request) -> Response:
        flight = self._known(request.path_params["id"])
        folder, row = self._flights.results(flight.id), self._row(flight)
        shown = preview(flight.log) if row["table"] or flight.choice.columns else None
        columns = dict(flight.choice.columns) or (shown.guessed() if shown else {})
        values: dict[str, Any] = {
            "flight": row,
            "recording": (folder / RECORDING).is_file(),
            "viewer": f"/flights/{quote(flight.id)}/{RECORDING}",
            "aircraft": self._flights.aircraft(),
            "chosen": flight.choice.aircraft,
            "preview": shown,
            "pairs": _pairs(columns),
            "clock": next(((c, m[5:]) for c, m in columns.items() if m.startswith("time_")), ("", "s")),
            "by_columns": bool(flight.choice.columns),
            "run": next((c for c, m in columns.items() if m == "run"), ""),
            "units": UNITS,
            "time_units": TIME_UNITS,
            "tasks": [task for task in self._flights.tasks() if flight.id in task.flights],
        }
        found = text_in(folder / PAGE) if flight.state == "done" else ""
        if found:
            return _within(found, flight.name, "flight_tools.html", values)
        waits, soon = row["sentence"], ""
        if flight.state != "done":
            soon = f"{row['sentence']} This page shows the verdict as soon as there is one.".strip()
            waits = f"{flight.name}: {flight.state}"
        status = row["status"] if row["status"] != "not_a_log" else "unknown"
        return _page(Document(flight.name, status or "no_data", waits, soon), template="flight.html", **values)

    async def result(self, request: Request) -> Response:
        flight, name = self._known(request.path_params["id"]), request.path_params["file"]
        path = self._flights.results(flight.id) / name
        if name not in _KINDS or not path.is_file():
            raise _not_there("There is no such result of this flight.")
        download = {AUDIT: f"{flight.name}.json", RECORDING: f"{flight.name}.rrd"}.get(name)
        if "download" in request.query_params and name == PAGE:
            download = f"{flight.name}.html"
        return FileResponse(path, media_type=_KINDS[name], filename=download)

    async def task(self, request: Request) -> Response:
        """A calibration, trend or explanation, or how far it is."""
        task = self._flights.task(request.path_params["id"])
        if task is None:
            raise _not_there("There is no such calibration, trend or explanation.")
        folder = self._flights.task_folder(task.id)
        found = text_in(folder / PAGE) if task.state == "done" else ""
        if found:
            return _within(found, task.title, "task_tools.html", {"task": task})
        at_work = task.state == "at work" and text_in(folder / PROGRESS)
        soon = task.sentence or f"{at_work or 'It waits.'} This page shows the result as soon as there is one."
        return _page(Document(task.title, task.status or "no_data", task.title, soon), template="task.html", task=task)

    async def compare(self, request: Request) -> Response:
        chosen = request.query_params.getlist("flight")
        if len(chosen) != 2:
            done = [flight for flight in self._flights.all() if flight.state == "done"]
            how = "Choose both; they are shown beside each other."
            asks = Document("Compare", "no_data", "Which two flights?", how)
            return _page(asks, template="compare.html", done=done, chosen=chosen[:2])
        flights = [self._known(one) for one in chosen]
        folders = [self._flights.results(one.id) for one in flights]
        try:
            documents = [json.loads((folder / AUDIT).read_text(encoding="utf-8")) for folder in folders]
        except OSError:
            raise HTTPException(HTTPStatus.CONFLICT, "One of the two is not judged yet.") from None
        names, links = [one.name for one in flights], [f"/flights/{one.id}" for one in flights]
        first, second = map(curves_in, folders)
        both = {name: (track, second[name]) for name, track in first.items() if name in second}
        off_s = [document["logs"][0].get("take_off_s") for document in documents]
        at_s = _moments(request.query_params.getlist("at") or ([] if None in off_s else list(map(str, off_s))))
        document = compare_report(names, documents, links, [charts(both, names, at_s)])
        return _page(document, template="compared.html", chosen=chosen, at_s=at_s, names=names, drawn=bool(both))

    async def viewer(self, request: Request) -> Response:
        name = request.path_params["file"] or "index.html"
        folder = await run_in_threadpool(viewer_files, self._flights.folder / RESULTS)
        if folder is None or name not in FILES:
            raise _not_there('The viewer is not here; pip install "servofd[view]" brings it.')
        return FileResponse(folder / name, media_type=FILES[name], headers={"Cache-Control": "private, max-age=86400"})

    def _row(self, flight: Flight) -> dict[str, Any]:
        """A flight in the list; it tells no folder. What is at work says how far it is."""
        known = asdict(flight.summary or Summary("", ""))
        del known["key"]
        if flight.state == "at work":
            known["sentence"] = text_in(self._flights.results(flight.id) / PROGRESS)
        size = f"{flight.size_bytes / 1e6:.1f} MB"
        return {"id": flight.id, "name": flight.name, "size": size, "state": flight.state, **known}

    def _known(self, flight_id: str) -> Flight:
        flight = self._flights.get(flight_id)
        if flight is None:
            raise _not_there("There is no such flight; it may have been deleted.")
        return flight


def _moments(given: Sequence[str]) -> tuple[float, float]:
    """The moment of each flight that lies at 0 [s]: its boot, if none is given and no take-off is known."""
    with suppress(ValueError):
        first, second = (float(one or 0.0) for one in given or ("", ""))
        if math.isfinite(first) and math.isfinite(second):
            return first, second
    raise _refused("Align two flights by a moment of each, in seconds.")


def _within(found: str, title: str, template: str, values: Mapping[str, Any]) -> Response:
    """The page of a result, with what can be done with it before it: one document."""
    tools = html_page(Document(title, "", ""), template, **values)
    return HTMLResponse(found.replace("<body>\n", f"<body>\n{tools}\n", 1))


def _pairs(columns: Mapping[str, str]) -> Sequence[tuple[str, str, str, str, str]]:
    """Surface, column and unit of its command, and of its position; some more to be filled."""
    found: dict[str, dict[str, tuple[str, str]]] = {}
    for column, meaning in columns.items():
        for what in ("cmd", "pos"):
            name, is_of, unit = meaning.rpartition(f"_{what}_")
            if is_of:
                found.setdefault(name, {})[what] = (column, unit)
    none = ("", "deg")
    pairs = [(name, *parts.get("cmd", none), *parts.get("pos", none)) for name, parts in found.items()]
    return [*pairs[:_PAIRS], *[("", "", "deg", "", "deg")] * (1 if pairs else 2)]


def _columns(form: Mapping[str, str], log: Path) -> dict[str, str]:
    """What the columns of a table are, as the form says it."""
    shown = preview(log)
    meant = [(form.get("time", ""), f"time_{form.get('time_unit', 's')}"), (form.get("run", ""), "run")]
    for k in range(_PAIRS + 1):
        name = form.get(f"surface{k}", "").strip() or (f"surface {k + 1}" if form.get(f"cmd{k}") else "")
        if form.get(f"cmd{k}") and not form.get(f"pos{k}"):
            raise ConfigError(f"choose the position of {name} as well: without it nothing can be judged")
        units = {what: form.get(f"{what}_unit{k}", "deg") for what in ("cmd", "pos")}
        meant += [(form.get(f"{what}{k}", ""), f"{name}_{what}_{unit}") for what, unit in units.items()]
    chosen = [(column, meaning) for column, meaning in meant if column]
    columns = dict(chosen)
    if len(columns) < len(chosen):
        twice = next(column for column, _ in chosen if sum(column == other for other, _ in chosen) > 1)
        raise ConfigError(f"column {twice!r} was chosen for two things")
    if not any(meaning.startswith("time_") for meaning in columns.values()):
        raise ConfigError("choose the column of the time")
    for column, meaning in columns.items():
        if meaning != "run" and (shown is None or column not in shown.numeric):
            raise ConfigError(f"column {column!r} holds no numbers")
    return columns

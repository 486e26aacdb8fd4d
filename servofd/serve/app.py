"""The routes of the page: flights, what was found in each, two beside each other."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import FileResponse, HTMLResponse, JSONResponse
from starlette.routing import Route

from servofd.outputs.compare_report import compare_report
from servofd.outputs.document import Cell, Document, Table
from servofd.outputs.fleet_report import FLIGHTS_HEAD, flight_row
from servofd.outputs.page import html_page
from servofd.serve.flights import RESULTS, TooLarge
from servofd.serve.guard import Guard
from servofd.serve.judge import AUDIT, PAGE, RECORDING, progress_in
from servofd.serve.viewer import FILES, viewer_files

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp

    from servofd.serve.flights import Flight, Flights

_KINDS = {AUDIT: "application/json", PAGE: "text/html; charset=utf-8", RECORDING: "application/octet-stream"}
_COMPARED = 2


def application(flights: Flights, token: str = "") -> ASGIApp:
    """The page as an ASGI application."""
    routes = _Routes(flights)
    app = Starlette(
        routes=[
            Route("/", routes.index),
            Route("/flights", routes.listed),
            Route("/flights", routes.take, methods=["PUT"]),
            Route("/flights/{id}", routes.flight),
            Route("/flights/{id}/{file}", routes.result),
            Route("/compare", routes.compare),
            Route("/viewer/{file:path}", routes.viewer),
        ],
        exception_handlers={HTTPException: _said, Exception: _failed},
    )
    return Guard(app, token)


async def _said(_request: Request, error: Exception) -> Response:
    """What is wrong with a request, as a page."""
    status, text = (error.status_code, error.detail) if isinstance(error, HTTPException) else (500, "")
    return _page(Document("Nothing here", "unknown", text or "Not found."), status)


async def _failed(_request: Request, _error: Exception) -> Response:
    """What is wrong with the page itself: printed where it runs; the browser learns only that there is something."""
    return _page(Document("An error", "unknown", "This did not work; the terminal says why."), 500)


def _page(document: Document, status: int = 200, template: str = "serve.html", **values: object) -> Response:
    return HTMLResponse(html_page(document, template, **values), status)


class _Routes:
    def __init__(self, flights: Flights) -> None:
        self._flights = flights

    async def index(self, _request: Request) -> Response:
        rows = []
        for one in map(self._row, self._flights.all()):
            name, verdict, *cells = flight_row(one["name"], one["status"], one, f"/flights/{one['id']}")
            state = verdict if one["state"] == "done" else one["state"]
            rows.append((name, state, *cells, Cell(choice=one["id"], soft=one["name"])))
        flights = Table("Flights, the latest first", (*FLIGHTS_HEAD, "compare"), rows, long=True, id="flights")
        where = "Drop flight logs here: .bin, .log, .tlog, .ulg, .mat, .csv, packed or not. They stay on this computer."
        return _page(Document("servofd", "no_data", "Which servo is lying?", where, [flights]), flights=rows)

    async def listed(self, _request: Request) -> Response:
        return JSONResponse([self._row(flight) for flight in self._flights.all()])

    async def take(self, request: Request) -> Response:
        """The bytes of one log, as they come: no more of them is in memory than one piece."""
        name = request.query_params.get("name", "") or "flight"
        expected = request.headers.get("content-length", "0")
        try:
            upload = self._flights.upload(name, int(expected) if expected.isdecimal() else 0)
        except TooLarge as error:
            return JSONResponse({"error": str(error)}, 413)
        try:
            async for some in request.stream():
                await run_in_threadpool(upload.write, some)
            flight = await run_in_threadpool(upload.finish)
        except TooLarge as error:
            upload.abandon()
            return JSONResponse({"error": str(error)}, 413)
        except ClientDisconnect:
            upload.abandon()
            return JSONResponse({"error": f"{name}: did not arrive completely"}, 400)
        except BaseException:
            upload.abandon()
            raise
        return JSONResponse(self._row(flight), 201)

    async def flight(self, request: Request) -> Response:
        flight = self._known(request.path_params["id"])
        recording, row = (self._flights.results(flight.id) / RECORDING).is_file(), self._row(flight)
        waits = "" if flight.state == "done" else f"{flight.name}: {flight.state}"
        soon = f"{row['sentence']} This page shows the verdict as soon as there is one.".strip()
        document = Document(flight.name, "no_data", waits, soon)
        viewer = f"/flights/{quote(flight.id)}/{RECORDING}"  # but for the host, which only the browser knows
        return _page(document, template="flight.html", flight=row, recording=recording, viewer=viewer)

    async def result(self, request: Request) -> Response:
        flight, name = self._known(request.path_params["id"]), request.path_params["file"]
        path = self._flights.results(flight.id) / name
        if name not in _KINDS or not path.is_file():
            raise HTTPException(404, "There is no such result of this flight.")
        download = {AUDIT: f"{flight.name}.json", RECORDING: f"{flight.name}.rrd"}.get(name)
        if "download" in request.query_params and name == PAGE:
            download = f"{flight.name}.html"
        return FileResponse(path, media_type=_KINDS[name], filename=download)

    async def compare(self, request: Request) -> Response:
        chosen = request.query_params.getlist("flight")
        if len(chosen) != _COMPARED:
            raise HTTPException(400, "Choose two flights to compare.")
        flights = [self._known(one) for one in chosen]
        try:
            documents = [
                json.loads((self._flights.results(one.id) / AUDIT).read_text(encoding="utf-8")) for one in flights
            ]
        except OSError:
            raise HTTPException(409, "One of the two is not judged yet.") from None
        return _page(
            compare_report([one.name for one in flights], documents, [f"/flights/{one.id}" for one in flights])
        )

    async def viewer(self, request: Request) -> Response:
        name = request.path_params["file"] or "index.html"
        folder = await run_in_threadpool(viewer_files, self._flights.folder / RESULTS / f"viewer-{_rerun_version()}")
        if folder is None or name not in FILES:
            raise HTTPException(404, 'The viewer is not here; pip install "servofd[view]" brings it.')
        return FileResponse(folder / name, media_type=FILES[name], headers={"Cache-Control": "private, max-age=86400"})

    def _row(self, flight: Flight) -> dict[str, Any]:
        """A flight in the list; it tells no folder. What is at work says how far it is."""
        summary = flight.summary
        sentence = summary.sentence if summary else ""
        if flight.state == "at work":
            sentence = progress_in(self._flights.results(flight.id))
        return {
            "id": flight.id,
            "name": flight.name,
            "size": f"{flight.size_bytes / 1e6:.1f} MB",
            "state": flight.state,
            "status": summary.status if summary else "",
            "sentence": sentence,
            "start_utc": summary.start_utc if summary else None,
            "duration_s": summary.duration_s if summary else None,
            "too_long": summary.too_long if summary else False,
            "surface": summary.surface if summary else "",
            "outline": summary.outline if summary else (),
        }

    def _known(self, flight_id: str) -> Flight:
        flight = self._flights.get(flight_id)
        if flight is None:
            raise HTTPException(404, "There is no such flight.")
        return flight


def _rerun_version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("rerun-sdk")
    except PackageNotFoundError:
        return "none"

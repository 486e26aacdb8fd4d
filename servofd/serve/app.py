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

from servofd.outputs.fleet_page import thumbnail
from servofd.outputs.page import page
from servofd.outputs.sentence import clock, minute_of, spoken
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
    return HTMLResponse(page("said.html", sentence=text or "Not found.", status=status), status)


async def _failed(_request: Request, _error: Exception) -> Response:
    """What is wrong with the page itself: printed where it runs; the browser learns only that there is something."""
    return HTMLResponse(page("said.html", sentence="This did not work; the terminal says why.", status=500), 500)


class _Routes:
    def __init__(self, flights: Flights) -> None:
        self._flights = flights

    async def index(self, _request: Request) -> Response:
        rows = self._rows()
        return HTMLResponse(page("serve.html", flights=rows, most_bytes=self._flights.most_bytes))

    async def listed(self, _request: Request) -> Response:
        return JSONResponse(self._rows())

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
        folder = self._flights.results(flight.id)
        recording = (folder / RECORDING).is_file()
        return HTMLResponse(
            page("flight.html", flight=self._row(flight), recording=recording, viewer=_viewer_address(flight))
        )

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
        rows = _compared([_parts(document["logs"]) for document in documents])
        return HTMLResponse(page("compare.html", flights=[self._row(one) for one in flights], rows=rows))

    async def viewer(self, request: Request) -> Response:
        name = request.path_params["file"] or "index.html"
        folder = await run_in_threadpool(viewer_files, self._flights.folder / RESULTS / f"viewer-{_rerun_version()}")
        if folder is None or name not in FILES:
            raise HTTPException(404, 'The viewer is not here; pip install "servofd[view]" brings it.')
        return FileResponse(folder / name, media_type=FILES[name], headers={"Cache-Control": "private, max-age=86400"})

    def _rows(self) -> list[dict[str, Any]]:
        return [self._row(flight) for flight in self._flights.all()]

    def _row(self, flight: Flight) -> dict[str, Any]:
        """A flight in the list; what is at work says how far it is."""
        row = _row(flight)
        if flight.state == "at work":
            row["sentence"] = progress_in(self._flights.results(flight.id))
        return row

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


def _row(flight: Flight) -> dict[str, Any]:
    """A flight in the list; it tells no folder."""
    summary = flight.summary
    return {
        "id": flight.id,
        "name": flight.name,
        "size": f"{flight.size_bytes / 1e6:.1f} MB",
        "state": flight.state,
        "status": summary.status if summary else "",
        "sentence": summary.sentence if summary else "",
        "begun": minute_of(summary.start_utc if summary else None),
        "duration": clock(summary.duration_s) if summary and summary.duration_s else "",
        "surface": spoken(summary.surface) if summary else "",
        "too_long": summary.too_long if summary else False,
        "thumbnail": thumbnail(summary.outline if summary else ()),
    }


def _viewer_address(flight: Flight) -> str:
    """Path and query of the viewer, but for the host, which only the browser knows."""
    return f"/flights/{quote(flight.id)}/{RECORDING}"


_RANKS = ("fault", "suspect", "healthy", "unknown", "no_data", "")


def _parts(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Surfaces and axes of a flight by name, each from the run of the log in which it did worst."""
    found: dict[str, Any] = {}
    for run in runs:
        axes = {f"{name} axis": entry for name, entry in run.get("axes", {}).items()}
        for name, entry in (run["surfaces"] | axes).items():
            known = found.get(name)
            if known is None or _RANKS.index(entry["status"]) < _RANKS.index(known["status"]):
                found[name] = entry
    return found


def _compared(parts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each surface and axis that either flight knows, the worst first."""
    names = list(dict.fromkeys(name for one in parts for name in one))
    rows = [{"name": spoken(name), "flights": [_entry(one.get(name)) for one in parts]} for name in names]
    return sorted(rows, key=lambda row: min(_RANKS.index(one["status"]) for one in row["flights"]))


def _entry(entry: dict[str, Any] | None) -> dict[str, Any]:
    if entry is None:
        return {"status": "", "reason": "not in this flight", "numbers": "", "thumbnail": thumbnail(())}
    residual = entry.get("residual")  # of an axis its sentence tells all
    numbers = (
        ""
        if residual is None
        else (
            f"largest residual {residual['max_abs_deg']:.2f} deg, mean {residual['mean_deg']:+z.2f}, "
            f"standard deviation {residual['std_deg']:.2f}"
        )
    )
    return {
        "status": entry["status"],
        "reason": entry["reason"],
        "numbers": numbers,
        "thumbnail": thumbnail((residual or entry).get("outline") or ()),
    }

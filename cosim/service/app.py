"""The server's application: its parts, its routes, and one form of error answers."""

import contextlib
import errno
import json
import logging
import os
import re
import shutil
from collections.abc import AsyncIterator, Mapping
from typing import Any

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

import sumo_scenarios
from cosim import __version__
from cosim.batch.store import TABLES, connect
from cosim.errors import BadInput, CosimError, hint
from cosim.policies import NAMES
from cosim.rewards import REWARDS
from cosim.scenario import BEHAVIORS, human_errors, load
from cosim.scenario.sumo_outputs import OUTPUTS
from cosim.service.clerk import Clerks
from cosim.service.confined import lacking
from cosim.service.documents import Catalogue, Health, Problem, Ready, World
from cosim.service.gate import Gate
from cosim.service.jobs import Jobs
from cosim.service.lanes import Lane, Lanes
from cosim.service.monitor import Figures
from cosim.service.openapi import describe
from cosim.service.problems import Refused
from cosim.service.processes import Processes
from cosim.service.readiness import Check, Readiness
from cosim.service.replays import Replays
from cosim.service.routes_live import live_router
from cosim.service.routes_page import page_router
from cosim.service.routes_runs import runs_router
from cosim.service.routes_sessions import sessions_router
from cosim.service.routes_uploads import uploads_router
from cosim.service.runs import Runs, shown
from cosim.service.sessions import Sessions
from cosim.service.settings import MB, Settings
from cosim.service.uploads import Uploads
from cosim.service.warm import Warmth
from cosim.types import Preset

BRANCH = re.compile(r"int|str|float|bool|Continuous|(list|dict|constrained|function)\b.*")  # of a union
log = logging.getLogger("cosim.service")
ABOUT = """Co-simulate altruistic cooperative driving on SUMO: submit runs of many episodes and read their
results, or drive step by step in a session."""


def create(settings: Settings) -> FastAPI:
    """The application. Raises BadInput: the database cannot be reached, Ray is not installed."""
    processes = Processes()
    uploads = Uploads(settings, processes)
    jobs = Jobs(settings.jobs_url)
    if settings.database is not None:
        connect(settings.database, TABLES, "--database").dispose()  # also for the rows of runs
    clerks = Clerks(settings, processes)
    runs = Runs(settings, jobs, clerks, lambda number: figures.episodes.inc(number))
    warmth = Warmth()
    lanes = Lanes(settings.limits)
    replays = Replays(settings, runs, uploads, clerks, warmth, processes, lanes.replays)
    sessions = Sessions(settings, clerks, warmth, lambda seconds: figures.steps.observe(seconds))
    ready = Readiness({"database": jobs.problem, "disk": _disk(settings), "workers": _workers(runs, warmth)})
    pool = runs.pool
    figures = Figures(
        {
            "cosim_runs": ("runs by status", "status", jobs.counts),
            "cosim_sessions": (
                "sessions",
                "state",
                lambda: {"open": sessions.number, "watched": sessions.watched},
            ),
            "cosim_workers": (
                "processes of runs",
                "state",
                lambda: {} if pool is None else {"busy": pool.busy, "idle": pool.workers - pool.busy},
            ),
        }
    )

    @contextlib.asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        warmth.start()
        runs.start()
        sessions.start()
        log.info("ready", extra={"host": settings.host, "port": settings.port, "data": str(settings.data)})
        yield
        warmth.close()
        lanes.close()
        ready.close()
        sessions.close()
        processes.close()
        runs.close()
        jobs.close()
        log.info("ended")

    wrong: dict[int | str, dict[str, Any]] = {
        code: {"model": Problem, "description": about}
        for code, about in {
            400: "not a request",
            401: "no token, or a wrong one",
            403: "from another origin, or not allowed by this server",
            404: "nothing of that id",
            405: "not a method of this path",
            409: "not possible in the present state",
            413: "too large",
            422: "bad input: field and value are named",
            429: "the server is at its limit",
            503: "the database does not answer, or another server drives the runs in it",
            507: "the server's disk is full",
        }.items()
    }
    # no pages of documentation: they would fetch their code from elsewhere
    app = FastAPI(
        title="cosim", version=__version__, description=ABOUT, docs_url=None, redoc_url=None,
        lifespan=life, responses=wrong,
    )  # fmt: skip
    app.state.runs = runs
    _answer_problems(app, settings)
    app.include_router(_about(figures, ready, lanes.reads))
    app.include_router(runs_router(runs, replays, uploads, lanes))
    app.include_router(uploads_router(uploads, runs, sessions, settings, lanes))
    app.include_router(sessions_router(sessions, uploads, lanes))
    app.include_router(live_router(sessions, lanes.sessions))
    app.include_router(page_router(settings))
    describe(app)
    app.add_middleware(Gate, settings=settings, figures=figures)
    return app


def _answer_problems(app: FastAPI, settings: Settings) -> None:
    """Convert every exception into a `Problem`."""

    def answer(
        status: int, problem: str, field: str | None = None, value: Any = None, file: Any = None
    ) -> Response:
        document = {"problem": problem, "field": field, "value": value, "file": file}
        return Response(json.dumps(document), status, media_type="application/json")

    @app.exception_handler(CosimError)
    def ours(_: Request, error: CosimError) -> Response:
        if isinstance(error, Refused):
            found = answer(error.status, str(error))
            if error.retry_after is not None:
                found.headers["Retry-After"] = str(error.retry_after)
            return found
        if isinstance(error, BadInput):
            e = shown(error, settings)
            if os.strerror(errno.ENOSPC).lower() in e.problem:
                return answer(507, e.problem)
            value = e.value if isinstance(e.value, str | int | float | bool | None) else repr(e.value)
            return answer(422, e.problem, e.field, value, e.file)
        log.error("a request failed", extra={"error": str(error)})
        return answer(500, str(error))

    @app.exception_handler(OSError)
    def storage(_: Request, error: OSError) -> Response:
        log.error("a request failed", extra={"error": str(error)})
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return answer(507, "the server's disk is full")
        return answer(500, f"the server's files: {error.strerror or type(error).__name__}")

    @app.exception_handler(ClientDisconnect)
    def gone(_: Request, __: ClientDisconnect) -> Response:
        return answer(400, "the client went away")

    @app.exception_handler(SQLAlchemyError)
    def database(_: Request, error: SQLAlchemyError) -> Response:
        log.error("a request failed", extra={"error": str(error.__cause__ or error)})
        return answer(503, "the server's database cannot be reached or written now")

    @app.exception_handler(RequestValidationError)
    def malformed(request: Request, error: RequestValidationError) -> Response:
        found = error.errors()
        # of a union every branch has errors: those that fit best are the deepest
        first = max(found, key=lambda one: (one["type"] == "extra_forbidden", len(one["loc"])))
        place = _place(first)
        problem = "; ".join(dict.fromkeys(str(one["msg"]) for one in found if _place(one) == place))
        value = first.get("input")
        if first["type"] == "json_invalid":
            problem, place = f"not JSON: {first['ctx']['error']} at character {place[-1]}", []
        elif first["type"] == "extra_forbidden":
            problem = f"unknown field{hint(place[-1], _fields(request)) if len(place) == 1 else ''}"
        plain = value if isinstance(value, str | int | float | bool | None) else None
        return answer(422, problem, ".".join(place) or None, plain)

    @app.exception_handler(HTTPException)
    def http(_: Request, error: HTTPException) -> Response:
        found = answer(error.status_code, str(error.detail))
        found.headers.update(error.headers or {})
        return found


def _place(error: Mapping[str, Any]) -> list[str]:
    """The path of a field, without the part of the request and the branches of unions."""
    parts = [str(part) for part in error["loc"] if part not in ("body", "query", "path", "header")]
    return [part for part in parts if not BRANCH.fullmatch(part)]


def _fields(request: Request) -> list[str]:
    """The fields of the request's body."""
    body = getattr(request.scope.get("route"), "body_field", None)
    model = None if body is None else body.field_info.annotation
    return [*getattr(model, "model_fields", ())]


def _disk(settings: Settings) -> Check:
    """The check of free disk space for runs."""

    def problem() -> str | None:
        free, least = shutil.disk_usage(settings.data).free, settings.limits.free
        if free < least:
            return f"{free // MB} MB are free for runs, at least {least // MB} are needed"
        return None if os.access(settings.data, os.W_OK) else "cannot be written"

    return problem


def _workers(runs: Runs, warmth: Warmth) -> Check:
    """The check of the processes of runs and sessions."""
    return lambda: runs.problem() or warmth.problem()


def _about(figures: Figures, ready: Readiness, reads: Lane) -> APIRouter:
    """The routes on the state of the server."""
    router = APIRouter(tags=["server"])
    uploads = not lacking()

    @router.get("/health", summary="Does the server answer?")
    async def health() -> Health:
        return Health(status="ok", version=__version__, uploads=uploads)

    @router.get(
        "/ready", summary="Can the server do its work now? 503 with the problems if not",
        responses={503: {"model": Ready, "description": "a part of the server is not ready"}},
    )  # fmt: skip
    async def is_ready(response: Response) -> Ready:
        problems = await ready.problems()
        response.status_code = 503 if problems else 200
        return Ready(ready=not problems, problems=problems)

    @router.get("/metrics", summary="Figures in Prometheus' format", response_class=Response)
    @reads
    def metrics() -> Response:
        return Response(figures.text(), media_type="text/plain; version=0.0.4; charset=utf-8")

    @router.get("/api/catalogue", summary="Scenarios, policies and option values of runs")
    @reads
    def catalogue() -> Catalogue:
        worlds = [load(name) for name in (*sumo_scenarios.names(), *sumo_scenarios.open_roads())]
        return Catalogue(
            scenarios=[
                World(name=w.name, title=w.title, demands=[*(w.demands or {})], duration_s=w.duration)
                for w in worlds
            ],
            policies=[*NAMES],
            behaviors=[*BEHAVIORS],
            presets=[*Preset.ALL],
            errors=[*human_errors.levels()],
            outputs=[*OUTPUTS],
            rewards=[*REWARDS],
        )

    return router

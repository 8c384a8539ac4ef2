"""The routes of runs: submit, list, watch, cancel, read, compare."""

import asyncio
import functools
import json
import mimetypes
from enum import Enum
from typing import Annotated, Any

from fastapi import APIRouter, Body, Path, Query, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel

from cosim.service.documents import Estimate, FileEntry, Progressing, Rows, RunDocument, RunList
from cosim.service.ids import PATTERN
from cosim.service.jobs import STATUSES, Job
from cosim.service.lanes import Lanes
from cosim.service.problems import Conflict, NotFound
from cosim.service.replays import Replays
from cosim.service.requests import EXAMPLE, MAX_LENGTH, RunRequest, flags, plain
from cosim.service.runs import REPORT, SUMMARY, Runs
from cosim.service.uploads import Uploads

RunId = Annotated[str, Path(pattern=PATTERN, examples=["3f2a9c10b7de"])]
Requested = Annotated[RunRequest, Body(openapi_examples={"two policies": {"value": EXAMPLE}})]
Side = Annotated[str, Query(pattern=r"^[0-9a-f]{12}(:[\w.+-]{1,100})?$", description="RUN or RUN:POLICY")]
Episode = Annotated[
    str,
    Query(
        pattern=r"^([0-9a-f]{12}-)?[0-9]{1,19}$",
        description="key of the episode, or its seed if only one episode has the seed",
        examples=["5d0c3e9f1a27-200000", "200000"],
    ),
]
Texts = Annotated[list[Annotated[str, Query(max_length=MAX_LENGTH)]], Query(max_length=20)]
# Restrictions of a report, because it contains texts of users.
SANDBOX = {
    "Content-Security-Policy": "sandbox allow-scripts; default-src 'none'; img-src data:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'; font-src data:"
}
Status = Enum("Status", {name: name for name in STATUSES}, type=str)  # type: ignore[misc]


def runs_router(runs: Runs, replays: Replays, uploads: Uploads, lanes: Lanes) -> APIRouter:
    """All routes of runs."""
    router = APIRouter(prefix="/api", tags=["runs"])

    def asked(request: BaseModel) -> tuple[dict[str, Any], list[str]]:
        return flags(request, uploads.file)

    def document(job: Job) -> RunDocument:
        drive = runs.drive(job.run)
        return RunDocument(
            id=job.run,
            name=job.name,
            status=job.status,
            request=job.request,
            episodes=job.episodes,
            done=job.done if drive is None else drive.done,
            created=job.created,
            began=job.began,
            ended=job.ended,
            error=job.error,
            waiting=runs.place(job.run),
            seconds_left=None if drive is None else drive.seconds_left,
            running=[
                Progressing(episode=key, simulated_s=done, of_s=total)
                for key, (done, total) in ({} if drive is None else drive.running).items()
            ],
        )

    def file(run: str, name: str, headers: dict[str, str] | None = None) -> Response:
        found = runs.files(run).get(name)
        if found is None:
            job = runs.get(run)
            if name in (REPORT, SUMMARY) and job.status != "finished":
                raise Conflict(f"run {run} is {job.status}: it has no {name}")
            raise NotFound(f"run {run} has no file {name!r}")
        kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
        return FileResponse(found, media_type=kind, headers=headers)

    @router.post("/runs", status_code=201, summary="Submit a run: a matrix of episodes")
    @lanes.checks
    def submit(request: Requested) -> RunDocument:
        given, used = asked(request)
        sent = request.model_dump(exclude_unset=True)
        return document(runs.submit(str(sent.pop("name", "")), sent, given, used))

    @router.post("/estimates", summary="Estimate the time of a run by a few short episodes")
    @lanes.estimates
    def estimate(request: Requested) -> Estimate:
        return Estimate(**runs.estimate(*asked(request)))

    @router.get("/runs", summary="Runs, the newest first")
    @lanes.reads
    def listing(
        status: Status | None = None,
        scenario: Annotated[str | None, Query(max_length=100)] = None,
        policy: Annotated[str | None, Query(max_length=100)] = None,
        limit: Annotated[int, Query(ge=1, le=1000)] = 100,
        offset: Annotated[int, Query(ge=0, le=2**31)] = 0,
    ) -> RunList:
        found = [
            job
            for job in runs.all(status and status.value)
            if _names(job, "scenario", scenario) and _names(job, "policy", policy)
        ]
        return RunList(total=len(found), runs=[document(job) for job in found[offset : offset + limit]])

    @router.get("/runs/{run}", summary="One run and its progress")
    @lanes.reads
    def status(run: RunId) -> RunDocument:
        return document(runs.get(run))

    @router.post("/runs/{run}/cancel", summary="End a run; its rows so far are kept")
    @lanes.reads
    def cancel(run: RunId) -> RunDocument:
        return document(runs.cancel(run))

    @router.post("/runs/{run}/resume", summary="Continue a failed or cancelled run")
    @lanes.reads
    def resume(run: RunId) -> RunDocument:
        for upload in runs.get(run).uploads:
            uploads.get(upload)
        return document(runs.resume(run))

    @router.delete("/runs/{run}", status_code=204, summary="Delete a run that has ended, and its files")
    @lanes.reads
    def remove(run: RunId) -> None:
        runs.remove(run)

    @router.get("/runs/{run}/rows", summary="One row per episode, also while it runs")
    @lanes.reads
    def rows(
        run: RunId,
        limit: Annotated[int, Query(ge=1, le=10_000)] = 1000,
        offset: Annotated[int, Query(ge=0, le=2**31)] = 0,
    ) -> Rows:
        found = runs.rows(run)
        return Rows(total=len(found), rows=found[offset : offset + limit])

    @router.get("/runs/{run}/summary", summary="Figures per cell with intervals, of a run that has finished")
    @lanes.reads
    def summary(run: RunId) -> dict[str, Any]:
        file(run, SUMMARY)
        with runs.reading(run) as folder:
            found: dict[str, Any] = json.loads((folder / SUMMARY).read_text("utf-8"))
        return found

    @router.get("/runs/{run}/report", summary="The report: one HTML file", response_class=FileResponse)
    async def report(run: RunId) -> Response:
        if not await lanes.reads.run(lambda: REPORT in runs.files(run)):
            await lanes.tables.run(lambda: runs.report(run))
        return await lanes.reads.run(lambda: file(run, REPORT, SANDBOX))

    @router.get(
        "/runs/{run}/replay",
        summary="An episode driven again and drawn: the HTML file of `cosim replay`",
        response_class=FileResponse,
        responses={200: {"content": {"text/html": {"example": "<!DOCTYPE html>..."}}}},
    )
    async def replay(run: RunId, episode: Episode) -> Response:
        drawn = await lanes.reads.run(functools.partial(replays.ask, run, episode))
        page = await asyncio.shield(asyncio.wrap_future(drawn))
        return FileResponse(page, media_type="text/html", headers=SANDBOX)

    @router.get("/runs/{run}/files", summary="The files of a run")
    @lanes.reads
    def files(run: RunId) -> list[FileEntry]:
        with runs.reading(run):
            return [FileEntry(name=name, bytes=path.stat().st_size) for name, path in runs.files(run).items()]

    @router.get("/runs/{run}/files/{name:path}", summary="One file of a run", response_class=FileResponse)
    @lanes.reads
    def artefact(run: RunId, name: Annotated[str, Path(examples=["episodes.csv"])]) -> Response:
        return file(run, name, SANDBOX)

    @router.get("/compare", summary="Compare two runs, or two policies, on equal seeds, as `cosim compare`")
    @lanes.tables
    def compare(a: Side, b: Side, fail_on: Texts = [], across: Texts = []) -> dict[str, Any]:  # noqa: B006
        for text in (*fail_on, *across):
            plain(text, "fail_on" if text in fail_on else "across")
        for side in (a, b):
            file(side[:12], SUMMARY)
        return runs.compare(a, b, fail_on, across)

    return router


def _names(job: Job, field: str, wanted: str | None) -> bool:
    """Whether the run's request has the value `wanted` in a field; None: any."""
    given = job.request.get(field, "idm" if field == "policy" else "")
    return wanted is None or wanted in (given if isinstance(given, list) else [given])

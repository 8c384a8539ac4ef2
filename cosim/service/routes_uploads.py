"""The routes of uploads: send an archive, list, delete."""

import functools
import os
import tempfile
from enum import Enum
from pathlib import Path as File
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from cosim.service.confined import KINDS, lacking
from cosim.service.ids import PATTERN
from cosim.service.lanes import Lanes
from cosim.service.problems import Conflict
from cosim.service.runs import Runs
from cosim.service.sessions import Sessions
from cosim.service.settings import Settings
from cosim.service.uploads import Uploads

UploadId = Annotated[str, Path(pattern=PATTERN, examples=["0c44d1e5f2ab"])]
Kind = Enum("Kind", {name: name for name in KINDS}, type=str)  # type: ignore[misc]
BODY = {
    "requestBody": {
        "required": True,
        "description": "a zip file: one .sumocfg with its net and demand files, or NAME.safetensors with its "
        "card NAME.json",
        "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
    }
}


class UploadDocument(BaseModel):
    """An upload; a run names it `upload:ID`."""

    id: str
    kind: str
    name: str
    created: str = Field(description="UTC")
    file: str = Field(description="its .sumocfg or its weights")
    files: list[str]
    bytes: int = Field(description="unpacked")
    about: dict[str, Any]


def uploads_router(
    uploads: Uploads, runs: Runs, sessions: Sessions, settings: Settings, lanes: Lanes
) -> APIRouter:
    """All routes of uploads."""
    router = APIRouter(prefix="/api", tags=["uploads"])

    @router.post("/uploads", status_code=201, summary="Send a scenario or weights", openapi_extra=BODY)
    async def send(
        request: Request, kind: Kind, name: Annotated[str, Query(max_length=200)] = ""
    ) -> UploadDocument:
        if problem := lacking():
            raise HTTPException(403, f"{problem}: none are accepted")
        handle, path = tempfile.mkstemp(suffix=".zip", dir=settings.scratch)
        try:
            os.fchmod(handle, 0o644)  # the process that unpacks it may have another user
            with os.fdopen(handle, "wb") as file:
                async for chunk in request.stream():
                    file.write(chunk)
            found = await lanes.uploads.run(functools.partial(uploads.add, File(path), kind.value, name))
        finally:
            os.unlink(path)
        return UploadDocument.model_validate(found, from_attributes=True)

    @router.get("/uploads", summary="Uploads, the newest first")
    @lanes.reads
    def listing() -> list[UploadDocument]:
        return [UploadDocument.model_validate(one, from_attributes=True) for one in uploads.all()]

    @router.get("/uploads/{upload}", summary="One upload")
    @lanes.reads
    def one(upload: UploadId) -> UploadDocument:
        return UploadDocument.model_validate(uploads.get(upload), from_attributes=True)

    @router.delete("/uploads/{upload}", status_code=204, summary="Delete an upload that no open run uses")
    @lanes.reads
    def remove(upload: UploadId) -> None:
        uploads.get(upload)
        if used := runs.that_use(upload):
            raise Conflict(f"run {used} uses it: cancel that first")
        if used := sessions.that_uses(upload):
            raise Conflict(f"session {used} uses it: close that first")
        uploads.remove(upload)

    return router

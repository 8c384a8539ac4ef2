"""The server's answers, as described in OpenAPI."""

from typing import Any

from pydantic import BaseModel, Field


class Problem(BaseModel):
    """Why a request is not carried out: one sentence, with field, value and file."""

    problem: str = Field(examples=["no such scenario, did you mean 'merge'?"])
    field: str | None = Field(None, examples=["scenario"])
    value: Any = Field(None, examples=["marge"])
    file: str | None = Field(None, description="of an upload")


class Health(BaseModel):
    """The server answers."""

    status: str = Field("ok", examples=["ok"])
    version: str
    uploads: bool = Field(description="whether uploads are accepted: they can be confined here (Landlock)")


class Ready(BaseModel):
    """Whether the server can do its work."""

    ready: bool
    problems: dict[str, str] = Field(
        description="by part: database, disk, workers", examples=[{"database": "cannot be reached or used"}]
    )


class World(BaseModel):
    """A shipped scenario."""

    name: str
    title: str
    demands: list[str]
    duration_s: float


class Catalogue(BaseModel):
    """Possible values of a run's options."""

    scenarios: list[World]
    policies: list[str]
    behaviors: list[str]
    presets: list[str]
    errors: list[str]
    outputs: list[str]
    rewards: list[str]


class Progressing(BaseModel):
    """An episode that is being driven."""

    episode: str
    simulated_s: float
    of_s: float = Field(description="0 while it starts")


class RunDocument(BaseModel):
    """A run and its progress."""

    id: str = Field(examples=["3f2a9c10b7de"])
    name: str
    status: str = Field(examples=["running"], description="queued, running, finished, cancelled or failed")
    request: dict[str, Any]
    episodes: int
    done: int
    created: str = Field(description="UTC")
    began: str | None
    ended: str | None
    error: str | None
    waiting: int | None = Field(description="number of runs ahead in the queue")
    seconds_left: float | None = Field(description="at the rate so far")
    running: list[Progressing]


class RunList(BaseModel):
    """A page of the list of runs, the newest first."""

    total: int
    runs: list[RunDocument]


class Estimate(BaseModel):
    """The estimated time of a run."""

    cells: int
    episodes: int
    estimated_s: float | None = Field(description="on an otherwise idle server; null: unknown")
    basis: str = Field(description="basis of the estimate")


class Rows(BaseModel):
    """One row per episode: the columns of `cosim run --json`."""

    total: int
    rows: list[dict[str, Any]]


class FileEntry(BaseModel):
    """A file of a run."""

    name: str
    bytes: int

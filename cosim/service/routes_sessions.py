"""The routes of sessions: open, reset, observe, act, close."""

import io
from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Body, Header, Path, Query, Response
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt

from cosim.errors import BadInput, hint
from cosim.service import views, wire
from cosim.service.ids import PATTERN
from cosim.service.lanes import Lanes
from cosim.service.problems import Conflict
from cosim.service.requests import SESSION_EXAMPLE, SessionRequest, flags, plain
from cosim.service.sessions import Open, Sessions
from cosim.service.uploads import Uploads
from cosim.types import COMPACT, ContinuousAction, MetaAction

SessionId = Annotated[str, Path(pattern=PATTERN, examples=["7be0915c2d44"])]
Accept = Annotated[str | None, Header(description=f"{wire.MEDIA}: bytes for cosim's own client, else JSON")]
Vehicle = Annotated[str, Query(max_length=200)]
AVS, MAPS = "/sessions/{session}", "application/octet-stream"


class Continuous(BaseModel):
    """An acceleration instead of a meta-action."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    accel: StrictFloat | StrictInt = Field(description="m/s2")
    lane_offset: StrictInt = Field(
        0, ge=-1, le=1, description="+1 begins a change to the left, -1 to the right"
    )


class Reset(BaseModel):
    """The episode to begin."""

    model_config = ConfigDict(extra="forbid")

    seed: StrictInt | None = Field(None, ge=0, lt=2**62, description="default: the next seed")


class Act(BaseModel):
    """One decision, 0.4 s."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [{"actions": {"av.0": "ACCELERATE", "av.1": {"accel": -1.5, "lane_offset": 0}}}]
        },
    )

    actions: dict[str, StrictInt | str | Continuous | None] = Field(
        max_length=10_000,
        description="AV -> meta-action by name or number (LANE_LEFT, IDLE, LANE_RIGHT, ACCELERATE, "
        "DECELERATE: 0 to 4), or acceleration and lane offset; the session's policy commands all other AVs",
    )
    see: list[str] | None = Field(None, max_length=10_000, description="AVs to observe (default: all)")


class SessionDocument(BaseModel):
    """A session."""

    id: str
    created: str = Field(description="UTC")
    request: dict[str, Any]
    scenario: str
    demand: str
    behavior: str
    preset: str
    fleet: str
    duration: float = Field(description="counted s of an episode")
    warmup: float = Field(description="s of the warm-up before")
    decision: float = Field(description="s between decisions")
    over: bool = Field(description="the episode is over, or none has begun")
    idle_s: float = Field(description="s without a request after which the session ends")
    watched: int = Field(description="number of pages that watch the session")
    program: bool = Field(description="whether a program drives the session by requests")


class Step(BaseModel):
    """The result of a reset or an act, by AV; a reset has only the first six fields."""

    model_config = ConfigDict(extra="allow")

    seed: int
    elapsed: float
    over: bool
    avs: list[str]
    observations: dict[str, dict[str, Any]]
    events: dict[str, list[Any]]
    rewards: dict[str, float] | None = None
    terms: dict[str, dict[str, float]] | None = None
    terminated: dict[str, bool] | None = None
    truncated: dict[str, bool] | None = None
    ended: dict[str, str] | None = None
    receipts: dict[str, dict[str, Any]] | None = None


BYTES: dict[int | str, dict[str, Any]] = {200: {"content": {wire.MEDIA: {}}}}
BINARY: dict[int | str, dict[str, Any]] = {200: {"content": {MAPS: {}}}}
PNG: dict[int | str, dict[str, Any]] = {200: {"content": {"image/png": {}}}}


def sessions_router(sessions: Sessions, uploads: Uploads, lanes: Lanes) -> APIRouter:
    """All routes of sessions."""
    router = APIRouter(prefix="/api", tags=["sessions"])

    def document(one: Open) -> SessionDocument:
        s = one.session.scenario
        return SessionDocument(
            id=one.id,
            created=one.created,
            request=one.request,
            scenario=s.name,
            demand=s.demand_name,
            behavior=s.behavior,
            preset=s.preset,
            fleet=s.fleet.describe(),
            duration=s.duration,
            warmup=s.warmup,
            decision=s.timing.decision,
            over=one.session.over or not one.session.begun,
            idle_s=one.idle,
            watched=one.live.number,
            program=one.live.program,
        )

    def answer(value: dict[str, Any]) -> Response:
        return Response(views.to_json(value), media_type="application/json")

    def wants_bytes(accept: str | None) -> bool:
        return accept is not None and wire.MEDIA in accept

    @router.post("/sessions", status_code=201, summary="Open a session")
    @lanes.sessions
    def open_one(
        request: Annotated[SessionRequest, Body(openapi_examples={"a merge": {"value": SESSION_EXAMPLE}})],
    ) -> SessionDocument:
        sent = request.model_dump(exclude_unset=True)
        own = {name: getattr(request, name) for name in ("seed", "reward", "idle_s", "maps")}
        if several := next((name for name, value in sent.items() if isinstance(value, list)), None):
            raise BadInput("one value is needed", field=several)
        given, used = flags(request, uploads.file, leave=own)
        observation = COMPACT if own["maps"] else replace(COMPACT, maps=False)
        opened = sessions.open(
            sent,
            given,
            used,
            observation=observation,
            seed=own["seed"],
            reward=own["reward"],
            idle=own["idle_s"],
        )
        return document(opened)

    @router.get("/sessions", summary="The sessions that are open")
    @lanes.reads
    def listing() -> list[SessionDocument]:
        return [document(one) for one in sessions.all()]

    @router.get(AVS, summary="One session")
    @lanes.reads
    def one(session: SessionId) -> SessionDocument:
        return document(sessions.get(session))

    @router.delete(AVS, status_code=204, summary="Close a session")
    @lanes.sessions
    def close(session: SessionId) -> None:
        sessions.end(session)

    @router.post(AVS + "/reset", summary="Begin an episode", response_model=Step, responses=BYTES)
    @lanes.sessions
    def reset(session: SessionId, begin: Reset, accept: Accept = None) -> Response:
        one = sessions.get(session)
        with one.asked() as found:
            one.live.program = True
            found.reset(begin.seed, passes_on=wants_bytes(accept))
            if found.passes_on:
                return Response(wire.of_reply(found.reply), media_type=wire.MEDIA)
            return answer(views.step(found, None))

    @router.post(AVS + "/act", summary="Carry out one decision", response_model=Step, responses=BYTES)
    @lanes.sessions
    def act(session: SessionId, decision: Act, accept: Accept = None) -> Response:
        actions = {av: _action(av, action) for av, action in decision.actions.items()}
        one = sessions.get(session)
        with one.asked() as found:
            if not wants_bytes(accept):
                found.check_observed()
            elif not found.passes_on:
                raise Conflict("this episode began with JSON answers: reset first")
            one.live.program = True
            result = one.act(actions, decision.see)
            if found.passes_on:
                return Response(wire.of_reply(found.reply), media_type=wire.MEDIA)
            return answer(views.step(found, result))

    @router.get(AVS + "/observation", summary="What each AV sees now", response_model=Step)
    @lanes.sessions
    def observation(session: SessionId) -> Response:
        with sessions.get(session).asked() as found:
            found.check_observed()
            found.observe()  # begins an episode if none has
            return answer(views.step(found, None))

    @router.get(AVS + "/maps", summary="The VelocityMaps of each AV, as safetensors", responses=BINARY,
                response_class=Response)  # fmt: skip
    @lanes.sessions
    def maps(session: SessionId, av: Vehicle | None = None) -> Response:
        with sessions.get(session).asked() as found:
            found.check_observed()
            seen = found.observe()
            if av is not None:
                _known(av, tuple(seen))
                seen = {av: seen[av]}
            arrays = {name: view.velocity_map for name, view in seen.items()}
            return Response(wire.pack(arrays, {"unit": "pixel * 255"}), media_type=MAPS)

    @router.get(AVS + "/vehicles", summary="Every vehicle, person and signal: the simulation's truth",
                responses=BYTES)  # fmt: skip
    @lanes.sessions
    def vehicles(session: SessionId, accept: Accept = None) -> dict[str, Any]:
        with sessions.get(session).asked() as found:
            now = found.snapshot()
            if wants_bytes(accept):
                return Response(wire.of_snapshot(now), media_type=wire.MEDIA)  # type: ignore[return-value]
            return answer(views.snapshot(now))  # type: ignore[return-value]

    @router.get(AVS + "/result", summary="The figures of the episode so far")
    @lanes.sessions
    def result(
        session: SessionId, policy: Annotated[str, Query(pattern=r"^[\w.+-]{1,100}$")] = "external"
    ) -> dict[str, Any]:
        with sessions.get(session).asked() as found:
            return answer(found.result(policy).document())  # type: ignore[return-value]

    @router.get(AVS + "/partner", summary="The AV that would have to yield to the mission vehicle")
    @lanes.sessions
    def partner(session: SessionId) -> str:
        with sessions.get(session).asked() as found:
            return found.partner()

    @router.get(AVS + "/picture", summary="The road around an AV from above", responses=PNG,
                response_class=Response)  # fmt: skip
    @lanes.sessions
    def picture(session: SessionId, av: Vehicle | None = None) -> Response:
        with sessions.get(session).asked() as found:
            if av is not None:
                _known(av, found.snapshot().avs)
            whole = io.BytesIO()
            Image.fromarray(found.picture(av)).save(whole, "png")
            return Response(whole.getvalue(), media_type="image/png")

    return router


def _known(av: str, avs: tuple[str, ...]) -> None:
    if av not in avs:
        raise BadInput(f"no AV of that name is on the road{hint(av, avs)}", field="av", value=av)


def _action(av: str, action: int | str | Continuous | None) -> int | ContinuousAction | None:
    """The action for the session. Raises BadInput for an unknown meta-action."""
    plain(av, "actions")
    if isinstance(action, Continuous):
        return ContinuousAction(float(action.accel), action.lane_offset)
    if isinstance(action, str):
        if action not in MetaAction.__members__:
            raise BadInput(
                f"is not a meta-action{hint(action, MetaAction.__members__)}", field=av, value=action
            )
        return MetaAction[action]
    return action

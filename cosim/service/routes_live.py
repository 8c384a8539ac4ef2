"""Watching a session: a WebSocket that sends the drive and receives requests to drive (service.md)."""

import asyncio
import contextlib
import functools
import json

from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from pydantic import BaseModel, ConfigDict, Field, StrictInt, ValidationError

from cosim.errors import CosimError
from cosim.service.lanes import Lane
from cosim.service.live import Viewer
from cosim.service.sessions import Open, Sessions

GONE, FAULTY = 4404, 4400  # codes of a closed socket


class Asked(BaseModel):
    """A request of a page to the session that it watches."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    until: float | None = Field(None, ge=0.0, le=1e9)  # drive up to so many s of the episode
    begin: StrictInt | None = Field(None, ge=0, lt=2**62)  # the episode of this seed
    next: bool = False  # the episode of the next seed
    explain: str | None = Field(None, max_length=200)  # the AV for attribution; "": no AV


def live_router(sessions: Sessions, lane: Lane) -> APIRouter:
    """The route of viewers."""
    router = APIRouter(prefix="/api")

    @router.websocket("/sessions/{session}/live")
    async def live(socket: WebSocket, session: str) -> None:
        await socket.accept()
        viewer = Viewer(asyncio.get_running_loop())
        try:
            one = sessions.get(session)
            await lane.run(functools.partial(one.watch, viewer))
        except CosimError as error:
            await socket.send_text(json.dumps({"ended": str(error)}))
            await socket.close(GONE)
            return
        sender = asyncio.create_task(_send(socket, viewer))
        try:
            async for text in socket.iter_text():
                try:
                    _answer(one, viewer, Asked.model_validate_json(text))
                except ValidationError:
                    await socket.close(FAULTY, "not a request")
                    break
        finally:
            one.live.leave(viewer)
            sender.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sender

    return router


def _answer(one: Open, viewer: Viewer, asked: Asked) -> None:
    if asked.explain is not None:
        one.live.ask_explained(asked.explain or None)
    if one.live.program:  # a program drives the session already
        return
    if asked.begin is not None or asked.next:
        one.live.ask_begin(asked.begin)
    if asked.until is not None:
        one.live.ask(viewer, asked.until)


async def _send(socket: WebSocket, viewer: Viewer) -> None:
    """Send all messages of a viewer, at the pace of its page."""
    while True:
        await viewer.wake.wait()
        viewer.wake.clear()
        for message in viewer.take():
            await socket.send_text(message)
        if viewer.ended:
            await socket.close()
            return

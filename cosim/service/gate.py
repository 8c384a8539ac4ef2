"""The first stage of every request: authorisation, size limits, counters and logs."""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import time
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import urlsplit

from starlette.exceptions import HTTPException

from cosim.service.monitor import Figures
from cosim.service.settings import Settings, is_loopback

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

PROBES = ("/health", "/ready")
OPEN = (*PROBES, "/login")  # paths that need no token
PARTS = "/page/"  # static parts of the page without user data, which need no token
PAGES = ("/", "/runs")  # a browser without a token is redirected from here to the login form
COOKIE = "cosim"
UPLOADS = "/api/uploads"
HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"SAMEORIGIN"),
)
PAUSE = 60.0  # s
log = logging.getLogger("cosim.service.http")


class Gate:
    """ASGI middleware that checks every request.

    Requests from other origins are refused. Without a token, requests must use a loopback name of this
    machine, so that foreign pages cannot reach the server through a user's browser.
    """

    def __init__(self, app: App, settings: Settings, figures: Figures) -> None:
        self._app, self._settings, self._figures = app, settings, figures
        self._token = None if settings.token is None else settings.token.encode()
        self._cookie = None if settings.token is None else cookie_of(settings.token).encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        began = time.perf_counter()
        status = 0
        headers = {name.lower(): value for name, value in scope["headers"]}

        async def answered(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [*message.get("headers", ()), *HEADERS]
            await send(message)

        try:
            await self._pass(scope, headers, receive, send, answered)
        except Exception:
            if status or scope["type"] != "http":
                raise
            log.exception("internal error", extra={"path": scope["path"]})
            await _refuse(scope, answered, 500, "internal error: the server's log has more")
        finally:
            self._note(scope, status, time.perf_counter() - began)

    async def _pass(
        self, scope: Scope, headers: dict[bytes, bytes], receive: Receive, send: Send, answered: Send
    ) -> None:
        """Refuse the request or pass it on."""
        refused = self._refused(scope, headers)
        if refused is not None and refused[0] == 401 and scope["path"] in PAGES:
            await answered(
                {"type": "http.response.start", "status": 303, "headers": [(b"location", b"/login")]}
            )
            await answered({"type": "http.response.body"})
        elif refused is not None:
            await _refuse(scope, answered, *refused)
        elif scope["type"] == "websocket":
            await self._app(scope, receive, send)
        else:
            most = self._most(scope["path"])
            try:
                length = int(headers.get(b"content-length", b"0"))
            except ValueError:
                length = -1
            if not 0 <= length <= most:
                problem = (
                    f"at most {most} bytes are accepted" if length > 0 else "content-length: not a number"
                )
                await _refuse(scope, answered, 413 if length > 0 else 400, problem)
            else:
                await self._app(scope, _limited(receive, most), answered)

    def _refused(self, scope: Scope, headers: dict[bytes, bytes]) -> tuple[int, str] | None:
        """Status and reason of a refusal; None if the request may pass."""
        host = headers.get(b"host", b"").decode("latin-1")
        origin = headers.get(b"origin")
        if origin is not None and _netloc(origin.decode("latin-1")) != host:
            return 403, "requests from pages of another origin are refused"
        if self._token is None:
            try:
                name = urlsplit(f"//{host}").hostname or ""
            except ValueError:
                name = ""
            if not is_loopback(name):
                return 403, "without a token the server answers only to loopback names of this machine"
        elif scope["path"] not in OPEN and not scope["path"].startswith(PARTS):
            scheme, _, given = headers.get(b"authorization", b"").partition(b" ")
            bearer = scheme.lower() == b"bearer" and hmac.compare_digest(given.strip(), self._token)
            if not bearer and not self._knows(headers.get(b"cookie", b"")):
                return 401, "a bearer token is needed"
        return None

    def _knows(self, cookies: bytes) -> bool:
        """Whether one of the cookies is the login form's cookie for the token."""
        assert self._cookie is not None
        given = (part.strip().partition(b"=") for part in cookies.split(b";"))
        return any(
            name == COOKIE.encode() and hmac.compare_digest(value, self._cookie) for name, _, value in given
        )

    def _most(self, path: str) -> int:
        limits = self._settings.limits
        return limits.upload if path.startswith(UPLOADS) else limits.body

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "none")  # the pattern, so that ids do not create figures
        method = scope.get("method", "WEBSOCKET")
        known = method if method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS") else "other"
        self._figures.requests.labels(known, route, str(status)).inc()
        if scope["type"] == "http":  # a socket stays open
            self._figures.seconds.labels(known, route).observe(seconds)
        level = (
            logging.DEBUG
            if route in ("/health", "/ready", "/metrics") or "/sessions/" in route
            else logging.INFO
        )
        fields = {"method": known, "path": scope["path"], "status": status, "seconds": round(seconds, 6)}
        log.log(level, "request", extra=fields)


def cookie_of(token: str) -> str:
    """The cookie that a browser sends instead of the token; it does not reveal the token."""
    return hmac.new(token.encode(), b"cosim page", "sha256").hexdigest()


def _netloc(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None


def _limited(receive: Receive, most: int) -> Receive:
    """`receive` with limits: HTTPException 413 after `most` bytes, 408 after `PAUSE` s without data."""
    got, whole = 0, False

    async def limited() -> Message:
        nonlocal got, whole
        try:
            message = await asyncio.wait_for(receive(), None if whole else PAUSE)
        except TimeoutError:
            raise HTTPException(408, f"no data of the request for {PAUSE:g} s") from None
        whole = not message.get("more_body", False)
        got += len(message.get("body", b""))
        if got > most:
            raise HTTPException(413, f"at most {most} bytes are accepted")
        return message

    return limited


async def _refuse(scope: Scope, send: Send, status: int, problem: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": problem})
        return
    body = json.dumps({"problem": problem, "field": None, "value": None, "file": None}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})

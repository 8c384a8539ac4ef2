"""The pages: HTML, styles and scripts, all from this package, and the login form for the token."""

import hmac
from importlib import resources
from string import Template
from urllib.parse import parse_qs

from fastapi import APIRouter, Request, Response

from cosim.report.replay.page import VIEWER, asset, viewer
from cosim.service.gate import COOKIE, cookie_of
from cosim.service.problems import NotFound
from cosim.service.settings import Settings

ASSETS = resources.files(__package__).joinpath("assets")
CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HTML, CSS, JS = "text/html", "text/css", "text/javascript"


def page_router(settings: Settings) -> APIRouter:
    """All routes of pages; they are not part of the API."""
    router = APIRouter(include_in_schema=False)
    parts = {
        "viewer.css": (CSS, asset("style.css")),
        "page.css": (CSS, _own("page.css")),
        "live.js": (JS, _script(*map(asset, VIEWER), _own("common.js"), _own("live.js"))),
        "runs.js": (JS, _script(asset("text.js"), _own("common.js"), _own("runs.js"))),
    }
    head = _own("head.html").rstrip()
    live = Template(_own("live.html")).substitute(
        head=head, viewer=viewer(nav=_own("nav.html"), stage=_own("start.html"), aside=_own("tally.html"))
    )
    runs = Template(_own("runs.html")).substitute(head=head, nav=_own("nav.html"))
    form = Template(_own("login.html"))

    def answer(kind: str, text: str, status: int = 200) -> Response:
        headers = {"Content-Security-Policy": CSP, "Cache-Control": "no-cache"}
        return Response(text, status, headers, media_type=kind)

    @router.get("/")
    async def watch() -> Response:
        return answer(HTML, live)

    @router.get("/runs")
    async def results() -> Response:
        return answer(HTML, runs)

    @router.get("/page/{name}")
    async def part(name: str) -> Response:
        if name not in parts:
            raise NotFound(f"no part {name!r} of the page")
        return answer(*parts[name])

    @router.get("/login")
    async def ask() -> Response:
        return answer(HTML, form.substitute(head=head, said=""))

    @router.post("/login")
    async def enter(request: Request) -> Response:
        given = parse_qs((await request.body()).decode("utf-8", "replace")).get("token", [""])[0].strip()
        token = settings.token or ""
        if token and not hmac.compare_digest(given.encode(), token.encode()):
            return answer(HTML, form.substitute(head=head, said="This token is wrong."), 401)
        found = Response(status_code=303, headers={"Location": "/"})
        if token:
            secure = request.url.scheme == "https"
            found.set_cookie(COOKIE, cookie_of(token), httponly=True, samesite="strict", secure=secure)
        return found

    return router


def _own(name: str) -> str:
    return ASSETS.joinpath(name).read_text("utf-8")


def _script(*texts: str) -> str:
    return "\n".join(('"use strict";', *texts))

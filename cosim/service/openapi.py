"""The API's description: FastAPI's schema with authorisation and an example of every JSON answer."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from cosim.service.gate import OPEN
from cosim.service.problems import Unavailable
from cosim.service.requests import EXAMPLE, SESSION_EXAMPLE

JSON = "application/json"
SCHEME = {
    "type": "http",
    "scheme": "bearer",
    "description": "the server's token: COSIM_TOKEN, or DATA/token of the server; not needed on loopback",
}
RETRY_AFTER = {
    "description": "s, after which the request may be repeated",
    "schema": {"type": "integer", "example": Unavailable.retry_after},
}
PROBLEM = {
    "problem": "unknown, did you mean 'merge'?",
    "field": "scenario",
    "value": "marge",
    "file": None,
}
UNREADY = {"ready": False, "problems": {"database": "cannot be reached or used"}}

_SHARE = {"value": 0.1, "low": 0.018, "high": 0.404}
_GROUP = {"scenario": "merge", "demand": "contested", "preset": "lawful", "svo_deg": 45.0}
_RUN = {
    "id": "3f2a9c10b7de",
    "name": EXAMPLE["name"],
    "status": "running",
    "request": {name: value for name, value in EXAMPLE.items() if name != "name"},
    "episodes": 20,
    "done": 7,
    "created": "2026-11-27T10:03:54Z",
    "began": "2026-11-27T10:03:55Z",
    "ended": None,
    "error": None,
    "waiting": None,
    "seconds_left": 41.3,
    "running": [{"episode": "ed48a4a2ab31-200007", "simulated_s": 12.4, "of_s": 60.0}],
}
_UPLOAD = {
    "id": "0c44d1e5f2ab",
    "kind": "scenario",
    "name": "city",
    "created": "2026-11-27T10:03:54Z",
    "file": "city.sumocfg",
    "files": ["cars.rou.xml.gz", "city.net.xml", "city.sumocfg"],
    "bytes": 1_204_331,
    "about": {"edges": 210, "vehicles": 4000, "flows": 0, "duration_s": 3600.0, "warnings": []},
}
_SESSION = {
    "id": "7be0915c2d44",
    "created": "2026-11-27T10:03:54Z",
    "request": SESSION_EXAMPLE,
    "scenario": "merge",
    "demand": "contested",
    "behavior": "moderate",
    "preset": "lawful",
    "fleet": "type av",
    "duration": 40.0,
    "warmup": 20.0,
    "decision": 0.4,
    "over": False,
    "idle_s": 600.0,
    "watched": 0,
    "program": True,
}
_SEEN = {
    "id": "left.0",
    "x": -4.7385,
    "y": 3.2,
    "speed": 17.4229,
    "heading": 0.0,
    "length": 5.0,
    "width": 2.0,
}
_BEGUN = {
    "seed": 7,
    "elapsed": 0.0,
    "over": False,
    "avs": ["av.0"],
    "observations": {
        "av.0": {
            "time": 20.0,
            "x": -327.16,
            "y": -4.8,
            "heading": 0.0,
            "speed": 17.147,
            "speed_limit": 25.0,
            "conflict_distance": 326.16,
            "signal": "",
            "vehicles": [
                {**_SEEN, "is_av": 0.0, "is_mission": 0.0, "age": 0.0, "source": "truth", "indicator": 0}
            ],
        }
    },
    "events": {"collisions": [], "interventions": [], "errors": []},
}
_STEP = _BEGUN | {
    "elapsed": 0.4,
    "rewards": {"av.0": 0.71},
    "terms": {"av.0": {"ego": 0.6, "av_social": 0.2, "hv_social": 0.2, "total": 0.71}},
    "terminated": {"av.0": False},
    "truncated": {"av.0": False},
    "ended": {},
    "receipts": {"av.0": {"executed": True, "blocked": None}},
}
_SIDE = {"policy": "idm", "policy_label": ""}
_COMPARED = {
    "a": "3f2a9c10b7de:idm",
    "b": "3f2a9c10b7de:altruist-rule",
    "verdict": "compared, no threshold was given",
    "exit_code": 0,
    "checks": [],
    "groups": [{**_GROUP, "a": _SIDE, "b": {**_SIDE, "policy": "altruist-rule"}, "pairs": 10}],
}
_ROW = {"key": "ed48a4a2ab31-200000", "status": "ok", "policy": "idm", "seed": 200000, "dt_mean_m": 652.4}
_VEHICLE = {"id": "av.0", "kind": "av", "actor": "car", "mission": False, "lane": 12, "x": -327.16, "y": -4.8}
_WORLD = {"name": "merge", "title": "one human driver on an acceleration lane", "duration_s": 40.0}

# Answers in JSON: method and path -> one of them.
EXAMPLES: dict[str, Any] = {
    "GET /health": {"status": "ok", "version": "0.1.0", "uploads": True},
    "GET /ready": {"ready": True, "problems": {}},
    "GET /api/catalogue": {
        "scenarios": [{**_WORLD, "demands": ["contested", "dense", "free"]}],
        "policies": ["idm", "altruist-rule", "vfn-p"],
        "behaviors": ["aggressive", "moderate", "conservative", "mixed", "as-is"],
        "presets": ["lawful", "unguarded", "guarded"],
        "errors": ["field", "stress"],
        "outputs": ["tripinfo", "fcd"],
        "rewards": ["p", "t"],
    },
    "POST /api/runs": {**_RUN, "status": "queued", "done": 0, "began": None, "waiting": 2, "running": []},
    "GET /api/runs": {"total": 1, "runs": [_RUN]},
    "GET /api/runs/{run}": _RUN,
    "POST /api/runs/{run}/cancel": {
        **_RUN,
        "status": "cancelled",
        "ended": "2026-11-27T10:04:08Z",
        "running": [],
    },
    "POST /api/runs/{run}/resume": {**_RUN, "status": "queued", "waiting": 0, "running": []},
    "POST /api/estimates": {
        "cells": 2,
        "episodes": 20,
        "estimated_s": 48.2,
        "basis": "2 of 2 cells driven for 4 s just now, 2 workers",
    },
    "GET /api/runs/{run}/rows": {"total": 1, "rows": [_ROW]},
    "GET /api/runs/{run}/summary": {
        "episodes": 20,
        "status": {"ok": 20, "sim_crash": 0, "timeout": 0, "bad_input": 0},
        "groups": [{**_GROUP, "policy": "idm", "rates": {"collision_rate": {**_SHARE, "hits": 1, "n": 10}}}],
    },
    "GET /api/runs/{run}/files": [{"name": "episodes.csv", "bytes": 1933}],
    "GET /api/compare": _COMPARED,
    "POST /api/uploads": _UPLOAD,
    "GET /api/uploads": [_UPLOAD],
    "GET /api/uploads/{upload}": _UPLOAD,
    "POST /api/sessions": _SESSION,
    "GET /api/sessions": [_SESSION],
    "GET /api/sessions/{session}": _SESSION,
    "POST /api/sessions/{session}/reset": _BEGUN,
    "POST /api/sessions/{session}/act": _STEP,
    "GET /api/sessions/{session}/observation": _BEGUN,
    "GET /api/sessions/{session}/vehicles": {"time": 20.0, "signals": "", "vehicles": [_VEHICLE]},
    "GET /api/sessions/{session}/result": {
        "scenario": "merge",
        "policy": "external",
        "seed": 7,
        "steps": 1,
        "crashed": False,
        "dt_mean_m": 6.9,
    },
    "GET /api/sessions/{session}/partner": "av.3",
}


def describe(app: FastAPI) -> None:
    """Have the application answer `/openapi.json` with this description."""

    def document() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = _document(app)
        return app.openapi_schema

    setattr(app, "openapi", document)  # noqa: B010 - FastAPI's way to extend it


def _document(app: FastAPI) -> dict[str, Any]:
    found = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
    found["components"]["securitySchemes"] = {"token": SCHEME}
    found["security"] = [{"token": []}]
    for path, operations in found["paths"].items():
        for method, operation in operations.items():
            if path in OPEN:
                operation["security"] = []
            for status, answer in operation["responses"].items():
                content = answer.get("content", {}).get(JSON)
                example = EXAMPLES.get(f"{method.upper()} {path}") if status < "300" else PROBLEM
                if content is not None and example is not None:
                    content["example"] = UNREADY if (path, status) == ("/ready", "503") else example
                if status == "429":
                    answer["headers"] = {"Retry-After": RETRY_AFTER}
    return found

"""The API as its OpenAPI document describes it, called with whatever that allows and real ids: no 5xx."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from jsonschema import Draft202012Validator
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from tests.service.servers import PATIENCE, Server
from tests.service.test_uploads import GOOD, send

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]


@schemathesis.serializer("application/zip")
def _bytes(_: object, value: object) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()


@pytest.fixture(scope="module")
def ids(server: Server) -> Iterator[dict[str, str]]:
    """Path parameter -> a real value of it."""
    run = server.submit(scenario="merge", duration=1, warmup=1)
    assert server.wait(run)["status"] == "finished"
    asked = {"scenario": "merge", "duration": 2, "warmup": 1, "maps": False}
    session = server.http.post("/api/sessions", json=asked).json()["id"]
    server.http.post(f"/api/sessions/{session}/reset", json={})
    upload = send(server, GOOD).json()["id"]
    yield {"run": run, "session": session, "upload": upload, "name": "episodes.csv"}
    for one in server.http.get("/api/sessions").json():
        server.http.delete(f"/api/sessions/{one['id']}")
    for one in server.http.get("/api/runs", params={"limit": 1000}).json()["runs"]:
        server.http.post(f"/api/runs/{one['id']}/cancel")


@pytest.fixture(scope="module")
def operations(server: Server) -> dict[str, Any]:
    """Method and path -> the operation."""
    found = schemathesis.openapi.from_url(f"{server.url}/openapi.json").get_all_operations()
    return {f"{op.method.upper()} {op.path}": op for op in (result.ok() for result in found)}


@pytest.mark.soak
def test_nothing_that_the_document_allows_is_a_server_error(
    operations: dict[str, Any], ids: dict[str, str]
) -> None:
    assert len(operations) > 25
    for operation in operations.values():

        @given(case=operation.as_strategy())
        @settings(
            max_examples=5,
            deadline=None,
            derandomize=True,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        def call(case: schemathesis.Case) -> None:
            if case.method != "DELETE":
                given = case.path_parameters or {}
                case.path_parameters = {name: ids.get(name, value) for name, value in given.items()}
            if case.path == "/api/compare" and isinstance(case.query, dict):
                case.query |= {"a": ids["run"], "b": ids["run"]}
            if case.path in ("/api/runs", "/api/estimates") and isinstance(case.body, dict):
                case.body |= {"duration": 1, "warmup": 0, "seeds": "0:1", "policy": "idm"}  # a second of work
            case.call_and_validate(checks=CHECKS, timeout=PATIENCE)

        call()


def test_every_answer_in_json_has_an_example_that_is_one(server: Server) -> None:
    document = server.http.get("/openapi.json").json()
    parts = {"components": document["components"]}
    examples = 0
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for status, answer in operation["responses"].items():
                content = answer.get("content", {}).get("application/json")
                if content is not None:
                    assert "example" in content, (method, path, status)
                    Draft202012Validator({**content["schema"], **parts}).validate(content["example"])
                    examples += status < "300"
    assert examples >= 25
    named = document["components"]["schemas"]["Act"]["examples"][0]["actions"]
    session = server.http.post(
        "/api/sessions", json={"scenario": "merge", "demand": "contested", "maps": False}
    )
    path = f"/api/sessions/{session.json()['id']}"
    assert named.keys() <= {*server.http.post(f"{path}/reset", json={"seed": 7}).json()["avs"]}
    server.http.delete(path)


def test_who_may_ask_is_part_of_the_document(server: Server) -> None:
    document = server.http.get("/openapi.json").json()
    assert document["components"]["securitySchemes"]["token"]["scheme"] == "bearer"
    assert document["security"] == [{"token": []}]
    open_to_all = {
        path for path, ops in document["paths"].items() for op in ops.values() if op.get("security") == []
    }
    assert open_to_all == {"/health", "/ready"}
    limited = document["paths"]["/api/estimates"]["post"]["responses"]["429"]
    assert "Retry-After" in limited["headers"]


def test_every_operation_says_what_it_is_for(server: Server) -> None:
    found = server.http.get("/openapi.json").json()
    operations = [op for path in found["paths"].values() for op in path.values()]
    assert all(op["summary"] for op in operations)
    run = found["components"]["schemas"]["RunRequest"]
    assert run["examples"][0]["scenario"] == "merge"
    assert set(run["properties"]) >= {"scenario", "policy", "seeds", "svo", "preset", "behavior"}

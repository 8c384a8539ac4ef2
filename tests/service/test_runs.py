"""Runs over HTTP: submitted, watched, cancelled, read, compared."""

from __future__ import annotations

import csv
import io
import os
from typing import Any

import pytest

from cosim.batch.store import Store
from cosim.cli.main import main
from tests.service.servers import Server

SHORT: dict[str, Any] = {"scenario": "merge", "demand": "contested", "duration": 2, "warmup": 1}


@pytest.fixture(scope="module")
def finished(server: Server) -> str:
    run = server.submit(**SHORT, policy=["idm", "altruist-rule"], seeds="200000:200002", name="two policies")
    assert server.wait(run)["status"] == "finished"
    return run


def test_a_run_has_the_rows_that_evaluate_would_write(server: Server, finished: str) -> None:
    found = server.http.get(f"/api/runs/{finished}/rows").json()
    assert found["total"] == 4
    assert [(row["policy"], row["seed"], row["status"]) for row in found["rows"]] == [
        ("idm", 200000, "ok"),
        ("idm", 200001, "ok"),
        ("altruist-rule", 200000, "ok"),
        ("altruist-rule", 200001, "ok"),
    ]


def test_a_run_leaves_the_files_of_a_batch(server: Server, finished: str) -> None:
    names = {entry["name"] for entry in server.http.get(f"/api/runs/{finished}/files").json()}
    assert names == {"episodes.csv", "episodes.parquet", "manifest.json", "summary.json"}
    table = server.http.get(f"/api/runs/{finished}/files/episodes.csv").text
    assert len(list(csv.DictReader(io.StringIO(table)))) == 4
    assert server.http.get(f"/api/runs/{finished}/summary").json()["status"]["ok"] == 4


def test_a_report_may_not_act_on_the_server(server: Server, finished: str) -> None:
    report = server.http.get(f"/api/runs/{finished}/report")
    assert report.text.startswith("<!doctype html>")
    assert "sandbox" in report.headers["content-security-policy"]


def test_two_policies_are_compared(server: Server, finished: str) -> None:
    sides = {"a": f"{finished}:idm", "b": f"{finished}:altruist-rule", "fail_on": "collision_rate > +100pp"}
    found = server.http.get("/api/compare", params=sides).json()
    assert (found["a"], found["exit_code"]) == (f"{finished}:idm", 0)
    assert found["groups"][0]["pairs"] == 2


@pytest.mark.usefixtures("finished")
def test_the_list_is_filtered(server: Server) -> None:
    def total(**wanted: str) -> int:
        return int(server.http.get("/api/runs", params=wanted).json()["total"])

    assert total(policy="altruist-rule", status="finished") >= 1
    assert total(policy="vfn-p") == 0
    assert total(scenario="exit") == 0


def test_no_file_of_the_server_is_read_by_its_path(server: Server, finished: str) -> None:
    for name in (
        "../../service.sqlite",
        "%2e%2e/%2e%2e/service.sqlite",
        "/etc/passwd",
        "store.sqlite",
    ):
        assert server.http.get(f"/api/runs/{finished}/files/{name}").status_code in (404, 307, 422), name
    for run in ("..", "%2e%2e", "x" * 12, "0" * 12):
        assert server.http.get(f"/api/runs/{run}/rows").status_code in (404, 422), run


def test_a_run_is_cancelled_at_once(server: Server) -> None:
    run = server.submit(scenario="merge", duration=80_000)
    server.wait(run, "running")
    server.http.post(f"/api/runs/{run}/cancel")
    assert server.wait(run)["status"] == "cancelled"
    again = server.http.post(f"/api/runs/{run}/cancel")
    assert (again.status_code, "has ended" in again.json()["problem"]) == (409, True)
    assert server.http.delete(f"/api/runs/{run}").status_code == 204
    assert server.http.get(f"/api/runs/{run}").status_code == 404


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("scenario", "marge", "did you mean 'merge'"),
        ("scenario", "/etc/passwd", "no file or code is read"),
        ("polcy", "idm", "did you mean 'policy'"),
        ("policy", "own.py:Policy", "no file or code is read"),
        ("policy", "vfnp", "did you mean"),
        ("policy", [], "1 to"),
        ("metric", "own.py:Metric", "code is not accepted"),
        ("reward", "own.py:Reward", "there are: p, t"),
        ("demand", "contestd", "did you mean 'contested'"),
        ("demand", "../../x.rou.xml", "accepted only from an upload"),
        ("svo", 91, "from 0 to 90"),
        ("seeds", "5:1", "no seed lies between"),
        ("seeds", 5, "a:b"),
        ("duration", 10**400, "out of range"),
        ("av_ids", "(", "not a regular expression"),
        ("output", "everything", "unknown"),
        ("mission", "a\0b", "cannot be printed"),
    ],
)
def test_bad_input_is_one_sentence_that_names_the_field(
    server: Server, field: str, value: object, says: str
) -> None:
    answer = server.http.post("/api/runs", json={**SHORT, field: value})
    problem = answer.json()
    assert (answer.status_code, problem["field"]) == (422, field)
    assert says in problem["problem"]


@pytest.mark.parametrize(
    "body",
    [
        b"[" * 100_000,
        b'{"scenario": ' + b"1" * 10_000 + b"}",
        b'{"\\ud800": 1}',
        b'{"name": "\\ud800"}',
        b"\xff",
    ],
)
def test_json_that_nobody_means_is_refused(server: Server, body: bytes) -> None:
    answer = server.http.post("/api/runs", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422)
    assert answer.json()["problem"]


def test_a_request_that_is_too_large_is_refused(server: Server) -> None:
    answer = server.http.post("/api/runs", content=b" " * (1 << 21))
    assert answer.status_code == 413

    def endless() -> Any:
        for _ in range(64):
            yield b" " * (1 << 16)

    assert server.http.post("/api/runs", content=endless()).status_code == 413


@pytest.mark.soak
def test_a_killed_server_loses_no_run_and_drives_none_twice(tmp_path_factory: pytest.TempPathFactory) -> None:
    data = tmp_path_factory.mktemp("killed") / "data"
    url = os.environ.get("COSIM_TEST_DATABASE")  # an empty PostgreSQL, in place of SQLite
    flags = ("--workers", "2", *(("--database", url) if url else ()))
    seeds = range(200000, 200020)
    with Server(data.with_name("undisturbed"), "--workers", "2") as server:
        run = server.submit(**SHORT, seeds=f"{seeds.start}:{seeds.stop}")
        assert server.wait(run)["status"] == "finished"
        undisturbed = server.hashes(run)
    server = Server(data, *flags)
    runs = {seed: server.submit(**SHORT, seeds=f"{seed}:{seed + 1}") for seed in seeds}
    server.wait(runs[seeds[2]])
    server.kill()
    with Server(data, *flags) as server:
        for run in runs.values():
            assert server.wait(run)["status"] == "finished"
        assert {k: v for run in runs.values() for k, v in server.hashes(run).items()} == undisturbed
        if url:
            assert main(["serve", "--data", f"{data}-2", "--port", "0", "--database", url]) == 2
        for run in runs.values():
            with Store.in_folder(data / "runs" / run, url) as store:
                assert len(store.rows()) == 1
                assert server.http.delete(f"/api/runs/{run}").status_code == 204
                assert url is None or not store.rows()

"""Replays over HTTP: an episode of a finished run, driven again and drawn; uploads in a confined process."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from tests.service.postgres import until
from tests.service.servers import Server
from tests.service.test_uploads import GOOD, send

SHORT: dict[str, Any] = {"scenario": "merge", "demand": "contested", "duration": 2, "warmup": 1}


@pytest.fixture(scope="module")
def finished(server: Server) -> str:
    run = server.submit(**SHORT, policy=["idm", "altruist-rule"], seeds="200000:200002")
    assert server.wait(run)["status"] == "finished"
    return run


def rows(server: Server, run: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = server.http.get(f"/api/runs/{run}/rows").json()["rows"]
    return found


def replay(server: Server, run: str, episode: object) -> Any:
    return server.http.get(f"/api/runs/{run}/replay", params={"episode": str(episode)})


def test_a_replay_is_the_page_of_its_episode_and_is_kept(server: Server, finished: str) -> None:
    row = rows(server, finished)[3]
    with ThreadPoolExecutor(2) as asking:
        first, second = asking.map(lambda _: replay(server, finished, row["key"]), range(2))
    assert (first.status_code, first.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert first.text.startswith("<!DOCTYPE html>")
    assert "altruist-rule, seed 200001" in first.text
    assert "sandbox" in first.headers["content-security-policy"]
    kept = server.data / "runs" / finished / f"replay-{row['key']}.html"
    kept.write_text("kept")
    assert second.text == first.text
    assert replay(server, finished, row["key"]).text == "kept"
    names = [entry["name"] for entry in server.http.get(f"/api/runs/{finished}/files").json()]
    assert kept.name in names
    until(lambda: not [*(server.data / "scratch").glob("tmp*")])


def test_a_seed_names_an_episode_where_only_one_has_it(server: Server, finished: str) -> None:
    answer = replay(server, finished, 200001)
    assert (answer.status_code, answer.json()["field"]) == (422, "episode")
    assert "2 episodes have this seed" in answer.json()["problem"]


@pytest.mark.parametrize(
    ("run", "episode", "status", "says"),
    [
        ("0" * 12, "200000", 404, "no run"),
        ("..", "200000", 404, ""),
        ("%2e%2e%2fuploads", "200000", 404, ""),
        ("", "7", 422, "no such episode"),
        ("", "0123456789ab-200000", 422, "no such episode"),
        ("", "../summary", 422, "pattern"),
        ("", "..%2Fmanifest", 422, "pattern"),
        ("", "", 422, "pattern"),
    ],
)
def test_what_is_not_there_has_no_replay(
    server: Server, finished: str, run: str, episode: str, status: int, says: str
) -> None:
    answer = replay(server, run or finished, episode)
    assert (answer.status_code, says in answer.json()["problem"]) == (status, True), answer.text


def test_a_run_that_has_not_finished_has_no_replay(server: Server) -> None:
    run = server.submit(scenario="merge", duration=80_000)
    answer = replay(server, run, 200000)
    assert (answer.status_code, "has no replays" in answer.json()["problem"]) == (409, True)
    server.http.post(f"/api/runs/{run}/cancel")


def test_an_upload_is_driven_again_while_it_is_there_and_unchanged(server: Server) -> None:
    upload = send(server, GOOD).json()["id"]
    run = server.submit(scenario=f"upload:{upload}", penetration=0.5, seeds="200000:200003")
    assert server.wait(run)["status"] == "finished"
    assert "seed 200000" in replay(server, run, 200000).text
    demand = server.data / "uploads" / upload / "demand.rou.xml"
    shutil.copy(demand, server.data / "demand.xml")
    demand.write_bytes(demand.read_bytes() + b" ")
    answer = replay(server, run, 200001)
    assert (answer.status_code, "has changed" in answer.json()["problem"]) == (422, True)
    assert str(server.data) not in answer.text
    shutil.move(server.data / "demand.xml", demand)
    assert server.http.delete(f"/api/uploads/{upload}").status_code == 204
    answer = replay(server, run, 200001)
    assert (answer.status_code, f"no upload '{upload}'" in answer.json()["problem"]) == (404, True)
    assert replay(server, run, 200000).status_code == 200  # it was kept

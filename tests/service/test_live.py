"""Watching a session: what is told over its WebSocket, to whom, and that it changes nothing."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

import cosim
from cosim.policies import make
from cosim.service import client
from cosim.service.live import KEPT, Viewer
from cosim.service.watch import Scene, tally
from tests.service.postgres import until
from tests.service.servers import PATIENCE, Server

WORDS: dict[str, Any] = {"scenario": "merge", "demand": "contested", "duration": 4.0, "warmup": 5.0}
SECRET = "a-secret-of-the-tests"


def opened(server: Server, **words: Any) -> str:
    answer = server.http.post("/api/sessions", json={**WORDS, "maps": False, **words})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def watching(server: Server, session: str, **options: Any) -> ClientConnection:
    address = f"ws{server.url[4:]}/api/sessions/{session}/live"
    return connect(address, max_size=None, open_timeout=PATIENCE, ping_timeout=PATIENCE, **options)


def told(socket: ClientConnection) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(socket.recv(timeout=PATIENCE))
    return found


def drawn(socket: ClientConnection, until: float) -> tuple[list[Any], list[dict[str, Any]]]:
    """What stays and the steps, until one is so far."""
    lasting, steps = [], []
    while not steps or (steps[-1]["elapsed"] < until - 1e-6 and not steps[-1]["over"]):
        message = told(socket)
        lasting += message.get("add", [])
        steps += message.get("steps", [])
    return lasting, steps


def test_a_session_is_driven_as_far_as_a_page_asks_and_as_it_would_be_unwatched(server: Server) -> None:
    session = opened(server, policy="altruist-rule")
    with watching(server, session) as socket:
        socket.send(json.dumps({"begin": 200_000}))
        head = told(socket)
        assert {"lanes", "stop_lines", "zones"} <= head["road"].keys()
        assert head["episode"]["facts"]["seed"] == 200_000
        assert head["steps"][0]["elapsed"] == 0.0
        socket.send(json.dumps({"until": 1.0}))
        lasting, steps = drawn(socket, 1.0)
        assert [step["elapsed"] for step in steps] == [0.4, 0.8, 1.2]
        time.sleep(0.5)
        with pytest.raises(TimeoutError):
            socket.recv(timeout=0.0)
        socket.send(json.dumps({"until": 100.0}))
        more, rest = drawn(socket, 100.0)
        assert rest[-1]["over"]
        names = [row[0] for kind, row in (*head["add"], *lasting, *more) if kind == "vehicles"]
        assert len(set(names)) == len(names) > 10
        truth = server.http.get(f"/api/sessions/{session}/vehicles").json()
        time_ms, numbers, x, y, *_ = rest[-1]["frames"][-1]
        assert time_ms == round(1000 * truth["time"])
        where = {v["id"]: (v["x"], v["y"]) for v in truth["vehicles"]}
        for number, cx, cy in zip(numbers, x, y, strict=True):
            assert where[names[number]] == pytest.approx((cx / 100, cy / 100), abs=0.006)
        facts = rest[-1]["facts"]
        assert facts["tally"]["episodes"] == 1
        socket.send(json.dumps({"next": True}))
        assert told(socket)["episode"]["facts"]["seed"] == 200_001
    server.http.delete(f"/api/sessions/{session}")
    words = {name: value for name, value in WORDS.items() if name != "scenario"}
    with cosim.open("merge", **words, others=Altruist) as local:
        local.reset(200_000)
        while not local.over:
            local.act({})
        assert local.result().trace_hash == facts["trace_hash"]


def Altruist() -> Any:
    return make("altruist-rule")


def test_the_tally_counts_a_seed_once(server: Server) -> None:
    session = opened(server, policy="idm", duration=1.0, warmup=1.0)
    counted = []
    with watching(server, session) as socket:
        for seed in (200_000, 200_000, 200_001):
            socket.send(json.dumps({"begin": seed}))
            told(socket)
            socket.send(json.dumps({"until": 100.0}))
            _, steps = drawn(socket, 100.0)
            counted.append(steps[-1]["facts"]["tally"]["episodes"])
    server.http.delete(f"/api/sessions/{session}")
    assert counted == [1, 1, 2]


def test_what_a_page_draws_of_an_explained_decision_is_told(server: Server) -> None:
    session = opened(server, policy="vfn-p")
    with watching(server, session) as socket:
        socket.send(json.dumps({"begin": 200_000}))
        socket.send(json.dumps({"until": 0.8}))
        lasting, steps = drawn(socket, 0.8)
    server.http.delete(f"/api/sessions/{session}")
    _, choices, forecast, beliefs = steps[-1]["decided"]
    assert beliefs is None, "all that is there is perceived"
    assert len(choices[0][6]) == 5  # action values
    assert len(forecast) > 5
    assert steps[-1]["interval"] == pytest.approx(0.4)
    assert ["words", None] in lasting


def test_a_choice_is_explained_and_stays_what_it_was(server: Server) -> None:
    session = opened(server, policy="vfn-p", duration=2.0)
    hashes, uses = [], []
    with watching(server, session) as socket:
        for _ in range(2):
            socket.send(json.dumps({"begin": 200_000}))
            head = told(socket)
            vehicles = [row for kind, row in head["add"] if kind == "vehicles"]
            number = next(k for k, row in enumerate(vehicles) if row[1] == 1)
            socket.send(json.dumps({"until": 100.0}))
            _, steps = drawn(socket, 100.0)
            hashes.append(steps[-1]["facts"]["trace_hash"])
            uses.append([step["uses"] for step in steps if "uses" in step])
            socket.send(json.dumps({"explain": vehicles[number][0]}))
    server.http.delete(f"/api/sessions/{session}")
    assert hashes[0] == hashes[1]
    assert (uses[0], len(uses[1])) == ([], 5)
    assert {row[0] for row in uses[1]} == {number}
    inputs = [(name, how) for name, how, _, _ in uses[1][0][1]]
    assert ("phi", "0 degrees") in inputs
    assert ("map branch", "its last layer zero") in inputs
    assert all(0 <= action < 5 and change >= 0.0 for _, rows in uses[1] for _, _, action, change in rows)
    assert any(change > 0.0 for _, rows in uses[1] for _, _, _, change in rows)


def test_a_program_s_session_is_watched_by_many_and_driven_by_it_alone(server: Server) -> None:
    words = {name: value for name, value in WORDS.items() if name != "scenario"}
    with client.open(server.url, "merge", **words) as session:
        one = server.http.get("/api/sessions").json()[-1]
        session.reset(7)
        with watching(server, one["id"]) as first, watching(server, one["id"]) as second:
            assert told(first)["road"] == told(second)["road"]
            first.send(json.dumps({"until": 4.0}))
            session.act({})
            session.act({})
            a, b = (drawn(socket, 0.8)[1] for socket in (first, second))
            assert [step["elapsed"] for step in a] == [step["elapsed"] for step in b] == [0.4, 0.8]
            with watching(server, one["id"]) as late:  # sees the newest, and whatever stays
                message = told(late)
                assert message["steps"] == [b[-1]]
                assert len([row for kind, row in message["add"] if kind == "vehicles"]) > 5
            listed = f"/api/sessions/{one['id']}"
            until(lambda: server.http.get(listed).json()["watched"] == 2)
            assert server.http.get(listed).json()["program"]
            session.close()
            assert told(first) == {"ended": "closed"}


def test_nonsense_ends_the_connection_and_an_unknown_session_is_named(server: Server) -> None:
    session = opened(server)
    for nonsense in ("nonsense", '{"until": -1}', '{"begin": "x"}', '{"more": 1}', "[]"):
        with watching(server, session) as socket:
            socket.send(nonsense)
            with pytest.raises(Exception, match="4400"):
                socket.recv(timeout=PATIENCE)
    server.http.delete(f"/api/sessions/{session}")
    with watching(server, session) as socket:
        assert told(socket) == {"ended": f"no session '{session}' is open"}


def test_a_page_of_another_origin_and_one_without_the_token_see_nothing(
    server: Server, tmp_path: Path
) -> None:
    session = opened(server)
    with pytest.raises(InvalidStatus), watching(server, session, origin="http://evil.example"):
        pass
    with watching(server, session, origin=server.url):
        pass
    server.http.delete(f"/api/sessions/{session}")
    with Server(tmp_path / "data", "--host", "0.0.0.0", COSIM_TOKEN=SECRET) as guarded:
        with pytest.raises(InvalidStatus), watching(guarded, "0" * 12):
            pass
        with watching(guarded, "0" * 12, additional_headers={"Authorization": f"Bearer {SECRET}"}) as socket:
            assert "ended" in told(socket)
        assert guarded.http.get("/").headers["location"] == "/login"
        wrong = guarded.http.post("/login", data={"token": "wrong"})
        assert (wrong.status_code, wrong.headers.get("set-cookie")) == (401, None)
        evil = guarded.http.post("/login", data={"token": SECRET}, headers={"Origin": "http://evil.example"})
        assert evil.status_code == 403
        right = guarded.http.post("/login", data={"token": SECRET})
        cookie = right.headers["set-cookie"]
        assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))
        assert SECRET not in cookie
        assert guarded.http.get("/api/runs").status_code == 200  # the client keeps it
        assert guarded.http.get("/").status_code == 200
        name, _, value = cookie.split(";")[0].partition("=")
        with watching(guarded, "0" * 12, additional_headers={"Cookie": f"{name}={value}"}) as socket:
            assert "ended" in told(socket)
        forged = {"Cookie": f"{name}={value[:-1]}x"}
        with pytest.raises(InvalidStatus), watching(guarded, "0" * 12, additional_headers=forged):
            pass
    assert SECRET not in guarded.log.read_text()


def test_a_slow_page_loses_the_oldest_steps_and_nothing_that_stays() -> None:
    async def slow() -> None:
        viewer = Viewer(asyncio.get_running_loop())
        lasting = ['["words",null]']
        viewer.begin(Scene("{}", "{}", [*lasting], "0"), lasting, "0")
        for k in range(1, 100):
            lasting.append(f'["words","{k}"]')
            viewer.add(str(k))
        (message,) = viewer.take()
        found = json.loads(message)
        assert len(found["add"]) == 100
        assert found["steps"] == [*range(100 - KEPT, 100)]
        assert viewer.dropped == 100 - KEPT
        assert viewer.take() == []

    asyncio.run(slow())


def test_the_tally_counts_what_applies() -> None:
    whole = {"crashed": True, "mission_success": None, "dt_mean_m": 10.0, "min_ttc_s": None}
    found = tally([whole, {**whole, "crashed": False, "mission_success": True, "min_ttc_s": 2.0}])
    assert (found["crashed"]["hits"], found["crashed"]["n"]) == (1, 2)
    assert found["crashed"]["low"] < 0.5 < found["crashed"]["high"]
    assert found["mission_success"]["n"] == 1
    assert (found["dt_mean_m"], found["min_ttc_s"]) == (10.0, 2.0)

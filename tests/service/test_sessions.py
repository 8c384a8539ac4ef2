"""Sessions: driven step by step, by our client as `cosim.open`'s are, by any program as JSON."""

from __future__ import annotations

import contextlib
import io
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import cosim
from cosim.envs.session import Session
from cosim.errors import BadInput, SimulationError
from cosim.service import client, wire
from cosim.types import ContinuousAction, MetaAction
from tests.service.postgres import until
from tests.service.servers import Server

WORDS: dict[str, Any] = {"demand": "contested", "duration": 4.0, "svo": 30.0, "warmup": 5.0}
PLAN = (MetaAction.ACCELERATE, ContinuousAction(-1.5), MetaAction.LANE_LEFT, None)


def drive(session: Session, seed: int) -> list[Any]:
    """Everything that an episode says; AVs do different things."""
    said: list[Any] = [session.reset(seed)]
    while not session.over:
        actions = {av: PLAN[(k + len(said)) % len(PLAN)] for k, av in enumerate(sorted(session.avs))}
        said.append(session.act(actions))
    return [*said, session.snapshot(), session.partner(), session.result().trace_hash, session.picture()]


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, name), getattr(b, name)) for name in a.__dataclass_fields__)
    return bool(a == b)


def test_a_remote_session_is_the_local_one_to_the_last_bit(server: Server) -> None:
    words = WORDS | {"errors": "stress"}
    with client.open(server.url, "merge", **words) as remote, cosim.open("merge", **words) as local:
        assert same(drive(remote, 7), drive(local, 7))
        ours, theirs = local.result().document(), remote.result().document()
        assert ours | {"timings": 0} == theirs | {"timings": 0}
        assert ours["human_errors_by_kind"]
        assert remote.scenario.duration == local.scenario.duration
        with pytest.raises(BadInput, match="the episode is over"):
            remote.act({})
        remote.reset(8)
        with pytest.raises(BadInput, match="no AV of that name"):
            remote.act({"nobody": 1})


def test_any_program_drives_a_session_by_json(server: Server) -> None:
    http = server.http
    asked = {"scenario": "merge", "policy": "altruist-rule", "maps": True, **WORDS}
    found = http.post("/api/sessions", json=asked).json()
    path = f"/api/sessions/{found['id']}"
    assert (found["scenario"], found["duration"], found["over"]) == ("merge", 4.0, True)
    step = http.post(f"{path}/reset", json={"seed": 7}).json()
    av = step["avs"][0]
    seen = step["observations"][av]
    assert seen["vehicles"][0]["id"] == av
    assert {"signal", "speed_limit", "action_mask", "limits"} <= seen.keys()
    action = {"accel": -2.0, "lane_offset": 0}
    step = http.post(
        f"{path}/act", json={"actions": {av: action} | dict.fromkeys(step["avs"][1:], "IDLE")}
    ).json()
    assert step["receipts"][av] == {"executed": True, "blocked": None}
    assert step["rewards"].keys() >= {av}
    arrays, _ = wire.unpack(http.get(f"{path}/maps", params={"av": av}).content)
    assert arrays[av].shape == (10, 4, 32, 128)
    truth = http.get(f"{path}/vehicles").json()
    assert {v["kind"] for v in truth["vehicles"]} == {"av", "hv"}
    assert Image.open(io.BytesIO(http.get(f"{path}/picture").content)).size == (640, 160)
    assert http.get(f"{path}/result").json()["steps"] == 1
    assert http.delete(path).status_code == 204
    assert http.post(f"{path}/act", json={"actions": {}}).status_code == 404


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"scenario": "marge"}, "scenario"),
        ({"scenario": ["merge", "exit"]}, "scenario"),
        ({"scenario": "merge", "policy": "/tmp/own.py:Own"}, "policy"),
        ({"scenario": "merge", "seeds": "1:2"}, "seeds"),
        ({"scenario": "merge", "idle_s": -1}, "idle_s"),
        ({"scenario": "merge", "reward": "own.py:R"}, "reward"),
        ({"scenario": "merge", "seed": 2**80}, "seed"),
        ({"scenario": "merge", "duration": "long"}, "duration"),
    ],
)
def test_a_session_of_nonsense_names_the_field(server: Server, body: dict[str, Any], field: str) -> None:
    answer = server.http.post("/api/sessions", json=body)
    assert (answer.status_code, answer.json()["field"]) == (422, field), answer.text


def test_a_wrong_field_of_a_reset_or_an_act_is_named_with_its_value(server: Server) -> None:
    path = (
        f"/api/sessions/{server.http.post('/api/sessions', json={'scenario': 'merge', **WORDS}).json()['id']}"
    )
    av = server.http.post(f"{path}/reset", json={"seed": 7}).json()["avs"][0]

    def refused(call: str, body: dict[str, Any]) -> tuple[str, Any, str]:
        found = server.http.post(f"{path}/{call}", json=body)
        assert found.status_code == 422, found.text
        return found.json()["field"], found.json()["value"], found.json()["problem"]

    assert refused("reset", {"sed": 7}) == ("sed", 7, "unknown field, did you mean 'seed'?")
    field, value, problem = refused("act", {"actions": {av: {"accel": "x"}}})
    assert (field, value) == (f"actions.{av}.accel", "x")
    assert "valid number" in problem
    field, value, problem = refused("act", {"actions": {av: {"accel": -1.0, "lane_offset": 5}}})
    assert (field, value, problem) == (
        f"actions.{av}.lane_offset",
        5,
        "Input should be less than or equal to 1",
    )
    assert refused("act", {"actions": {av: {"acel": -1.0}}})[0] == f"actions.{av}.acel"
    server.http.delete(path)


def test_an_idle_session_ends_by_itself_and_a_dead_one_begins_anew(server: Server) -> None:
    with client.open(server.url, "merge", **WORDS) as session:
        session.reset(1)
        os.kill(youngest_child(server.process.pid), signal.SIGKILL)
        with pytest.raises(SimulationError, match="the simulation failed"):
            session.act({})
    before = {one["id"] for one in server.http.get("/api/sessions").json()}
    with client.open(server.url, "merge", **WORDS, idle_s=1.0) as session:
        until(lambda: {one["id"] for one in server.http.get("/api/sessions").json()} <= before)
        with pytest.raises(BadInput, match="is open"):
            session.reset(1)


def youngest_child(pid: int) -> int:
    """The process that it started last."""
    began = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # a thread or a process that ended meanwhile
            for child in map(int, (task / "children").read_text().split()):
                began[child] = int(Path(f"/proc/{child}/stat").read_text().split()[21])
    return max(began, key=lambda child: began[child])


def test_no_server_is_one_sentence() -> None:
    with pytest.raises(BadInput, match="no server answers"):
        client.open("http://127.0.0.1:1", "merge")
    with pytest.raises(BadInput, match="http://HOST:PORT is needed"):
        client.open("merge", "merge")

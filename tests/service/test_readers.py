"""Which processes of a server read an upload: every one of them is confined."""

from __future__ import annotations

import gzip
import os
import random
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from policy.checkpoint import SHIPPED
from tests.service.servers import Server
from tests.service.test_uploads import CONFIG, DEMAND, NET, send

AUDIT = Path(__file__).with_name("audit") / "sitecustomize.py"
# Their names, and what they do with an upload.
PROCESSES = {
    "cosim-examiner": "takes it",
    "cosim-planner": "plans a run, an estimate, a session or a run that is resumed",
    "cosim-evaluation": "drives a run or an estimate",
    "cosim-session": "drives a session",
    "cosim-replay": "drives an episode again and draws it",
}


class Opened(NamedTuple):
    """A file of an upload, by the process that opened it."""

    process: str
    confined: bool
    file: str


def drawn_scenario(draw: random.Random) -> dict[str, bytes]:
    """An upload of the same road and traffic, in files of drawn names, packed or plain."""

    def name(suffix: str) -> str:
        return "".join(draw.choices("abcXYZ019_-", k=draw.randint(1, 12))) + suffix

    def packed(content: bytes) -> bytes:
        return gzip.compress(content) if draw.random() < 0.5 else content

    net, demand = f"net{name('.net.xml')}", f"cars{name('.rou.xml')}"
    config = CONFIG % (b"3", b"")
    for old, new in ((b"net.net.xml", net), (b"demand.rou.xml", demand)):
        config = config.replace(old, new.encode())
    folder = f"{name('')}/" if draw.random() < 0.5 else ""
    files = {name(".sumocfg"): config, net: packed(NET), demand: packed(DEMAND)}
    return {folder + file: content for file, content in files.items()}


def drawn_weights(draw: random.Random) -> dict[str, bytes]:
    """An upload of weights that ship, by another name."""
    name = f"w{draw.randrange(10**6)}"
    return {
        f"{name}.{kind}": (SHIPPED / f"conv2d-dqn.{kind}").read_bytes() for kind in ("safetensors", "json")
    }


def use(server: Server, draw: random.Random) -> None:
    """Do everything with two uploads that can be done with them."""
    scenario = send(server, drawn_scenario(draw)).json()["id"]
    weights = send(server, drawn_weights(draw), "policy").json()["id"]
    asked: dict[str, Any] = {
        "scenario": f"upload:{scenario}",
        "policy": f"mine=upload:{weights}",
        "penetration": draw.choice((0.2, 0.5, 1.0)),
        "duration": draw.choice((1, 2)),
        "warmup": 1,
    }
    assert server.http.post("/api/estimates", json=asked).json()["estimated_s"] > 0.0
    run = server.submit(**asked, seeds="140000:140002", output="tripinfo")
    server.http.post(f"/api/runs/{run}/cancel")
    if server.wait(run)["status"] == "cancelled":
        server.http.post(f"/api/runs/{run}/resume")  # which is planned once more
    assert server.wait(run)["status"] == "finished"
    for path in ("rows", "summary", "report", "files", "replay?episode=140000"):
        assert server.http.get(f"/api/runs/{run}/{path}").status_code == 200, path
    assert server.http.get("/api/compare", params={"a": run, "b": run}).status_code == 200
    session = f"/api/sessions/{server.http.post('/api/sessions', json=asked).json()['id']}"
    assert server.http.post(f"{session}/reset", json={"seed": 7}).status_code == 200
    assert server.http.post(f"{session}/act", json={"actions": {}}).status_code == 200
    assert server.http.get(f"{session}/picture").status_code == 200
    assert server.http.delete(session).status_code == 204


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> list[Opened]:
    """What was opened while uploads were used."""
    folder = tmp_path_factory.mktemp("readers")
    shutil.copy(AUDIT, folder)
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    with Server(folder / "data", "--workers", "2", PYTHONPATH=path) as server:
        server.warm()
        use(server, random.Random(52))
    lines = [line.split("\t") for line in (folder / "opened").read_text().splitlines()]
    return [Opened(process, confined == "True", file) for process, confined, file in lines]


@pytest.mark.soak
@pytest.mark.parametrize("process", PROCESSES)
def test_a_process_that_reads_an_upload_is_confined(opened: list[Opened], process: str) -> None:
    found = [one for one in opened if one.process == process]
    assert len({one.file.partition("/")[0] for one in found}) == 2, found  # of either upload
    assert [one for one in found if not one.confined] == []


@pytest.mark.soak
def test_no_other_process_reads_an_upload(opened: list[Opened]) -> None:
    assert {one.process for one in opened} == set(PROCESSES)

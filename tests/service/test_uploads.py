"""Uploads: scenarios and weights are driven as any other; what is hostile is refused or contained."""

from __future__ import annotations

import gzip
import io
import stat
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import sumo_scenarios
from policy.checkpoint import SHIPPED
from tests.service.postgres import until
from tests.service.servers import Server

MERGE = sumo_scenarios.folder("merge")
NET = (MERGE / "net.net.xml").read_bytes()
DEMAND = (MERGE / "demand" / "contested.rou.xml").read_bytes()
CONFIG = (
    b'<configuration><net-file value="net.net.xml"/><route-files value="demand.rou.xml"/>'
    b'<end value="%s"/>%s</configuration>'
)
GOOD = {"run.sumocfg": CONFIG % (b"3", b""), "net.net.xml": NET, "demand.rou.xml": DEMAND}
Files = Mapping[str | zipfile.ZipInfo, bytes]


def archive(files: Files, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip file of these files."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", method) as target:
        for name, content in files.items():
            target.writestr(name, content)
    return whole.getvalue()


def send(server: Server, body: bytes | Files, kind: str = "scenario") -> Any:
    """The server's answer to an upload."""
    content = body if isinstance(body, bytes) else archive(body)
    return server.http.post("/api/uploads", params={"kind": kind}, content=content)


def everything(folder: Path) -> set[str]:
    """Every path below it."""
    return {str(path) for path in folder.rglob("*")}


def link(name: str) -> zipfile.ZipInfo:
    """An entry that is a symbolic link."""
    entry = zipfile.ZipInfo(name)
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    return entry


def test_an_uploaded_scenario_is_driven(server: Server) -> None:
    more = b'<tripinfo-output value="/tmp/stolen.xml"/>'
    detector = b'<inductionLoop id="d" lane="main_in_0" pos="5" period="1" file="/tmp/stolen"/>'
    additional = b'<additional-files value="d.add.xml"/>'
    files = {
        **GOOD,
        "run.sumocfg": CONFIG % (b"3", more + additional),
        "d.add.xml": b"<additional>" + detector + b"</additional>",
    }
    upload = send(server, files).json()
    assert upload["about"]["options_not_passed_on"] == ["tripinfo-output=/tmp/stolen.xml"]
    name = f"upload:{upload['id']}"
    run = server.submit(scenario=name, demand="demand.rou.xml", output="tripinfo", penetration=0.5)
    assert server.http.delete(f"/api/uploads/{upload['id']}").status_code == 409
    assert server.wait(run)["status"] == "finished"
    rows = server.http.get(f"/api/runs/{run}/rows").json()["rows"]
    assert [(row["status"], row["demand"]) for row in rows] == [("ok", "demand")]
    (tripinfo,) = (e["name"] for e in server.http.get(f"/api/runs/{run}/files").json() if "/" in e["name"])
    assert "<tripinfo " in server.http.get(f"/api/runs/{run}/files/{tripinfo}").text
    assert not Path("/tmp/stolen").exists()
    assert not Path("/tmp/stolen.xml").exists()


def test_uploaded_weights_drive(server: Server) -> None:
    files = {name: (SHIPPED / name).read_bytes() for name in ("conv2d-dqn.safetensors", "conv2d-dqn.json")}
    answer = send(server, files, "policy")
    upload = answer.json()
    assert answer.status_code == 201, upload
    run = server.submit(scenario="merge", policy=f"mine=upload:{upload['id']}", duration=2, warmup=1)
    assert server.wait(run)["status"] == "finished"
    assert server.http.get(f"/api/runs/{run}/rows").json()["rows"][0]["policy"] == "mine"


def bomb() -> bytes:
    """A gz file of 300 MB that are 1.3 MB."""
    return gzip.compress(b"\0" * 300_000_000, 1)


NESTED = b"<configuration>" + b"<a>" * 100_000 + b"</a>" * 100_000 + b"</configuration>"
LAUGHS = b'<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><routes>&b;</routes>'
OUTSIDE = b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><routes>&a;</routes>'
CUT = NET.replace(b"<connection ", b"<xconnection ", 3)
BAD: dict[str, tuple[bytes | Files, str]] = {
    "traversal": ({**GOOD, "../../evil.xml": b"<a/>"}, "below the archive's own folder"),
    "absolute": ({**GOOD, "/tmp/evil.xml": b"<a/>"}, "below the archive's own folder"),
    "backslash": ({**GOOD, "..\\evil.xml": b"<a/>"}, "must not contain"),
    "symlink": ({**GOOD, link("a.xml"): b"/etc/passwd"}, "not a regular file"),
    "wrong type": ({**GOOD, "own.py": b"import os"}, "is not one of"),
    "no zip": (b"PK" + b"\0" * 100, "is not a readable zip file"),
    "empty": (b"", "is not a readable zip file"),
    "10,000 files": ({f"{k}.xml": b"" for k in range(10_000)}, "are more than"),
    "bomb": ({**GOOD, "a.xml": b"\0" * 300_000_000}, "unpacks to more than"),
    "gz bomb": ({**GOOD, "a.rou.xml.gz": bomb()}, "unpacks to more than"),
    "two configurations": ({**GOOD, "b.sumocfg": b"<configuration/>"}, "one .sumocfg is needed"),
    "entities": ({**GOOD, "demand.rou.xml": LAUGHS}, "entities may not be declared"),
    "external entity": ({**GOOD, "demand.rou.xml": OUTSIDE}, "entit"),
    "nested tags": ({**GOOD, "run.sumocfg": NESTED}, "nest deeper"),
    "net elsewhere": (
        {**GOOD, "run.sumocfg": (CONFIG % (b"3", b"")).replace(b"net.net", b"../../../etc/x")},
        "no such file in the archive",
    ),
    "absolute demand": (
        {**GOOD, "run.sumocfg": (CONFIG % (b"3", b"")).replace(b"demand.rou.xml", b"/etc/passwd")},
        "no such file in the archive",
    ),
    "include": (
        {**GOOD, "demand.rou.xml": b'<routes><include href="/etc/passwd"/></routes>'},
        "no such file in the archive",
    ),
    "saved state": (
        {**GOOD, "run.sumocfg": CONFIG % (b"3", b'<load-state value="/etc/passwd"/>')},
        "no such file in the archive",
    ),
    "a net that SUMO cannot take": ({**GOOD, "net.net.xml": CUT}, ""),
    "truncated net": ({**GOOD, "net.net.xml": NET[:3000]}, "truncated"),
    "unknown edge": ({**GOOD, "demand.rou.xml": DEMAND.replace(b"main_in", b"nowhere")}, "no such edge"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_upload_is_refused_and_leaves_nothing(server: Server, what: str) -> None:
    body, says = BAD[what]
    data = Path(server.data)
    before = everything(data)
    answer = send(server, body)
    assert answer.status_code == 422, answer.text
    assert says in answer.json()["problem"]
    assert str(data) not in answer.text
    until(lambda: everything(data) <= before)
    assert server.http.get("/health").json()["status"] == "ok"


def test_bad_weights_are_refused(server: Server) -> None:
    whole, card = ((SHIPPED / f"conv2d-dqn.{kind}").read_bytes() for kind in ("safetensors", "json"))
    for files, says in (
        ({"a.safetensors": whole}, "its card"),
        ({"a.safetensors": whole[:-8], "a.json": card}, "SHA-256"),
        ({"a.pt": whole, "a.json": card}, "is not one of"),
    ):
        answer = send(server, files, "policy")
        assert (answer.status_code, says in answer.json()["problem"]) == (422, True), answer.text


def test_more_than_the_server_takes_is_refused(server: Server) -> None:
    assert send(server, archive({"a.xml": bytes(70_000_000)}, zipfile.ZIP_STORED)).status_code == 413


def test_an_endless_simulation_is_ended_and_the_server_goes_on(server: Server) -> None:
    upload = send(server, {**GOOD, "run.sumocfg": CONFIG % (b"8e4", b"")}).json()
    run = server.submit(scenario=f"upload:{upload['id']}")
    server.wait(run, "running")
    time.sleep(1.0)
    other = server.submit(scenario="merge", duration=2, warmup=1)
    assert server.wait(other)["status"] == "finished"
    server.http.post(f"/api/runs/{run}/cancel")
    assert server.wait(run)["status"] == "cancelled"


def test_uploads_are_listed_and_deleted(server: Server) -> None:
    upload = send(server, GOOD).json()["id"]
    assert upload in {one["id"] for one in server.http.get("/api/uploads").json()}
    assert server.http.delete(f"/api/uploads/{upload}").status_code == 204
    assert server.http.get(f"/api/uploads/{upload}").status_code == 404
    answer = server.http.post("/api/runs", json={"scenario": f"upload:{upload}"})
    assert (answer.status_code, answer.json()["field"]) == (422, "scenario")

"""`cosim serve --engine ray`: the hashes of this machine; cancelled at once, nothing lost by a kill."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from tests.service.servers import Server
from tests.service.test_uploads import GOOD, send

SHORT: dict[str, Any] = {"scenario": "merge", "demand": "contested", "duration": 2, "warmup": 1}
FLAGS = ("--workers", "2", "--engine", "ray")


@pytest.mark.soak
def test_runs_on_ray_are_those_of_this_machine(server: Server, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    run = server.submit(**SHORT, seeds="200000:200004")
    assert server.wait(run)["status"] == "finished"
    undisturbed = server.hashes(run)
    upload = send(server, GOOD).json()["id"]
    uploaded = server.submit(scenario=f"upload:{upload}", penetration=0.5)
    assert server.wait(uploaded)["status"] == "finished"

    cluster = Server(tmp_path / "data", *FLAGS)
    endless = cluster.submit(scenario="merge", duration=30_000)
    runs = {seed: cluster.submit(**SHORT, seeds=f"{seed}:{seed + 1}") for seed in undisturbed}
    cluster.wait(endless, "running")
    time.sleep(5.0)  # it is driven, or its actors start
    cluster.http.post(f"/api/runs/{endless}/cancel")
    assert cluster.wait(endless)["status"] == "cancelled"
    estimate = cluster.http.post("/api/estimates", json=SHORT).json()
    assert estimate["estimated_s"] > 0.0
    cluster.wait(runs[200000])
    cluster.kill()
    with Server(tmp_path / "data", *FLAGS) as cluster:
        for run in runs.values():
            assert cluster.wait(run)["status"] == "finished"
        assert {k: v for run in runs.values() for k, v in cluster.hashes(run).items()} == undisturbed
        upload = send(cluster, GOOD).json()["id"]
        run = cluster.submit(scenario=f"upload:{upload}", penetration=0.5)
        assert cluster.wait(run)["status"] == "finished"
        assert cluster.hashes(run) == server.hashes(uploaded)

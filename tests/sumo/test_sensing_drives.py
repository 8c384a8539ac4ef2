"""Sensing levels in SUMO: one flag changes what AVs know, and nothing of what is measured."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.envs.gym import SumoEnv
from cosim.errors import BadInput
from cosim.host import Host
from cosim.report.replay.packing import document
from cosim.scenario import load
from cosim.service.requests import RunRequest, flags
from cosim.service.views import view
from cosim.types import EpisodeResult, Kind, Preset, Snapshot, Source

FLEET: dict[str, Any] = {"demand": "contested", "penetration": 0.4, "duration": 3.0}


def driven(
    sensing: str | None, policy: str = "altruist-rule", **words: Any
) -> tuple[EpisodeResult, Snapshot]:
    """One short episode on the merge, and its last snapshot."""
    scenario = load("merge", sensing=sensing, **({"preset": Preset.UNGUARDED} | FLEET | words))
    host = Host(scenario, policy, math.radians(45.0))
    try:
        return host.run(7), host.episode.snapshot
    finally:
        host.close()


def test_a_level_is_named_repeats_itself_and_changes_what_avs_know() -> None:
    ideal, _ = driven(None)
    named, snapshot = driven("ideal")
    assert (named.trace_hash, named.sensing, snapshot.percepts) == (ideal.trace_hash, None, None)
    late, snapshot = driven("v2v,delay=0.8")
    again, _ = driven("v2v,delay=0.8")
    assert late.trace_hash == again.trace_hash != ideal.trace_hash
    assert late.document()["sensing"] == "v2v,delay=0.8"
    assert snapshot.percepts is not None
    assert set(snapshot.percepts) == set(snapshot.avs)
    for av, percept in snapshot.percepts.items():
        assert av in percept.world.ids
        assert percept.world.ids == tuple(sorted(percept.world.ids))
        assert percept.age.max() <= 0.8 + 1.0 + 0.3


def test_where_nobody_decides_by_it_sensing_changes_nothing_but_the_hash() -> None:
    places = [driven(level, "keep-lane")[1] for level in (None, "harsh")]
    assert places[0].ids == places[1].ids
    assert places[0].x.tolist() == places[1].x.tolist()


def test_an_agent_is_told_how_late_its_decisions_act() -> None:
    for sensing, latency in (("v2v,decision_latency=0.25", 0.3), (None, 0.0)):
        words: dict[str, Any] = {"sensing": sensing, "preset": Preset.UNGUARDED, "worker": False} | FLEET
        with cosim.open("merge", seed=7, **words) as session:
            seen = session.observe()
            assert {v.decision_latency for v in seen.values()} == {latency}
            assert {view(v)["decision_latency"] for v in seen.values()} == {latency}
            seen = session.act({}).observations
            assert {v.decision_latency for v in seen.values()} == {latency}
        env = SumoEnv("merge", flatten="kinematics", **words)
        assert env.reset(seed=7)[1]["decision_latency"] == latency
        env.close()


def test_a_replay_holds_what_each_av_believed_and_did_not_see() -> None:
    scenario = load("merge", sensing="radar-camera,latency=0.8,compensation=hold", **FLEET)
    host = Host(scenario, "altruist-rule", math.radians(45.0))
    try:
        _, replay = host.run_recorded(7)
    finally:
        host.close()
    packed = document(replay)
    names = [row[0] for row in packed["vehicles"]]
    tracks = {track.id: track for track in replay.tracks}
    hidden = believed = 0
    for k, beliefs in zip(
        np.searchsorted(replay.times, replay.decided - 1e-6), packed["beliefs"], strict=True
    ):
        for av, known, unseen in beliefs:
            assert tracks[names[av]].kind == Kind.AV
            hidden += len(unseen)
            for vehicle, x, y, age, source in known:
                track = tracks[names[vehicle]]
                speed = track.speed[k - track.first]
                assert source == Source.SENSOR
                assert math.hypot(x, y) / 10.0 == pytest.approx(speed * age / 10.0, abs=4.0)
                believed += 1
    assert hidden > 20
    assert believed > 20
    json.dumps(packed)
    assert driven(None)[1].percepts is None


def test_a_building_of_an_additional_file_stands_between(tmp_path: Path) -> None:
    at = -295.0  # m, where a wall crosses the road: what nobody could build, and everybody can check
    file = tmp_path / "walls.add.xml"
    shape = f"{at},-500 {at},500"
    for kind, hides in (("building", True), ("building.house", True), ("park", False)):
        file.write_text(f'<additional><poly id="w" type="{kind}" color="red" shape="{shape}"/></additional>')
        scenario = load("merge", sensing="ideal,line_of_sight=true,forget=0.1", **FLEET)
        host = Host(replace(scenario, additional=(file,)), "idm", 0.0)
        try:
            host.run(7)
            snapshot = host.episode.snapshot
        finally:
            host.close()
        assert snapshot.percepts is not None
        beyond = [
            snapshot.x[snapshot.row[name]] > at
            for av, percept in snapshot.percepts.items()
            if snapshot.x[snapshot.row[av]] < at - 5.0
            for name in percept.world.ids
            if abs(snapshot.x[snapshot.row[name]] - at) > 5.0
        ]
        assert len(beyond) > 20
        assert any(beyond) is not hides, kind


def test_http_takes_levels_and_parameters_but_no_file() -> None:
    given, _ = flags(RunRequest(scenario="merge", sensing=["v2v", "v2v,delay=0.8"]), None)  # type: ignore[arg-type, call-arg]
    assert given["sensing"] == ["v2v", "v2v,delay=0.8"]
    with pytest.raises(BadInput, match="no file or code is read"):
        flags(RunRequest(scenario="merge", sensing="/etc/x.yaml,delay=1"), None)  # type: ignore[arg-type, call-arg]

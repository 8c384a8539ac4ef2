"""A user's file without AVs drives as plain SUMO drives it; what AVs need is changed with them, and said."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.cli.main import main
from cosim.episode import Episode, Hook, Step
from cosim.host import Host
from cosim.scenario import Fleet, load
from cosim.workers.worker import Worker

SEED = 140_000
END = 240.0  # s
OPTIONS = {  # what a user's file may say of the traffic
    "SUMO's defaults": "",
    "impatience with queues": '<time-to-teleport value="10"/><collision.action value="remove"/>'
    '<collision.check-junctions value="true"/><collision.mingap-factor value="1"/>',
    "a step of its own": '<step-length value="0.25"/><lanechange.duration value="3"/>',
    "a step that no frame divides": '<step-length value="0.15"/><step-method.ballistic value="true"/>',
    "sublane": '<step-length value="0.5"/><lateral-resolution value="0.8"/>',
}
WORLDS = ("lane_drop", "weaving", "mixed_types", "crossing_signals")
Arrivals = dict[str, float]  # vehicle -> s


class Plain:
    """SUMO on a configuration as it is."""

    def arrivals(self, config: str) -> Arrivals:
        import libsumo

        quiet = ["--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true"]
        libsumo.start(["sumo", "-c", config, "--seed", str(SEED), *quiet])
        found: Arrivals = {}
        while libsumo.simulation.getTime() < END:
            libsumo.simulationStep()
            now = libsumo.simulation.getTime()
            found |= dict.fromkeys(libsumo.simulation.getArrivedIDList(), now)
        libsumo.close()
        return found

    def close(self) -> None:
        """It has ended."""


class Arriving(Hook):
    """Who arrives in which frame."""

    def __init__(self) -> None:
        self.found: Arrivals = {}

    def on_step(self, episode: Episode, step: Step) -> None:
        for frame in step.frames:
            self.found |= dict.fromkeys(frame.events.arrived, frame.time)


class Ours:
    """cosim on the same."""

    def arrivals(self, config: str, traffic: str | None = None) -> tuple[Arrivals, float]:
        """And the s between frames."""
        scenario = load(config, fleet=Fleet(penetration=0.0), mission="none", traffic=traffic)
        host, arriving = Host(scenario, "idm", 0.0), Arriving()
        try:
            host.run(SEED, hooks=[arriving])
        finally:
            host.close()
        return arriving.found, scenario.timing.frame

    def close(self) -> None:
        """It has ended."""


@pytest.fixture(scope="module")
def workers() -> Iterator[tuple[Worker, Worker]]:
    plain, ours = Worker(Plain, timeout=60.0), Worker(Ours, timeout=120.0)
    yield plain, ours
    plain.close()
    ours.close()


@pytest.fixture
def user(law_worlds: dict[str, Path], tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """One of tests/worlds as a user's file with these options."""
    world, options = request.param
    place = law_worlds[world].parent
    config = tmp_path / "user.sumocfg"
    config.write_text(
        f'<configuration><net-file value="{place / "net.net.xml"}"/>'
        f'<route-files value="{place / "demand.rou.xml"}"/><end value="{END:g}"/>{OPTIONS[options]}'
        "</configuration>"
    )
    return config


CASES = [
    *((world, "SUMO's defaults") for world in WORLDS),
    *(("weaving", name) for name in OPTIONS if name != "SUMO's defaults"),
]


@pytest.mark.parametrize("user", CASES, ids=": ".join, indirect=True)
def test_without_avs_the_same_vehicles_arrive_at_the_same_times_as_in_plain_sumo(
    user: Path, workers: tuple[Worker, Worker]
) -> None:
    plain = workers[0].call("arrivals", str(user))
    ours, frame = workers[1].call("arrivals", str(user))
    assert len(plain) > 30
    late = {name: ours.get(name, -1.0) - time for name, time in plain.items()}
    assert ours.keys() == plain.keys()
    assert all(-1e-6 < s < frame - 1e-6 for s in late.values()), "within the frame in which SUMO says so"


@pytest.mark.parametrize("user", [("weaving", "SUMO's defaults")], indirect=True)
def test_controlled_traffic_is_another_and_can_be_had_without_avs(
    user: Path, workers: tuple[Worker, Worker]
) -> None:
    plain = workers[0].call("arrivals", str(user))
    ours, frame = workers[1].call("arrivals", str(user), "controlled")
    assert frame == 0.2
    assert ours.keys() != plain.keys()


def document(capsys: pytest.CaptureFixture[str], *flags: str) -> dict[str, Any]:
    assert main(["run", *flags, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.parametrize("user", [("lane_drop", "impatience with queues")], indirect=True)
def test_the_result_says_whose_traffic_it_is_and_what_was_changed(
    user: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = [str(user), "--duration", "4"]
    alone = document(capsys, *short, "--penetration", "0", "--out", str(tmp_path / "alone"))["manifest"]
    assert alone["traffic"] == "as-is"
    assert "changed_options" not in alone
    assert alone["timing"] == alone["timing"] | {"step_s": 1.0, "frame_s": 1.0, "decision_s": 1.0}
    assert alone["sumo_options"]["collision.action"] == "remove"
    mixed = document(capsys, *short, "--penetration", "0.5")["manifest"]
    assert mixed["traffic"] == "controlled"
    changed = {name: (c["file"], c["used"]) for name, c in mixed["changed_options"].items()}
    assert changed == {
        "step-length": ("1", "0.1"),
        "lanechange.duration": ("0", "2"),
        "collision.action": ("remove", "warn"),
        "collision.mingap-factor": ("1", "0"),
    }, "its own time to a teleport stays, and junctions are checked as it asks"
    assert all(c["why"] for c in mixed["changed_options"].values())
    assert mixed["sumo_options"]["time-to-teleport"] == "10"
    assert main(["run", *short, "--penetration", "0.5", "--", "--time-to-teleport", "300"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"(?s)traffic controlled: step-length 1 -> 0.1, .*collision.action remove -> warn", said)
    assert main(["replay", str(tmp_path / "alone"), "--html", str(tmp_path / "r.html")]) == 0


@pytest.mark.parametrize("user", [("lane_drop", "SUMO's defaults")], indirect=True)
def test_a_policy_that_predicts_waits_for_nobody_in_traffic_as_it_is(
    user: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = document(capsys, str(user), "--duration", "4", "--policy", "vfn-p", "--penetration", "0")
    assert found["steps"] == 4
    assert found["comparable"] is True


@pytest.mark.parametrize(("checks", "wrecks"), [("false", False), ("true", True)])
@pytest.mark.parametrize("user", [("priority", "SUMO's defaults")], indirect=True)
def test_humans_overlap_inside_a_junction_as_their_file_lets_them(
    user: Path, checks: str, wrecks: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    blind = 'jmIgnoreJunctionFoeProb="1" jmIgnoreFoeProb="1" jmIgnoreFoeSpeed="99" length="16"'
    (user.parent / "a.add.xml").write_text(f'<additional><vType id="DEFAULT_VEHTYPE" {blind}/></additional>')
    more = f'<additional-files value="a.add.xml"/><collision.check-junctions value="{checks}"/>'
    user.write_text(user.read_text().replace("</conf", f"{more}</conf"))
    flags = ["run", str(user), "--traffic", "controlled", "--duration", "120", "--mission", "none"]
    assert main([*flags, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [c["kind"] for c in found["collision_list"]].count("junction") > 2
    assert (found["wrecks_removed"] > 0) == wrecks
    assert main(flags) == 0
    assert ("of these: humans inside junctions" in capsys.readouterr().out) != wrecks

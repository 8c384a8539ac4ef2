"""Anybody's SUMO files are driven as they come: those that SUMO's package brings, and small ones."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import sumo

import cosim
from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.scenario import load
from cosim.scenario.vet import vet

GAMES = Path(sumo.SUMO_HOME) / "tools" / "game"
CONFIGS = sorted(GAMES.rglob("*.sumocfg"))
ROUTES = """<routes>
  <vType id="car" carFollowModel="IDM"/>
  <route id="through" edges="ab bc"/>
  <flow id="main" type="car" route="through" begin="0" end="60" period="12" departSpeed="max"/>
  <vehicle id="main" type="car" depart="1"><route edges="rb bc"/></vehicle>
  <flow id="side" type="car" begin="5" end="60" period="10"><route edges="rb bc"/></flow>
</routes>"""

AVS = r"main\..*"
Drive = Callable[..., dict[str, Any]]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A road with a side road that gives way."""
    place = tmp_path / "city"
    place.mkdir()
    nodes = '<nodes><node id="a" x="0" y="0"/><node id="b" x="300" y="0"/><node id="c" x="600" y="0"/>'
    (place / "n.nod.xml").write_text(nodes + '<node id="r" x="300" y="-200"/></nodes>')
    edges = "".join(
        f'<edge id="{i}" from="{i[0]}" to="{i[1]}" priority="{p}" speed="14"/>'
        for i, p in (("ab", 9), ("bc", 9), ("rb", 1))
    )
    (place / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    build = ["netconvert", "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"]
    binary = Path(sumo.SUMO_HOME) / "bin" / build[0]
    subprocess.run([binary, *build[1:]], cwd=place, check=True, capture_output=True)
    (place / "r.rou.xml").write_text(ROUTES)
    file = place / "run.sumocfg"
    file.write_text(
        '<configuration><net-file value="n.net.xml"/><route-files value="r.rou.xml"/>'
        '<end value="60"/></configuration>'
    )
    return file


@pytest.fixture
def drive(config: Path, capsys: pytest.CaptureFixture[str]) -> Drive:
    """`cosim run` with these flags; its document."""

    def run(*flags: str) -> dict[str, Any]:
        assert main(["run", str(config), "--av-ids", AVS, "--json", *flags]) == 0
        document: dict[str, Any] = json.loads(capsys.readouterr().out)
        return document

    return run


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: str(path.relative_to(GAMES)))
def test_every_configuration_of_sumos_package_is_read(path: Path) -> None:
    assert vet(load(str(path))).edges > 0


def test_trains_are_driven_and_said_not_to_be_supported(capsys: pytest.CaptureFixture[str]) -> None:
    path = GAMES / "rail_demo.sumocfg"
    assert main(["run", str(path), "--penetration", "1", "--duration", "20", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["vehicles_inserted"] > 0
    reasons = " ".join(found["not_comparable_because"])
    assert "no road vehicles" in reasons
    assert "no AV was ever on the road" in reasons


def test_a_flow_and_a_vehicle_of_one_id_are_driven_and_the_guess_is_said(drive: Drive) -> None:
    found = drive()
    assert found["scenario"] == "city/run"
    assert found["vehicles_inserted"] > 10
    assert (found["mission_vehicle"], found["mission_guessed"]) == ("main", True)
    assert found["comparable"] is True


def test_a_mission_vehicle_is_named_or_there_is_none(drive: Drive) -> None:
    found = drive("--mission", "side.1")
    assert (found["mission_vehicle"], found["mission_guessed"]) == ("side.1", False)
    assert found["mission_success"] is True
    several = drive("--mission", r"side\.[01]")
    assert several["mission_vehicle"] == "side.0, side.1"
    assert several["manifest"]["mission"] == r"side\.[01]"
    nobody = drive("--mission", "none")
    assert (nobody["mission_vehicle"], nobody["mission_success"]) == (None, None)


def test_the_table_says_that_the_mission_vehicle_is_a_guess(
    config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(config), "--av-ids", AVS]) == 0
    said = capsys.readouterr().out
    assert "main is the mission vehicle: the driver that has to reach its goal. It is guessed" in said


def test_a_warm_up_is_driven_before_the_counted_time(drive: Drive) -> None:
    cold, warm = drive("--duration", "8"), drive("--duration", "8", "--warmup", "30")
    assert (cold["manifest"]["timing"]["warmup_s"], warm["manifest"]["timing"]["warmup_s"]) == (0.0, 30.0)
    assert cold["steps"] == warm["steps"] == 20
    assert warm["vehicles_inserted"] > cold["vehicles_inserted"] + 5


def test_a_session_takes_the_words_of_run(config: Path) -> None:
    words: dict[str, Any] = {"penetration": 1.0, "warmup": 20, "mission": "side.0", "duration": 8}
    with cosim.open(str(config), **words, seed=200_000) as session:
        session.reset()
        snapshot = session.snapshot()
        assert snapshot.time == pytest.approx(20.0)
        assert [
            name for name, is_mission in zip(snapshot.ids, snapshot.mission, strict=True) if is_mission
        ] == ["side.0"]
        assert len(session.avs) == snapshot.n - 1
        scenario = session.scenario
    with pytest.raises(BadInput, match="is part of the Scenario that is given"):
        cosim.open(scenario, warmup=3.0)


def test_as_is_drivers_have_sumos_speed_deviation_and_avs_their_types_mean(config: Path) -> None:
    def speeds(behavior: str | None, penetration: float) -> set[float]:
        words: dict[str, Any] = {"penetration": penetration, "warmup": 8, "duration": 2, "behavior": behavior}
        with cosim.open(str(config), **words, mission="none", seed=200_000) as session:
            session.reset()
            snapshot = session.snapshot()
            return {
                round(float(v), 2)
                for v, x in zip(snapshot.speed, snapshot.lane_position, strict=True)
                if x > 30
            }

    assert len(speeds(None, 0.0)) > 1
    assert all(speed <= 14.0 for speed in speeds(None, 1.0))

"""Everybody's figures on a jammed road agree with what SUMO writes of the same drive."""

from __future__ import annotations

import json
import subprocess
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sumo

from cosim.cli.main import main
from cosim.seeding import uniform

END = 120.0  # s
SEED = 140_000
TRIP = 0.02  # s: an arrival's last reading is up to a frame old (0.2 s near free flow; measured: 0.018 s)
# Twice as many as the lane can take: wished departure, s
WISHED = {f"{'av' if k % 4 == 0 else 'hv'}.{k}": round(0.63 * k, 2) for k in range(180)}
SLOW, FORGETS = 1.0, 2.0  # m/s, and s a second: docs/reference/figures.md, Everybody

Drive = Callable[..., "Driven"]


@dataclass(frozen=True)
class Driven:
    """One drive: our figures, and SUMO's account of each vehicle's trip."""

    figures: dict[str, Any]
    folder: Path

    @property
    def trips(self) -> dict[str, ElementTree.Element]:
        found = ElementTree.parse(self.folder / "outputs" / "tripinfo.xml").getroot()
        return {str(trip.get("id")): trip for trip in found.iter("tripinfo")}

    @property
    def delays(self) -> dict[str, float]:
        """s of every vehicle that was to depart: SUMO's, and until the end of those it inserted never."""
        trips, found = self.trips, {}
        for name, wished in WISHED.items():
            trip = trips.get(name)
            if trip is None or number(trip, "depart") < 0.0:
                found[name] = END - wished
            else:
                found[name] = number(trip, "departDelay") + number(trip, "timeLoss")
        return found


def number(trip: ElementTree.Element, name: str) -> float:
    return float(trip.get(name, "nan"))


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two lanes become one behind a bend, and many more want to depart than it can take."""
    place = tmp_path_factory.mktemp("jam")
    nodes = (
        '<nodes><node id="a" x="0" y="0"/><node id="b" x="400" y="0"/><node id="c" x="600" y="80"/></nodes>'
    )
    (place / "n.nod.xml").write_text(nodes)
    edges = '<edge id="ab" from="a" to="b" numLanes="2" speed="20"/>'
    edges += '<edge id="bc" from="b" to="c" numLanes="1" speed="8"/>'
    (place / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    binary = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    build = [binary, "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"]
    subprocess.run(build, cwd=place, check=True, capture_output=True)
    vehicles = "".join(
        f'<vehicle id="{name}" type="car" route="way" depart="{wished}" departLane="best" departSpeed="max"/>'
        for name, wished in WISHED.items()
    )
    (place / "r.rou.xml").write_text(
        f'<routes><vType id="car"/><route id="way" edges="ab bc"/>{vehicles}</routes>'
    )
    file = place / "run.sumocfg"
    file.write_text(
        '<configuration><net-file value="n.net.xml"/><route-files value="r.rou.xml"/>'
        f'<end value="{END:g}"/><route-steps value="10"/></configuration>'  # read as time goes on
    )
    return file


@pytest.fixture
def drive(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Drive:
    def run(*flags: str, avs: tuple[str, str] = ("--av-ids", r"av\..*")) -> Driven:
        words = ["run", str(config), "--seed", str(SEED), *avs, "--out", str(tmp_path / "run"), "--json"]
        words += ["--output", "tripinfo", "--output", "fcd", "--mission", "none", "--", *flags]
        assert main(words) == 0
        return Driven(json.loads(capsys.readouterr().out), tmp_path / "run")

    return run


def test_the_delay_of_all_of_avs_and_of_humans_is_that_of_sumos_trips(drive: Drive) -> None:
    driven = drive("--device.emissions.probability", "1")
    figures, trips, delays = driven.figures, driven.trips, driven.delays
    undeparted = [name for name, trip in trips.items() if number(trip, "depart") < 0.0]
    assert len(undeparted) == figures["vehicles_never_inserted"] > 50
    for name in undeparted:  # SUMO says the same of them as the route file
        assert number(trips[name], "departDelay") == pytest.approx(delays[name], abs=1e-3)
    assert figures["vehicles_due"] == len(WISHED)
    assert figures["total_delay_s"] == pytest.approx(np.mean([*delays.values()]), abs=TRIP)
    for column, prefix in (("av", "av."), ("hv", "hv.")):
        mine = [delay for name, delay in delays.items() if name.startswith(prefix)]
        assert figures[f"total_delay_{column}_s"] == pytest.approx(np.mean(mine), abs=TRIP)
    slowest = sorted(delays.values())[-len(WISHED) // 10 :]
    assert figures["total_delay_slowest_tenth_s"] == pytest.approx(np.mean(slowest), abs=TRIP)
    arrived = [name for name, trip in trips.items() if number(trip, "arrival") >= 0.0]
    assert figures["arrivals"] == len(arrived) > 10
    assert figures["arrivals_av"] == sum(name.startswith("av.") for name in arrived) > 0
    assert figures["arrivals_hv"] == figures["arrivals"] - figures["arrivals_av"]
    driven_trips = [trip for trip in trips.values() if number(trip, "depart") >= 0.0]
    length, time = (sum(number(trip, of) for trip in driven_trips) for of in ("routeLength", "duration"))
    assert figures["mean_speed_mps"] == pytest.approx(length / time, rel=0.01)
    emitted = sum(number(found, "CO2_abs") for trip in driven_trips for found in trip.iter("emissions"))  # mg
    assert figures["co2_kg"] == pytest.approx(emitted / 1e6, rel=0.01)
    assert figures["co2_kg_per_vehicle_km"] == pytest.approx(emitted / length / 1e3, rel=0.01)


def test_vehicles_that_sumo_gives_up_are_late_until_the_end(drive: Drive) -> None:
    """Its trips do not hold them."""
    driven = drive("--max-depart-delay", "5")
    assert len(WISHED) - len(driven.trips) > 50
    assert driven.figures["vehicles_due"] == len(WISHED)
    delays = driven.delays
    assert driven.figures["total_delay_s"] == pytest.approx(np.mean([*delays.values()]), abs=TRIP)


def test_who_would_have_been_an_av_is_drawn_as_for_those_inserted(drive: Drive) -> None:
    driven = drive(avs=("--penetration", "0.3"))
    avs = {name for name in WISHED if uniform(SEED, "av", name) < 0.3}
    inserted = {name for name, trip in driven.trips.items() if number(trip, "depart") >= 0.0}
    assert avs & inserted
    assert avs - inserted
    mine = [delay for name, delay in driven.delays.items() if name in avs]
    assert driven.figures["total_delay_av_s"] == pytest.approx(np.mean(mine), abs=TRIP)


def test_waits_are_those_of_the_speeds_that_sumo_writes(drive: Drive) -> None:
    driven = drive()
    waited: defaultdict[str, float] = defaultdict(float)
    squared: defaultdict[str, float] = defaultdict(float)
    longest = 0.0
    for name, trip in driven.trips.items():
        outside = number(trip, "departDelay")
        waited[name], squared[name], longest = outside, outside**2, max(longest, outside)
    seen: set[str] = set()
    for step in ElementTree.parse(driven.folder / "outputs" / "fcd.xml").getroot():
        for vehicle in step.iter("vehicle"):
            name, slow = str(vehicle.get("id")), float(vehicle.get("speed", "nan")) < SLOW
            elapsed = 0.2
            after = waited[name] + elapsed if slow else max(waited[name] - FORGETS * elapsed, 0.0)
            squared[name] += after**2 - waited[name] ** 2 if slow else 0.0
            waited[name], longest = after, max(longest, after)
            seen.add(name)
    assert len(seen) > 50
    assert driven.figures["longest_wait_s"] == pytest.approx(longest, abs=0.01)
    mean = sum(squared.values()) / len(WISHED)
    assert driven.figures["mean_squared_wait_s2"] == pytest.approx(mean, rel=0.01)


def test_of_a_warm_up_nothing_counts(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What all lose in the second minute is what they lose in two, less what they lose in the first."""

    def lost(*flags: str) -> float:
        assert main(["run", str(config), "--seed", str(SEED), "--penetration", "0.3", "--json", *flags]) == 0
        found = json.loads(capsys.readouterr().out)
        return float(found["total_delay_s"] * found["vehicles_due"])

    first, both = lost("--duration", "60"), lost("--duration", "120")
    assert lost("--warmup", "60", "--duration", "60") == pytest.approx(both - first, rel=1e-3)


def test_wrecks_lose_the_rest_of_the_time_and_have_not_arrived(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    end = 150.0  # s
    words = ["run", "merge", "--demand", "dense", "--policy", "random", "--preset", "unguarded"]
    words += ["--on-collision", "continue", "--penetration", "0.4", "--warmup", "0", "--seed", "140003"]
    words += ["--duration", f"{end:g}", "--output", "tripinfo", "--out", str(tmp_path / "run"), "--json"]
    assert main(words) == 0
    driven = Driven(json.loads(capsys.readouterr().out), tmp_path / "run")
    late, arrived, wrecks = [], 0, 0
    for trip in driven.trips.values():
        gone = number(trip, "arrival") >= 0.0
        wreck = gone and trip.get("vaporized") == "traci"
        rest = end - number(trip, "arrival") if wreck else 0.0
        late.append(number(trip, "departDelay") + number(trip, "timeLoss") + rest)
        wrecks, arrived = wrecks + wreck, arrived + (gone and not wreck)
    assert wrecks == driven.figures["wrecks_removed"] > 5
    assert driven.figures["arrivals"] == arrived > 0
    assert driven.figures["total_delay_s"] == pytest.approx(np.mean(late), abs=TRIP)


def test_a_run_prints_everybodys_figures_together(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(config), "--duration", "20", "--penetration", "0", "--seed", str(SEED)]) == 0
    said = capsys.readouterr().out
    assert "delay of all, s" in said
    assert "delay of humans, s" in said
    assert "delay of AVs" not in said  # there are none

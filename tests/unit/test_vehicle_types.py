"""Each vehicle type is written once more for every driver: the vehicle is its own, the driver is not."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from cosim.scenario import Fleet, Scenario, load
from cosim.scenario.disabled_outputs import disable_outputs
from cosim.scenario.vehicle_types import Driver, vehicle_types
from cosim.simulation.conventions import type_names
from cosim.simulation.derived_types import drivers
from cosim.simulation.shared import lost
from cosim.types import Preset

VEHICLE = {
    "vClass": "bus",
    "length": "12",
    "maxSpeed": "20",
    "personCapacity": "40",
    "loadingDuration": "9",
    "parkingBadges": "gold",
    "maneuverAngleTimes": "10 1 2,80 3 4",
    "emissionClass": "HBEFA4/UBus",
    "speedFactor": "0.9",
    "impatience": "0.3",
    "timeToTeleport": "77",
}
DRIVER = {"carFollowModel": "EIDM", "tau": "1.4", "decel": "4", "actionStepLength": "1", "lcStrategic": "9"}
JUNCTIONS = {"jmDriveAfterRedTime": "300"}
MORE = """<routes>
    <vTypeDistribution id="mix" vTypes="b/1"><vType id="c"/></vTypeDistribution>
    <vehicle id="v" depart="0"><route edges="e"/></vehicle>
</routes>"""
LISTS = """<additional>
    <rerouter id="r" edges="e" vTypes="mix other"/><edgeData id="d" file="x.xml" vTypes="b/1"/>
    <tlLogic id="t"><param key="vTypes" value="c"/><phase duration="9" state="G"/></tlLogic>
    <person id="p"><personTrip from="e" to="e" vTypes="c"/><param key="vTypes" value="c"/></person>
</additional>"""


@pytest.fixture
def scenario(tmp_path: Path) -> Scenario:
    attributes = " ".join(f'{k}="{v}"' for k, v in (VEHICLE | DRIVER | JUNCTIONS).items())
    kind = f'<vType id="b/1" imgFile="b.png" {attributes}><param key="owner" value="&lt;city&gt;"/></vType>'
    (tmp_path / "n.net.xml").write_text(
        '<net><tlLogic id="t"><param key="vTypes" value="c"/></tlLogic></net>'
    )
    (tmp_path / "t.add.xml").write_text(f"<additional>{kind}</additional>")
    (tmp_path / "l.add.xml").write_text(LISTS)
    (tmp_path / "r.rou.xml").write_text(MORE)
    (tmp_path / "c.sumocfg").write_text(
        '<configuration><net-file value="n.net.xml"/><route-files value="r.rou.xml"/>'
        '<additional-files value="t.add.xml,l.add.xml"/></configuration>'
    )
    return load(str(tmp_path / "c.sumocfg"), fleet=Fleet(penetration=0.5))


def written(scenario: Scenario, tmp_path: Path) -> dict[str, ElementTree.Element]:
    file = tmp_path / "derived.add.xml"
    vehicle_types(scenario).write(file, drivers(scenario, frozenset()))
    return {kind.get("id", ""): kind for kind in ElementTree.parse(file).getroot()}


def test_the_vehicle_is_its_own_and_the_driver_is_not(scenario: Scenario, tmp_path: Path) -> None:
    found = written(scenario, tmp_path)
    for name in ("", "/lawful", "/late"):
        kind = found[f"cosim.av.b/1{name}"]
        kept = {key: value for key, value in VEHICLE.items() if kind.get(key) == value}
        assert VEHICLE.items() - kept.items() <= ({("impatience", "0.3")} if name else set())
        assert kind.get("carFollowModel") == ("Krauss" if name else "IDM")
        assert not {"lcStrategic", "actionStepLength"} & set(kind.keys())
        assert float(kind.get("decel", "")) in (7.0, 2.8, 8.0)
        assert kind.get("imgFile") == str(tmp_path / "b.png")
        assert [(p.get("key"), p.get("value")) for p in kind] == [("owner", "<city>")]


def test_who_drives_lawfully_does_not_drive_on_at_red_because_the_type_s_driver_does(
    scenario: Scenario, tmp_path: Path
) -> None:
    found = written(scenario, tmp_path)
    assert found["cosim.av.b/1"].get("jmDriveAfterRedTime") == "300"
    assert found["cosim.av.b/1/lawful"].get("jmDriveAfterRedTime") is None


def test_types_of_distributions_and_sumo_s_own_are_written_too(scenario: Scenario, tmp_path: Path) -> None:
    found = written(scenario, tmp_path)
    assert {"cosim.av.c", "cosim.av.DEFAULT_VEHTYPE"} <= found.keys()
    assert found["cosim.av.DEFAULT_VEHTYPE"].get("vClass") == "passenger"
    assert "cosim.av.DEFAULT_BIKETYPE" not in found, "nobody has it"
    assert vehicle_types(scenario).named("mix") == {"b/1", "c"}
    assert vehicle_types(scenario).named("c") == {"c"}


def test_lists_of_types_name_the_written_ones_too(scenario: Scenario, tmp_path: Path) -> None:
    types = vehicle_types(scenario)
    also = lambda name: types.also(name, [Driver("av.", "", {"tau": "1"}, frozenset({"b/1", "c"}))])  # noqa: E731
    whole = disable_outputs(scenario, tmp_path / "copies", also)
    root = ElementTree.parse(whole.additional[1]).getroot()
    assert root[0].get("vTypes") == "mix other av.b/1 av.c"
    assert root[1].get("vTypes") == "b/1 av.b/1"
    assert root[2][0].get("value") == "c av.c"
    assert [root[3][0].get("vTypes"), root[3][1].get("value")] == ["c", "c"], "not a list of who is meant"
    assert ElementTree.parse(whole.net).getroot()[0][0].get("value") == "c av.c"


def test_a_written_type_is_known_by_the_name_of_its_own() -> None:
    for name in ("cosim.av.b/1", "cosim.av.b/1@v", "cosim.av.b/1/lawful@v", "b/1/timid"):
        assert "b/1" in type_names(name), name


@pytest.mark.parametrize(("fleet", "words"), [(Fleet(), 0), (Fleet(type="c"), 1), (Fleet(type="b/1"), 1)])
def test_what_is_lost_in_somebody_else_s_sumo_is_said(scenario: Scenario, fleet: Fleet, words: int) -> None:
    said = lost(replace(scenario, fleet=fleet, preset=Preset.GUARDED))
    assert len(said) == words
    if fleet.type == "b/1":
        assert "(b/1: jmDriveAfterRedTime" not in said[0]
        assert "loadingDuration, maneuverAngleTimes, parameters, parkingBadges, personCapacity" in said[0]
        assert "maxSpeed" not in said[0]
    elif words:
        assert "what is decided by type 'mix'" in said[0]

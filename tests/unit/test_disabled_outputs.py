"""A user's additional files keep their elements and lose their outputs."""

import gzip
from pathlib import Path
from xml.etree import ElementTree

import pytest

from cosim.scenario import Scenario, load
from cosim.scenario.disabled_outputs import disable_outputs

LOUD = """<additional>
  <!-- file="comment.xml" stays -->
  <inductionLoop id="a > b" lane="e_0" pos="10" period="60"
                 file="loop.xml"/>
  <edgeData id="d" file='host:9999'/>
  <timedEvent type="SaveTLSSwitchStates" dest="../../up.xml"/>
  <variableSpeedSign id="v" lanes="e_0" file="speeds.xml"/>
  <vType id="t"><param key="device.ssm.file" value="ssm.xml"/><param key="file" value="kept"/></vType>
</additional>"""


@pytest.fixture
def scenario(tmp_path: Path) -> Scenario:
    (tmp_path / "n.net.xml").write_text("<net/>")
    (tmp_path / "r.rou.xml").write_text("<routes/>")
    (tmp_path / "loud.add.xml").write_text(LOUD)
    (tmp_path / "still.add.xml").write_text('<additional><vType id="x"/></additional>')
    (tmp_path / "c.sumocfg").write_text(
        '<configuration><net-file value="n.net.xml"/><route-files value="r.rou.xml"/>'
        '<additional-files value="loud.add.xml,still.add.xml"/></configuration>'
    )
    return load(str(tmp_path / "c.sumocfg"))


def test_outputs_go_nowhere_and_all_else_stays(scenario: Scenario, tmp_path: Path) -> None:
    loud, still = disable_outputs(scenario, tmp_path / "copies").additional
    assert still == tmp_path / "still.add.xml"
    assert loud.parent == tmp_path / "copies"
    root = ElementTree.fromstring(loud.read_text())
    before = ElementTree.fromstring(LOUD)
    assert [e.tag for e in root.iter()] == [e.tag for e in before.iter()]
    assert [e.get("file") for e in root][:2] == ["NUL", "NUL"]
    assert [e.get("dest") for e in root][2] == "NUL"
    assert root[3].get("file") == str(tmp_path / "speeds.xml")
    assert [p.get("value") for p in root[4]] == ["NUL", "kept"]
    assert root[0].get("id") == "a > b"
    assert 'file="comment.xml" stays' in loud.read_text()
    assert (tmp_path / "loud.add.xml").read_text() == LOUD


def test_a_silent_scenario_is_left_as_it_is(scenario: Scenario, tmp_path: Path) -> None:
    (tmp_path / "loud.add.xml").write_text("<additional/>")
    assert disable_outputs(scenario, tmp_path / "copies") == scenario
    assert not (tmp_path / "copies").exists()


def test_an_included_file_is_silenced_too(scenario: Scenario, tmp_path: Path) -> None:
    (tmp_path / "outer.xml").write_text('<additional><include href="loud.add.xml"/></additional>')
    (tmp_path / "loud.add.xml").write_bytes(LOUD.encode())
    (tmp_path / "still.add.xml").write_text('<additional><include href="outer.xml"/></additional>')
    still = disable_outputs(scenario, tmp_path / "copies").additional[1]
    outer = Path(ElementTree.fromstring(still.read_text())[0].get("href", ""))
    loud = Path(ElementTree.fromstring(outer.read_text())[0].get("href", ""))
    assert "loop.xml" not in loud.read_text()
    assert {still.parent, outer.parent, loud.parent} == {tmp_path / "copies"}


def test_a_packed_file_is_unpacked(scenario: Scenario, tmp_path: Path) -> None:
    (tmp_path / "loud.add.xml").write_bytes(gzip.compress(LOUD.encode()))
    loud = disable_outputs(scenario, tmp_path / "copies").additional[0]
    assert "NUL" in loud.read_text()

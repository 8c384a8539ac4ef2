"""Where cosim drives nobody a user's file keeps its options; arms that are compared have the same ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cosim.batch.matrix import cells
from cosim.batch.spec import Spec, read
from cosim.errors import BadInput
from cosim.scenario import Fleet, Scenario, load
from cosim.scenario.traffic import check, clocks
from cosim.types import Timing, Traffic

AVS = Fleet(penetration=0.2)


@pytest.fixture
def config(tmp_path: Path) -> str:
    (tmp_path / "n.net.xml").write_text("<net/>")
    file = tmp_path / "user.sumocfg"
    file.write_text(
        '<configuration><net-file value="n.net.xml"/><step-length value="0.5"/>'
        '<time-to-teleport value="60"/><collision.check-junctions value="1"/></configuration>'
    )
    return str(file)


@pytest.mark.parametrize(
    ("step", "frame", "decision"),
    [
        (0.1, 0.2, 0.4),
        (0.05, 0.2, 0.4),
        (0.2, 0.2, 0.4),
        (0.25, 0.25, 0.5),
        (0.15, 0.3, 0.6),
        (1.0, 1.0, 1.0),
    ],
)
def test_the_clocks_are_whole_multiples_of_sumos_step(step: float, frame: float, decision: float) -> None:
    assert clocks(step) == Timing(step, pytest.approx(frame), pytest.approx(decision))


@pytest.mark.parametrize(
    ("what", "traffic"),
    [
        ({}, Traffic.AS_IS),
        ({"fleet": Fleet(penetration=0.0)}, Traffic.AS_IS),
        ({"fleet": AVS}, Traffic.CONTROLLED),
        ({"fleet": Fleet(type="cav")}, Traffic.CONTROLLED),
        ({"fleet": Fleet(ids="a.*")}, Traffic.CONTROLLED),
        ({"behavior": "aggressive"}, Traffic.CONTROLLED),
        ({"errors": "field"}, Traffic.CONTROLLED),
        ({"traffic": "controlled"}, Traffic.CONTROLLED),
    ],
)
def test_traffic_is_controlled_where_cosim_drives_somebody(
    config: str, what: dict[str, object], traffic: str
) -> None:
    assert load(config, **what).traffic == traffic  # type: ignore[arg-type]


def test_only_what_differs_from_the_file_is_changed(config: str) -> None:
    def changed(scenario: Scenario) -> dict[str, tuple[str, str]]:
        return {c.option: (c.file, c.used) for c in scenario.changed}

    ours = load(config, fleet=AVS)
    assert changed(ours) == {
        "step-length": ("0.5", "0.1"),
        "lanechange.duration": ("0", "2"),
        "collision.action": ("teleport", "warn"),
        "collision.mingap-factor": ("-1", "0"),
    }
    assert dict(ours.options) == {"time-to-teleport": "60", "collision.check-junctions": "1"}
    typed = load(config, fleet=AVS, options=["--step-length", "0.2", "--lanechange.duration", "0"])
    assert changed(typed).keys() == {"collision.action", "collision.mingap-factor"}
    assert typed.timing.step == 0.2
    assert load("merge").changed == ()


def test_the_command_line_sets_the_step_of_traffic_as_it_is(config: str) -> None:
    assert load(config, options=["--step-length", "0.3"]).timing == clocks(0.3)
    assert (
        dict(load(config, options=["--collision.action", "remove"]).options)["collision.action"] == "remove"
    )
    with pytest.raises(BadInput, match="above 0"):
        load(config, options=["--step-length", "0"])


@pytest.mark.parametrize(
    ("what", "changes"), [("", {"fleet": AVS}), ("", {"behavior": "mixed"}), ("merge", {})]
)
def test_traffic_is_not_as_it_is_where_cosim_drives(
    config: str, what: str, changes: dict[str, object]
) -> None:
    with pytest.raises(BadInput) as error:
        load(what or config, traffic="as-is", **changes)  # type: ignore[arg-type]
    assert (error.value.field, error.value.value) == ("--traffic", "as-is")


def test_avs_that_come_after_loading_are_refused(config: str) -> None:
    check(load(config, fleet=AVS))
    with pytest.raises(BadInput, match="load the scenario with them"):
        check(replace(load(config), fleet=AVS))


def test_cells_that_are_compared_have_the_same_traffic(config: str) -> None:
    def traffic(spec: Spec) -> list[str]:
        return [case.scenario().traffic for case in cells(spec)]

    def spec(what: str, *shares: float, **more: str) -> Spec:
        return read(None, {"scenario": [what], "penetration": [*shares], **more})

    alone = spec(config, 0.0)
    assert traffic(alone) == ["as-is"]
    both = spec(config, 0.0, 0.2)
    assert traffic(both) == ["controlled", "controlled"]
    none, some = cells(both)
    assert none.cell != next(cells(alone)).cell, "another traffic is another cell"
    assert some.cell == next(cells(spec(config, 0.2))).cell
    assert traffic(spec(config, 0.0, traffic="controlled")) == ["controlled"]
    shipped = spec("merge", 0.0, 0.2)
    assert ["traffic" in case.document() for case in cells(shipped)] == [False, False]

"""Scripted drives past stop lines, into junctions and beside persons, and the figures that they leave."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_rows import cell, write

from cosim.cli.main import main
from cosim.metrics import MetricContext, Metrics
from cosim.report import html as report
from cosim.report.run_folder import read
from cosim.road import Crossing, Lane, Link, RoadMap, Rule
from cosim.types import Collision, Entry, Events, Intervention, Kind, Snapshot, Timing

FRAME = 0.2  # s
MINOR, INSIDE_MINOR, MINOR_OUT, MAJOR, INSIDE_MAJOR, MAJOR_OUT = range(6)
MINOR_LINK, MAJOR_LINK = range(2)


def lane(name: str, successors: Sequence[int], length: float, **more: Any) -> Lane:
    shape = np.array([[0.0, 0.0], [length, 0.0]])
    edge = name.rpartition("_")[0]
    made = Lane(name, edge, 0, shape, length, 3.2, 15.0, tuple(successors), internal=name[0] == ":")
    return replace(made, **more)


def crossing(rule: Rule = Rule.YIELD, signals: bool = False, cont: bool = False) -> RoadMap:
    """A minor road (lanes 0, 1, 2) crosses a major one (lanes 3, 4, 5); `cont`: one waits on lane 1."""
    lanes = [
        lane("minor_0", (1,), 100.0),
        lane(":j_0_0", (6,) if cont else (2,), 10.0, start="j", speed_limit=8.0),
        lane("out_0", (), 100.0),
        lane("major_0", (4,), 100.0),
        lane(":j_1_0", (5,), 10.0, start="j"),
        lane("away_0", (), 100.0),
        *([lane(":j_2_0", (2,), 10.0, start="j")] if cont else []),
    ]
    links = (
        Link(MINOR, INSIDE_MINOR, MINOR_OUT, 0 if signals else -1, rule, (MAJOR_LINK,)),
        Link(MAJOR, INSIDE_MAJOR, MAJOR_OUT, 1 if signals else -1, Rule.PRIORITY),
    )
    return RoadMap(tuple(lanes), links=links, signals=(("j", 0), ("j", 1)) if signals else ())


@dataclass(frozen=True)
class At:
    """A vehicle in one frame."""

    lane: int
    position: float  # m, front bumper
    speed: float = 0.0  # m/s
    accel: float = 0.0  # m/s2
    kind: Kind = Kind.HV
    x: float = 0.0  # m
    y: float = 0.0  # m
    heading: float = 0.0  # rad


def av(lane: int, position: float, speed: float = 0.0, **more: Any) -> At:
    return At(lane, position, speed, kind=Kind.AV, **more)


def frame(time: float, here: Mapping[str, At], events: Events = Events(), signals: str = "") -> Snapshot:
    ids = tuple(sorted(here))
    cars = [here[name] for name in ids]
    persons = np.array([c.kind == Kind.PERSON for c in cars], np.bool_)
    return Snapshot(
        time=time,
        ids=ids,
        kind=np.array([c.kind for c in cars], np.int8),
        mission=np.zeros(len(ids), np.bool_),
        x=np.array([c.x for c in cars], np.float64),
        y=np.array([c.y for c in cars], np.float64),
        heading=np.array([c.heading for c in cars], np.float64),
        speed=np.array([c.speed for c in cars], np.float64),
        accel=np.array([c.accel for c in cars], np.float64),
        length=np.where(persons, 0.3, 5.0),
        width=np.where(persons, 0.5, 2.0),
        lane=np.array([c.lane for c in cars], np.int32),
        lane_position=np.array([c.position for c in cars], np.float64),
        events=events,
        signals=np.frombuffer(signals.encode(), np.uint8),
    )


def figures(frames: Sequence[Snapshot], road: RoadMap) -> dict[str, Any]:
    metrics = Metrics()
    metrics.reset(frames[0], MetricContext(road, Timing(), "none", frozenset(), 10.0))
    for shown in frames[1:]:
        metrics.add(shown)
    return {name: metric.value for name, metric in metrics.result().items()}


def entered(rule: Rule = Rule.YIELD, link: int = MINOR_LINK, state: str = "", **more: Any) -> dict[str, Any]:
    """The figures of one entry of an AV by a link."""
    entry = Entry(0.2, "av", link, state, **({"speed": 8.0, "least_speed": 8.0} | more))
    frames = [
        frame(0.0, {"av": av(MINOR, 99.0, 8.0)}),
        frame(0.2, {"av": av(INSIDE_MINOR, 0.6, 8.0)}, Events(entries=(entry,))),
        frame(0.4, {"av": av(INSIDE_MINOR, 2.2, 8.0)}),
    ]
    return figures(frames, crossing(rule, bool(state)))


# ---- signals and signs ----


@pytest.mark.parametrize(("state", "count"), [("r", 1), ("u", 1), ("g", 0), ("G", 0), ("o", 0), ("O", 0)])
def test_entries_on_red_are_violations_and_others_are_none(state: str, count: int) -> None:
    assert entered(state=state)["red_light_violations"] == count


@pytest.mark.parametrize(("distance", "speed", "count"), [(24.0, 12.0, 1), (23.9, 12.0, 0), (0.0, np.inf, 0)])
def test_on_yellow_only_those_who_could_stop_with_3_mps2_are_counted(
    distance: float, speed: float, count: int
) -> None:
    """From 12 m/s 24 m are enough; who was not on the road yet could not."""
    seen = entered(state="y", yellow_since=0.0, yellow_distance=distance, yellow_speed=speed)
    assert seen["red_light_violations"] == count


@pytest.mark.parametrize(
    ("rule", "least", "count"),
    [(Rule.STOP, 0.6, 1), (Rule.STOP, 0.5, 0), (Rule.ALL_WAY_STOP, 3.0, 1), (Rule.YIELD, 3.0, 0)],
)
def test_a_stop_sign_asks_for_a_stop_and_a_yield_sign_does_not(rule: Rule, least: float, count: int) -> None:
    assert entered(rule, least_speed=least)["stop_sign_violations"] == count


def test_the_arrow_that_asks_for_a_stop_is_a_stop_sign() -> None:
    assert entered(state="s")["stop_sign_violations"] == 1
    assert entered(state="s", least_speed=0.0)["stop_sign_violations"] == 0


# ---- the right of way ----


def met(
    speeds: Sequence[float],
    *,
    rule: Rule = Rule.YIELD,
    others: Mapping[str, At] = {},
    signals: str = "",
    left_after: int = 99,
    collision: int = -1,
    start: float = 50.0,
    where: int = MAJOR,
    road: RoadMap | None = None,
    goes_on: int = -1,
) -> int:
    """An AV enters in frame 1 before a foe with these speeds in frames 0, 1, 2, ..., and leaves the place
    inside in frame `goes_on`; violations counted."""
    entry = Entry(0.2, "av", MINOR_LINK, "g" * bool(signals), 8.0, 8.0, foes=(("foe", MAJOR_LINK),))
    hit = Collision(0.2 * collision, "foe", "av", False, True, "collision", "sumo", "", 0.0, 0.0)
    frames, position = [], start
    for k, speed in enumerate(speeds):
        position += FRAME * speed
        me = av(MINOR, 99.0, 8.0) if k == 0 else av(INSIDE_MINOR, min(1.5 * k, 9.9), 8.0)
        here = {"av": av(MINOR_OUT, 6.0, 8.0) if k >= left_after else me, "foe": At(where, position, speed)}
        went = replace(entry, time=FRAME * k, inside=True)
        happened = Events((hit,) * (k == collision), entries=(entry,) * (k == 1) + (went,) * (k == goes_on))
        frames.append(frame(FRAME * k, here | dict(others), happened, signals))
    found = figures(frames, road or crossing(rule, bool(signals)))["right_of_way_violations"]
    assert isinstance(found, int)
    return found


HARD = (12.0, 12.0, 12.0, 11.2, 10.4)  # 4 m/s2 from the second frame after the entry on


def test_a_foe_that_begins_to_brake_harder_than_3_mps2_was_not_given_way() -> None:
    assert met(HARD) == 1
    assert met((12.0, 12.0, 12.0, 11.4, 10.8)) == 0  # just 3


def test_a_foe_that_braked_so_hard_already_is_no_violation() -> None:
    assert met((12.8, 12.0, 11.2, 10.4, 9.6)) == 0


def test_a_foe_that_brakes_when_the_av_has_left_is_no_violation() -> None:
    assert met(HARD, left_after=2) == 0
    assert met(HARD, left_after=3) == 1  # seen out of the junction in the frame in which the foe brakes


@pytest.mark.parametrize(("position", "count"), [(85.0, 0), (99.0, 1), (20.0, 1)])
def test_a_leader_within_30_m_excuses_the_braking(position: float, count: int) -> None:
    """The foe is near 59 m then; bumpers are 21 and 35 m apart, or the other is behind it."""
    assert met(HARD, others={"leader": At(MAJOR, position, 12.0)}) == count


def test_a_leader_inside_the_junction_excuses_the_braking_but_not_the_av_itself() -> None:
    assert met(HARD, others={"leader": At(INSIDE_MAJOR, 2.0)}, start=60.0) == 0
    assert met(HARD, others={"beside": At(INSIDE_MINOR, 2.0)}, start=60.0) == 1


@pytest.mark.parametrize(("position", "count"), [(4.0, 0), (20.0, 1)])
def test_a_leader_just_behind_the_junction_excuses_the_braking(position: float, count: int) -> None:
    """The foe is near 84 m then, 26 m before the end of the junction: bumpers are 25 and 41 m apart."""
    assert met(HARD, others={"leader": At(MAJOR_OUT, position)}, start=75.0) == count


def test_who_turns_off_the_foes_lane_and_is_still_on_it_excuses_the_braking() -> None:
    """A way of two meters that leaves the foe's lane: of 5 m of car 3 m or nothing are on the lane."""
    road = crossing()
    turning = Lane(":j_3_0", ":j_3", 0, np.zeros((2, 2)), 9.0, 3.2, 15.0, (), internal=True, start="j")
    lanes = [replace(one, successors=(4, 6)) if k == MAJOR else one for k, one in enumerate(road.lanes)]
    road = replace(road, lanes=(*lanes, turning))
    assert met(HARD, others={"turns": At(6, 2.0)}, start=60.0, road=road) == 0
    assert met(HARD, others={"turns": At(6, 5.5)}, start=60.0, road=road) == 1


def test_a_fast_foe_brakes_for_a_leader_as_far_ahead_as_it_stops_comfortably() -> None:
    """From 20 m/s: 67 m and 10 m. The foe is near 39 m then, the leader's rear bumper at 95 m."""
    fast = (20.0, 20.0, 20.0, 19.2, 18.4)
    assert met(fast, others={"leader": At(MAJOR, 100.0, 12.0)}, start=25.0) == 0
    assert met(fast, start=25.0) == 1


def test_where_one_may_wait_inside_the_right_of_way_is_decided_there() -> None:
    road = crossing(cont=True)
    assert met(HARD, road=road) == 0
    assert met(HARD, road=road, goes_on=1) == 1
    assert met(HARD, road=road, goes_on=3) == 0, "who braked before it went on did not brake for that"
    assert met((12.0,) * 5, road=road, collision=3) == 1, "touching counts from the line on"


def test_a_foe_past_the_junction_brakes_for_something_else() -> None:
    assert met(HARD, where=MAJOR_OUT, start=0.0) == 0
    assert met(HARD, where=INSIDE_MAJOR, start=0.0) == 1


@pytest.mark.parametrize(("state", "count"), [("G", 1), ("g", 1), ("o", 1), ("y", 0), ("r", 0)])
def test_a_foe_may_brake_for_its_own_signal(state: str, count: int) -> None:
    assert met(HARD, signals=f"g{state}") == count


@pytest.mark.parametrize("rule", [Rule.STOP, Rule.ALL_WAY_STOP])
def test_a_foe_may_brake_before_its_own_stop_sign_but_not_behind_it(rule: Rule) -> None:
    road = crossing()
    road = replace(road, links=(road.links[MINOR_LINK], replace(road.links[MAJOR_LINK], rule=rule)))
    assert met(HARD, road=road) == 0
    assert met(HARD, road=road, where=INSIDE_MAJOR, start=0.0) == 1


@pytest.mark.parametrize(
    ("place", "start", "count"),
    [
        ((5.0, 0.0), 60.0, 0),  # on the crossing
        ((5.0, 12.9), 60.0, 0),  # within 10 m of its end at (5, 3)
        ((5.0, 13.1), 60.0, 1),
        ((5.0, 0.0), 50.0, 1),  # the foe is near 59 m then, 41 m before the line
    ],
)
def test_persons_at_a_crossing_over_its_way_excuse_the_braking(
    place: tuple[float, float], start: float, count: int
) -> None:
    zebra = Crossing("c", np.array([[5.0, -3.0], [5.0, 3.0]]), 4.0, (INSIDE_MAJOR,))
    person = At(-1, 0.0, 1.0, kind=Kind.PERSON, x=place[0], y=place[1])
    over, elsewhere = (replace(crossing(), crossings=(replace(zebra, lanes=k),)) for k in ((4,), (1,)))
    assert met(HARD, others={"person:p": person}, start=start, road=over) == count
    assert met(HARD, others={"person:p": person}, start=start, road=elsewhere) == 1


def test_a_foe_that_is_touched_was_not_given_way_even_where_all_wait_for_one_another() -> None:
    calm = (12.0,) * 5
    assert met(calm, collision=3) == 1
    assert met(calm, collision=3, rule=Rule.ALL_WAY_STOP) == 1
    assert met(HARD, rule=Rule.ALL_WAY_STOP) == 0
    assert met(calm, collision=4, left_after=2) == 0


# ---- speed and standing ----


def test_speeding_counts_frames_above_the_limit_inside_junctions_too() -> None:
    frames = [
        frame(0.0, {"av": av(MINOR, 90.0, 15.4)}),  # within the tolerance of 15 + 0.5
        frame(0.2, {"av": av(MINOR, 93.0, 16.0)}),
        frame(0.4, {"av": av(INSIDE_MINOR, 1.0, 10.0)}),  # limit 8
        frame(0.6, {"av": av(-1, 0.0, 40.0)}),  # on no lane
        frame(0.8, {"av": av(MINOR_OUT, 1.0, 9.0), "hv": At(MINOR, 1.0, 30.0)}),
    ]
    seen = figures(frames, crossing())
    assert seen["speeding_share"] == 2 / 4
    assert seen["worst_speeding_mps"] == pytest.approx(2.0)


def standing(where: int, seconds: float, road: RoadMap, others: Mapping[str, At] = {}, **more: Any) -> Any:
    """The figures of an AV that stands there."""
    count = round(seconds / FRAME) + 1
    here = {"av": av(where, 50.0 if where == MINOR else 5.0), **others}
    return figures([frame(FRAME * k, here, **more) for k in range(count)], road)


def test_who_stands_inside_a_junction_for_more_than_5_s_blocks_it_once() -> None:
    assert standing(INSIDE_MINOR, 5.0, crossing())["junctions_blocked"] == 0
    assert standing(INSIDE_MINOR, 30.0, crossing())["junctions_blocked"] == 1
    assert standing(MINOR, 30.0, crossing())["junctions_blocked"] == 0


def test_a_place_to_wait_inside_a_junction_is_not_blocked() -> None:
    assert standing(INSIDE_MINOR, 30.0, crossing(cont=True))["junctions_blocked"] == 0
    assert standing(6, 30.0, crossing(cont=True))["junctions_blocked"] == 1


def test_who_stands_for_more_than_a_minute_without_a_reason_is_stuck() -> None:
    assert standing(MINOR, 60.0, crossing())["avs_stuck"] == 0
    assert standing(MINOR, 60.2, crossing())["avs_stuck"] == 1


@pytest.mark.parametrize(("signals", "count"), [("rG", 0), ("yG", 0), ("GG", 1), ("Gr", 1)])
def test_red_and_yellow_are_reasons_to_stand(signals: str, count: int) -> None:
    assert standing(MINOR, 70.0, crossing(signals=True), signals=signals)["avs_stuck"] == count


@pytest.mark.parametrize(("place", "count"), [((5.0, 0.0), 0), ((5.0, 4.9), 0), ((5.0, 5.1), 1)])
def test_a_person_on_a_crossing_over_its_way_is_a_reason_to_stand(
    place: tuple[float, float], count: int
) -> None:
    person = {"person:p": At(-1, 0.0, 1.0, kind=Kind.PERSON, x=place[0], y=place[1])}
    zebra = Crossing("c", np.array([[5.0, -3.0], [5.0, 3.0]]), 4.0, (INSIDE_MINOR,))
    over, elsewhere = (
        replace(crossing(), crossings=(replace(zebra, lanes=(k,)),)) for k in (INSIDE_MINOR, INSIDE_MAJOR)
    )
    assert standing(MINOR, 70.0, over, person)["avs_stuck"] == count
    assert standing(INSIDE_MINOR, 70.0, over, person)["avs_stuck"] == count
    assert standing(MINOR, 70.0, elsewhere, person)["avs_stuck"] == 1


def test_a_queue_is_a_reason_to_stand_if_its_head_has_one() -> None:
    queue = {"b": At(MINOR, 60.0), "c": av(MINOR, 70.0)}
    road = crossing(signals=True)
    assert standing(MINOR, 70.0, road, queue, signals="rG")["avs_stuck"] == 0
    assert standing(MINOR, 70.0, road, queue, signals="GG")["avs_stuck"] == 2
    assert standing(MINOR, 70.0, road, queue | {"c": At(MINOR, 70.0)}, signals="GG")["avs_stuck"] == 0, (
        "a human at its head needs no reason"
    )
    assert (
        standing(MINOR, 70.0, road, {"bus": At(MINOR, 60.0)}, events=Events(stopped=("bus",)))["avs_stuck"]
        == 0
    )
    assert standing(MINOR, 70.0, road, events=Events(stopped=("av",)))["avs_stuck"] == 0


# ---- trips, interventions, persons ----


def test_trips_are_those_of_avs_that_arrive_without_a_crash() -> None:
    gone = Events(arrived=("a", "b", "hv"))
    hit = Events((Collision(0.2, "b", "hv", True, False, "collision", "sumo", "", 0.0, 0.0),))
    here = {"a": av(MINOR, 1.0), "b": av(MINOR, 20.0), "hv": At(MINOR, 40.0)}
    seen = figures([frame(0.0, here), frame(0.2, here, hit), frame(0.4, {}, gone)], crossing())
    assert seen["av_trips_completed"] == 1


def test_interventions_are_counted() -> None:
    events = Events(
        interventions=(Intervention(0.1, "av", "red light"), Intervention(0.2, "av", "lane ends"))
    )
    here = {"av": av(MINOR, 1.0)}
    assert (
        figures([frame(0.0, here), frame(0.2, here, events), frame(0.4, here)], crossing())["interventions"]
        == 2
    )


def walk(speed: float, y: float) -> Sequence[Snapshot]:
    """An AV drives eastwards at 10 m/s; a person, 30 m ahead of it, walks northwards from `y`."""
    return [
        frame(
            FRAME * k,
            {
                "av": av(MINOR, 0.0, 10.0, x=2.0 * k),
                "person:p": At(
                    -1, 0.0, speed, kind=Kind.PERSON, x=30.0, y=y + speed * FRAME * k, heading=0.5 * np.pi
                ),
            },
        )
        for k in range(30)
    ]


@pytest.mark.parametrize(
    ("speed", "y", "count"),
    [
        (1.0, -3.0, 1),  # they meet
        (0.0, -3.0, 0),  # waits beside the lane
        (1.0, 3.0, 0),  # was across long before
        (2.0, -2.6, 1),  # is across 0.6 s before the AV gets there
        (2.0, 0.6, 0),  # is across 2.2 s before
    ],
)
def test_persons_whom_an_av_meets_or_narrowly_misses_are_conflicts(
    speed: float, y: float, count: int
) -> None:
    assert figures(walk(speed, y), crossing())["person_conflicts"] == count


def test_without_avs_the_figures_do_not_apply() -> None:
    seen = figures([frame(0.0, {"hv": At(MINOR, 1.0)})] * 2, crossing())
    for name in (
        "red_light_violations", "stop_sign_violations", "right_of_way_violations", "speeding_share",
        "worst_speeding_mps", "junctions_blocked", "avs_stuck", "av_trips_completed", "person_conflicts",
        "interventions",
    ):  # fmt: skip
        assert seen[name] is None, name


# ---- reports and gates ----

BROKEN = {"red_light_violations": [0, 3, 0, 0], "stop_sign_violations": [0] * 4, "speeding_share": [0.1] * 4}


def test_the_report_shows_what_was_against_the_law_in_red(tmp_path: Path) -> None:
    folder = write(tmp_path / "run", cell("idm", 4), cell("rash", 4, columns=BROKEN))
    page = report.write(read(folder)).read_text()
    law = page[page.index("<h3>The law</h3>") :].split("</table>")[0]
    assert 'data-sort="0.75" class="bad"' in law
    assert 'data-sort="0.1" class="bad"' in law
    assert law.count('class="bad"') == 2  # stop signs are 0, and idm's rows hold no such columns
    assert "The law" not in report.write(read(write(tmp_path / "old", cell("idm", 4)))).read_text()


def test_every_figure_of_the_law_can_be_a_gate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean = {name: [0] * 4 for name in BROKEN}
    folder = write(tmp_path / "run", cell("idm", 4, columns=clean), cell("rash", 4, columns=BROKEN))
    code = main(["compare", f"{folder}:idm", f"{folder}:rash", "--fail-on", "red_light_violations > 0"])
    out = capsys.readouterr().out
    assert code == 1
    assert "red_light_violations" in out.split("FAIL")[0]
    assert "speeding_share" in out  # shown because it is not 0
    assert "stop_sign_violations" not in out
    assert main(["compare", f"{folder}:idm", f"{folder}:rash", "--fail-on", "stop_sign_violations > 0"]) == 0


def test_a_run_from_before_is_compared_with_one_that_has_the_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = (
        write(tmp_path / "old", cell("idm", 4)),
        write(tmp_path / "new", cell("idm", 4, columns=BROKEN)),
    )
    assert main(["compare", str(old), str(new), "--json"]) == 0
    figure = json.loads(capsys.readouterr().out)["groups"][0]["figures"]["red_light_violations"]
    assert (figure["n"], figure["na"]) == (0, 4)

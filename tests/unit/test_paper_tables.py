"""What the papers' pages claim and how they sort episodes, on made-up rows and drives with known answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.papers import episodes, guide, shipped, summary, table3
from benchmarks.papers.claims import APPROACHES, VFN, VFN_P
from benchmarks.papers.driving import Settings
from benchmarks.papers.guide import NONE, OTHER, OVERTAKES, SLOWS, YIELDS, guided
from benchmarks.papers.pages import SAID_FIRST
from benchmarks.tables import READ, Line, marks, write_csv, write_page
from cosim.recording.replay_data import ReplayData, Track
from cosim.report.run_folder import Run
from cosim.road import Lane, RoadMap
from cosim.types import Floats, Kind
from policy.prediction.predictors import PREDICTORS

INTERVAL = 0.2  # s
LANES = (1.6, 4.8, 8.0)  # m, the middles of the acceleration lane and of the two main lanes
ROOT = Path(__file__).parents[2]
SAID_ON = ("README", "table3", "figure9", "decisions", "phi")
FRAMES, MERGE = 100, 60  # of a made-up drive, and the one in which the merging vehicle is on the main road


def run(crashed: list[int], n: int, first: int = 200_000) -> Run:
    """n episodes at the ramp, of which those with these numbers crashed."""
    rows = [
        {"status": "ok", "scenario": "merge", "seed": first + k, "crashed": k in crashed, "policy": "x"}
        for k in range(n)
    ]
    return Run(Path("x"), rows)


def test_below_the_paper_is_said_only_when_the_upper_bound_is() -> None:
    names = {name: name for name in (VFN_P, VFN, "safe-dqn")}
    runs = {VFN_P: run([], 1000), VFN: run([1], 100), "safe-dqn": run([], 100)}
    rows = {line.split(" | ")[0]: line for line in table3.against_p(runs, names, ["merge"])}
    assert "0/1000 = 0.00 (0.00 to 0.38), below P's 1.04" in rows[f"| {VFN_P}"]
    assert "not below P's 1.96" in rows[f"| {VFN}"]  # 1 % is less than 1.96 %, but may well be 5 %
    assert "not below P's 1.95" in rows["| safe-dqn"]  # none of 100 may still be 3.7 %
    assert "not run yet (P 29.12)" in rows["| conv2d-dqn"]


def test_there_are_episodes_enough_that_a_crash_free_agent_can_lie_below_the_paper() -> None:
    for world, claimed in table3.TABLE_3.items():
        n = table3.enough(world)
        assert n >= table3.MOST
        name = VFN_P
        line = table3.against_p({name: of_world(world, n)}, {name: name}, [world])[-2]
        assert f", below P's {claimed[name]}" in line
    assert table3.enough("highway") == 1300


def test_shipped_episodes_are_of_the_agents_and_worlds_that_are_here() -> None:
    # A new option of the agent would part them from its pages: agents.NEWER leaves it out at its default.
    settings = Settings(shipped=ROOT / shipped.FOLDER)
    unknown = episodes.unknown(settings)
    if unknown == len(shipped.episodes(settings.shipped).rows):
        pytest.skip("they were driven with other versions of the packages")
    assert unknown == 0, "make the pages anew, then `python -m benchmarks.papers.episodes keep`"


def of_world(world: str, n: int) -> Run:
    """n episodes without a crash."""
    return Run(Path("x"), [{**row, "scenario": world} for row in run([], n).rows])


def test_the_fewest_crashes_are_counted_on_common_seeds_and_ties_are_named() -> None:
    runs = {VFN: run([0, 1], 10), VFN_P: run([2, 700], 1000), "safe-dqn": run([5], 10)}
    assert table3.crashes_in_common(runs, "merge") == ({VFN: 2, VFN_P: 1, "safe-dqn": 1}, 10)
    names = {name: name for name in runs}
    lines = table3.fewest(runs, names, ["merge"])
    assert any(f"merge: `safe-dqn`, `{VFN_P}` (tie) with 1 of 10" in line for line in lines)
    assert "3 of 6 approaches" in lines[0]


def test_the_summary_is_filled_from_the_csv_and_from_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    name = "collision_rate"
    lines = [Line("dense", "merge", VFN_P, "", name, "share", 0.005, 0.002, 0.009, 1000, 0, None)]
    for other in APPROACHES[:-1]:
        value = 0.0 if other == VFN else -0.01
        figures = (value, -0.02, 0.01, 300, 0, 0.5)
        lines.append(Line("dense", "merge", VFN_P, other, name, "share", *figures))
    write_csv(tmp_path / "data" / "table3.csv", lines)
    summary.write(Settings(out=tmp_path))
    rows = [
        line
        for line in (tmp_path / "README.md").read_text().splitlines()
        if line.startswith("| P, Table III")
    ]
    assert "merge 0.50 % (0.20 to 0.90), n 1000, below" in rows[0]
    assert "below in 1 of 5 worlds" in rows[0]
    assert f"| merge: yes, tied with {VFN} |" in rows[1]
    assert "| merge +0.00 points (-2.00 to +1.00), n 300 |" in rows[2]
    assert "untrained" not in "".join(rows)


def test_the_best_of_the_eight_predictors_is_named_and_one_that_knows_the_road_is_not(tmp_path: Path) -> None:
    assert summary.predictors(tmp_path) == summary.NOT_RUN
    names = sorted(PREDICTORS, key="gp-indirect".__ne__)  # it first
    lines = ["predictor,scenario,behavior,horizon_s,mean_m,ci_low,ci_high,n"]
    lines += [f"{name},all,all,mean,{3.0 + k},2,9,1" for k, name in enumerate(names)]
    lines += ["gp-lane,all,all,mean,1,1,1,1", "cs,merge,all,mean,0,0,0,1"]
    (tmp_path / "position_error.csv").write_text("\n".join(lines) + "\n")
    assert (
        summary.predictors(tmp_path)
        == "lowest: gp-indirect 3.00 m (2.00 to 9.00), then cs 4.00 m (2.00 to 9.00)"
    )
    gain = "scenario,against,pre_change,pre_low,pre_high\nall,hpn-no-history,-0.185,-0.21,-0.16\n"
    (tmp_path / "map_gain.csv").write_text(gain)
    assert summary.history(tmp_path) == "-18.5 % (-21.0 to -16.0)"


# ---- the guide AV ----


def track(
    name: str, x: Floats, y: Floats, speed: Floats, kind: Kind = Kind.AV, mission: bool = False
) -> Track:
    """A drive eastwards; the lane is the one whose middle is nearest."""
    lane = np.abs(y[:, None] - np.array(LANES)).argmin(1)
    still = np.zeros(len(x))
    return Track(name, kind, mission, "", 5.0, 2.0, 0, x, y, still, speed, still, lane)


def drive(*others: Track) -> ReplayData:
    """The merging vehicle (20 m/s) is in the first main lane from frame MERGE on; `others` are beside it."""
    lanes = tuple(
        Lane(f"acc_{k}", "acc", k, np.array([[0.0, y], [2000.0, y]]), 2000.0, 3.2, 30.0)
        for k, y in enumerate(LANES)
    )
    times = INTERVAL * np.arange(FRAMES)
    merging = track("mission", 20.0 * times, lateral((MERGE, LANES[1]), start=LANES[0]),
                    np.full(FRAMES, 20.0), Kind.HV, mission=True)  # fmt: skip
    facts: dict[str, Any] = {}
    tracks = (merging, *others)
    return ReplayData(facts, RoadMap(lanes), 0.0, INTERVAL, times, tracks, times, (), (), ())


def lateral(*changes: tuple[int, float], start: float = LANES[1]) -> Floats:
    """[FRAMES] m: in the middle of a lane until a change, then of another."""
    y = np.full(FRAMES, start)
    for frame, to in changes:
        y[frame:] = to
    return y


def follower(speed: Floats, y: Floats, gap: float = 10.0, name: str = "av") -> Track:
    """An AV that is `gap` m behind the merging vehicle when that merges."""
    x = np.concatenate([[0.0], np.cumsum(0.5 * INTERVAL * (speed[1:] + speed[:-1]))])
    return track(name, x - x[MERGE] + 20.0 * INTERVAL * MERGE - gap, y, speed)


STEADY = np.full(FRAMES, 20.0)
SLOWING = np.concatenate([np.linspace(25.0, 18.0, MERGE), np.full(FRAMES - MERGE, 18.0)])
BACK = np.concatenate([np.linspace(25.0, 18.0, MERGE), np.full(FRAMES - MERGE, 30.0)])


@pytest.mark.parametrize(
    ("av", "kind"),
    [
        (follower(SLOWING, lateral()), SLOWS),
        (follower(STEADY, lateral((MERGE - 15, LANES[2]))), YIELDS),
        (follower(BACK, lateral((MERGE + 5, LANES[2]))), OVERTAKES),
        (follower(SLOWING, lateral((MERGE + 5, LANES[2]))), SLOWS),  # it moved over, but stayed behind
        (follower(STEADY, lateral()), OTHER),
        (follower(STEADY, lateral(start=LANES[2])), NONE),  # in the far lane throughout
        (follower(STEADY, lateral(), gap=150.0), NONE),  # too far behind to be meant
    ],
    ids=["slows", "left", "overtakes", "behind", "keeps on", "far lane", "far behind"],
)
def test_the_guide_av_is_sorted_by_how_it_made_room(av: Track, kind: str) -> None:
    found = guided(drive(av))
    assert found.kind == kind
    assert found.merged == pytest.approx(INTERVAL * MERGE)
    assert found.guide == ("" if kind == NONE else "av")


def test_the_guide_is_the_nearest_and_an_episode_without_a_merge_has_none() -> None:
    near, far = follower(SLOWING, lateral(), 12.0, "near"), follower(STEADY, lateral(), 40.0, "far")
    found = guided(drive(far, near))
    assert (found.guide, found.mission) == ("near", "mission")
    assert found.guide_speed[MERGE] == pytest.approx(18.0)
    assert found.times[MERGE] == 0.0
    data = drive(near)
    alone = [t for t in data.tracks if not t.mission]
    assert guide.guided(ReplayData(**{**vars(data), "tracks": tuple(alone)})).merged is None


@pytest.mark.parametrize("page", SAID_ON)
def test_what_is_known_of_the_networks_stands_before_their_figures(page: str) -> None:
    text = (ROOT / "docs" / "results" / f"{page}.md").read_text(encoding="utf-8")
    assert "\n".join(SAID_FIRST) in text[:1500]


def test_what_a_person_read_in_a_page_survives_the_page_made_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    write_page(page, ["# A page", "", "1 of 2.", "", "## More", "", "old"])
    begin, end = marks(READ)
    page.write_text(page.read_text().replace("## More", f"{begin}\nIt is the car.\n{end}\n\n## More"))
    write_page(page, ["# A page", "", "2 of 2.", "", "## More", "", "new"])
    assert page.read_text() == (f"# A page\n\n2 of 2.\n\n{begin}\nIt is the car.\n{end}\n\n## More\n\nnew\n")
    assert "still hold?" in capsys.readouterr().err

"""Claims are driven: each episode once for all, kept, taken, audited; two seconds each, in one process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cosim.report.figures import measures
from cosim.scenario.manifest import POLICY_FILES
from cosim.workers.engines import LocalEngine
from cosim.workers.tasks import Outcome, Task
from research import audit, cli, drive, index, kept, page
from research.drive import Runner, Settings
from research.schema import Claim, chosen
from tests.research.claims import written

ROOT = Path(__file__).parents[2]
TUNING = range(150_000, 150_002)  # a test drives no seed that a claim is judged on


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two claims about the merge: the second has an arm and all of the first's but its floor."""
    found = tmp_path_factory.mktemp("claims")
    written(found, "first", scenarios=["merge"])
    arms = {
        "rule": {"policy": "altruist-rule"},
        "idm": {"policy": "idm"},
        "polite": {"policy": "idm-courteous"},
    }
    written(found, "second", scenarios=["merge"], arms=arms, floors={})
    return found


@pytest.fixture(scope="module")
def claims(folder: Path) -> list[Claim]:
    return [*chosen([], folder)]


class Counting:
    """The local engine; ends like a killed process after so many episodes."""

    driven: int = 0
    ends_after: int | None = None

    def run(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        with closing(LocalEngine(Runner, workers=1).run(tasks)) as outcomes:
            for outcome in outcomes:
                if self.driven == self.ends_after:
                    raise KeyboardInterrupt
                self.driven += 1
                yield outcome


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Counting:
    found = Counting()
    monkeypatch.setattr(drive, "engine", lambda _: found)
    return found


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory, claims: list[Claim]) -> Settings:
    """Of a store in which all was driven, killed once in between."""
    runs = tmp_path_factory.mktemp("runs")
    found = Settings(runs=runs, kept=None, workers=1, seeds=TUNING, duration=2.0)
    with pytest.MonkeyPatch.context() as patch:
        counting = Counting()
        counting.ends_after = 3
        patch.setattr(drive, "engine", lambda _: counting)
        with pytest.raises(KeyboardInterrupt):
            drive.drive(claims, found)
        counting.ends_after = None
        drive.drive(claims, found)
        assert counting.driven == 4 * 2  # policies of both claims x seeds
    return found


def test_a_killed_drive_goes_on_and_each_episode_is_driven_once_for_all_claims(
    settings: Settings, claims: list[Claim], engine: Counting
) -> None:
    found = drive.drive(claims, settings)
    assert engine.driven == 0
    assert [len(found.arms[one.name]) for one in claims] == [3, 3]
    assert all(arm.complete for arms in found.arms.values() for arm in arms.values())
    (first, second) = (found.arms[one.name] for one in claims)
    shared = next(key for key in first if key[1] == "rule")
    assert first[shared].rows == second[shared].rows


def test_an_episode_has_every_figure_that_a_claim_names(settings: Settings, claims: list[Claim]) -> None:
    found = drive.held(claims, settings)
    rows = [row for arm in found.arms["first"].values() for row in arm.rows]
    known = measures(rows, found.notes["units"], found.notes["better"])
    assert {metric for claim in chosen([]) for metric in claim.metrics} <= known.keys()


@pytest.mark.soak
def test_every_claim_is_driven_and_written_in_small(tmp_path: Path) -> None:
    flags = ["--seeds", "150000:150001", "--scenario", "merge", "--duration", "2", "--untrained", "--anew"]
    flags += ["--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "pages")]
    assert cli.main(["drive", *flags]) == 0
    assert cli.main(["page", *flags]) == 0
    index_of = (tmp_path / "pages" / "README.md").read_text()
    assert index_of.count("**Unresolved.**") == len([*chosen([])])
    assert cli.main(["check", *flags]) == 0


def test_page_check_and_index_follow(settings: Settings, folder: Path, tmp_path: Path, capsys: Any) -> None:
    flags = ["--claims", str(folder), "--runs", str(settings.runs), "--out", str(tmp_path), "--anew"]
    flags += ["--seeds", "150000:150002", "--duration", "2"]
    assert cli.main(["page", *flags]) == 0
    assert (tmp_path / "first.md").read_text().startswith("# A script lets more")
    assert "[second](second.md)" in (tmp_path / "README.md").read_text()
    assert cli.main(["check", *flags]) == 0
    capsys.readouterr()
    assert cli.main(["list", *flags]) == 0
    assert capsys.readouterr().out.startswith("first               6 of      6 episodes, 0.0 CPU hours left")
    assert cli.main(["check", *flags[:-2]]) == 1  # of whole episodes
    assert "was driven with other files or settings" in capsys.readouterr().out


def test_a_page_that_lacks_episodes_is_left_as_it_is(
    settings: Settings, folder: Path, tmp_path: Path, capsys: Any
) -> None:
    flags = ["--claims", str(folder), "--runs", str(settings.runs), "--out", str(tmp_path), "--anew"]
    assert cli.main(["page", "first", *flags, "--seeds", "150000:150003", "--duration", "2"]) == 0
    assert "first: page unchanged: 3 episodes are missing" in capsys.readouterr().err
    assert not (tmp_path / "first.md").exists()
    assert "Not driven yet." in (tmp_path / "README.md").read_text()


def test_what_is_wrong_ends_with_one_sentence(folder: Path, capsys: Any) -> None:
    assert cli.main(["list", "frist", "--claims", str(folder)]) == 2
    assert capsys.readouterr().err == "error: NAME='frist': unknown, did you mean 'first'?\n"


def test_kept_episodes_are_taken_and_are_the_same_when_driven_anew(
    settings: Settings, claims: list[Claim], engine: Counting, tmp_path: Path
) -> None:
    work = drive.planned(claims, settings)
    with drive.opened(work, settings) as store:
        assert kept.keep(store, work.wanted, tmp_path / "kept") == 8
    elsewhere = replace(settings, runs=tmp_path / "runs", kept=tmp_path / "kept")
    found = drive.drive(claims, elsewhere)
    assert engine.driven == 0
    assert all(arm.complete for arm in found.arms["second"].values())
    run = kept.episodes(tmp_path / "kept")
    assert not {"timings", "total_s"} & set(run.rows[0])
    assert audit.audit(work, elsewhere, 2) == audit.Audited(2, (), 8, 0)


def test_a_kept_episode_that_is_not_the_same_again_is_found_and_named(
    settings: Settings, claims: list[Claim], tmp_path: Path
) -> None:
    work = drive.planned(claims[:1], settings)
    with drive.opened(work, settings) as store:
        kept.keep(store, work.wanted, tmp_path)
    run = kept.episodes(tmp_path)
    kept.write([{**run.rows[0], "collisions": 7}], run.manifest, tmp_path)
    found = audit.audit(work, replace(settings, kept=tmp_path), 5)
    (line,) = found.differing
    assert "in merge, seed 150000: collisions is" in line
    assert line.endswith("kept is 7")
    other = drive.planned(claims[:1], replace(settings, duration=3.0))
    assert audit.audit(other, replace(settings, kept=tmp_path), 5) == audit.Audited(0, (), 1, 1)


def test_an_audit_misses_no_kind_of_episode() -> None:
    many = [{"key": str(i), "policy": "idm", "preset": "lawful", "sensing": None} for i in range(50)]
    rare = {"key": "rare", "policy": "idm", "preset": "lawful", "sensing": "v2v"}
    for pick in range(5):
        assert rare in audit._drawn([*many, rare], 2, pick)


def test_what_collisions_tell_today_besides_is_no_difference() -> None:
    row = {"key": "k", "policy": "p", "scenario": "w", "seed": 1, "status": "ok"}
    before = row | {"collision_list": '[{"collider": "a", "victim": "b"}]'}
    today = row | {"collision_list": '[{"collider": "a", "victim": "b", "human_error_involved": false}]'}
    other = row | {"collision_list": '[{"collider": "b", "victim": "a", "human_error_involved": false}]'}
    assert [*audit._differences(before, today)] == []
    assert len([*audit._differences(before, other)]) == 1
    assert len([*audit._differences(before, row | {"collision_list": "[]"})]) == 1


def test_new_weights_make_new_cells(
    settings: Settings, claims: list[Claim], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = drive.planned(claims, settings)
    weights = tmp_path / "rule.safetensors"
    weights.write_bytes(b"new")
    made_of = drive._made_of
    changed = lambda name: ((weights,), "") if name == "altruist-rule" else made_of(name)  # noqa: E731
    monkeypatch.setattr(drive, "_made_of", changed)
    after = drive.planned(claims, settings)
    names = [{drive.policy(c): c.name for c in work.cells} for work in (before, after)]
    assert {n for n in names[0] if names[0][n] != names[1][n]} == {"altruist-rule"}
    rule = next(arm for key, arm in after.arms["first"].items() if key[1] == "rule")
    assert len(rule.weights) == 12
    assert rule.cell.manifest[POLICY_FILES].keys() == {"rule.safetensors"}


def test_what_has_no_trained_weights_is_left_out_unless_it_is_asked_for(
    settings: Settings, claims: list[Claim], monkeypatch: pytest.MonkeyPatch, engine: Counting, capsys: Any
) -> None:
    made_of = drive._made_of
    changed = lambda name: ((), "untrained") if name == "idm-courteous" else made_of(name)  # noqa: E731
    monkeypatch.setattr(drive, "_made_of", changed)
    assert len(drive.planned(claims, settings).cells) == 3
    assert len(drive.planned(claims, replace(settings, untrained=True)).cells) == 4
    drive.drive(claims, settings)
    assert "research: idm-courteous: untrained, not driven" in capsys.readouterr().err
    assert engine.driven == 0


def test_ray_is_an_engine(settings: Settings) -> None:
    pytest.importorskip("ray")
    from cosim.workers.ray_engine import RayEngine

    assert isinstance(drive.engine(replace(settings, engine="ray")), RayEngine)


def test_the_pages_of_the_repository_are_of_its_weights_and_definitions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(ROOT)
    assert cli.main(["check"]) == 0


def test_the_kept_episodes_of_the_repository_are_those_of_its_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    claims = [*chosen([])]
    if all(index.answer(claim, page.OUT) == index.NOT_DRIVEN for claim in claims):
        pytest.skip("no claim has been driven yet: what is kept is of earlier networks")
    found = audit.audit(drive.planned(claims, Settings()), Settings(workers=1), 1)
    assert found.differing == ()
    assert found.unknown == 0, (
        "weights or scenarios are new: `python -m research drive`, then `page` and `keep`"
    )


def test_a_part_does_not_replace_the_kept_episodes_of_all(capsys: pytest.CaptureFixture[str]) -> None:
    for part in (["altruism"], ["--scale", "0.5"], ["--seeds", "300000:300002"], ["--scenario", "merge"]):
        assert cli.main(["keep", *part]) == 2
        assert "would replace the kept episodes" in capsys.readouterr().err

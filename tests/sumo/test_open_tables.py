"""A world, a reward, a metric, a predictor and a policy of a user's, none of them in our packages."""

from __future__ import annotations

import csv
import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import cosim
import sumo_scenarios
from cosim import metrics, rewards
from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.policies import make
from cosim.report import run_folder
from cosim.scenario import load, place
from cosim.simulation.fake import FakeSimulator, FakeVehicle
from cosim.types import MetaAction
from policy.prediction.predictors import make_predictor

CODE = """
from cosim.types import Decision, Metric, MetaAction, ObservationConfig
from policy.prediction.constant import ConstantSpeed

def by_speed(step):
    now = step.after
    return {av: float(now.speed[now.row[av]]) if av in now.row else 0.0 for av in step.avs}

def forgetful(step): return {}

def divides(step): return 1 / 0

class Frames:
    def reset(self, first, context): self.frames = 0
    def add(self, snapshot): self.frames += 1
    def result(self): return {"frames": Metric(self.frames, "frames", "")}

class Crashed(Frames):
    def result(self): return {"crashed": Metric(False, "", "lower")}

class Seed(Frames):
    def result(self): return {"seed": Metric(7, "", "")}

class Words(Frames):
    def result(self): return {"words": Metric("abc", "", "")}

class Five(Frames):
    def result(self): return 5

class Brakes:
    observation = ObservationConfig(maps=False)
    def reset(self, context): ...
    def decide(self, histories): return {av: MetaAction.DECELERATE for av in histories}

class Slower(ConstantSpeed):
    name = "slower"
    def predict(self, kinematics, valid): return super().predict(0.5 * kinematics, valid)

class Breaks(ConstantSpeed):
    def predict(self, kinematics, valid): return kinematics[99]
"""


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder outside the package: the world `mine`, which is merge by another name, and code.py."""
    folder = tmp_path_factory.mktemp("own")
    world = folder / "mine"
    shutil.copytree(sumo_scenarios.folder("merge"), world)
    (world / "merge.sumocfg").rename(world / "mine.sumocfg")
    definition = world / "scenario.yaml"
    definition.write_text(definition.read_text().replace("name: merge", "name: mine"))
    (folder / "code.py").write_text(CODE)
    return folder


def one_av(*_: object) -> FakeSimulator:
    return FakeSimulator([FakeVehicle("av", 50.0, 0, 20.0, is_av=True)], length=520.0)


def test_a_world_is_a_folder_wherever_it_lies(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs, ours = load(str(own / "mine"), demand=["contested"]), load("merge", demand=["contested"])
    assert (theirs.name, theirs.behavior) == ("mine", ours.behavior)
    assert theirs.demand[0] == own / "mine" / "demand" / "contested.rou.xml"
    monkeypatch.chdir(own)
    assert place("mine") == str(own / "mine")
    assert place("merge") == "merge"


def test_a_world_may_not_be_called_as_one_that_ships(own: Path, tmp_path: Path) -> None:
    shutil.copytree(sumo_scenarios.folder("exit"), tmp_path / "exit")
    with pytest.raises(BadInput, match=r"scenario\.yaml: name='exit': a world that ships is called so"):
        load(str(tmp_path / "exit"))
    with pytest.raises(BadInput, match=r"a world's folder holds scenario\.yaml"):
        load(str(own))


def test_reward_metric_and_policy_of_ones_own_drive_in_a_world_of_ones_own(own: Path) -> None:
    code = f"{own}/code.py"
    words = {"demand": "contested", "seed": 100_007, "others": partial(make, f"{code}:Brakes")}
    with cosim.open("merge", **words) as session:
        session.reset()
        session.act({})
        ours = session.result()
    words |= {"reward": f"{code}:by_speed", "metrics": [f"{code}:Frames"]}
    with cosim.open(str(own / "mine"), **words) as session:
        before = session.reset()
        step = session.act({})
        now = session.snapshot()
        theirs = session.result()
        timing = session.scenario.timing
    assert (theirs.scenario, theirs.trace_hash) == ("mine", ours.trace_hash)
    assert step.rewards == {av: now.speed[now.row[av]] for av in before}
    assert {av: terms.ego for av, terms in step.terms.items()} == step.rewards
    assert set(step.receipts) == set(before), "the policy commands them all"
    assert theirs.metrics["frames"].value == round(timing.decision / timing.frame)


def test_a_copy_drives_as_the_world_that_ships(own: Path) -> None:
    driven = {}
    for what, preset in (("merge", None), (str(own / "mine"), None), ("merge", "unguarded")):
        with cosim.open(what, demand="contested", preset=preset) as session:
            session.reset(140_007)
            for _ in range(6):  # a queue that always asks for more: the lawful car keeps its distance
                session.act(dict.fromkeys(session.avs, MetaAction.ACCELERATE))
            driven[what, preset] = session.result().trace_hash
    ours, copy, unguarded = driven.values()
    assert ours == copy != unguarded


def test_a_share_of_all_vehicles_may_be_avs(own: Path) -> None:
    with cosim.open(str(own / "mine"), penetration=0.0) as session:
        assert session.reset(100_007) == {}
    with pytest.raises(BadInput, match=r"av_type='av': excludes penetration"):
        cosim.open("merge", penetration=0.5, av_type="av")


@pytest.mark.parametrize(
    ("reward", "metric", "said"),
    [
        ("by_speed", "Frames", "reward='by_speed': unknown"),
        ("{code}:forgetful", "Frames", "code.py: reward=[]: must pay each of"),
        ("{code}:divides", "Frames", "code.py:11: divides: ZeroDivisionError"),
        ("p", "Crashed", "code.py: metric='crashed': is the name of something else in a row"),
        ("p", "Seed", "code.py: metric='seed': is the name of something else in a row"),
        ("p", "Words", "code.py: metric.words="),
        ("p", "Five", "code.py: result: must return a mapping"),
        ("t", "by_speed", "code.py: reset: AttributeError"),
    ],
)
def test_a_mistake_in_it_is_one_line(own: Path, reward: str, metric: str, said: str) -> None:
    code = f"{own}/code.py"
    words = {"reward": reward.format(code=code), "metrics": [f"{code}:{metric}"], "simulator": one_av}

    def go() -> None:
        with cosim.open(str(own / "mine"), worker=False, **words) as session:
            session.reset(100_007)
            session.act({})
            session.result()

    with pytest.raises(BadInput) as refused:
        go()
    assert said in str(refused.value)


def test_what_cannot_be_imported_elsewhere_is_refused() -> None:
    with pytest.raises(BadInput, match="must be importable, or worker=False"):
        cosim.open("merge", reward=lambda _: {})


def test_texts_name_what_tables_hold_and_what_files_hold(own: Path) -> None:
    for name in rewards.REWARDS:
        assert rewards.read(name) == rewards.RewardConfig(variant=name)
    assert metrics.read(f"{own}/code.py:Frames")().result  # a fresh one each time
    predictor = make_predictor(f"{own}/code.py:Slower", 20, 0.2)
    state = np.zeros((3, 10, 4))
    state[:, :, 2] = 12.0
    everywhere = np.ones((3, 10), bool)
    half = make_predictor("cs", 20, 0.2).predict(0.5 * state, everywhere)
    np.testing.assert_array_equal(predictor.predict(state, everywhere).x, half.x)
    with pytest.raises(BadInput, match=r"code\.py:\d+: predict: IndexError"):
        make_predictor(f"{own}/code.py:Breaks", 20, 0.2).predict(state, everywhere)
    with pytest.raises(BadInput, match=r"code\.py: Brakes: TypeError"):
        make_predictor(f"{own}/code.py:Brakes", 20, 0.2)


def test_all_of_them_together_are_evaluated(own: Path, tmp_path: Path) -> None:
    code = f"{own}/code.py"
    words = ["--policy", f"{code}:Brakes", "--metric", f"{code}:Frames", "--reward", f"{code}:by_speed"]
    words += ["--scenario", str(own / "mine"), "--duration", "4", "--seeds", "200000:200001"]
    assert main(["evaluate", *words, "--workers", "1", "--no-report", "--out", str(tmp_path)]) == 0
    (row,) = run_folder.read(tmp_path).rows
    assert (row["scenario"], row["policy"], row["status"]) == ("mine", "Brakes", "ok")
    assert row["frames"] == 2 * row["steps"] > 0
    assert 0.0 < row["reward_mean"] < 25.0, "by speed in m/s"
    manifest = run_folder.read(tmp_path).manifest
    (cell,) = manifest["cells"].values()
    assert set(cell["manifest"]["policy_files"]) == {"code.py"}
    assert manifest["better"]["frames"] == ""


def test_all_of_them_together_are_trained_with(
    own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = f"{own}/code.py"
    words = ["--reward", f"{code}:by_speed", "--metric", f"{code}:Frames", "--scenario", str(own / "mine")]
    run = ["train", "vfn-p", "--config", "smoke", *words, "--out", str(tmp_path)]
    assert main([*run, "--iterations", "2"]) == 0
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert len(log) == 2
    assert all(entry["train/frames"] > 0 for entry in log)
    assert all(entry["train/reward"] > 1.0 for entry in log), "by speed in m/s"
    assert json.loads((tmp_path / "best.json").read_text())["data"]["reward"] == f"{code}:by_speed"
    capsys.readouterr()
    again = ["--scenario", str(own / "mine"), "--config", "smoke", "--out", str(tmp_path), "--resume"]
    assert main(["train", "vfn-p", *again, "--iterations", "3"]) == 2, "without its reward"
    assert "was trained with another configuration" in capsys.readouterr().err


@pytest.mark.soak
def test_an_encoder_is_trained_on_one_s_own_roads(
    own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ["train", "encoder", "--config", "smoke", "--scenario", str(own / "mine"), "--out", str(tmp_path)]
    assert main([*run, "--seed", "3"]) == 0
    card = json.loads((tmp_path / "encoder.json").read_text())
    assert card["data"]["seed"] == 3
    assert card["data"]["frames"]["training"] > card["data"]["frames"]["validation"] // 2 > 0
    log = (tmp_path / "log.csv").read_text().splitlines()
    assert len(log) == 5, "a head, and a line of each update"
    capsys.readouterr()
    assert main([*run, "--errors", "stress"]) == 2
    assert "does not apply to the encoder" in capsys.readouterr().err


def test_a_predictor_is_measured_where_one_s_own_policy_drives(own: Path, tmp_path: Path) -> None:
    code = f"{own}/code.py"
    words = ["--scenario", str(own / "mine"), "--demand", "free", "--behavior", "mixed", "--no-maps"]
    words += ["--policy", f"{code}:Brakes", "--predictor", f"{code}:Slower", "--predictor", "cs"]
    assert main(["bench", "predict", *words, "--seeds", "200000:200001", "--out", str(tmp_path)]) == 0
    with (tmp_path / "position_error.csv").open() as file:
        rows = [r for r in csv.DictReader(file) if r["scenario"] == "mine" and r["horizon_s"] == "mean"]
    error = {r["predictor"]: float(r["mean_m"]) for r in rows if r["behavior"] == "all"}
    assert error["slower"] > error["cs"] > 0.0


@pytest.mark.parametrize("command", ["evaluate", "train"])
@pytest.mark.parametrize("flag", ["--reward", "--metric"])
def test_what_cannot_be_loaded_is_refused_before_anything_is_made(
    own: Path, tmp_path: Path, command: str, flag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (
        ["evaluate", "--duration", "4"] if command == "evaluate" else ["train", "vfn-p", "--config", "smoke"]
    )
    words += ["--scenario", "merge", flag, f"{own}/code.py:nope", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert f"{flag}='nope': no class or function of this name" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

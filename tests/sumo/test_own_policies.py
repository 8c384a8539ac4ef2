"""Weights of a training and a user's own code as `--policy`: driven like what ships, mistakes named."""

from __future__ import annotations

import json
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cosim.batch.store import FILE
from cosim.cli.main import main
from cosim.errors import BadInput
from cosim.learning.configuration import configuration
from cosim.policies import check, make
from cosim.policies.trained import config
from cosim.types import COMPACT, SMOKE
from policy import checkpoint
from policy.agents.approaches import APPROACHES, compact
from policy.checkpoint import SHIPPED
from policy.networks.vfn import VFN
from policy.safety import Thresholds
from policy.training.config import agent_config, described

EXAMPLES = Path(__file__).parents[2] / "examples"
SEED = "200061"
CODE = """
from cosim.types import COMPACT, SMOKE, ContinuousAction, Decision, MetaAction, ObservationConfig

class Holds:
    observation = ObservationConfig(maps=False)
    def reset(self, context): ...
    def decide(self, histories): return {av: self.answer(av) for av in histories}
    def answer(self, av): return 1

class Raises(Holds):
    def answer(self, av):
        return 1 // 0

class Text(Holds):
    def answer(self, av): return "left"

class UnknownVehicle(Holds):
    def decide(self, histories): return {"nobody": None}

class Lists(Holds):
    def decide(self, histories): return [1]

class Blind(Holds):
    observation = None

class Fails(Holds):
    def __init__(self): raise OSError("no model file")

class Wrapped(Holds):
    def answer(self, av): return Decision("left")

class Filed(Holds):
    files = ["nowhere.zip"]

class Numbered(Holds):
    av_parameters = {"lcSpeedGain": 3}

class Leaves(Holds):
    def answer(self, av): raise SystemExit(3)

class Prints(Holds):
    def answer(self, av):
        print("hello")
        return 1

class Eases(Holds):
    def answer(self, av): return ContinuousAction(-0.5, 1)

class EasesToo(Holds):
    def answer(self, av): return Decision(MetaAction.LANE_LEFT, accel=-0.5)

class Endless(Holds):
    def answer(self, av): return ContinuousAction(float("nan"), 0)

class Leaps(Holds):
    def answer(self, av): return ContinuousAction(1.0, 3)

class Nothing: ...

def factory(): return Holds()
def looks(seen): return None if seen.velocity_map.shape[-1] else MetaAction.IDLE
number = 7
"""


@pytest.fixture
def code(tmp_path: Path) -> Path:
    file = tmp_path / "code.py"
    file.write_text(CODE)
    return file


def run(policy: str, out: Path, *more: str) -> dict[str, Any]:
    """Two seconds of the contested merge."""
    arguments = ["run", "merge", "--demand", "contested", "--duration", "2", "--seed", SEED]
    assert main([*arguments, "--policy", policy, "--out", str(out), *more]) == 0
    found: dict[str, Any] = json.loads((out / "result.json").read_text())
    return found


def test_weights_of_a_training_drive_as_the_same_weights_that_ship(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    for ending in ("safetensors", "json"):
        shutil.copy(SHIPPED / f"vfn.{ending}", folder / f"best.{ending}")
    mine, ours = run(str(folder), tmp_path / "a"), run("vfn", tmp_path / "b")
    assert mine["policy"] == "mine"
    assert mine["policy_label"] == ours["policy_label"]
    assert mine["trace_hash"] == ours["trace_hash"]
    hashes = [list(x["manifest"]["policy_files"].values()) for x in (mine, ours)]
    assert hashes[0] == hashes[1] != []


@pytest.mark.parametrize("name", APPROACHES)
def test_the_card_of_what_ships_says_all_of_its_agent(name: str) -> None:
    assert config(SHIPPED / f"{name}.safetensors") == compact(name)


def test_the_card_of_ones_own_training_says_its_sizes_and_thresholds(tmp_path: Path) -> None:
    file = configuration("smoke").file
    file = replace(file, safety=Thresholds(safe_th=2.5))
    wanted = agent_config("vfn", file)
    about = described("vfn", wanted, file)
    weights = tmp_path / "best.safetensors"
    checkpoint.save(weights, {"vfn": VFN(wanted.vfn)}, {"vfn": wanted.vfn}, {}, about)
    assert config(weights) == replace(wanted, vfn_weights=weights)
    assert make(f"{tmp_path}/").observation == SMOKE != COMPACT
    checkpoint.save(
        weights, {"vfn": VFN(wanted.vfn)}, {"vfn": wanted.vfn}, {}, about | {"hpn_sha256": "0" * 64}
    )
    assert make(f"{tmp_path}/").label == "trained with another HPN"


def test_weights_that_are_no_value_networks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"hpn\.json: data\.policy: not the card of a value network"):
        check(str(SHIPPED / "hpn.safetensors"))
    for ending in ("safetensors", "json"):
        shutil.copy(SHIPPED / f"vfn.{ending}", tmp_path / f"best.{ending}")
    card = json.loads((tmp_path / "best.json").read_text())
    card["data"]["safety"]["safe_the"] = 1
    (tmp_path / "best.json").write_text(json.dumps(card))
    with pytest.raises(BadInput, match=r"best\.json: data\.safety\.safe_the=1: unknown field, did you mean"):
        check(f"{tmp_path}/")


def test_a_class_a_factory_and_a_function_of_ones_own_drive(code: Path, tmp_path: Path) -> None:
    unguarded = ("--preset", "unguarded")  # as keep-lane always is
    results = [run(f"{code}:{name}", tmp_path / name, *unguarded) for name in ("Holds", "factory", "looks")]
    ours = run("keep-lane", tmp_path / "ours")
    assert [r["policy"] for r in results] == ["Holds", "factory", "looks"]
    assert results[0]["trace_hash"] == results[1]["trace_hash"] == ours["trace_hash"]
    assert make(f"{code}:looks").observation == COMPACT  # maps, unless it says otherwise: SUMO drives here
    assert results[2]["trace_hash"] == run("idm", tmp_path / "idm", *unguarded)["trace_hash"]
    eased, too = (run(f"{code}:{name}", tmp_path / name)["trace_hash"] for name in ("Eases", "EasesToo"))
    assert eased == too != run("idm", tmp_path / "lawful")["trace_hash"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Raises", "code.py:12: decide: ZeroDivisionError"),
        (
            "Text",
            "decide='left': must decide for a Decision, a MetaAction (0 to 4), a ContinuousAction or None",
        ),
        ("Wrapped", "must decide for a Decision, a MetaAction (0 to 4), a ContinuousAction or None"),
        ("Endless", "decide=ContinuousAction(accel=nan, lane_offset=0): must decide for"),
        ("Leaps", "with a finite acceleration and a lane offset of 1, 0 or -1"),
        ("Filed", "Filed.files='nowhere.zip': no such file"),
        ("Numbered", "Numbered.av_parameters=('lcSpeedGain', 3): must map SUMO's parameters to text"),
        ("Leaves", "decide: SystemExit: 3"),
        ("UnknownVehicle", "decide: decided for an id that is no AV on the road: 'nobody'"),
        ("Lists", "decide='list': must return a mapping of AV to decision"),
        ("Blind", "Blind.observation: must be a cosim.types.ObservationConfig"),
        ("Fails", "Fails: OSError: no model file"),
        ("Nothing", "Nothing: a policy needs observation, reset, decide (cosim.types.Policy)"),
        ("number", "--policy='number': no class or function of this name"),
        ("Hold", "--policy='Hold': no class or function of this name, did you mean 'Holds'?"),
    ],
)
def test_a_mistake_in_it_is_one_line_that_names_its_file(
    code: Path, name: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", "merge", "--demand", "contested", "--duration", "2", "--policy", f"{code}:{name}"]
    assert main(arguments) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith(f"cosim: {code}")
    assert said in error


def test_what_it_prints_leaves_stdout_to_the_document(code: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "merge", "--demand", "contested", "--duration", "1", "--json"]
    assert main([*arguments, "--policy", f"{code}:Prints"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["policy"] == "Prints"
    assert "hello" in err


def test_a_run_folder_holds_one_run(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run("idm", out, "--output", "tripinfo", "--replay")
    assert (out / "replay.mp4").is_file()
    run("keep-lane", out, "--output", "fcd")
    assert sorted(p.name for p in out.rglob("*") if p.is_file()) == [
        "fcd.xml", "manifest.json", "metrics.txt", "result.json",
    ]  # fmt: skip


def test_a_device_that_is_not_there_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cosim.learning.train_vfn.usable", lambda device: device == "cpu")
    out = tmp_path / "out"
    assert main(["train", "vfn-p", "--config", "smoke", "--device", "cuda", "--out", str(out)]) == 2
    assert "--device='cuda': torch has no such device here" in capsys.readouterr().err
    assert not out.exists()


def test_code_that_cannot_be_imported_is_named_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("x = 1\nimport no_such_package\n")
    with pytest.raises(BadInput, match=r"broken\.py:2: import: ModuleNotFoundError"):
        check(f"{tmp_path}/broken.py:Agent")
    with pytest.raises(BadInput, match="no_such_package: import: ModuleNotFoundError"):
        check("no_such_package:Agent")
    with pytest.raises(BadInput, match="a policy that ships is called idm"):
        check(f"idm={tmp_path}/broken.py:Agent")


def test_a_batch_compares_ones_own_with_ours_and_knows_when_it_was_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("own_policy.py", "own_agent.py"):
        shutil.copy(EXAMPLES / name, tmp_path)
    out = tmp_path / "out"
    spec = tmp_path / "spec.yaml"
    spec.write_text(
        "scenario: merge\ndemand: contested\nduration: 2\nseeds: '200061:200063'\n"
        "policy: [idm, mine=own_policy.py:NearMission, 'own_agent.py:my_agent']\n"
    )
    assert main(["evaluate", str(spec), "--workers", "1", "--no-report", "--out", str(out)]) == 0
    assert main(["compare", str(out), "--baseline", "idm", "--candidate", "mine"]) == 0
    assert "idm -> mine" in capsys.readouterr().out
    cells = json.loads((out / "manifest.json").read_text())["cells"]
    key = next(f"{k}-{SEED}" for k, cell in cells.items() if cell["case"]["policy"].startswith("mine="))
    assert main(["replay", str(out), key, "--html", str(tmp_path / "page.html")]) == 0
    assert main(["replay", str(out), key, "--beside", f"{tmp_path}/own_agent.py:my_agent"]) == 0
    assert (out / f"replay-{key}-beside-my_agent.mp4").stat().st_size > 10_000
    with (tmp_path / "own_policy.py").open("a") as file:
        file.write("# another one\n")
    assert main(["replay", str(out), key, "--html", str(tmp_path / "page.html")]) == 2
    assert "own_policy.py: has changed since it drove" in capsys.readouterr().err
    with sqlite3.connect(out / FILE) as store:
        store.execute("delete from cosim_episodes where key = ?", [key])
    assert main(["evaluate", "--workers", "1", "--no-report", "--out", str(out), "--resume"]) == 2
    assert "own_policy.py: policy='mine': has changed in a worker: " in capsys.readouterr().err


@pytest.mark.soak
def test_what_stable_baselines_learned_drives_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tmp_path / "dqn.zip"
    train = [sys.executable, str(EXAMPLES / "train_sb3_dqn.py"), "--steps", "40", "--episodes", "1"]
    subprocess.run([*train, "--out", str(model)], check=True, capture_output=True)
    monkeypatch.setenv("SB3_MODEL", str(model))
    found = run(f"{EXAMPLES}/sb3_policy.py:Dqn", tmp_path / "run")
    assert list(found["manifest"]["policy_files"]) == ["sb3_policy.py", "dqn.zip"]
    assert found["steps"] == 5
    model.unlink()
    with pytest.raises(BadInput, match="Dqn: FileNotFoundError"):
        make(f"{EXAMPLES}/sb3_policy.py:Dqn")


def test_two_of_one_name_are_refused(code: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policies = ["--policy", f"{code}:Holds", "--policy", f"Holds={code}:factory"]
    assert main(["evaluate", "--scenario", "merge", *policies, "--out", str(tmp_path / "out")]) == 2
    assert "policy: two policies are called Holds: label them, LABEL=..." in capsys.readouterr().err

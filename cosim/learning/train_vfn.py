"""Training of the value networks from a configuration file: joins trainer and rollouts."""

import argparse
import math
import shlex
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import yaml

from cosim.errors import BadInput
from cosim.files import code, working_in
from cosim.learning.announcement import Announced, begin, begun
from cosim.learning.configuration import configuration
from cosim.learning.rollouts import Rollouts
from cosim.metrics import read as read_metric
from cosim.rewards import REWARDS, RewardConfig
from cosim.rewards import read as read_reward
from cosim.scenario import human_errors, load, place
from cosim.scenario.manifest import digests
from cosim.scenario.policy_name import BEST
from cosim.workers.memory import keep_freed_memory
from cosim.workers.progress import Progress
from policy.checkpoint import sha256
from policy.training.config import agent_config, described
from policy.training.curriculum import Lesson, VfnTraining
from policy.training.loop import tensorboard
from policy.training.networks import usable, use_threads
from policy.training.vfn import TrainingRun
from sumo_scenarios import names

WEIGHTS = {"contested": 2.0, "dense": 1.0}  # weights of demands: altruism is learned where an AV must yield


def train(args: argparse.Namespace) -> int:
    """`cosim train NAME` for an agent. Raises BadInput for invalid input before the first episode."""
    values, file = configuration(args.config)
    name = args.what
    agent = agent_config(name, file)
    if not usable(args.device):
        raise BadInput("torch has no such device here", field="--device", value=args.device)
    training = _scheduled(file.training, args)
    reward, metrics, own = _user_code(training, args)
    for lesson in training.lessons:
        load(lesson.scenario, demand=[lesson.demand], behavior=lesson.behavior)
    with working_in(args.out) as folder:
        begun(folder / "state.json", args)
        about = described(name, agent, file)
        about["scenarios"] = sorted({lesson.scenario for lesson in training.lessons})
        about |= {"code": own} if own else {}
        about |= {"reward": reward} if reward else {}
        about |= {"metrics": list(metrics)} if metrics else {}
        if agent.predicted_maps and agent.chain.source == "hpn" and agent.hpn_weights is not None:
            about["hpn_sha256"] = sha256(agent.hpn_weights)
        keep_freed_memory()
        use_threads(args.threads)  # more threads than cores stall each other (docs/guides/training.md)
        writer = tensorboard(folder)
        earned = chosen_reward(reward, file.reward)
        rollouts = Rollouts(args.workers, name, agent, file.explore, earned, metrics)
        wanted = 0 if agent.vfn.critic else training.prefill  # decisions before the first update
        begin(name, training, wanted, shlex.quote(args.out))
        with closing(writer), Progress(f"train {name}", "iterations") as progress, rollouts as actors:
            announced = Announced(actors, wanted, progress.say)
            run = TrainingRun(
                training, agent.vfn, announced, folder, device=args.device, log=writer, about=about
            )
            if args.resume and not run.resume():
                print("nothing to resume: starting a new training", file=sys.stderr)
            announced.recorded = run.trainer.replay.size
            (folder / "config.yaml").write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
            run.run(progress)
        # a path for `--policy`: a bare word would name a shipped policy
        typed = shlex.quote(args.out if "/" in args.out else f"./{args.out}")
        best = f", best validation reward {run.best:.3f}" if math.isfinite(run.best) else ""
        print(f"{name}: {run.iteration} iterations, {run.trainer.learner.updates} updates{best}")
        print(f"  {folder / BEST}" + (f" (cosim run merge --policy {typed})" if best else ""))
        return 0


def _scheduled(training: VfnTraining, args: argparse.Namespace) -> VfnTraining:
    """The file's schedule, overridden by the command line."""
    worlds = names() if "all" in args.scenario else tuple(map(place, args.scenario))
    if worlds:
        lessons = tuple(lesson for world in worlds for lesson in _lessons(world))
        training = replace(training, lessons=lessons)
    errors = human_errors.asked(args.errors or training.errors or human_errors.NONE)
    given = {field: getattr(args, field) for field in ("iterations", "seed")}
    changes = {field: value for field, value in given.items() if value is not None}
    return replace(training, errors=errors or "", **changes)


def chosen_reward(reward: str, weights: RewardConfig) -> str | RewardConfig:
    """The reward of `--reward`: one of ours with the configuration's weights, the user's, or ("") the
    configuration's."""
    return replace(weights, variant=reward) if reward in REWARDS else reward or weights


def _user_code(
    training: VfnTraining, args: argparse.Namespace
) -> tuple[str, tuple[str, ...], dict[str, str]]:
    """The checked reward and metrics of the user; SHA-256 of their files and of the error level's."""
    reward = code.absolute(args.reward, Path(), "--reward") if args.reward else ""
    metrics = tuple(code.absolute(metric, Path(), "--metric") for metric in args.metric)
    if reward:
        read_reward(reward)
    for metric in metrics:
        read_metric(metric)
    level = human_errors.read(training.errors or None)
    files = [*code.files_of([*metrics, reward]), *([] if level is None else [level.file])]
    return reward, metrics, digests(files)


def _lessons(world: str) -> list[Lesson]:
    """The scenario's contested and dense demands, else all. Raises BadInput without named demands."""
    known = load(world).demands
    if not known:
        raise BadInput("has no demands by name to train on", field="--scenario", value=world)
    return [Lesson(world, d, weight=WEIGHTS[d]) for d in WEIGHTS if d in known] or [
        Lesson(world, d) for d in known
    ]

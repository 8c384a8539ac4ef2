"""Cost of the agent: one decision for 8 AVs by its parts, without simulation, and the speed of training.

    python -m benchmarks.agent [--size compact paper] [--threads 1 2] [--decisions 40] [--out FILE.md]
    python -m benchmarks.agent --only training [--config paper] [--episodes 1]

Decisions: prediction, values and prioritizer are timed on recorded histories (highway, dense, validation seed
100,000, a share of AVs such that 8 decide); medians over decisions. Simulation and observation are timed in
whole episodes driven by the agent. Training: one rollout process explores while this process updates without
a pause. Results do not depend on the weights. On a busy machine times are upper, rates lower bounds.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.prediction_maps import AGENTS, DECISION, PENETRATION, Gatherer
from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.host import Host
from cosim.learning.configuration import configuration
from cosim.learning.rollouts import Rollouts
from cosim.scenario import Fleet, Scenario, load
from cosim.seeding import TUNING_SEEDS
from cosim.types import EpisodeResult, History, PolicyContext
from cosim.workers.memory import keep_freed_memory
from cosim.workers.worker import Worker
from policy.agents.approaches import AgentConfig, compact, paper
from policy.agents.prediction_aware import PredictionAware
from policy.training.config import agent_config
from policy.training.curriculum import Drive, DriveResult, Lesson
from policy.training.ddqn import DdqnLearner
from policy.training.replay_buffer import ReplayBuffer

SIZES: Mapping[str, Callable[[str], AgentConfig]] = {"compact": compact, "paper": paper}
POLICY = "vfn-p"
TARGET_MS = 50.0  # compact size, 8 AVs, two cores; the period is 400 ms
TARGET_RATE = 60.0  # joint decisions/s with the learner on the other core
WARM_UP = 2  # uncounted decisions, for compilation and caches
SVO = math.radians(45.0)
FILL = 4  # episodes in the replay before updates are timed


def decision(
    config: AgentConfig, road: Any, kept: Sequence[Mapping[str, History]], context: PolicyContext
) -> dict[str, float]:
    """Median ms of every part of a joint decision, and of its processor time."""
    agent = PredictionAware(POLICY, config)
    agent.reset(replace(context, road=road, observation=agent.observation))
    spent: dict[str, list[float]] = {name: [] for name in ("prediction", "values", "prioritizer")}
    processor: list[float] = []  # ms of all threads, insensitive to other load
    warm_up = kept[:WARM_UP]
    for number, histories in enumerate([*warm_up, *kept]):
        worked, clock = time.process_time(), [time.perf_counter()]
        inputs = agent.perceive(histories)
        clock.append(time.perf_counter())
        q = agent.values(inputs)
        clock.append(time.perf_counter())
        agent.choose(q, inputs)
        clock.append(time.perf_counter())
        if number >= len(warm_up):
            for name, seconds in zip(spent, np.diff(clock), strict=True):
                spent[name].append(1e3 * float(seconds))
            processor.append(1e3 * (time.process_time() - worked))
    out = {name: statistics.median(values) for name, values in spent.items()}
    out["decision"] = statistics.median(map(sum, zip(*spent.values(), strict=True)))
    out["processor time"] = statistics.median(processor)
    return out


def decisions(
    size: str, threads: Sequence[int], count: int, scenario: Scenario, *, bf16: bool = False
) -> dict[int, dict[str, float]]:
    """Threads -> ms by part, for one size."""
    config = replace(SIZES[size](POLICY), bf16=bf16)
    if size == "paper":
        config = replace(config, vfn_weights=None)  # only compact ones are shipped
    with Worker(Gatherer, scenario, config.observation) as worker:
        road, kept = worker.call("gather", TUNING_SEEDS.start, count)
    context = PolicyContext(road, scenario.timing, config.observation, SVO, np.random.default_rng(0))
    found = {}
    before = torch.get_num_threads()
    try:
        for number in threads:
            torch.set_num_threads(number)
            found[number] = decision(config, road, kept, context)
    finally:
        torch.set_num_threads(before)
    return found


def closed_loop(scenario: Scenario, episodes: int) -> dict[str, float]:
    """ms per decision by part, in whole episodes driven by the compact agent in one process."""
    with Worker(Host, scenario, POLICY, SVO) as worker:
        worker.call("run", TUNING_SEEDS.start)  # compilation
        done: list[EpisodeResult] = [worker.call("run", TUNING_SEEDS.start + 1 + k) for k in range(episodes)]
    steps = sum(result.steps for result in done)
    parts = {"simulation": "simulation_s", "observation": "observation_s", "decision": "decision_s"}
    return {name: 1e3 * sum(r.timings[key] for r in done) / steps for name, key in parts.items()}


def training(config: str, lesson: Lesson, episodes: int) -> dict[str, float]:
    """Rates of a rollout process and of the learner in this process, running in parallel.

    A joint decision commands all AVs of an episode at once.
    """
    file = configuration(config).file
    agent = agent_config(POLICY, file)
    learner = DdqnLearner(agent.vfn, file.training.ddqn_config, seed=0)
    replay = ReplayBuffer(file.training.replay_config)
    with Rollouts(1, POLICY, agent, file.explore, file.reward) as actors:

        def drive(seed: int) -> Any:
            return actors.submit(Drive(lesson, seed, SVO, 0.5, "", "", True, preset=file.training.preset))

        fill = min(FILL, episodes)
        for future in [drive(seed) for seed in range(fill)]:
            replay.add(future.result().trajectories)
        if not replay.size:
            raise SystemExit(f"nothing to learn from in {lesson.scenario}, {lesson.demand}: no AV decides")
        rng = np.random.default_rng(0)
        learner.update(replay.sample(rng))
        began, updates = time.perf_counter(), 0
        waiting = [drive(fill + seed) for seed in range(episodes)]
        while not all(future.done() for future in waiting):
            learner.update(replay.sample(rng))
            updates += 1
        elapsed = time.perf_counter() - began
        drove: list[DriveResult] = [future.result() for future in waiting]
    steps = sum(figure(one, "steps") for one in drove)
    whole = file.training.iterations * file.training.episodes
    return {
        "joint decisions/s": steps / elapsed,
        "updates/s": updates / elapsed,
        "batch": float(file.training.batch),
        "episodes/h": 3600.0 * episodes / elapsed,
        "episodes of a whole training": float(whole),
        "hours of a whole training, at this rate": whole * elapsed / (3600.0 * episodes),
        "simulation and observation, share of the rollout's time": sum(
            figure(one, name) for one in drove for name in ("reset_s", "simulation_s", "observation_s")
        )
        / elapsed,
    }


def figure(one: DriveResult, name: str) -> float:
    """The value of a figure that every drive has."""
    value = one.figures[name]
    assert value is not None
    return value


def page(found: Mapping[str, Any], command: str) -> list[str]:
    """The Markdown page."""
    lines = ["# What the agent costs", "", f"Made by `{command}`; validation seeds.", ""]
    if found["decisions"]:
        lines += [
            f"One joint decision for {AGENTS} AVs, ms, median; the period is {1e3 * DECISION:g} ms.",
            "",
        ]
        columns = ("prediction", "values", "prioritizer", "decision", "processor time")
        heads = ["size", "threads", *columns, "target"]
        lines += markdown_head(heads)
        for size, by_threads in found["decisions"].items():
            for threads, parts in by_threads.items():
                times = [f"{parts[name]:.1f}" for name in columns]
                result = (
                    verdict(parts["decision"], TARGET_MS, at_most=True) if size == "compact" else "measured"
                )
                lines.append(markdown_row([size, str(threads), *times, result]))
        lines += [""]
    if found["closed loop"]:
        parts = found["closed loop"]
        lines += ["Whole episodes in one process, ms a decision (compact, one thread): "]
        lines += [", ".join(f"{name} {value:.1f}" for name, value in parts.items()) + ".", ""]
    for config, rates in found["training"].items():
        rate = verdict(rates["joint decisions/s"], TARGET_RATE, at_most=False)
        rate_shown = "measured" if config == "paper" else rate
        lines += [
            f"Training, `{config}`, a rollout process beside the learner (joint decisions/s: {rate_shown}):",
            "",
        ]
        lines += [markdown_row(["", "measured"]), "|---|---|"]
        lines += [markdown_row([name, rate_text(value)]) for name, value in rates.items()]
        lines += [""]
    return lines


def rate_text(value: float) -> str:
    """Three significant digits; integers without decimals."""
    return f"{value:,.0f}" if value == round(value) or value >= 1000.0 else f"{value:.3g}"


def verdict(value: float, limit: float, *, at_most: bool) -> str:
    """Whether a target is met."""
    met = value <= limit if at_most else value >= limit
    return f"{'met' if met else '**missed**'} ({'at most' if at_most else 'at least'} {limit:g})"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, then print or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", nargs="+", choices=[*SIZES], default=[*SIZES])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--decisions", type=int, default=40)
    parser.add_argument("--bf16", action="store_true", help="networks in bfloat16")
    parser.add_argument("--episodes", type=int, default=4, help="whole episodes, to drive and to train")
    parser.add_argument(
        "--config", nargs="+", default=["papers"], help="training configuration: name or file"
    )
    parser.add_argument("--scenario", default="merge", help="training scenario")
    parser.add_argument("--demand", default="contested", help="training demand")
    parser.add_argument("--only", choices=("decision", "loop", "training"))
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--out", type=Path, metavar="FILE.md")
    args = parser.parse_args(arguments)
    keep_freed_memory()
    torch.set_num_threads(1)
    scenario = load("highway", demand=["dense"], fleet=Fleet(penetration=PENETRATION))
    found: dict[str, Any] = {"decisions": {}, "closed loop": {}, "training": {}}
    if args.only in (None, "decision"):
        for size in args.size:
            times = decisions(size, args.threads, args.decisions, scenario, bf16=args.bf16)
            found["decisions"][size] = times
    if args.only in (None, "loop"):
        found["closed loop"] = closed_loop(scenario, args.episodes)
    if args.only in (None, "training"):
        lesson = Lesson(args.scenario, args.demand)
        for config in args.config:
            episodes = 1 if config == "paper" else args.episodes  # minutes each
            found["training"][config] = training(config, lesson, episodes)
    if args.json:
        print(json.dumps(found))
        return
    words = sys.argv[1:] if arguments is None else arguments
    lines = page(found, " ".join(["python -m benchmarks.agent", *words]))
    write_page(args.out, lines)


if __name__ == "__main__":
    main()

"""One decision without the agent against bare libsumo, and against HighwayEnv, side by side in one run.

    python -m benchmarks.loop [--scenario merge] [--demand dense] [--decisions 200] [--rounds 5] [--profile]

Each round runs the same episode (same seed, same traffic: AVs driven by SUMO's IDM) twice, in fresh
processes one after the other: bare, four `libsumo.simulationStep()` per decision and nothing else but giving
newcomers their driver; and ours, the same steps plus two frames of VelocityMap and kinematics for every AV,
with full history. Figures are medians over decisions; only the ratios mean anything elsewhere.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace
from typing import Any

import numpy as np

from cosim.scenario import Fleet, Scenario, load
from cosim.types import COMPACT, PAPER, ObservationConfig
from cosim.worker import Worker

TARGET = {"compact": 3.0, "paper": 6.0}  # times bare libsumo
HIGHWAY_TARGET = 20.0  # times HighwayEnv's simulated seconds per second
VEHICLES, AVS = 50, 8


class Bare:
    """Bare libsumo: the same episode, nothing read."""

    def __init__(self, scenario: Scenario) -> None:
        import libsumo

        from cosim.simulation.sumo import SumoSimulator

        self._sumo = libsumo
        self._simulator = SumoSimulator(scenario)
        self._steps = round(scenario.timing.decision / scenario.timing.step)

    def run(self, seed: int, decisions: int) -> list[float]:
        """Seconds per decision."""
        self._simulator.reset(seed)
        step, departed = self._sumo.simulationStep, self._sumo.simulation.getDepartedIDList
        times = []
        for _ in range(decisions):
            began = time.perf_counter()
            for _ in range(self._steps):
                step()
                for name in departed():
                    self._simulator._bodies[name] = self._simulator._fleet.welcome(name, seed)
            times.append(time.perf_counter() - began)
        return times

    def close(self) -> None:
        """End SUMO."""
        self._simulator.close()


class Ours:
    """The loop up to the agent: advance, read, draw, keep the history."""

    def __init__(self, scenario: Scenario, observation: ObservationConfig) -> None:
        from cosim.observation import Observer
        from cosim.simulation.sumo import SumoSimulator

        self._simulator = SumoSimulator(scenario)
        self._observer = Observer(self._simulator.road, observation)

    def run(self, seed: int, decisions: int, profile: bool = False) -> dict[str, Any]:
        """Seconds per decision, and how many vehicles and AVs there were."""
        simulator, observer = self._simulator, self._observer
        observer.reset()
        for frame in simulator.reset(seed):
            observer.add(frame)
        observer.histories(simulator.route, simulator.commanded)  # compiled before the clock starts
        simulator.reset(seed)
        observer.reset()
        total, observing, vehicles, avs = [], [], [], []
        profiler = None
        if profile:
            import cProfile

            profiler = cProfile.Profile()
            profiler.enable()
        for _ in range(decisions):
            began = time.perf_counter()
            _, frames = simulator.advance(())
            middle = time.perf_counter()
            for frame in frames:
                observer.add(frame)
            histories = observer.histories(simulator.route, simulator.commanded)
            end = time.perf_counter()
            total.append(end - began)
            observing.append(end - middle)
            vehicles.append(frames[-1].n)
            avs.append(len(histories))
        text = ""
        if profiler is not None:
            import io
            import pstats

            profiler.disable()
            stream = io.StringIO()
            pstats.Stats(profiler, stream=stream).sort_stats("tottime").print_stats(18)
            text = stream.getvalue()
        return {"total": total, "observing": observing, "n": vehicles, "avs": avs, "profile": text}

    def reset_times(self, seeds: range) -> list[float]:
        """Seconds of `libsumo.load` + the first snapshot (no warm-up: that is simulated time)."""
        times = []
        for seed in seeds:
            began = time.perf_counter()
            frames = self._simulator.reset(seed)
            self._observer.reset()
            self._observer.add(frames[-1])
            times.append(time.perf_counter() - began)
        return times

    def memory(self) -> float:
        """Resident MiB of this process."""
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096 / 2**20

    def close(self) -> None:
        """End SUMO."""
        self._simulator.close()


class Highway:
    """HighwayEnv with as many vehicles, 8 agents and a grid observation of comparable size."""

    def run(self, steps: int) -> tuple[float, float]:
        """Simulated seconds, seconds."""
        import gymnasium
        import highway_env  # noqa: F401 - registers its environments

        config = {
            "lanes_count": 3,
            "vehicles_count": VEHICLES - AVS,
            "controlled_vehicles": AVS,
            "duration": 1000,
            "policy_frequency": 5,
            "simulation_frequency": 15,
            "action": {"type": "MultiAgentAction", "action_config": {"type": "DiscreteMetaAction"}},
            "observation": {
                "type": "MultiAgentObservation",
                "observation_config": {
                    "type": "OccupancyGrid",
                    "features": ["presence", "vx", "vy", "on_road"],
                    "grid_size": [[-128, 128], [-16, 16]],
                    "grid_step": [4, 2],
                },
            },
        }
        env = gymnasium.make("highway-v0", config=config)
        env.reset(seed=0)
        idle = (1,) * AVS
        env.step(idle)
        began = time.perf_counter()
        done = 0
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(idle)
            done += 1
            if terminated or truncated:
                env.reset()
        return done / 5.0, time.perf_counter() - began


def main() -> None:
    """Print one table; with --json one document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--scenario", default="highway")
    parser.add_argument("--demand", default="dense")
    parser.add_argument("--penetration", type=float, default=AVS / VEHICLES)
    parser.add_argument("--decisions", type=int, default=75)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--resets", type=int, default=500)
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()

    scenario = load(args.scenario, demand=[args.demand], fleet=Fleet(penetration=args.penetration))
    result: dict[str, Any] = {"scenario": args.scenario, "demand": args.demand, "rounds": args.rounds}
    bare, ours = [], {"compact": [], "paper": []}
    share, counts = {"compact": [], "paper": []}, []
    for k in range(args.rounds):
        seed = 100_000 + k
        with Worker(Bare, scenario) as worker:
            worker.call("run", seed, args.decisions)
            bare.append(statistics.median(worker.call("run", seed, args.decisions)))
        for name, config in (("compact", COMPACT), ("paper", PAPER)):
            with Worker(Ours, scenario, config) as worker:
                run = worker.call("run", seed, args.decisions)
                ours[name].append(statistics.median(run["total"]))
                share[name].append(statistics.median(run["observing"]))
                counts.append((float(np.mean(run["n"])), float(np.mean(run["avs"]))))
                if args.profile and k == 0:
                    print(worker.call("run", seed, args.decisions, profile=True)["profile"])
    vehicles, avs = np.mean(counts, axis=0)
    result |= {"vehicles": round(float(vehicles), 1), "avs": round(float(avs), 1)}
    result["bare_us"] = round(1e6 * statistics.median(bare), 1)
    for name in ours:
        ratios = [o / b for o, b in zip(ours[name], bare, strict=True)]
        result[name] = {
            "decision_us": round(1e6 * statistics.median(ours[name]), 1),
            "observation_us": round(1e6 * statistics.median(share[name]), 1),
            "ratio": round(statistics.median(ratios), 2),
            "ratio_range": [round(min(ratios), 2), round(max(ratios), 2)],
            "target": TARGET[name],
        }
    short = replace(scenario, warmup=0.0)
    with Worker(Ours, short, COMPACT) as worker:
        worker.call("reset_times", range(100_000, 100_020))
        before = worker.call("memory")
        times = worker.call("reset_times", range(100_000, 100_000 + args.resets))
        result["reset_ms"] = round(1e3 * statistics.median(times), 2)
        result["memory_growth_mib"] = round(worker.call("memory") - before, 1)
        result["resets"] = args.resets
    with Worker(Highway) as worker:
        simulated, seconds = worker.call("run", 60)
    theirs = simulated / seconds
    mine = scenario.timing.decision / (result["compact"]["decision_us"] * 1e-6)
    result["highway_env"] = {
        "their_simulated_s_per_s": round(theirs, 2),
        "our_simulated_s_per_s": round(mine, 1),
        "ratio": round(mine / theirs, 1),
        "target": HIGHWAY_TARGET,
    }
    print(json.dumps(result, indent=None if args.json else 2))


if __name__ == "__main__":
    main()

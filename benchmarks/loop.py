"""Speed of the loop without agent, compared with bare libsumo and with HighwayEnv in one run.

    python -m benchmarks.loop [--scenario merge] [--demand dense] [--decisions 75] [--rounds 5] [--profile]

Each round drives the same episode (same seed, AVs driven by SUMO's IDM) in three processes. They alternate
every five decisions, so that other load affects all equally. `bare`: four `libsumo.simulationStep()` per
decision, and drivers for departed vehicles. `compact` and `paper`: the same steps plus two frames of
VelocityMap and kinematics for every AV with full history. Figures are medians over decisions; only the
ratios carry over to other machines.
"""

from __future__ import annotations

import argparse
import cProfile
import io
import json
import pstats
import statistics
import time
from dataclasses import replace
from typing import Any

from cosim.scenario import Fleet, Scenario, load
from cosim.types import COMPACT, PAPER, ObservationConfig
from cosim.workers.worker import Worker

TARGET = {"compact": 3.0, "paper": 6.0}  # times bare libsumo
HIGHWAY_TARGET = 20.0  # times HighwayEnv's simulated seconds per second
VEHICLES, AVS = 50, 8
TURN = 5  # decisions of a process before the next one continues


class Bare:
    """Bare libsumo: the same episode without reading any state."""

    def __init__(self, scenario: Scenario) -> None:
        import libsumo

        from cosim.simulation.sumo import SumoSimulator

        self._sumo = libsumo
        self._simulator = SumoSimulator(scenario)
        self._steps = round(scenario.timing.decision / scenario.timing.step)

    def start(self, seed: int) -> None:
        """Begin an episode."""
        self._seed = seed
        self._simulator.reset(seed)

    def go(self, decisions: int) -> dict[str, list[float]]:
        """Continue; seconds per decision."""
        step, departed = self._sumo.simulationStep, self._sumo.simulation.getDepartedIDList
        times = []
        for _ in range(decisions):
            began = time.perf_counter()
            for _ in range(self._steps):
                step()
                for name in departed():
                    self._simulator._bodies[name] = self._simulator._fleet.depart(name, self._seed)
            times.append(time.perf_counter() - began)
        return {"total": times}

    def close(self) -> None:
        """End SUMO."""
        self._simulator.close()


class Ours:
    """The loop without agent: advance SUMO, read the state, draw maps, keep the history."""

    def __init__(self, scenario: Scenario, observation: ObservationConfig) -> None:
        from cosim.observation.observer import Observer
        from cosim.simulation.sumo import SumoSimulator

        self._simulator = SumoSimulator(scenario)
        self._observer = Observer(self._simulator.road, observation)

    def start(self, seed: int) -> None:
        """Begin an episode, with all kernels compiled before the measurement."""
        simulator, observer = self._simulator, self._observer
        for _ in range(2):
            observer.reset()
            for frame in simulator.reset(seed):
                observer.add(frame)
            observer.histories(simulator.route, simulator.commanded)

    def go(self, decisions: int) -> dict[str, list[float]]:
        """Continue; seconds per decision, seconds of observation, and numbers of vehicles and AVs."""
        simulator, observer = self._simulator, self._observer
        seen: dict[str, list[float]] = {"total": [], "observing": [], "vehicles": [], "avs": []}
        for _ in range(decisions):
            began = time.perf_counter()
            _, frames = simulator.advance(())
            middle = time.perf_counter()
            for frame in frames:
                observer.add(frame)
            histories = observer.histories(simulator.route, simulator.commanded)
            end = time.perf_counter()
            seen["total"].append(end - began)
            seen["observing"].append(end - middle)
            seen["vehicles"].append(frames[-1].n)
            seen["avs"].append(len(histories))
        return seen

    def profile(self, seed: int, decisions: int) -> str:
        """As `go`, under cProfile; returns its table."""
        self.start(seed)
        stream = io.StringIO()
        with cProfile.Profile() as profiler:
            self.go(decisions)
        pstats.Stats(profiler, stream=stream).sort_stats("tottime").print_stats(18)
        return stream.getvalue()

    def reset_times(self, seeds: range) -> list[float]:
        """Seconds of `libsumo.load` and the first snapshot, without warm-up."""
        times = []
        for seed in seeds:
            began = time.perf_counter()
            frames = self._simulator.reset(seed)
            self._observer.reset()
            self._observer.add(frames[-1])
            times.append(time.perf_counter() - began)
        return times

    def load_times(self, n: int) -> list[float]:
        """Seconds of bare `libsumo.load` with the same options: a lower bound for a reset."""
        import libsumo

        arguments, times = self._simulator._arguments(100_000), []
        for _ in range(n):
            began = time.perf_counter()
            libsumo.load(arguments)
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
    """HighwayEnv with equally many vehicles, 8 agents and a grid observation of similar size."""

    def run(self, steps: int) -> tuple[float, float]:
        """Simulated time and wall time, s."""
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
    parser.add_argument("--highway", type=int, default=60, help="decisions of HighwayEnv")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()

    scenario = load(args.scenario, demand=[args.demand], fleet=Fleet(penetration=args.penetration))
    result: dict[str, Any] = {"scenario": args.scenario, "demand": args.demand, "rounds": args.rounds}
    rounds: list[dict[str, dict[str, float]]] = []  # [round][size][figure], medians over decisions
    with (
        Worker(Bare, scenario) as plain,
        Worker(Ours, scenario, COMPACT) as compact,
        Worker(Ours, scenario, PAPER) as paper,
    ):
        workers = {"bare": plain, "compact": compact, "paper": paper}
        for k in range(args.rounds + 1):
            seen: dict[str, dict[str, list[float]]] = {size: {} for size in workers}
            for worker in workers.values():
                worker.call("start", 100_000 + k)
            for _ in range(0, args.decisions, TURN):
                for size, worker in workers.items():
                    for figure, values in worker.call("go", TURN).items():
                        seen[size].setdefault(figure, []).extend(values)
            if k:  # the first round warms up
                rounds.append({w: {f: statistics.median(v) for f, v in s.items()} for w, s in seen.items()})
        if args.profile:
            for size in TARGET:
                print(workers[size].call("profile", 100_000, args.decisions))

    def typical(size: str, figure: str) -> float:
        return statistics.median(r[size][figure] for r in rounds)

    result["vehicles"] = typical("compact", "vehicles")
    result["avs"] = typical("compact", "avs")
    result["bare_us"] = round(1e6 * typical("bare", "total"), 1)
    for size in TARGET:
        ratios = [r[size]["total"] / r["bare"]["total"] for r in rounds]
        result[size] = {
            "decision_us": round(1e6 * typical(size, "total"), 1),
            "observation_us": round(1e6 * typical(size, "observing"), 1),
            "ratio": round(statistics.median(ratios), 2),
            "ratio_range": [round(min(ratios), 2), round(max(ratios), 2)],
            "target": TARGET[size],
        }
    short = replace(scenario, warmup=0.0)
    with Worker(Ours, short, COMPACT) as worker:
        worker.call("reset_times", range(100_000, 100_020))
        before = worker.call("memory")
        times = worker.call("reset_times", range(100_000, 100_000 + args.resets))
        result["reset_ms"] = round(1e3 * statistics.median(times), 2)
        result["memory_growth_mib"] = round(worker.call("memory") - before, 1)
        result["resets"] = args.resets
        result["bare_load_ms"] = round(1e3 * statistics.median(worker.call("load_times", args.resets)), 2)
    with Worker(Highway) as worker:
        simulated, seconds = worker.call("run", args.highway)
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

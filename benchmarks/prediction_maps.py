"""Cost of a prediction over four seconds for 8 AVs: forecast, HPN, chain and rendering.

    python -m benchmarks.prediction_maps [--size compact paper] [--threads 1 2] [--out FILE.md | --json]

Every part is timed on recorded histories (highway, dense, validation seed 100,000, a share of AVs such that
about 8 decide); medians over decisions. The map branch at paper size (one frame per step, 20 steps) is timed
eager, compiled, in bfloat16 and, if installed, in ONNX Runtime. "Real time" is the decision period, 0.4 s.
Compare ratios, not seconds, since other load affects all times.
"""

from __future__ import annotations

import argparse
import importlib.util
import io
import json
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.tables import markdown_head, markdown_row, write_page
from cosim.episode import Episode, Hook, Step
from cosim.geometry.raster import rasterize_road
from cosim.host import Host
from cosim.scenario import Fleet, Scenario, load
from cosim.types import COMPACT, PAPER, History, ObservationConfig
from cosim.workers.memory import keep_freed_memory
from cosim.workers.worker import Worker
from policy.chain.chain import ChainConfig, predict
from policy.inputs.scene import join
from policy.inputs.tensors import to_batch
from policy.networks.hpn import HPN, HpnConfig
from policy.networks.map_branch import MapBranch, MapBranchConfig
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import TrafficConfig, predict_traffic

DECISION = 0.4  # s
TARGET = 25.0  # ms, compact size, 8 AVs
AGENTS, PENETRATION = 8, 0.19


class Gatherer:
    """Runs in a worker: drives an episode and keeps the histories of 8 AVs."""

    def __init__(self, scenario: Scenario, observation: ObservationConfig) -> None:
        self._host = Host(scenario, "idm", 0.0, observation=observation)

    def gather(self, seed: int, decisions: int) -> tuple[Any, list[Any]]:
        """The road, and copies of the histories of the first AGENTS AVs."""
        kept = Kept()
        self._host.run(seed, hooks=[kept])
        return self._host.simulator.road, kept.histories[:decisions]

    def close(self) -> None:
        """End SUMO."""
        self._host.close()


class Kept(Hook):
    """Copies of the histories of the first AGENTS AVs at every decision."""

    def __init__(self) -> None:
        self.histories: list[dict[str, History]] = []

    def on_start(self, episode: Episode) -> None:
        """Keep the histories of the first decision."""
        chosen = sorted(episode.histories)[:AGENTS]
        if len(chosen) == AGENTS:
            seen = {a: episode.histories[a] for a in chosen}
            self.histories.append(
                {a: h._replace(velocity_map=h.velocity_map.copy()) for a, h in seen.items()}
            )

    def on_step(self, episode: Episode, step: Step) -> None:
        """Keep the histories of the next decision."""
        self.on_start(episode)


def median_ms(work: Callable[[], object], rounds: int) -> float:
    """Median wall time in ms, without the first round (compilation, caches)."""
    times = []
    for _ in range(rounds + 1):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return 1e3 * statistics.median(times[1:])


def parts(road: Any, kept: list[Any], size: ObservationConfig, chain: ChainConfig) -> dict[str, float]:
    """ms of every part of one joint prediction with the shipped HPN architecture."""
    predictor, raster, hpn = (
        make_predictor("gp-indirect", 20, 0.2),
        rasterize_road(road),
        HPN(HpnConfig()).eval(),
    )
    names = ("join", "forecast", "along the lanes", "to tensors", "HPN and rendering", "rendering alone")
    spent: dict[str, list[float]] = {name: [] for name in names}
    with torch.inference_mode():
        for number, histories in enumerate([*kept[:2], *kept]):
            clock = [time.perf_counter()]
            scene = join(histories)
            clock.append(time.perf_counter())
            forecast = predictor.predict(scene.state, scene.valid)
            clock.append(time.perf_counter())
            traffic = predict_traffic(scene, forecast, road, TrafficConfig(), 28)
            clock.append(time.perf_counter())
            batch = to_batch(scene.histories)
            clock.append(time.perf_counter())
            predict(chain, size, raster, hpn, scene, batch, forecast, traffic)
            clock.append(time.perf_counter())
            predict(chain, size, raster, None, scene, batch, forecast)
            clock.append(time.perf_counter())
            if number >= 2:
                for name, seconds in zip(names, np.diff(clock), strict=True):
                    spent[name].append(1e3 * seconds)
    out = {name: statistics.median(v) for name, v in spent.items()}
    out["whole prediction"] = statistics.median(np.sum([spent[n] for n in names[:-1]], 0).tolist())
    return out


def map_branch(config: MapBranchConfig, horizon: int, rounds: int, backend: str) -> dict[str, float | str]:
    """ms of the map branch's whole chain for 8 AVs, by backend."""
    torch.manual_seed(0)
    branch = MapBranch(config).eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    seen = config.seen * config.channels
    past = torch.rand(AGENTS, seen, config.height, config.width).contiguous(memory_format=torch.channels_last)
    rows = torch.rand(AGENTS, config.seen, config.rows, 9)
    steps = horizon // config.block
    out: dict[str, float | str] = {}

    def note(name: str, result: float | str) -> None:
        out[name] = result
        say(f"  map branch, {name}: {_ratio(result)}")

    def chain(step: Callable[..., Any]) -> None:
        window = past
        with torch.inference_mode():
            for _ in range(steps):
                guess = step(window, rows)[0]
                window = torch.cat([window, guess.to(window.dtype)], 1)[:, -seen:]

    note("eager", median_ms(lambda: chain(branch), rounds))

    def reduced() -> None:
        with torch.autocast("cpu", torch.bfloat16):
            chain(branch)

    note("ONNX Runtime", onnx(branch, past, rows, steps, rounds))
    try:
        compiled = torch.compile(branch, backend=backend)
        note("compiled", median_ms(lambda: chain(compiled), rounds))
    except Exception as error:  # needs a C++ compiler on the machine
        note("compiled", f"not possible here: {type(error).__name__}")
    note("bfloat16", median_ms(reduced, rounds))
    return out


def say(line: str) -> None:
    """Print progress, since paper size takes minutes."""
    print(line, file=sys.stderr, flush=True)


def _ratio(ms: float | str) -> str:
    return ms if isinstance(ms, str) else f"{ms:.1f} ms, {1e3 * DECISION / ms:.2g} x real time"


def page(result: Mapping[str, Mapping[str, Any]], command: str) -> list[str]:
    """Markdown: the whole prediction by its parts, then the map branch by backend."""
    lines = [
        "# What a prediction costs",
        "",
        f"Made by `{command}`; validation seeds, {AGENTS} AVs, four seconds ahead, medians. Real time is the",
        f"decision period, {1e3 * DECISION:.0f} ms. At 10 x real time a prediction takes a tenth of it.",
        "",
        "## The shipped HPN by parts, ms",
        "",
    ]
    parts_of = list(next(iter(result.values()))["parts"])
    lines += markdown_head(["size", *parts_of, "real time"])
    for name, found in result.items():
        spent = found["parts"]
        whole = _ratio(spent["whole prediction"]).split(", ")[1]
        lines.append(markdown_row([name, *(f"{ms:.2f}" for ms in spent.values()), whole]))
    lines += [
        "",
        f"Target at compact size: at most {TARGET:.0f} ms on two cores.",
        "",
        "## P's own network (`hpn-plain`: figure 3, algorithm 1), the whole chain",
        "",
    ]
    backends = list(next(iter(result.values()))["map branch"])
    lines += markdown_head(["size", *backends])
    lines += [
        markdown_row([name, *map(_ratio, found["map branch"].values())]) for name, found in result.items()
    ]
    return lines


def onnx(branch: MapBranch, past: torch.Tensor, rows: torch.Tensor, steps: int, rounds: int) -> float | str:
    """ms in ONNX Runtime, or the reason why it is not possible."""
    if importlib.util.find_spec("onnxruntime") is None or importlib.util.find_spec("onnx") is None:
        return "not installed"
    import onnxruntime

    file = io.BytesIO()
    export: Any = torch.onnx.export  # typed for paths only
    export(branch, ([past], rows), file, dynamo=False)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(file.getvalue(), options)
    names = [i.name for i in session.get_inputs()]
    seen, first, moved = past.shape[1], past.contiguous().numpy(), rows.numpy()

    def chain() -> None:
        window = first
        for _ in range(steps):
            guess = session.run(None, dict(zip(names, (window, moved), strict=True)))[0]
            window = np.concatenate([window, guess], 1)[:, -seen:]

    return median_ms(chain, rounds)


def main() -> None:
    """Measure, then print or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", nargs="+", choices=("compact", "paper"), default=["compact", "paper"])
    parser.add_argument("--decisions", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=5, help="of the map branch's chain")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--backend", default="inductor", help="of torch.compile; eager needs no C++ compiler")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--out", type=Path, metavar="FILE.md")
    args = parser.parse_args()
    keep_freed_memory()
    scenario = load("highway", demand=["dense"], fleet=Fleet(penetration=PENETRATION))
    plans = {
        "compact": (COMPACT, ChainConfig(), MapBranchConfig()),
        "paper": (PAPER, ChainConfig(every=1), MapBranchConfig(height=64, width=512, block=1)),
    }
    result: dict[str, Any] = {}
    for name in args.size:
        size, chain, branch = plans[name]
        with Worker(Gatherer, scenario, replace(size)) as worker:
            road, kept = worker.call("gather", 100_000, args.decisions)
        for threads in args.threads:
            torch.set_num_threads(threads)
            label = f"{name}, {threads} thread{'s' * (threads > 1)}"
            say(label)
            spent = parts(road, kept, size, chain)
            say(f"  whole prediction: {_ratio(spent['whole prediction'])}")
            vehicles = round(float(np.mean([len(join(h).vehicles) for h in kept])), 1)
            backends = map_branch(branch, chain.horizon, args.rounds, args.backend)
            result[label] = {"parts": spent, "map branch": backends, "vehicles": vehicles}
    if args.json:
        print(json.dumps(result))
        return
    lines = page(result, " ".join(["python -m benchmarks.prediction_maps", *sys.argv[1:]]))
    write_page(args.out, lines)


if __name__ == "__main__":
    main()

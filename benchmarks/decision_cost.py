"""Cost of a decision per AV in a city, with 25, 50 and 100 AVs on the road, on one thread.

    python -m benchmarks.decision_cost [--avs 25 50 100] [--decisions 40] [--real] [--out FILE.md] [--profile]

netgenerate builds a grid of signalised junctions, and one vehicle in five is an AV. Each vehicle drives a
random walk of `WALK` edges, so that all vehicles stay on the road. SUMO drives all vehicles and the decisions
are not executed, so that the traffic does not depend on the policy. Medians over decisions, in a separate
process. `--real`: A10KW of the `eclipse-sumo` package, driven by the policy with at most 100 AVs on the road.
`--profile`: cProfile's table instead. Ratios refer to a fixed piece of work, timed between decisions.
"""

from __future__ import annotations

import argparse
import cProfile
import io
import json
import math
import pstats
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.real_nets import a10kw
from benchmarks.tables import markdown_row, write_page
from cosim.host import Host
from cosim.scenario import Fleet, Scenario, load
from cosim.scenario.vet import vetted
from cosim.seeding import TUNING_SEEDS
from cosim.workers.memory import keep_freed_memory
from cosim.workers.worker import Worker

POLICY = "vfn-p"
TARGET_MS = 4.0  # per decision and AV
AVS = (25, 50, 100)
SHARE = 5  # vehicles per AV
GRID, BLOCK, WALK = 6, 200.0, 40  # junctions per side, m between junctions, edges of a walk
WARM_UP = 90.0  # s, after which all vehicles have departed and queues stand at the signals
INSERTED = 60.0  # s, period of departures
UNCOUNTED = 5  # decisions, for the compilation of kernels and caches
SVO = math.radians(45.0)
MAX_AVS = 100  # on the road, up to which A10KW has to run in real time
DECIDING = ("prediction", "values", "prioritizer")
PARTS = ("simulation", "figures", "observing", *DECIDING)


def build_city(folder: Path, avs: int) -> Path:
    """The .sumocfg of a new signalised grid with `SHARE` times `avs` vehicles, ids `av.K` and `hv.K`."""
    net = folder / "city.net.xml"
    flags = ["--grid", "--grid.number", str(GRID), "--grid.length", f"{BLOCK:g}", "--no-turnarounds"]
    flags += ["--default.lanenumber", "2", "--default-junction-type", "traffic_light"]
    generator = Path(sys.executable).with_name("netgenerate")
    subprocess.run([str(generator), *flags, "-o", str(net)], check=True, stdout=subprocess.DEVNULL)
    draw = random.Random(0)
    count = SHARE * avs
    lines = ["<routes>"]
    for k in range(count):
        name = f"av.{k // SHARE}" if k % SHARE == 0 else f"hv.{k}"
        depart = f'depart="{INSERTED * k / count:.2f}" departPos="random_free" departLane="free"'
        lines.append(f'<vehicle id="{name}" {depart}><route edges="{" ".join(_walk(draw))}"/></vehicle>')
    (folder / "city.rou.xml").write_text("\n".join([*lines, "</routes>", ""]))
    config = folder / "city.sumocfg"
    files = '<net-file value="city.net.xml"/><route-files value="city.rou.xml"/>'
    config.write_text(
        f"<configuration><input>{files}</input>"
        f'<time><begin value="0"/><end value="{WARM_UP + 600.0:g}"/></time></configuration>\n'
    )
    return config


def _walk(draw: random.Random) -> list[str]:
    """`WALK` edges of netgenerate's grid, without U-turns."""
    before, at = None, (draw.randrange(GRID), draw.randrange(GRID))
    edges: list[str] = []
    while len(edges) < WALK:
        around = [(at[0] + dx, at[1] + dy) for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        to = draw.choice([n for n in around if n != before and min(n) >= 0 and max(n) < GRID])
        edges.append("".join(f"{chr(65 + x)}{y}" for x, y in (at, to)))
        before, at = at, to
    return edges


def reference_ms() -> float:
    """ms of the reference work on one thread: 100,000 additions in Python, 400,000 sines in numpy."""
    angles = np.linspace(0.0, 6.0, 100_000)
    began = time.perf_counter()
    total = 0
    for k in range(100_000):
        total += k
    for _ in range(4):
        np.sin(angles)
    return 1e3 * (time.perf_counter() - began)


class Driven:
    """Runs in a worker: SUMO drives; the policy's decisions are timed by part and not executed."""

    def __init__(self, scenario: Scenario) -> None:
        import torch

        keep_freed_memory()
        torch.set_num_threads(1)
        self._host = Host(scenario, POLICY, SVO)

    def start(self, seed: int) -> None:
        """Drive the warm-up and the uncounted decisions."""
        host = self._host
        host.policy.reset(host.episode.context(seed, SVO))
        host.episode.start(seed)
        while host.episode.snapshot.time < WARM_UP:
            host.episode.advance({})
        self.go(UNCOUNTED)

    def go(self, decisions: int) -> list[dict[str, float]]:
        """Per decision: ms of every part, AVs and vehicles on the road, ms of the reference work."""
        episode = self._host.episode
        agent: Any = self._host.policy
        found = []
        for _ in range(decisions):
            histories = episode.histories
            worked = time.process_time()
            clock = [time.perf_counter()]
            inputs = agent.perceive(histories)
            clock.append(time.perf_counter())
            q = agent.values(inputs)
            clock.append(time.perf_counter())
            agent.choose(q, inputs)
            clock.append(time.perf_counter())
            worked = time.process_time() - worked
            before = dict(episode.timings)
            episode.advance({})
            clock.append(time.perf_counter())
            spent = {name: 1e3 * (episode.timings[name] - before[name]) for name in before}
            prediction, values, prioritizer, rest = (1e3 * np.diff(clock)).tolist()
            one = {
                "avs": float(len(histories)),
                "vehicles": float(episode.snapshot.n),
                "processor": 1e3 * worked,
                "simulation": spent["simulation_s"],
                "observing": spent["observation_s"],
                "prediction": prediction,
                "values": values,
                "prioritizer": prioritizer,
                "figures": rest - spent["simulation_s"] - spent["observation_s"],
                "reference": reference_ms(),
            }
            found.append(one)
        return found

    def profile(self, decisions: int) -> str:
        """As `go`, under cProfile; returns its table."""
        stream = io.StringIO()
        with cProfile.Profile() as profiler:
            self.go(decisions)
        pstats.Stats(profiler, stream=stream).sort_stats("tottime").print_stats(45)
        return stream.getvalue()

    def close(self) -> None:
        """End SUMO."""
        self._host.close()


class Real(Driven):
    """Executes the policy's decisions and times whole runs."""

    def drive(self, seed: int, max_avs: int) -> dict[str, float]:
        """Drive to the end, or until more than `max_avs` AVs are on the road: simulated s and wall s."""
        host = self._host
        times: list[tuple[int, float]] = []  # AVs, wall s
        host.policy.reset(host.episode.context(seed, SVO))
        histories = host.episode.start(seed)
        while len(histories) <= max_avs and not host.episode.truncated:
            began = time.perf_counter()
            histories = host.episode.advance(host.policy.decide(histories))
            times.append((len(histories), time.perf_counter() - began))
        period = host.episode.scenario.timing.decision
        late = [second for _, second in times[-50:]]  # with the most AVs
        return {
            "simulated s": period * len(times),
            "wall s": sum(second for _, second in times),
            "AVs at the end": float(times[-1][0]),
            "times real time": period * len(times) / sum(second for _, second in times),
            "times real time, last 50 decisions": period / statistics.median(late),
        }


def city(avs: int, decisions: int, *, profile: bool = False) -> Any:
    """Medians over decisions for `avs` AVs, in ms; with `profile` cProfile's table."""
    with tempfile.TemporaryDirectory(prefix="cosim-city-") as folder:
        scenario = vetted(load(str(build_city(Path(folder), avs)), fleet=Fleet(ids=r"av\..*")))
        with Worker(Driven, scenario) as worker:
            worker.call("start", TUNING_SEEDS.start)
            if profile:
                return worker.call("profile", decisions)
            rows = worker.call("go", decisions)
    one = {name: statistics.median(row[name] for row in rows) for name in rows[0]}
    one["decision"] = statistics.median(sum(row[name] for name in DECIDING) for row in rows)
    return one


def real() -> dict[str, float]:
    """A10KW with one AV per `SHARE` vehicles, driven by the policy."""
    scenario = vetted(load(str(a10kw()), fleet=Fleet(penetration=1 / SHARE)))
    with Worker(Real, scenario) as worker:
        found: dict[str, float] = worker.call("drive", TUNING_SEEDS.start, MAX_AVS)
    return found


def page(found: Mapping[str, Any], command: str) -> list[str]:
    """The Markdown page."""
    heads = ["AVs", "vehicles", *PARTS, "decision", "of the reference", "processor", "target"]
    lines = [
        "# What a decision costs in a city",
        "",
        f"Made by `{command}`.",
        "",
        f"`{POLICY}` on one thread, in a grid of {GRID} x {GRID} signalised junctions {BLOCK:g} m apart.",
        f"Roads have two lanes per direction, and one vehicle in {SHARE} is an AV. Values are medians over",
        "decisions in ms of wall time **per AV**. `decision` is all of `policy.decide`: prediction, values,",
        "prioritizer. It is also given as a share of the reference, a fixed piece of work timed between",
        "decisions. The target is for `processor`, the processor time, which other load hardly changes.",
        "",
        markdown_row(heads),
        "|---" * len(heads) + "|",
    ]
    for one in found["city"]:
        parts = [f"{one[name] / one['avs']:.2f}" for name in (*PARTS, "decision")]
        ms, ratio = one["processor"] / one["avs"], one["decision"] / one["avs"] / one["reference"]
        target = f"at most {TARGET_MS:g}: {'met' if ms <= TARGET_MS else '**missed**'}"
        sizes = [f"{one['avs']:.0f}", f"{one['vehicles']:.0f}"]
        lines.append(markdown_row([*sizes, *parts, f"{ratio:.2f}", f"{ms:.2f}", target]))
    reference = statistics.median(one["reference"] for one in found["city"])
    lines += ["", f"The reference took {reference:.1f} ms.", ""]
    if "real" in found:
        lines += [
            "## A real interchange",
            "",
            f"A10KW of the `eclipse-sumo` package, one vehicle in {SHARE} an AV, driven by `{POLICY}` from",
            f"an empty road until more than {MAX_AVS} AVs are on it. Target: at least real time.",
            "",
            markdown_row(list(found["real"])),
            "|---" * len(found["real"]) + "|",
            markdown_row([f"{value:.3g}" for value in found["real"].values()]),
        ]
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, then print or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--avs", type=int, nargs="+", default=list(AVS), metavar="N")
    parser.add_argument("--decisions", type=int, default=40)
    parser.add_argument("--real", action="store_true", help="also drive A10KW")
    parser.add_argument("--profile", action="store_true", help="print cProfile's table for each size")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--out", type=Path, metavar="FILE.md")
    args = parser.parse_args(arguments)
    if args.profile:
        for avs in args.avs:
            print(city(avs, args.decisions, profile=True))
        return
    found: dict[str, Any] = {"city": [city(avs, args.decisions) for avs in args.avs]}
    if args.real:
        found["real"] = real()
    words = sys.argv[1:] if arguments is None else arguments
    if args.json:
        print(json.dumps(found))
        return
    lines = page(found, " ".join(["python -m benchmarks.decision_cost", *words]))
    write_page(args.out, lines)


if __name__ == "__main__":
    main()

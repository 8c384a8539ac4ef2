"""Nets that none of us wrote, driven as they stand: those of the eclipse-sumo package.

    python -m benchmarks.real_nets [--duration S] [--seeds N] [--nets NAME ...] [--workers N] [--runs FOLDER]
                                   [--held] [--out docs/results/real_nets.md]

Drives A10KW, a motorway interchange, to its end with SUMO's driver and with the agent, and every other
configuration of eclipse-sumo's games that loads; lists every collision with an explanation, the overlaps that
are none, offences and the memory. What `--runs` holds is not driven again: by default what the page was made
of, so that another folder drives everything anew. `--held` drives nothing.
Needs `pip install cosim-sumo[tools]`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import libsumo
import numpy as np

from benchmarks.tables import markdown_row, write_page
from cosim.episode import Episode, Hook, Step
from cosim.errors import CosimError
from cosim.files import read_json, whole
from cosim.geometry import Boxes, boxes, overlapping_pairs
from cosim.host import Host
from cosim.road import RoadMap
from cosim.road.too_close import described, too_close
from cosim.scenario import Fleet, load
from cosim.scenario.vet import vetted
from cosim.simulation.collisions import direction, only_a_tail, the_nets
from cosim.simulation.convert import PERSON
from cosim.types import Kind, Snapshot, Timing
from cosim.workers.worker import Worker

DECISION = Timing().decision  # s
FIRST_SEED = 200000
PENETRATION = 0.2
SEEDS = {"idm": 10, "vfn-p": 2}  # of A10KW; the other nets are driven by idm on one seed
LONGEST = 10_000.0  # s: of demonstrations that go on for days
SETTLED = 60.0  # s: the memory is read from then on
EVERY = 300.0  # s between the memory's readings that are kept
CURVE = 12  # of these at most on the page
FEW = 100  # AVs on the road, up to which the simulation is to be no slower than real time
STANDING = 0.1  # m/s, SUMO's own threshold of a halting vehicle
QUEUE = 30.0  # m: further ahead nobody is a leader of a queue
LISTED = 5  # of each kind of overlap and of offence, the worst or first of a run
KEPT = Path("docs/results/data/real_nets")
SAME = (  # of an episode's document, kept as they are
    *("preset", "steps", "trace_hash", "collision_list", "memory", "memory_curve", "avs", "most_avs"),
    *("few_avs", "end", "heads", "lanes"),
)
TRAFFIC = {
    "inserted": "vehicles_inserted",
    "never inserted": "vehicles_never_inserted",
    "collisions": "collisions",
    "AV involved": "av_involved_collisions",
    "AV caused": "av_caused_collisions",
    "human only": "hv_hv_collisions",
    "insertion": "insertion_collisions",
    "wrecks removed": "wrecks_removed",
    "teleports": "teleports",
    "emergency stops": "emergency_stops",
}
LAW = {
    "red lights": "red_light_violations",
    "stop signs": "stop_sign_violations",
    "right of way": "right_of_way_violations",
    "worst speeding, m/s": "worst_speeding_mps",
    "AVs stuck": "avs_stuck",
    "junctions blocked": "junctions_blocked",
    "persons": "person_conflicts",
    "AV trips": "av_trips_completed",
    "interventions": "interventions",
}
LOOKED_AT = {  # (net, collider, victim) -> what the pictures show
    ("A10KW", "veh200", "veh194"): (
        "SUMO's drivers': two ways through the junction begin in one lane; on the right one a car stands at"
        " the end of the queue before the next signal, with 2 m of its tail still in the junction, and the"
        " other passes it on the left one and touches that tail at 3.9 m/s"
    ),
    ("fkk_in", "1_horizontal.0", "2_left.0"): (
        "the net's: the car stands where `:gneJ21_12_0` ends, the place inside the junction at which the net"
        " lets it wait, and its front reaches into the way of the lorry, a stiff box of 16 m that turns past"
        " it at 13.9 m/s; each is on its own centre line"
    ),
    ("grid6", "bottomTop2.17", "topBottom.17"): (
        "the net's: the junction `gneJ17` is of SUMO's type unregulated, nobody heeds anybody there, and the"
        " two drive into one another at 12 and 14 m/s where their ways cross"
    ),
}
MEASURED = ("depth, m", "askew, degrees", "apart, m", "slower one, m/s")  # of an overlap
WALKED_THROUGH = (
    "SUMO's: the vehicle stands on a crossing, in a queue that does not move, and the persons walk through it"
    " at their own pace (the first of these, in pictures)"
)
ALIKE = {  # (net, collider, victim, kind, source) -> what the pictures show of the first of a sort
    ("fokr_bs_demo", "HV", "HV", "junction", "sumo"): (
        "SUMO's drivers': a car turns across a bicycle's way and heeds it too late (54,689.1 s, 55,110.8 s,"
        " 55,917.6 s), and a bicycle starts from the head of a queue into the way of a car (55,912.4 s)"
    ),
    ("fokr_bs_demo", "person", "HV", "crossing", "sumo"): WALKED_THROUGH,
    ("fokr_bs_demo", "person", "AV", "crossing", "sumo"): WALKED_THROUGH,
    ("fokr_bs_demo", "HV", "person", "crossing", "sumo"): (
        "SUMO's drivers': bicycles of a queue that moves at 1 m/s roll into persons who walk through it"
    ),
    ("fokr_bs_demo", "person", "AV", "overlap", "box"): (
        "only the places: each of the persons is on one of the crossings `:38_c0` and `:38_c4`, within 1.3 m"
        " of its centre line, where SUMO reports others of the same kind"
    ),
}
TAIL, NET = "one stands askew", "the lanes lie too close"  # why boxes overlap that have not collided


@dataclass(frozen=True, slots=True)
class Run:
    """One episode that is wanted."""

    config: Path
    policy: str
    seed: int
    duration: float | None  # s; None: to its end

    @property
    def name(self) -> str:
        """Of its file."""
        limit = "" if self.duration is None else f"-{self.duration:g}s"
        return f"{self.config.stem}-{self.policy}-{self.seed}{limit}.json"


class Cost(Hook):
    """The process's resident memory in MB after `SETTLED` s and at the end, and what steps cost."""

    first = last = math.nan

    def on_start(self, episode: Episode) -> None:
        self._avs: set[str] = set()
        self._most = 0
        self.curve: list[tuple[int, int, int]] = []  # s, vehicles and persons on the road, MB
        self._few = [0.0, 0.0, 0.0]  # s simulated, passed, of the processor, while few AVs were on the road
        self._before = time.perf_counter(), time.process_time()

    def on_step(self, episode: Episode, step: Step) -> None:
        if episode.elapsed >= SETTLED or math.isnan(self.last):
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
            self.last = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
            if math.isnan(self.first) or episode.elapsed < SETTLED + DECISION:
                self.first = self.last
            if episode.elapsed % EVERY < DECISION - 1e-6:
                self.curve.append((round(episode.elapsed), step.after.n, round(self.last)))
        avs = step.after.avs
        self._avs.update(avs)
        self._most = max(self._most, len(avs))
        now = time.perf_counter(), time.process_time()
        if len(avs) <= FEW and episode.steps > 1:  # the first step compiles
            passed = (DECISION, *(a - b for a, b in zip(now, self._before, strict=True)))
            self._few = [a + b for a, b in zip(self._few, passed, strict=True)]
        self._before = now

    def document(self) -> dict[str, Any]:
        """As JSON holds it."""
        return {
            "memory": (self.first, self.last),
            "memory_curve": self.curve,
            "avs": len(self._avs),
            "most_avs": self._most,
            "few_avs": self._few,
        }


class Overlaps(Hook):
    """Pairs with an AV whose boxes overlap though they have not collided, each at its deepest."""

    def on_start(self, episode: Episode) -> None:
        self.found: dict[str, dict[str, Any]] = {}

    def on_step(self, episode: Episode, step: Step) -> None:
        road: RoadMap = episode.simulator.road
        collided = {frozenset((c.collider, c.victim)) for c in episode.collisions}
        for frame in step.frames:
            for i, j in overlapping_pairs(boxes(frame)).tolist():
                names = frame.ids[i], frame.ids[j]
                if Kind.AV not in (frame.kind[i], frame.kind[j]) or frozenset(names) in collided:
                    continue
                if not road.connected(int(frame.place[i]), int(frame.place[j])):
                    continue
                why = TAIL if only_a_tail(frame, road, i, j) else NET if the_nets(frame, road, i, j) else ""
                key, one = f"{why}: {' '.join(names)}", self._measured(frame, road, i, j)
                known = self.found.setdefault(key, {**one, "why": why, "frames": 0})
                frames = known["frames"] + 1
                self.found[key] = max(known, {**known, **one}, key=lambda o: o["depth"]) | {"frames": frames}

    @staticmethod
    def _measured(s: Snapshot, road: RoadMap, i: int, j: int) -> dict[str, Any]:
        rows = np.array([i, j])
        along = np.array([direction(road, s, r) if s.lane[r] >= 0 else s.heading[r] for r in rows])
        askew = np.degrees((s.heading[rows] - along + np.pi) % (2.0 * np.pi) - np.pi)
        half, heading = 0.5 * s.length[rows], s.heading[rows]
        x = s.x[rows] + half * (np.cos(heading) - np.cos(along))
        y = s.y[rows] + half * (np.sin(heading) - np.sin(along))
        pair = boxes(s, rows)
        return {
            "time": s.time,
            "names": [s.ids[r] for r in rows],
            "av": [bool(s.kind[r] == Kind.AV) for r in rows],
            "lanes": [road.lanes[s.lane[r]].id if s.lane[r] >= 0 else "" for r in rows],
            "length": s.length[rows].tolist(),  # m
            "speed": s.speed[rows].tolist(),  # m/s
            "askew": askew.tolist(),  # degrees, from the lane's direction
            "depth": depth(pair),  # m
            "laid": depth(pair._replace(x=x, y=y, heading=along)),  # m, both laid along their lanes
        }


def depth(pair: Boxes) -> float:
    """How deep two boxes [2] overlap along that of the four edge normals where it is least, m; a gap is
    negative."""
    heading = np.asarray(pair.heading)
    angles = np.concatenate([heading, heading + 0.5 * np.pi])
    apart = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ np.diff([pair.x, pair.y])[:, 0]
    turned = angles[:, None] - heading
    half = 0.5 * (np.abs(np.cos(turned)) * pair.length + np.abs(np.sin(turned)) * pair.width)  # [4,2] m
    return float((half.sum(axis=1) - np.abs(apart)).min())


class Queues(Hook):
    """Where the queues of AVs that stand without a reason begin, as SUMO's leaders on their routes tell."""

    def on_start(self, episode: Episode) -> None:
        self.heads: Counter[str] = Counter()
        self._known: set[str] = set()

    def on_step(self, episode: Episode, step: Step) -> None:
        for offence in episode.offences if np.any(step.after.speed < STANDING) else ():
            if offence.what.startswith("stood") and offence.vehicle not in self._known:
                self._known.add(offence.vehicle)
                self.heads[self._head(offence.vehicle, step.after)] += 1

    @staticmethod
    def _head(name: str, s: Snapshot) -> str:
        """Who is at the head of its queue, and what it waits for."""
        get, seen = libsumo.vehicle, {name}
        if name not in s.row:
            return "has left the road"
        head = name
        while (leader := get.getLeader(head, QUEUE)) and leader[0] and leader[0] not in seen:
            head = leader[0]
            seen.add(head)
        who = "it" if head == name else "an AV" if s.kind[s.row[head]] == Kind.AV else "an HV"
        lights, links = get.getNextTLS(head)[:1], get.getNextLinks(head)[:1]
        lane = get.getLaneIndex(head)
        if leader and leader[0]:
            return "a ring of vehicles that wait for one another"
        if get.getSpeed(head) > STANDING:
            return f"{who} moves"
        if lights and lights[0][2] < QUEUE and lights[0][3] in "ruyY":
            return f"{who} stands at a red light"
        if any(best[3] for k, best in enumerate(get.getBestLanes(head)) if k == lane):
            return f"{who} cannot change to the lane of its route"
        if links and not links[0][1]:
            return f"{who} waits for the right of way"
        return f"{who} waits in a junction or for a place behind it"


class Driver:
    """Hosted in a process of its own, since a net may end SUMO and with it the process."""

    def __init__(self, run: Run) -> None:
        fleet = Fleet(penetration=PENETRATION)
        self._end = load(str(run.config), fleet=fleet).duration
        duration = min(run.duration or self._end, self._end, LONGEST)
        scenario = load(str(run.config), fleet=fleet, duration=duration)
        self._run = run
        self._host = Host(vetted(scenario), run.policy, svo=math.radians(45.0))

    def drive(self) -> dict[str, Any]:
        """The episode's document, with what it cost, its overlaps and offences, and what is wrong with the
        net's lanes."""
        cost, overlaps, queues = Cost(), Overlaps(), Queues()
        document = self._host.run(self._run.seed, hooks=[cost, overlaps, queues]).document()
        road: RoadMap = self._host.simulator.road
        return {
            **document,
            "end": self._end,
            **cost.document(),
            "overlaps": list(overlaps.found.values()),
            "heads": dict(queues.heads.most_common()),
            "offences": [(o.time, o.vehicle, o.what) for o in self._host.episode.offences],
            "lanes": described(road, too_close(road)),
        }

    def close(self) -> None:
        """End the simulation."""
        self._host.close()


def a10kw() -> Path:
    """The configuration file of eclipse-sumo's game. Raises ImportError where that is not installed."""
    import sumo

    return Path(sumo.__file__).parent / "tools" / "game" / "A10KW.sumocfg"


def wanted(seeds: int | None, duration: float | None) -> Iterator[Run]:
    """Every run: A10KW with each policy, on at most `seeds` seeds, then other games with SUMO's driver."""
    big = a10kw()
    for policy, number in SEEDS.items():
        last = FIRST_SEED + min(number, seeds or number)
        yield from (Run(big, policy, seed, duration) for seed in range(FIRST_SEED, last))
    others = sorted(path for path in big.parent.glob("*.sumocfg") if path != big)
    yield from (Run(path, "idm", FIRST_SEED, duration) for path in others)


def drive(run: Run, runs: Path, held: bool) -> dict[str, Any] | str | None:
    """The document of one run, from `runs` or driven and put there; or why there is none. None: `held`."""
    file = runs / run.name
    if file.exists():
        return read_json(file)
    if held:  # what was driven of it, if only its beginning was
        parts = [read_json(part) for part in runs.glob(run.name.replace(".json", "-*s.json"))]
        return max(parts, key=_simulated, default=None)
    try:
        worker = Worker(Driver, run, timeout=3600.0, name="real-nets")
        try:
            found: dict[str, Any] = worker.call("drive")
        finally:
            worker.close()
    except CosimError as error:
        return str(error).replace(f"{run.config.parent}/", "")
    runs.mkdir(parents=True, exist_ok=True)
    found = kept(found, run)
    with whole(file) as draft:
        draft.write_text(json.dumps(found) + "\n", encoding="utf-8")
    return found


def kept(document: dict[str, Any], run: Run) -> dict[str, Any]:
    """What the page needs of a drive's document; numbers to 4 places, and of overlaps and offences the
    `LISTED` in words."""
    by_why: dict[str, Any] = {}
    for one in sorted(document["overlaps"], key=lambda o: -o["depth"]):
        of_why = by_why.setdefault(one["why"], {"measured": [], "deepest": []})
        measured = one["depth"], max(map(abs, one["askew"])), -one["laid"], min(one["speed"])
        of_why["measured"].append([round(value, 2) for value in measured])
        if len(of_why["deepest"]) < LISTED:
            of_why["deepest"].append(_overlap(one))
    told = document["offences"]
    found = {
        **{key: document[key] for key in (*TRAFFIC.values(), *LAW.values(), *SAME)},
        "total_s": document["timings"]["total_s"],
        "not_comparable_because": [
            reason.replace(f"{run.config}", run.config.name) for reason in document["not_comparable_because"]
        ],
        "overlaps": by_why,
        "offences": [f"{at:,.1f} s, `{who}` {what}" for at, who, what in told[:LISTED]],
        "more_offences": max(len(told) - LISTED, 0),
    }
    rounded: dict[str, Any] = json.loads(json.dumps(found), parse_float=lambda text: round(float(text), 4))
    return rounded


def explained(collision: dict[str, Any]) -> str:
    """One collision in a sentence: what happened, who saw it, whose it is."""
    collider, victim = (f"{_kind(collision, who)} `{collision[who]}`" for who in ("collider", "victim"))
    seen = "SUMO" if collision["source"] == "sumo" else "our boxes alone"
    if collision["kind"] == "insertion":
        what, whose = f"SUMO put {collider} and {victim} onto one another", "the demand's"
    else:
        what = f"{collider} moved into {victim} ({collision['kind']})"
        cut_in = collision["av_caused"] and not collision["collider_is_av"]
        whose = (
            "an AV's, which had just cut in" if cut_in else f"that of the {collider.split()[0]} that moved"
        )
    where = f"`{collision['lane']}`" if collision["lane"] else "off the lanes"
    return f"{collision['time']:,.1f} s, {where}: {what}; seen by {seen}; counted as {whose}"


def _kind(collision: dict[str, Any], who: str) -> str:
    """What the collider or victim is: an AV, an HV or a person."""
    person = collision[who].startswith(PERSON)
    return "person" if person else "AV" if collision[f"{who}_is_av"] else "HV"


def _collisions(run: Run, one: dict[str, Any]) -> Iterator[str]:
    """A line per collision; of more than `LISTED` of one kind the first of them, and how many there were."""
    alike: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for c in one["collision_list"]:
        sort = _kind(c, "collider"), _kind(c, "victim"), c["kind"], c["source"]
        alike.setdefault(sort, []).append(c)
    name = f"- {run.config.stem}, {run.policy}, seed {run.seed}: "
    for (collider, victim, kind, source), found in alike.items():
        yield from (f"{name}{explained(c)}{_seen(run, c)}" for c in found[:LISTED])
        seen = ALIKE.get((run.config.stem, collider, victim, kind, source))
        if len(found) > LISTED:
            lanes = Counter(c["lane"] or "off the lanes" for c in found).most_common()
            where = ", ".join(f"`{lane}` {n}" for lane, n in lanes)
            yield f"{name}{len(found)} of this sort ({collider} into {victim}, {kind}) in all: {where}" + (
                f". Looked at: {seen}" if seen else ""
            )
        elif seen:
            yield f"{name}{collider} into {victim}, {kind}. Looked at: {seen}"


def page(runs: Sequence[Run], found: Sequence[dict[str, Any] | str | None], command: str) -> list[str]:
    """The Markdown page."""
    driven = [(run, one) for run, one in zip(runs, found, strict=True) if isinstance(one, dict)]
    count = Counter((r.config.stem, r.policy) for r, one in driven if _simulated(one) >= _end(one))
    wanted_ = Counter((run.config.stem, run.policy) for run in runs)
    big = [f"`{p}` on {count[net, p]} of {n} seeds" for (net, p), n in wanted_.items() if n > 1]
    lines = [
        "# Nets that none of us wrote",
        "",
        f"Made by `{command}`: the games of the `eclipse-sumo` package",
        f"(`pip install cosim-sumo[tools]`), driven as they stand, {PENETRATION:.0%} of the vehicles AVs.",
        f"What each drive gave is in `{KEPT.relative_to('docs/results')}`; `--runs FOLDER` drives all anew.",
        f"A10KW is a motorway interchange with bridges; driven to its end with {', '.join(big)}.",
        f"Memory: of the simulation's process, after {SETTLED:g} s and at the end.",
        "Time factor: simulated s per s that passed, other programs on the machine included; over the steps",
        f"with at most {FEW} AVs on the road first per s of the processor, then per s that passed.",
        "",
        "## Traffic, collisions and cost",
        "",
    ]
    heads = ["net", "policy", "seed", "preset", "simulated", "AVs", "most at once"]
    rows = []
    for _, one in driven:
        first, last = one["memory"]
        cells = [
            one["preset"],
            f"{_simulated(one):,.0f} of {_end(one):,.0f} s",
            f"{one['avs']:,}",
            f"{one['most_avs']}",
        ]
        rows.append([*cells, *_figures(one, TRAFFIC), f"{first:.0f}, {last:.0f}", *_factors(one)])
    few = f"at most {FEW} AVs"
    lines += _table([*heads, *TRAFFIC, "memory, MB", "time factor", few], driven, rows)
    lines += ["", "## The law and the trips of AVs", ""]
    lines += _table([*heads[:3], *LAW], driven, [_figures(one, LAW) for _, one in driven])
    lines += ["", f"## Memory every {EVERY:g} s, MB (on the road then)", ""]
    for run, one in driven:
        curve = ", ".join(f"{mb} ({n})" for _, n, mb in one["memory_curve"][:CURVE])
        lines += [f"- {run.config.stem}, {run.policy}, seed {run.seed}: {curve}"] if curve else []
    lines += ["", "## Every collision", ""]
    collisions = [line for run, one in driven for line in _collisions(run, one)]
    lines += collisions or ["None."]
    lines += [*_overlaps(driven), *_offences(driven)]
    lines += ["", "## Lanes too close together", ""]
    lanes = {run.config.stem: one["lanes"] for run, one in driven if one["lanes"]}
    lines += [f"- {name}: {text}" for name, text in lanes.items()] or ["None."]
    why: dict[str, list[str]] = {}
    for run, one in driven:
        for reason in one["not_comparable_because"]:
            why.setdefault(reason, []).append(f"{run.config.stem} {run.policy} {run.seed}")
    if why:
        lines += ["", "## Not comparable with other runs, and the results say so", ""]
        lines += [f"- {', '.join(names)}: {reason}" for reason, names in why.items()]
    refused = [(run, one) for run, one in zip(runs, found, strict=True) if isinstance(one, str)]
    if refused:
        lines += ["", "## Not driven", ""]
        lines += [f"- {run.config.stem}, {run.policy}, seed {run.seed}: {one}" for run, one in refused]
    missing: dict[tuple[str, str], list[str]] = {}
    for run, it in zip(runs, found, strict=True):
        whole_ = isinstance(it, str) or (it and _simulated(it) >= min(run.duration or _end(it), LONGEST))
        if not whole_:
            missing.setdefault((run.config.stem, run.policy), []).append(f"{run.seed}")
    if missing:
        lines += ["", "## Not yet driven to the end", ""]
        lines += [f"- {net}, {policy}, seeds {', '.join(seeds)}" for (net, policy), seeds in missing.items()]
    return [
        *lines,
        "",
        "The tests drive A10KW's first 200 s with Table II's drivers (`--behavior mixed`), and with `vfn-p`",
        "its first 12 s (`tests/sumo/test_run.py`).",
    ]


def _seen(run: Run, collision: dict[str, Any]) -> str:
    seen = LOOKED_AT.get((run.config.stem, collision["collider"], collision["victim"]))
    return f". Looked at: {seen}" if seen else ""


def _simulated(one: dict[str, Any]) -> float:
    return float(one["steps"] * DECISION)


def _end(one: dict[str, Any]) -> float:
    """s, of the scenario as it is written."""
    return float(one["end"])


def _figures(one: dict[str, Any], columns: dict[str, str]) -> list[str]:
    return [_number(one.get(key)) for key in columns.values()]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:,.2f}" if isinstance(value, float) else f"{value:,}"


def _factors(one: dict[str, Any]) -> list[str]:
    """How much quicker than real time: of the whole, and with few AVs on the road."""
    simulated, passed, processor = one["few_avs"]
    few = f"{simulated / processor:.1f}, {simulated / passed:.1f} ({simulated:,.0f} s)" if passed else "-"
    return [f"{_simulated(one) / one['total_s']:.1f}", few]


def _table(heads: Sequence[str], driven: Sequence[tuple[Run, Any]], rows: Sequence[list[str]]) -> list[str]:
    """A line per run, which begins with what it is."""
    lines = [markdown_row(heads), "|---" * len(heads) + "|"]
    for (run, _), cells in zip(driven, rows, strict=True):
        lines.append(markdown_row([run.config.stem, run.policy, str(run.seed), *cells]))
    return lines


def _overlaps(driven: Sequence[tuple[Run, dict[str, Any]]]) -> list[str]:
    """The overlaps that are no collisions: how many, how deep, and the deepest."""
    lines = [
        "",
        "## Overlaps that are no collisions",
        "",
        "Pairs with an AV whose boxes overlap, which SUMO does not report and the figures do not count, each",
        f"at its deepest. {TAIL.capitalize()}: SUMO moves the front of a vehicle that changes lanes",
        "sideways at a constant rate however slowly it drives, and draws its tail behind; laid along their",
        "lanes, with their fronts where they are, the two are apart (askew: the larger angle between a",
        "vehicle and its lane; apart: the gap of the two so laid).",
        f"{NET.capitalize()}: each is on the centre line of its own lane, of lanes whose drivers need not",
        "heed one another, or one is behind the other on a lane that is drawn shorter than it is.",
        "",
        *_row("net", "policy", "why", "pairs", *MEASURED),
    ]
    lines.append("|---" * 8 + "|")
    deepest = []
    for net, policy in dict.fromkeys((run.config.stem, run.policy) for run, _ in driven):
        of_net = [(r, o) for r, o in driven if (r.config.stem, r.policy) == (net, policy)]
        for why in dict.fromkeys(why for _, one in of_net for why in one["overlaps"]):
            same = [(r, one["overlaps"][why]) for r, one in of_net if why in one["overlaps"]]
            columns = np.concatenate([o["measured"] for _, o in same]).T
            spread = [f"{np.median(c):.2f} ({min(c):.2f} to {max(c):.2f})" for c in columns]
            lines += _row(net, policy, why, f"{len(columns[0])}", *spread)
            worst = [(o["measured"][k][0], r, text) for r, o in same for k, text in enumerate(o["deepest"])]
            worst = sorted(worst, key=lambda found: -found[0])[:LISTED]
            deepest += [f"- {net}, {policy}, seed {r.seed}, {why}: {text}" for _, r, text in worst]
    return (
        [*lines, "", "Medians, and ranges. The deepest:", "", *deepest] if deepest else [*lines[:-2], "None."]
    )


def _row(*cells: str) -> list[str]:
    return [markdown_row(cells)]


def _overlap(o: dict[str, Any]) -> str:
    """One overlap in words."""
    each = zip(o["av"], o["names"], o["length"], o["lanes"], o["speed"], o["askew"], strict=True)
    who = [
        f"{'AV' if av else 'HV'} `{name}` ({length:.1f} m), `{lane}`, {speed:.1f} m/s, {askew:.0f} degrees"
        for av, name, length, lane, speed, askew in each
    ]
    return f"{o['time']:,.1f} s, {o['depth']:.2f} m deep, {o['frames']} frames: {'; '.join(who)}"


def _offences(driven: Sequence[tuple[Run, dict[str, Any]]]) -> list[str]:
    """What AVs did against the law, the first of each run."""
    lines = [
        "",
        "## Offences of AVs",
        "",
        "The figure follows a queue as far as vehicles stand within 10 m of one another on the straightest",
        "lanes ahead. SUMO's drivers also queue around corners, and stop before a junction that they could",
        "not clear: those count as standing without a reason. Below, for each run, where SUMO's own leaders",
        "lead from them. The lights of A10KW, bs3d and bs3Dosm are a player's to switch: they have phases of",
        "1,000 s and longer.",
        "",
    ]
    empty = len(lines)
    for run, one in driven:
        name = f"- {run.config.stem}, {run.policy}, seed {run.seed}"
        lines += [f"{name}: {told}" for told in one["offences"]]
        if more := one["more_offences"]:
            lines.append(f"{name}: {more} more")
        if heads := one["heads"]:
            begin = "; ".join(f"{head} ({n})" for head, n in heads.items())
            lines.append(f"{name}: the queues of those that stood begin where {begin}")
    return lines if len(lines) > empty else [*lines, "None."]


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--duration", type=float, metavar="S", help="default: to each scenario's end")
    parser.add_argument("--seeds", type=int, metavar="N", help=f"at most; default: {SEEDS}")
    parser.add_argument("--nets", nargs="+", metavar="NAME", help="these alone: A10KW, grid6 ...")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (1)")
    parser.add_argument("--runs", type=Path, default=KEPT, metavar="FOLDER")
    parser.add_argument(
        "--held", action="store_true", help="write the page of what was driven, drive nothing"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/results/real_nets.md"), metavar="FILE.md")
    args = parser.parse_args(arguments)
    given = {"duration": args.duration, "seeds": args.seeds}
    limit = "".join(f" --{name} {value:g}" for name, value in given.items() if value is not None)
    runs = list(wanted(args.seeds, args.duration))
    if args.nets:
        limit += f" --nets {' '.join(args.nets)}"
        known = {run.config.stem for run in runs}
        if unknown := set(args.nets) - known:
            parser.error(f"--nets: {', '.join(sorted(unknown))}: none of {', '.join(sorted(known))}")
        runs = [run for run in runs if run.config.stem in args.nets]
    with ThreadPoolExecutor(args.workers) as pool:
        found = list(pool.map(lambda run: drive(run, args.runs, args.held), runs))
    write_page(args.out, page(runs, found, f"python -m benchmarks.real_nets{limit}"))
    print(args.out)


if __name__ == "__main__":
    main()

"""Drives what the tables need, each episode once: one store for all of them, resumable, shared and growing.

An episode counts only for the very agent (configuration, weights by hash), input files and packages it was
driven with: newly trained weights are driven anew, all else stays. More episodes drive only what is missing,
and what came with the repository (`benchmarks.papers.shipped`) is missing only to those who say `--anew`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.papers import shipped
from benchmarks.papers.agents import Agent, build, fingerprint, missing, short
from benchmarks.papers.claims import TABLE_3
from cosim.batch import execution as batch
from cosim.batch import matrix
from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.folder import RunFolder
from cosim.batch.store import Store
from cosim.report.figures import Row
from cosim.report.run_folder import Run
from cosim.scenario.options import EpisodeOptions
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import Policy
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import Progress
from sumo_scenarios import names

WORLDS = tuple(TABLE_3)  # in P's order
SVO = 45.0  # deg, weighs oneself and the others alike
LEAST = 2  # episodes, however small the scale
TRAININGS = Path("docs/results/trainings")  # logs of the trainings that made the shipped weights
MARK = "#"  # between an agent's name and its fingerprint


@dataclass(frozen=True, slots=True)
class Order:
    """So many episodes of an agent in one kind of traffic, on the test seeds from the first one."""

    agent: Agent
    scenario: str
    demand: str
    behavior: str  # of the HVs
    episodes: int  # at scale 1
    svo_deg: float = SVO
    arm: str = ""  # its name in tables; "": the agent's

    @property
    def name(self) -> str:
        return self.arm or self.agent.name

    @property
    def case(self) -> EpisodeOptions:
        """Of the first seed; the policy is the agent's name."""
        return EpisodeOptions(
            what=self.scenario,
            demand=(self.demand,),
            policy=self.agent.name,
            seed=FIRST_TEST_SEED,
            behavior=self.behavior,
            svo_deg=self.svo_deg,
            preset="unguarded",
        )


@dataclass(frozen=True)
class Settings:
    """How much is driven, and where everything lies."""

    runs: Path = Path("runs/results")  # the store of all episodes
    out: Path = Path("docs/results")  # pages, pictures, CSV
    scale: float = 1.0  # of the numbers of episodes
    scenarios: tuple[str, ...] = ()  # (): all that a table has
    workers: int = 2
    untrained: bool = False  # value networks with initial weights: nothing needs to have been trained
    duration: float | None = None  # s; None: the scenario's own
    first: int = FIRST_TEST_SEED  # seed; what is compared to tune something belongs on tuning seeds
    trainings: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)  # policy -> runs of cosim train
    shipped: Path | None = shipped.FOLDER  # episodes that need not be driven; None: every one is
    held: bool = False  # drive nothing: pages of what there is, however many episodes of each

    def episodes(self, full: int) -> int:
        """How many of `full` episodes are wanted."""
        return max(math.ceil(full * self.scale), LEAST)

    def chosen(self, orders: Sequence[Order]) -> list[Order]:
        """Those of the worlds that are wanted, each once."""
        return [o for o in dict.fromkeys(orders) if not self.scenarios or o.scenario in self.scenarios]

    def trained(self, policy: str) -> tuple[Path, ...]:
        """The runs of `cosim train` it is known of: as given, else runs/POLICY and runs/POLICY-0, -1, ...,
        else the logs of the shipped weights' trainings."""
        found: tuple[Path, ...] = ()
        for root in (Path("runs"), TRAININGS):
            places = [root / policy, *sorted(root.glob(f"{policy}-[0-9]*"))]
            found = found or tuple(p for p in places if (p / "log.jsonl").is_file())
        return self.trainings.get(policy, found)

    @property
    def flags(self) -> str:
        """As they were typed, for the page's command."""
        words = [] if self.scale == 1.0 else [f"--scale {self.scale:g}"]
        words += [f"--scenario {name}" for name in self.scenarios]
        words += [f"--duration {self.duration:g}"] if self.duration is not None else []
        words += ["--held"] if self.held else []
        return " ".join(["", *words, *(["--untrained"] if self.untrained else [])])


@dataclass(frozen=True)
class Driven:
    """What there is of one order."""

    order: Order
    rows: list[Row]  # by seed, of any status; [] when nothing could be driven
    why: str = ""  # why not

    @property
    def label(self) -> str:
        """`untrained`, or what else is to be warned of; "" when nothing is."""
        return next((str(row["policy_label"]) for row in self.rows if row.get("policy_label")), "")

    @property
    def name(self) -> str:
        """In tables: the arm, and what is to be warned of."""
        return f"{self.order.name} ({self.label})" if self.label else self.order.name


@dataclass(frozen=True)
class Results:
    """Every order with its rows, and what the store holds of all figures."""

    driven: tuple[Driven, ...]
    notes: Mapping[str, Mapping[str, str]]  # `units` and `better` of the figures

    def runs(self, *, demand: str = "", behavior: str = "") -> dict[str, Run]:
        """Arm -> its episodes of all worlds, of one demand or behaviour where that is given; never none."""
        found: dict[str, list[Row]] = {}
        for one in self.driven:
            mine = demand in ("", one.order.demand) and behavior in ("", one.order.behavior)
            if mine and one.rows:
                found.setdefault(one.name, []).extend(one.rows)
        return {name: Run(Path(name), rows, self.notes) for name, rows in found.items()}

    @property
    def lacking(self) -> int:
        """How many orders have no episode."""
        return sum(not one.rows for one in self.driven)

    @property
    def absent(self) -> list[str]:
        """What was not driven and why, a line per reason."""
        return reasons({one.order.agent: one.why for one in self.driven if one.why})


def drive(orders: Sequence[Order], settings: Settings, title: str) -> Results:
    """Drive what the store does not hold yet; what lacks weights is left out and named on stderr.

    With `settings.held` nothing is driven, and orders may have fewer episodes than they want, or none.

    Raises BadInput (nothing is driven then) and CosimError as `cosim evaluate` does.
    """
    orders = settings.chosen(orders)
    absent = without_weights(orders, settings, title)
    work = planned([o for o in orders if o.agent not in absent], settings)
    settings.runs.mkdir(parents=True, exist_ok=True)
    with (
        RunFolder(str(settings.runs), resume=True, episodes=work.episodes) as folder,
        _store(folder.path) as store,
    ):
        _write_down(work, store)
        _take(work, store, settings, title)
        if not settings.held:
            _drive(work, store, settings, title)
        rows: dict[str, list[Row]] = {}
        for row in store.rows():
            rows.setdefault(row["cell"], []).append(row)
        notes = {name: dict(store.document()[name]) for name in ("units", "better")}
    driven = []
    for order in orders:
        cell = work.cell_of.get(order)
        last = settings.first + settings.episodes(order.episodes)
        mine: list[Row] = [
            {**row, "policy": order.agent.name}  # rows that failed name the fingerprint
            for row in rows.get(cell or "", [])
            if settings.first <= row["seed"] < last
        ]
        driven.append(Driven(order, mine, absent.get(order.agent, "")))
    return Results(tuple(driven), notes)


def without_weights(orders: Sequence[Order], settings: Settings, title: str) -> dict[Agent, str]:
    """The agents that cannot drive, and why; said on stderr, a line per reason."""
    absent = {o.agent: why for o in orders if not settings.untrained and (why := missing(o.agent))}
    for line in reasons(absent):
        print(f"{title}: not driven: {line}", file=sys.stderr)
    return absent


def reasons(absent: Mapping[Agent, str]) -> list[str]:
    """`vfn-p and 9 more: no weights ...`: one line per reason."""
    names: dict[str, list[str]] = {}
    for agent, why in absent.items():
        names.setdefault(why, []).append(agent.name)
    more = {why: f" and {len(mine) - 1} more" if len(mine) > 1 else "" for why, mine in names.items()}
    return [f"{mine[0]}{more[why]}: {why}" for why, mine in names.items()]


@dataclass(frozen=True)
class Planned(matrix.Plan):
    """A plan whose cells have numbers of episodes of their own."""

    counts: tuple[int, ...]
    cell_of: Mapping[Order, str]
    agents: Mapping[str, Agent]
    untrained: bool  # driven with networks of initial weights

    @property
    def episodes(self) -> int:
        return sum(self.counts)

    @property
    def wanted(self) -> dict[str, range]:
        """Cell -> its seeds."""
        return {cell.name: self.seeds[:n] for cell, n in zip(self.cells, self.counts, strict=True)}

    def cases(self) -> Iterator[tuple[matrix.Cell, EpisodeOptions]]:
        wanted = self.wanted
        for cell in self.cells:
            for seed in wanted[cell.name]:
                yield cell, cell.case.with_seed(seed)


def planned(orders: Sequence[Order], settings: Settings) -> Planned:
    """Every cell that is ordered, once; its policy name holds the fingerprint of agent, files and packages.

    Raises BadInput when a world or demand is wrong.
    """
    agents = {o.agent.name: o.agent for o in orders}
    clash = [o.agent.name for o in orders if agents[o.agent.name] != o.agent]
    assert not clash, f"two agents of one name: {clash}"
    prints = {name: fingerprint(agent, settings.untrained) for name, agent in agents.items()}
    cases = [replace(o.case, duration=settings.duration) for o in orders]
    most = max((settings.episodes(o.episodes) for o in orders), default=1)
    plan = matrix.plan(cases, range(settings.first, settings.first + most), lambda _: None)
    cells: dict[str, matrix.Cell] = {}
    counts: dict[str, int] = {}
    cell_of = {}
    for order, cell in zip(orders, plan.cells, strict=True):
        mark = short([prints[order.agent.name], shipped.lasting(cell.manifest)])
        cell = replace(cell, case=replace(cell.case, policy=f"{order.agent.name}{MARK}{mark}"))
        cells.setdefault(cell.name, cell)
        counts[cell.name] = max(counts.get(cell.name, 0), settings.episodes(order.episodes))
        cell_of[order] = cell.name
    return Planned(
        tuple(cells.values()), plan.seeds, tuple(counts.values()), cell_of, agents, settings.untrained
    )


def agent_of(policy: str) -> str:
    """The agent's name in the policy of a planned case: what stands before the mark."""
    return policy.split(MARK)[0]


class AgentRunner(EpisodeRunner):
    """Hosted by the engine: like `cosim evaluate`, for agents that `--policy` cannot name."""

    def __init__(self, agents: Mapping[str, Agent], untrained: bool) -> None:
        super().__init__()
        self._agents, self._untrained = agents, untrained

    def policy(self, case: EpisodeOptions) -> Policy:
        """The agent that the case names."""
        return build(self._agents[agent_of(case.policy)], self._untrained)


def held(work: Planned, settings: Settings) -> dict[str, set[int]]:
    """Which of the planned seeds need not be driven, by cell: the store's and the shipped ones."""
    rows = [*shipped.episodes(settings.shipped).rows]
    if settings.runs.is_dir():
        with _store(settings.runs) as store:
            rows += store.rows()
    wanted = work.wanted
    found: dict[str, set[int]] = {}
    for row in rows:
        if row["seed"] in wanted.get(row["cell"], ()):
            found.setdefault(row["cell"], set()).add(row["seed"])
    return found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The flags that all papers' tables share."""
    default = Settings()
    add = parser.add_argument
    add("--scale", type=float, default=1.0, metavar="X", help="of the numbers of episodes")
    add("--scenario", action="append", default=[], choices=names(), help="default: all that a table has")
    add("--duration", type=float, metavar="S", help="of an episode; default: the scenario's own")
    add("--workers", type=int, default=default.workers, metavar="N")
    add("--untrained", action="store_true", help="value networks with initial weights, labelled so")
    add("--runs", type=Path, default=default.runs, help="where the episodes are kept")
    add("--out", type=Path, default=default.out, help="folder of pages, pictures and data/*.csv")
    add("--held", action="store_true", help="drive nothing: pages of the episodes that there are")
    add("--anew", action="store_true", help="drive also the episodes that come with the repository")
    add("--training", action="append", default=[], metavar="POLICY=RUN", help="a run of cosim train")
    add("--dry-run", action="store_true", help="what is still to be driven, and its CPU hours")


def settings_of(args: argparse.Namespace) -> Settings:
    """The settings as typed."""
    default = Settings()
    trainings: dict[str, tuple[Path, ...]] = {}
    for text in args.training:
        policy, _, run = text.partition("=")
        trainings[policy] = (*trainings.get(policy, ()), Path(run))
    return Settings(
        runs=args.runs,
        out=args.out,
        scale=args.scale,
        scenarios=tuple(args.scenario),
        workers=args.workers,
        untrained=args.untrained,
        duration=args.duration,
        trainings=trainings,
        shipped=None if args.anew else default.shipped,
        held=args.held,
    )


# ---- inside ----


def _store(folder: Path) -> Store:
    store = Store.in_folder(folder)
    if store.spec_hash() is None:
        store.begin("papers", {"units": {}, "better": {}}, [])
    return store


def _drive(work: Planned, store: Store, settings: Settings, title: str) -> None:
    engine = LocalEngine(AgentRunner, (work.agents, settings.untrained), workers=settings.workers)
    progress = Progress(title, "episodes")
    try:
        faults = batch.drive(work, store, engine, settings.runs / "outputs", progress)
    finally:
        progress.done()
    for fault in faults:
        print(f"{title}: {fault.key}: our own code failed, no row: {fault.stderr}", file=sys.stderr)


def _write_down(work: Planned, store: Store) -> None:
    """The cells of the plan, with the versions that drive them from now on."""
    known = store.cells()
    store.extend(
        [{"cell": c.name, "case": c.case.document(), "manifest": dict(c.manifest)} for c in work.cells]
    )
    for cell in work.cells:
        if cell.name in known and known[cell.name]["manifest"]["versions"] != cell.manifest["versions"]:
            store.set_manifest(cell.name, known[cell.name]["manifest"] | cell.manifest)


def _take(work: Planned, store: Store, settings: Settings, title: str) -> None:
    """What is shipped of it goes into the store; said on stderr, and why when it cannot."""
    here = work.cells[0].manifest["versions"] if work.cells else {}
    other = shipped.other_versions(here, settings.shipped)
    taken = shipped.take(store, work.wanted, settings.shipped)
    if other and work.cells:
        note = f"{settings.shipped} was driven with {other}: what was not driven here is driven anew"
        print(f"{title}: {note}", file=sys.stderr, flush=True)
    if taken:
        note = f"{taken} episodes taken from {settings.shipped} (--anew drives them)"
        print(f"{title}: {note}", file=sys.stderr, flush=True)

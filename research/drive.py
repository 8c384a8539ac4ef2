"""Drives the episodes of all claims, each once, into one resumable store.

An episode is identified by its options, the hashes of the policy's and the scenario's files, and the versions
of the packages. All four are part of the cell's name, so new weights are driven again and existing episodes
stay.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from cosim.batch import execution, matrix
from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.folder import RunFolder
from cosim.batch.store import Store
from cosim.files import code
from cosim.policies import check, make
from cosim.report.figures import Row
from cosim.scenario.manifest import POLICY_FILES, digests
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.policy_name import WEIGHTS
from cosim.workers.engines import Engine, LocalEngine
from cosim.workers.progress import Progress
from research import kept
from research.schema import Claim, Condition

PART = "part"  # of a pooled arm's row: the number of its condition
MIN_EPISODES = 2  # episodes, however small the scale


@dataclass(frozen=True)
class Settings:
    """Amount, engine and folders of the drives. Defaults: complete, as for the pages."""

    runs: Path = Path("runs/research")
    workers: int = 2
    engine: str = "local"  # or "ray"
    kept: Path | None = kept.FOLDER  # folder of stored episodes; None: drive all
    scale: float = 1.0  # factor on the numbers of episodes
    seeds: range | None = None  # instead of every claim's own
    scenarios: tuple[str, ...] = ()  # (): all of a claim
    duration: float | None = None  # s; None: the scenario's own
    untrained: bool = False  # value networks with initial weights may drive

    def seeds_of(self, claim: Claim, scenario: str) -> range:
        """The seeds of every arm in a scenario, fewer at a small scale."""
        seeds = claim.seeds_of(scenario) if self.seeds is None else self.seeds
        return seeds[: max(round(len(seeds) * self.scale), MIN_EPISODES)]

    def conditions(self, claim: Claim) -> list[Condition]:
        """The claim's conditions in the wanted scenarios."""
        return [c for c in claim.conditions if not self.scenarios or c.scenario in self.scenarios]


@dataclass(frozen=True)
class Arm:
    """One arm in one condition: its policy and its episodes."""

    cell: matrix.Cell
    seeds: range
    weights: str  # first digits of the SHA-256 of its network, or of its code; "": a shipped script
    definitions: str  # first digits of the hash of the policy's and scenario's files and options
    label: str  # "untrained value network", or ""
    rows: tuple[Row, ...] = ()  # by seed, of any status

    @property
    def network(self) -> bool:
        """Whether its policy has trained weights."""
        return any(name.endswith(WEIGHTS) for name in self.cell.manifest[POLICY_FILES])

    @property
    def complete(self) -> bool:
        """Whether every episode was driven."""
        return len(self.rows) == len(self.seeds)


Arms = Mapping[tuple[Condition, str], Arm]  # of one claim


def pooled(claim: Claim, arms: Arms) -> Arms:
    """One arm for all conditions that the claim counts together; its rows say by `PART` of which they are."""
    parts: dict[tuple[Condition, str], list[Arm]] = {}
    for (condition, name), arm in arms.items():
        parts.setdefault((claim.pooled(condition), name), []).append(arm)
    return {key: _together(one) if len(one) > 1 else one[0] for key, one in parts.items()}


@dataclass(frozen=True)
class Work(matrix.Plan):
    """A plan whose cells have seeds of their own."""

    wanted: Mapping[str, frozenset[int]]  # cell -> seeds
    arms: Mapping[str, Arms]  # claim -> its arms, without rows

    @property
    def episodes(self) -> int:
        return sum(map(len, self.wanted.values()))

    def cases(self) -> Iterator[tuple[matrix.Cell, EpisodeOptions]]:
        for cell in self.cells:
            for seed in sorted(self.wanted[cell.name]):
                yield cell, cell.case.with_seed(seed)


@dataclass(frozen=True)
class Driven:
    """The stored episodes of the claims."""

    arms: Mapping[str, Arms]  # claim -> its arms
    notes: Mapping[str, Mapping[str, str]]  # `units` and `better` of the figures


def planned(claims: Sequence[Claim], settings: Settings) -> Work:
    """Every cell that the claims need, once.

    Raises BadInput: a scenario, demand or policy is wrong.
    """
    asked = {
        (claim.name, condition, arm): replace(claim.cases[condition, arm], duration=settings.duration)
        for claim in claims
        for condition in settings.conditions(claim)
        for arm in claim.every_arm
    }
    plan = matrix.plan(asked.values(), range(1), check)
    by_name = {claim.name: claim for claim in claims}
    cells: dict[str, matrix.Cell] = {}
    wanted: dict[str, frozenset[int]] = {}
    arms: dict[str, dict[tuple[Condition, str], Arm]] = {name: {} for name in by_name}
    for (name, condition, arm), plain in zip(asked, plan.cells, strict=True):
        found = _arm(plain, settings.seeds_of(by_name[name], condition.scenario))
        arms[name][condition, arm] = found
        if found.label and not settings.untrained:
            continue
        cells.setdefault(found.cell.name, found.cell)
        wanted[found.cell.name] = wanted.get(found.cell.name, frozenset()) | {*found.seeds}
    return Work(tuple(cells.values()), range(1), wanted, arms)


def drive(claims: Sequence[Claim], settings: Settings) -> Driven:
    """Drive the missing episodes. Policies without trained weights are skipped and named on stderr.

    Raises BadInput (nothing is driven then) and CosimError as `cosim evaluate` does.
    """
    work = planned(claims, settings)
    arms = [arm for of_claim in work.arms.values() for arm in of_claim.values()]
    for label in sorted({f"{policy(arm.cell)}: {arm.label}" for arm in arms if arm.label}):
        print(f"research: {label}{'' if settings.untrained else ', not driven'}", file=sys.stderr)
    with opened(work, settings) as store:
        with Progress("research", "episodes") as progress:
            faults = execution.drive(work, store, engine(settings), settings.runs / "outputs", progress)
        for fault in faults:
            print(f"research: {fault.key}: internal error, no row: {fault.stderr}", file=sys.stderr)
        return _found(work, store)


def held(claims: Sequence[Claim], settings: Settings) -> Driven:
    """The stored episodes of the claims, without driving. Raises BadInput as `drive`."""
    work = planned(claims, settings)
    with opened(work, settings) as store:
        return _found(work, store)


@contextmanager
def opened(work: Work, settings: Settings) -> Iterator[Store]:
    """The store with the cells of `work` and its kept episodes, locked against other processes."""
    with (
        RunFolder(str(settings.runs), resume=True, episodes=work.episodes) as folder,
        Store.in_folder(folder.path) as store,
    ):
        if store.spec_hash() is None:
            store.begin("research", {"units": {}, "better": {}}, [])
        known = store.cells()
        store.extend(
            [{"cell": c.name, "case": c.case.document(), "manifest": dict(c.manifest)} for c in work.cells]
        )
        for cell in work.cells:  # another version of Python is allowed
            if cell.name in known and known[cell.name]["manifest"]["versions"] != cell.manifest["versions"]:
                store.set_manifest(cell.name, known[cell.name]["manifest"] | cell.manifest)
        if taken := kept.take(store, work.wanted, settings.kept):
            print(f"research: {taken} episodes taken from {settings.kept}", file=sys.stderr, flush=True)
        yield store


def engine(settings: Settings) -> Engine:
    """The engine of the drives. Raises BadInput when ray is not installed."""
    if settings.engine == "local":
        return LocalEngine(Runner, workers=settings.workers)
    from cosim.workers.ray_engine import RayEngine

    return RayEngine(Runner, workers=settings.workers)


class Runner(EpisodeRunner):
    """Hosted by the engine: drives as `cosim evaluate` does, for marked policy names (`kept.MARK`)."""

    def policy(self, case: EpisodeOptions) -> str:
        """The policy's name for `--policy`."""
        return kept.unmarked(case.policy)


def policy(cell: matrix.Cell) -> str:
    """The cell's policy, by its name for `--policy`."""
    return kept.unmarked(cell.case.policy)


# ---- inside ----


@cache
def _made_of(name: str) -> tuple[tuple[Path, ...], str]:
    """The policy's weights and code files, and its label."""
    made = make(name)
    return tuple(getattr(made, "files", ())), str(getattr(made, "label", ""))


def _arm(plain: matrix.Cell, seeds: range) -> Arm:
    """The arm with the hash of its policy and definitions in the cell's name."""
    paths, label = _made_of(plain.case.policy)
    files = digests([*paths, *code.files_of([*plain.case.metrics, plain.case.reward])])
    about = {**plain.manifest, POLICY_FILES: files}
    versions = kept.packages(about["versions"])
    defined = _short({name: part for name, part in about.items() if name != "versions"})
    case = replace(plain.case, policy=f"{plain.case.policy}{kept.MARK}{_short([defined, versions])}")
    cell = replace(plain, case=case, manifest=about)
    weights = [digest for name, digest in files.items() if name.endswith(WEIGHTS)] or [*files.values(), ""]
    return Arm(cell, seeds, weights[0][:12], defined, label)


def _together(arms: Sequence[Arm]) -> Arm:
    rows = tuple({**row, PART: k} for k, arm in enumerate(arms) for row in arm.rows)
    return replace(arms[0], rows=rows, definitions=_short([arm.definitions for arm in arms]))


def _short(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:12]


def _found(work: Work, store: Store) -> Driven:
    """The arms with their rows."""
    rows = {(row["cell"], row["seed"]): row for row in store.rows()}
    filled = {
        name: {
            key: replace(arm, rows=tuple(rows[k] for s in arm.seeds if (k := (arm.cell.name, s)) in rows))
            for key, arm in arms.items()
        }
        for name, arms in work.arms.items()
    }
    document = store.document()
    return Driven(filled, {name: document[name] for name in ("units", "better")})

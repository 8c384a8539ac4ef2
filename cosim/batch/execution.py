"""The execution of a batch: missing episodes -> engine -> row -> store, one episode at a time."""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from cosim.batch.matrix import Cell, Plan
from cosim.batch.records import row
from cosim.batch.store import FILE, Store
from cosim.errors import BadInput, CosimError
from cosim.scenario.manifest import POLICY_FILES
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.policy_name import label
from cosim.workers.engines import Engine
from cosim.workers.tasks import BAD_INPUT, FAULT, Outcome, Progress

MAX_FAULTS = 10  # internal errors before a batch stops


def asked(folder: Path, url: str | None) -> tuple[list[EpisodeOptions], range]:
    """The case of every cell and the seeds of the run in a folder, or in the database `url`.

    Raises BadInput without a run.
    """
    if url is not None or (folder / FILE).is_file():
        with Store.in_folder(folder, url) as store:
            if store.spec_hash() is not None:
                cases = [EpisodeOptions.read(cell["case"]) for cell in store.cells().values()]
                return cases, range(*store.document()["seeds"])
    raise BadInput("holds no run to resume", field="--out", value=str(folder))


def begin_or_resume(plan: Plan, store: Store, document: Mapping[str, Any], *, resume: bool) -> None:
    """Begin a fresh store with this plan, or check that an existing store has the same plan.

    Raises BadInput for a store with another plan, or an existing store without `resume`.
    """
    if store.spec_hash() is None:
        begin(plan, store, document)
    elif resume:
        check_same(plan, store)
    else:
        problem = f"holds a run named {store.run} already: --resume it, or name another --out"
        raise BadInput(problem, field="--store")


def begin_or_grow(plan: Plan, store: Store, document: Mapping[str, Any], *, resume: bool) -> None:
    """As `begin_or_resume`, but a resumed run may have additional seeds.

    Raises BadInput also when the store holds seeds outside of the plan.
    """
    if not resume or store.spec_hash() is None:
        begin_or_resume(plan, store, document, resume=resume)
        return
    first, end = store.document()["seeds"]
    check_same(replace(plan, seeds=range(first, end)), store)
    if plan.seeds.start != first or plan.seeds.stop < end:
        problem = f"the run has the seeds {first}:{end}: it can only get more seeds at the end"
        raise BadInput(problem, field="--resume", value=f"{plan.seeds.start}:{plan.seeds.stop}")
    store.note("seeds", [first, plan.seeds.stop], plan.spec_hash)


def begin(plan: Plan, store: Store, document: Mapping[str, Any]) -> None:
    """Store the plan in a fresh store. `document`: content for the manifest."""
    cells = [
        {"cell": cell.name, "case": cell.case.document(), "manifest": dict(cell.manifest)}
        for cell in plan.cells
    ]
    seeds = [plan.seeds.start, plan.seeds.stop]
    store.begin(plan.spec_hash, {**document, "seeds": seeds, "units": {}, "better": {}}, cells)


def check_same(plan: Plan, store: Store) -> None:
    """Raises BadInput unless the store has this plan, with the same files and versions."""
    if store.spec_hash() != plan.spec_hash:
        problem = "holds the run of another spec: name another folder, or no spec to continue that run"
        raise BadInput(problem, field="--resume")
    known = store.cells()
    for cell in plan.cells:
        _compare(known[cell.name]["manifest"], cell.manifest, cell, "since the run began")


def drive(plan: Plan, store: Store, engine: Engine, outputs: Path, progress: Progress) -> list[Outcome]:
    """Run every missing episode and store each result at once.

    Returns the episodes with internal errors. They have no row, so a resumed run tries them again.

    `outputs`: folder of SUMO's own outputs, one folder per episode in it. The engine hosts an object whose
    `run(case, warnings, outputs)` returns the document of `cosim run --json`.

    Raises:
        BadInput: a worker saw other files or versions than the plan did.
        CosimError: the store cannot be written any more, or `MAX_FAULTS` internal errors.
    """
    done = store.keys()
    cases = {case.key: (cell, case) for cell, case in plan.cases() if case.key not in done}
    refused = [(cell, case) for cell, case in cases.values() if cell.refused]
    store.add(row(cell, case, Outcome(case.key, BAD_INPUT, error=cell.refused)) for cell, case in refused)
    tasks = [
        cell.task(case, outputs if case.outputs else None)
        for cell, case in cases.values()
        if not cell.refused
    ]
    common = _Common(store)
    faults: list[Outcome] = []
    with closing(engine.run(tasks)) as outcomes:
        for finished, outcome in enumerate(outcomes, len(refused) + 1):
            progress(finished, len(cases))
            cell, case = cases[outcome.key]
            if outcome.ok:
                common.check(cell, outcome.value)
            if outcome.status != FAULT:
                store.add([row(cell, case, outcome)])
                continue
            faults.append(outcome)
            if len(faults) == MAX_FAULTS:
                raise CosimError(f"stopped at the {MAX_FAULTS}th internal error: {outcome.stderr}")
    return faults


def manifest(plan: Plan, store: Store) -> dict[str, Any]:
    """manifest.json: plan and versions, and `cosim.scenario.manifest` of every cell."""
    cells = store.cells()
    versions: dict[str, Any] = next((cell["manifest"]["versions"] for cell in cells.values()), {})
    return {**store.document(), "spec": plan.spec_hash, "versions": versions, "cells": cells}


class _Common:
    """The common part of all episodes of a cell: stored once, and compared with every episode."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._manifests = {name: cell["manifest"] for name, cell in store.cells().items()}
        self._notes = {name: dict(store.document().get(name, {})) for name in ("units", "better")}

    def check(self, cell: Cell, document: Mapping[str, Any]) -> None:
        """Compare one episode's document. Raises BadInput when its manifest differs from the cell's."""
        found = {k: v for k, v in document["manifest"].items() if k != "seed"}
        known = self._manifests[cell.name]
        _compare(known, found, cell, "in a worker")
        if found.keys() - known.keys():
            self._manifests[cell.name] = known | found
            self._store.set_manifest(cell.name, known | found)
        for name, notes in self._notes.items():
            if document[name].keys() - notes.keys():
                notes.update(document[name])
                self._store.note(name, notes)


def _compare(known: Mapping[str, Any], found: Mapping[str, Any], cell: Cell, where: str) -> None:
    """Compare the common fields, since some are known only to workers. Raises BadInput."""
    for name in known.keys() & found.keys():
        a, b = known[name], found[name]
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            differing = next((k for k in sorted({*a, *b}) if a.get(k) != b.get(k)), None)
            if differing is not None:
                problem = f"has changed {where}: it is {b.get(differing)!r}, it was {a.get(differing)!r}"
                if name == POLICY_FILES:
                    raise BadInput(problem, file=differing, field="policy", value=label(cell.case.policy))
                raise BadInput(problem, file=cell.scenario.config, field=f"{name}.{differing}")
        elif a != b:
            raise BadInput(
                f"has changed {where}: it is {b!r}, it was {a!r}", file=cell.scenario.config, field=name
            )

"""Run folders made by hand: rows as `cosim evaluate` keeps them, with whatever a test wants in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cosim.batch.export import export
from cosim.batch.store import Store
from cosim.report.summary import summarize
from cosim.scenario.options import EpisodeOptions

UNITS = {
    "crashed": "bool",
    "av_caused_collisions": "pairs",
    "mission_success": "bool",
    "dt_mission_m": "m",
    "dt_av_m": "m",
    "dt_mean_m": "m",
    "dt_hv_m": "m",
    "min_ttc_s": "s",
    "hard_brakings_av": "events",
    "veto_rate": "share",
    "total_delay_s": "s",
}
BETTER = {
    "crashed": "lower",
    "av_caused_collisions": "lower",
    "mission_success": "higher",
    "dt_mission_m": "higher",
    "dt_av_m": "higher",
    "dt_mean_m": "higher",
    "dt_hv_m": "higher",
    "min_ttc_s": "higher",
    "hard_brakings_av": "lower",
    "veto_rate": "lower",
    "total_delay_s": "lower",
}
CASE = EpisodeOptions(
    what="merge",
    demand=("contested",),
    policy="idm",
    behavior=None,
    driver_model="lc2013",
    penetration=None,
    av_type=None,
    av_ids=None,
    svo_deg=45.0,
    preset=None,
    duration=None,
    seed=200_000,
)


def row(case: EpisodeOptions, **values: Any) -> dict[str, Any]:
    """One ok episode without a crash; `values` replace or add columns."""
    plain = {
        "key": case.key,
        "cell": case.cell,
        "status": "ok",
        "scenario": case.what,
        "demand": "+".join(Path(name).name for name in case.demand),
        "policy": case.policy,
        "policy_label": "",
        "behavior": case.behavior or "moderate",
        "driver_model": case.driver_model,
        "penetration": case.penetration,
        "preset": case.preset or "unguarded",
        "svo_deg": case.svo_deg,
        "seed": case.seed,
        "steps": 100,
        "crashed": False,
        "av_caused_collisions": 0,
        "mission_success": True,
        "dt_mission_m": 500.0,
        "dt_av_m": 800.0,
        "dt_mean_m": 810.0,
        "dt_hv_m": 820.0,
        "min_ttc_s": 2.0,
        "hard_brakings_av": 1,
        "veto_rate": None,
        "trace_hash": f"{case.key}",
        "comparable": True,
        "not_comparable_because": "[]",
        "collision_list": "[]",
        "total_s": 1.0,
        "error": None,
        "stderr": None,
        "attempts": 1,
    }
    return plain | values


def failed(case: EpisodeOptions, status: str = "sim_crash") -> dict[str, Any]:
    """An episode without figures, as the batch keeps it."""
    identity = list(row(case))[: list(row(case)).index("steps")]
    found = {name: value for name, value in row(case).items() if name in identity}
    error = {"error": "the simulation process died (SIGSEGV)", "attempts": 2}
    return found | {"status": status, "stderr": "Loading net ...\nError: no such junction\n", **error}


def cell(
    policy: str,
    count: int,
    *,
    first: int = 200_000,
    columns: dict[str, Sequence[Any]] | None = None,
    **case: Any,
) -> list[tuple[EpisodeOptions, dict[str, Any]]]:
    """`count` episodes of one policy; `columns`: by name, one value per episode."""
    cases = [replace(CASE, policy=policy, seed=first + k, **case) for k in range(count)]
    values = columns or {}
    return [(c, row(c, **{name: column[k] for name, column in values.items()})) for k, c in enumerate(cases)]


def write(
    folder: Path,
    *cells: list[tuple[EpisodeOptions, dict[str, Any]]],
    manifest: bool = True,
    planned: int | None = None,
) -> Path:
    """The run folder; `planned`: seeds of every cell (None: as many as the first one has)."""
    folder.mkdir(parents=True)
    rows = [found for one in cells for _, found in one]
    document = _document(len(cells[0]) if planned is None else planned) | {"cells": _cells(*cells)}
    export(folder, rows, document, summarize(rows, UNITS, BETTER))
    if not manifest:
        (folder / "manifest.json").unlink()
    return folder


def begin(folder: Path, *cells: list[tuple[EpisodeOptions, dict[str, Any]]], planned: int) -> Path:
    """The folder of a run that is still being driven: `planned` seeds of every cell, these rows so far."""
    folder.mkdir(parents=True)
    with Store.in_folder(folder) as store:
        store.begin("hash", _document(planned), [{"cell": c} | about for c, about in _cells(*cells).items()])
        store.add(found for one in cells for _, found in one)
    return folder


def _document(seeds: int) -> dict[str, Any]:
    return {
        "command": "cosim evaluate --scenario merge",
        "seeds": [200_000, 200_000 + seeds],
        "versions": {"cosim": "0.1.0", "libsumo": "1.28.0"},
        "units": UNITS,
        "better": BETTER,
    }


def _cells(*cells: list[tuple[EpisodeOptions, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    return {c.cell: {"case": c.document(), "manifest": {}} for one in cells for c, _ in one}

"""The run folder of `cosim evaluate`, written and read back: rows, manifest, summary."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet

from cosim.batch import export as files
from cosim.batch.store import FILE, Store
from cosim.errors import BadInput
from cosim.files import read_json
from cosim.report.figures import Measure, Row, measures
from cosim.report.summary import summarize
from cosim.scenario.manifest import checked
from cosim.scenario.options import COLUMNS, FLEET
from cosim.types import OnCollision, Traffic
from cosim.workers.tasks import OK

# Options in which pairs must agree and that are not columns of a row: requested options, and hashes.
SETTINGS = (*(name for name in COLUMNS if name not in FLEET), "errors_sha256", "sensing_sha256", "tilt")
NEEDED = ("key", "cell", "status", "scenario", "demand", "policy", "seed")


@dataclass(frozen=True)
class Run:
    """The episodes of one run folder."""

    path: Path
    rows: list[Row]
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def measures(self) -> dict[str, Measure]:
        """Every figure of these episodes by name."""
        return measures(self.rows, self.manifest.get("units"), self.manifest.get("better"))

    @property
    def policies(self) -> list[str]:
        """Names of the policies, in the order of the rows."""
        return list(dict.fromkeys(str(row["policy"]) for row in self.rows))

    @property
    def planned(self) -> int | None:
        """Number of planned episodes; None if missing in the manifest."""
        seeds, cells = self.manifest.get("seeds"), self.manifest.get("cells")
        if not (isinstance(seeds, list) and len(seeds) == 2 and cells):
            return None
        return len(cells) * (int(seeds[1]) - int(seeds[0]))

    @property
    def missing(self) -> int:
        """Number of planned episodes without a row."""
        return max((self.planned or 0) - len(self.rows), 0)

    def case(self, row: Row) -> dict[str, Any]:
        """The requested options (`EpisodeOptions`), without policy and seed; {} if unknown."""
        return {k: v for k, v in self._cell(row).get("case", {}).items() if k not in ("policy", "seed")}

    def settings(self, row: Row) -> dict[str, Any]:
        """Options of an episode outside of its row's columns (`SETTINGS`); times in s."""
        driven, asked = self._cell(row).get("manifest", {}), self.case(row)
        times = driven.get("timing", {})
        return {name: asked.get(option.field) for name, option in COLUMNS.items()} | {
            "duration": times.get("duration_s", asked.get("duration")),
            "warmup": times.get("warmup_s", asked.get("warmup")),
            "on_collision": driven.get("on_collision", asked.get("on_collision") or OnCollision.END),
            "errors_sha256": driven.get("errors", {}).get("sha256"),
            "sensing_sha256": driven.get("sensing", {}).get("sha256"),
            "tilt": driven.get("tilt"),
            "traffic": driven.get("traffic", asked.get("traffic") or Traffic.CONTROLLED),
        }

    def _cell(self, row: Row) -> Mapping[str, Any]:
        cell: Mapping[str, Any] = self.manifest.get("cells", {}).get(row["cell"], {})
        return cell


def export(folder: Path, rows: Sequence[Row], manifest: Mapping[str, Any], planned: int) -> dict[str, Any]:
    """Write rows, manifest and summary, and return the summary; `planned`: episodes of the run.

    Raises CosimError as `cosim.batch.export`.
    """
    summary = {"planned": planned} | summarize(rows, manifest["units"], manifest["better"])
    files.export(folder, rows, manifest, summary)
    return summary


def read(path: str | Path, *, unfinished: bool = False) -> Run:
    """The run in the folder `path`.

    Args:
        path: the run folder.
        unfinished: whether to read the driven episodes of a run that still runs or was interrupted.

    Raises:
        BadInput: no such folder, no `episodes.parquet` in it, or another program's; no episode yet.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise BadInput("no such run folder", value=str(path))
    file = folder / "episodes.parquet"
    if not file.is_file():
        if (folder / FILE).is_file():
            if unfinished:
                return _so_far(folder)
            raise BadInput(
                f"is not finished: `cosim evaluate --resume --out {folder}` continues", file=folder
            )
        raise BadInput("has no episodes.parquet: is it a run of `cosim evaluate`?", file=folder)
    try:
        rows: list[dict[str, Any]] = pa.parquet.read_table(file).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"cannot be read: {str(error).splitlines()[0]}", file=file) from None
    for name in NEEDED:
        if rows and name not in rows[0]:
            raise BadInput("has no such column: is it a run of `cosim evaluate`?", file=file, field=name)
    file = folder / "manifest.json"
    manifest = checked(read_json(file), file) if file.is_file() else {}
    return Run(folder, _with_policy_names(rows), manifest)


def _so_far(folder: Path) -> Run:
    """The episodes in the store of an unfinished run."""
    with Store.in_folder(folder) as store:
        if not (rows := store.rows()):
            raise BadInput("has no episode yet", file=folder)
        manifest = {**store.document(), "cells": store.cells()}
    return Run(folder, _with_policy_names(files.arrow(rows).to_pylist()), manifest)


def _with_policy_names(rows: list[dict[str, Any]]) -> list[Row]:
    """The rows with the policy's own name also in failed episodes, which have the name as typed."""
    names = {row["cell"]: row["policy"] for row in rows if row["status"] == OK}
    return [{**row, "policy": names.get(row["cell"], row["policy"])} for row in rows]

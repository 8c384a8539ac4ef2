"""What `cosim evaluate` leaves in a run folder, written and read back: rows, manifest, summary."""

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
from cosim.scenario import CONFIG, file_name
from cosim.scenario.manifest import checked
from cosim.scenario.options import COLUMNS, FLEET
from cosim.types import OnCollision, Traffic
from cosim.workers.tasks import OK

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
        """Names of the policies, in the order they come."""
        return list(dict.fromkeys(str(row["policy"]) for row in self.rows))

    @property
    def planned(self) -> int | None:
        """How many episodes the run is to have; None where it does not say."""
        seeds, cells = self.manifest.get("seeds"), self.manifest.get("cells")
        if not (isinstance(seeds, list) and len(seeds) == 2 and cells):
            return None
        return len(cells) * (int(seeds[1]) - int(seeds[0]))

    @property
    def missing(self) -> int:
        """How many of these have no row."""
        return max((self.planned or 0) - len(self.rows), 0)

    def case(self, row: Row) -> dict[str, Any]:
        """What was asked for (`EpisodeOptions`), without policy and seed; {} where not known."""
        return {k: v for k, v in self._cell(row).get("case", {}).items() if k not in ("policy", "seed")}

    def settings(self, row: Row) -> dict[str, Any]:
        """What no column says of how an episode was driven (`SETTINGS`); s, and the mission as asked for."""
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
        found: Mapping[str, Any] = self.manifest.get("cells", {}).get(row["cell"], {})
        return found


def export(folder: Path, rows: Sequence[Row], manifest: Mapping[str, Any], planned: int) -> dict[str, Any]:
    """Write the rows, the manifest and their summary, which is returned; `planned`: episodes of the run.

    Raises CosimError as `cosim.batch.export`.
    """
    summary = {"planned": planned} | summarize(rows, manifest["units"], manifest["better"])
    files.export(folder, rows, manifest, summary)
    return summary


def read(path: str | Path, *, unfinished: bool = False) -> Run:
    """The run in the folder `path`; `unfinished`: also one that goes on or was stopped, as far as it is.

    Raises:
        BadInput: no such folder, no `episodes.parquet` in it, or one that is not ours; no episode yet.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise BadInput("no such run folder", value=str(path))
    file = folder / "episodes.parquet"
    if not file.is_file():
        if (folder / FILE).is_file():
            if unfinished:
                return _so_far(folder)
            raise BadInput(f"is not finished: `cosim evaluate --resume --out {folder}` goes on", file=folder)
        raise BadInput("holds no episodes.parquet: is it a run of `cosim evaluate`?", file=folder)
    try:
        rows: list[dict[str, Any]] = pa.parquet.read_table(file).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise BadInput(f"cannot be read: {str(error).splitlines()[0]}", file=file) from None
    for name in NEEDED:
        if rows and name not in rows[0]:
            raise BadInput("has no such column: is it a run of `cosim evaluate`?", file=file, field=name)
    file = folder / "manifest.json"
    manifest = checked(read_json(file), file) if file.is_file() else {}
    return Run(folder, _named_alike(rows, manifest.get("cells", {})), manifest)


def _so_far(folder: Path) -> Run:
    """What the store of an unfinished run holds, as it will be read when the run has ended."""
    with Store.in_folder(folder) as store:
        if not (rows := store.rows()):
            raise BadInput("has no episode yet", file=folder)
        manifest = {**store.document(), "cells": store.cells()}
    return Run(folder, _named_alike(files.arrow(rows).to_pylist(), manifest["cells"]), manifest)


def _named_alike(rows: list[dict[str, Any]], cells: Mapping[str, Any]) -> list[Row]:
    """Episodes that failed have the policy's name as typed; give them the one that it gives itself. Earlier
    runs named a .sumocfg without its folder; give it the name that it has now."""
    names = {row["cell"]: row["policy"] for row in rows if row["status"] == OK}
    configs = {cell: str(about.get("case", {}).get("what", "")) for cell, about in cells.items()}
    worlds = {cell: file_name(Path(what)) for cell, what in configs.items() if what.endswith(CONFIG)}
    return [
        {
            **row,
            "policy": names.get(row["cell"], row["policy"]),
            "scenario": worlds.get(row["cell"], row["scenario"]),
        }
        for row in rows
    ]

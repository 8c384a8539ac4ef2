"""A folder of recordings: present and missing episodes, and their roads."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.errors import BadInput
from cosim.files import cannot, read_json, whole
from cosim.recording import roads
from cosim.recording.file import FORMAT, Recording, read
from cosim.road import RoadMap


def seed_of(key: str) -> int:
    """The seed of a recorded episode, by its key."""
    return int(key.rsplit("-", 1)[1])


def fits(case: Mapping[str, Any], scenarios: Sequence[str], behaviors: Sequence[str]) -> bool:
    """Whether a recording is of one of these scenarios and behaviours; an empty list matches any."""
    return (not scenarios or case["scenario"] in scenarios) and (
        not behaviors or case["behavior"] in behaviors
    )


class Folder:
    """`DIR/manifest.json`, `DIR/episodes/KEY.parquet`, `DIR/roads/HASH.json`.

    Files are written atomically, so a killed recorder leaves no partial episode. A resumed recorder skips
    existing episodes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._roads: dict[str, RoadMap] = {}

    @property
    def manifest_file(self) -> Path:
        return self.path / "manifest.json"

    def prepare(self) -> None:
        """Make the folder. Raises BadInput."""
        with cannot("make this folder", field="--out", value=str(self.path)):
            for part in ("episodes", "roads"):
                (self.path / part).mkdir(parents=True, exist_ok=True)

    def episode_file(self, key: str) -> Path:
        return self.path / "episodes" / f"{key}.parquet"

    def has(self, key: str) -> bool:
        return self.episode_file(key).is_file()

    def episodes(self, seeds: range | None = None) -> list[str]:
        """Keys of the existing episodes, sorted; with `seeds`, of these seeds only."""
        keys = sorted(file.stem for file in (self.path / "episodes").glob("*.parquet"))
        return [key for key in keys if seeds is None or seed_of(key) in seeds]

    def manifest(self) -> dict[str, Any]:
        """Raises BadInput when this is not a folder of recordings."""
        found = read_json(self.manifest_file, "not a folder of recordings (no manifest.json)")
        if found.get("format") != FORMAT:
            raise BadInput(f"not a folder of recordings of format {FORMAT}", file=self.manifest_file)
        return found

    def write_manifest(self, document: Mapping[str, Any]) -> None:
        """Replace the manifest atomically."""
        _write_whole(self.manifest_file, json.dumps({"format": FORMAT, **document}, indent=1) + "\n")

    def add_road(self, road: RoadMap) -> str:
        """Store a road once; returns its name for the episodes' cases."""
        text = roads.text(road)
        name = hashlib.sha256(text.encode()).hexdigest()[:16]
        file = self.path / "roads" / f"{name}.json"
        if not file.is_file():
            _write_whole(file, text)
        return name

    def road(self, recording: Recording) -> RoadMap:
        """The road of a recording. Raises BadInput."""
        name = str(recording.case["road"])
        if name not in self._roads:
            self._roads[name] = roads.read_road(self.path / "roads" / f"{name}.json")
        return self._roads[name]

    def recordings(self, scenarios: Sequence[str] = (), behaviors: Sequence[str] = ()) -> Iterator[Recording]:
        """Every episode, by key; limited to the named scenarios and behaviours if any are named."""
        for key in self.episodes():
            recording = read(self.episode_file(key))
            if scenarios and recording.case["scenario"] not in scenarios:
                continue
            if behaviors and recording.case["behavior"] not in behaviors:
                continue
            yield recording


def _write_whole(file: Path, text: str) -> None:
    # two workers may store the same road
    with cannot("write", file=file), whole(file, contended=True) as draft:
        draft.write_text(text)

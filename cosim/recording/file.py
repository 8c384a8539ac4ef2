"""One episode as one Parquet file: a row per vehicle and frame, written atomically."""

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from cosim.errors import BadInput
from cosim.files import cannot, whole
from cosim.recording.recorder import Knowledge, Recorder
from cosim.types import Bytes, Collision, Entry, Events, HumanError, Intervention, Overlap, Snapshot

FORMAT = "cosim-recording-1"
# float64, so that histories rebuilt from a recording equal the policy's bit for bit. float32 would be half as
# large (70 against 135 kB for 40 s of 30 vehicles), but turns headings near +-pi by a whole circle and
# changes target speeds.
REAL = ("x", "y", "heading", "speed", "accel", "length", "width", "lane_position")
WHOLE: dict[str, Any] = {"kind": pa.int8(), "mission": pa.bool_(), "lane": pa.int32(), "actor": pa.int8()}
EVENT_FIELDS: dict[str, Any] = {
    "collisions": Collision,
    "entries": Entry,
    "interventions": Intervention,
    "errors": HumanError,
    "overlaps": Overlap,
}
SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),  # index into the times of the file's metadata
        ("vehicle", pa.int32()),  # index into the ids of the file's metadata
        *WHOLE.items(),
        *((name, pa.float64()) for name in REAL),
        ("route", pa.int32()),  # index into the routes of the metadata; null without a deciding AV
        ("target_speed", pa.float64()),  # m/s; null while SUMO drives
        ("lane_changing", pa.int8()),
    ]
)


@dataclass(frozen=True)
class Recording:
    """One episode read back. Arrays [L] run over vehicles, then frames: see SCHEMA for units."""

    case: Mapping[str, Any]  # scenario, demand, behavior, policy, seed, ..., as passed to the recorder
    times: npt.NDArray[np.float64]  # [T] s
    ids: tuple[str, ...]  # sorted
    first: int  # frame at which the episode's clock is 0
    table: Mapping[str, npt.NDArray[Any]]  # column -> [L]
    routes: tuple[tuple[str, ...], ...]
    events: Mapping[int, Events]  # frame -> events, for frames with any
    signals: Bytes  # [T,s] the states of the signals, see `Snapshot.signals`

    def snapshots(self) -> list[Snapshot]:
        """Every frame, oldest first, vehicles sorted by id."""
        t, order = self.table, self._by_frame
        frame = t["frame"][order]
        cuts = np.searchsorted(frame, np.arange(len(self.times) + 1))
        frames = []
        names: tuple[str, ...] = ()
        before: npt.NDArray[np.int32] = np.zeros(0, np.int32)
        for k, time in enumerate(self.times):
            rows = order[cuts[k] : cuts[k + 1]]
            present = t["vehicle"][rows]
            numbers: dict[str, Any] = {name: t[name][rows].astype(np.float64) for name in REAL}
            if not np.array_equal(present, before):  # the same tuple while the set of vehicles is unchanged
                names, before = tuple([self.ids[i] for i in present]), present
            frames.append(
                Snapshot(
                    time=float(time),
                    ids=names,
                    kind=t["kind"][rows],
                    mission=t["mission"][rows],
                    lane=t["lane"][rows],
                    actor=t["actor"][rows],
                    signals=self.signals[k],
                    events=self.events.get(k, Events()),
                    **numbers,
                )
            )
        return frames

    def known(self) -> dict[int, dict[str, Knowledge]]:
        """Decision frame -> AV -> its knowledge besides the traffic."""
        t = self.table
        found: dict[int, dict[str, Knowledge]] = {}
        for row in self._by_frame[t["route"][self._by_frame] >= 0]:
            target = float(t["target_speed"][row])
            found.setdefault(int(t["frame"][row]), {})[self.ids[t["vehicle"][row]]] = Knowledge(
                self.routes[t["route"][row]],
                None if np.isnan(target) else target,
                int(t["lane_changing"][row]),
            )
        return found

    @cached_property
    def _by_frame(self) -> npt.NDArray[np.int64]:
        return np.lexsort((self.table["vehicle"], self.table["frame"]))


def write(path: Path, recorder: Recorder, case: Mapping[str, Any]) -> None:
    """Write the recorded episode to `path` atomically. Raises BadInput."""
    columns: dict[str, npt.NDArray[Any]]
    ids, frame, vehicle, columns = recorder.vehicles(*WHOLE, *REAL)
    empty = Knowledge((), float("nan"))  # of an AV without a decision
    known = [recorder.known.get(k, {}).get(ids[i]) for k, i in zip(frame, vehicle, strict=True)]
    routes = {r: k for k, r in enumerate(dict.fromkeys(a.route for a in known if a is not None))}
    columns |= {"frame": frame, "vehicle": vehicle}
    columns["route"] = np.array([-1 if a is None else routes[a.route] for a in known], np.int64)
    each = [a or empty for a in known]
    columns["target_speed"] = np.array([a.target_speed for a in each], np.float64)  # None is nan
    columns["lane_changing"] = np.array([a.lane_changing for a in each], np.int64)
    hidden = {"route": columns["route"] < 0, "target_speed": np.isnan(columns["target_speed"])}
    arrays = [
        pa.array(columns[field.name].astype(str(field.type)), field.type, mask=hidden.get(field.name))
        for field in SCHEMA
    ]
    frames = recorder.frames
    events = {str(k): asdict(s.events) for k, s in enumerate(frames) if any(asdict(s.events).values())}
    about = {
        "format": FORMAT,
        "case": dict(case),
        "times": [s.time for s in frames],
        "first": recorder.first,
        "ids": ids,
        "routes": list(routes),
        "events": events,
        # one byte per frame and signal, compressed: most states do not change
        "signals": base64.b64encode(zlib.compress(b"".join(s.signals.tobytes() for s in frames))).decode(),
    }
    table = pa.Table.from_arrays(arrays, schema=SCHEMA.with_metadata({"cosim": json.dumps(about)}))
    with cannot("write", file=path), whole(path) as draft:
        pq.write_table(
            table,
            draft,
            compression="zstd",
            use_dictionary=[n for n in SCHEMA.names if n not in REAL],
            use_byte_stream_split=list(REAL),
        )


def read(path: Path) -> Recording:
    """Read one episode. Raises BadInput when the file is not a recording."""
    try:
        with cannot("read", file=path):
            file = pq.ParquetFile(path)
            about = json.loads((file.schema_arrow.metadata or {}).get(b"cosim", b"null"))
            if not isinstance(about, dict) or about.get("format") != FORMAT:
                raise BadInput(f"not a recording of format {FORMAT}", file=path)
            return _recording(about, file.read().select(SCHEMA.names))
    except (pa.ArrowException, ValueError, KeyError) as error:
        raise BadInput(f"not a recording: {error}", file=path) from None


def _recording(about: Mapping[str, Any], table: pa.Table) -> Recording:
    fill = {"route": -1, "target_speed": float("nan")}
    states = zlib.decompress(base64.b64decode(about["signals"]))
    return Recording(
        case=about["case"],
        times=np.array(about["times"], np.float64),
        ids=tuple(about["ids"]),
        first=about["first"],
        table={
            name: (table[name].fill_null(fill[name]) if name in fill else table[name]).to_numpy()
            for name in table.column_names
        },
        routes=tuple(tuple(route) for route in about["routes"]),
        events={int(k): _events(e) for k, e in about["events"].items()},
        signals=np.frombuffer(states, np.uint8).reshape(len(about["times"]), -1),
    )


def _events(document: Mapping[str, Any]) -> Events:
    found = {name: _tuples(values) for name, values in document.items()}
    for name, kind in EVENT_FIELDS.items():
        made = ({field: _tuples(value) for field, value in one.items()} for one in found.get(name, ()))
        found[name] = tuple(kind(**one) for one in made)
    return Events(**found)


def _tuples(value: Any) -> Any:
    """JSON has lists only: convert them to tuples."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value

"""A session's answers as bytes for cosim's client: arrays as safetensors, the rest as JSON metadata.

Nothing is unpickled, so a server cannot run code in the client.
"""

from __future__ import annotations

import json
import math
import typing
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from cosim.envs.host import Reply
from cosim.errors import BadInput
from cosim.observation.view import Packed
from cosim.rewards import RewardTerms
from cosim.scenario.options import COLUMNS
from cosim.types import IDENTITY, Collision, Due, EpisodeResult, Events, HumanError, Metric, Receipt, Snapshot

MEDIA = "application/vnd.cosim.step"  # accepted by clients that want bytes
_DOCUMENT = "document"  # the key of the metadata
Arrays = Mapping[str, npt.NDArray[Any]]
_PACKED = tuple(name for name in Packed._fields if name not in ("avs", "newcomers", "ids"))
_EVENTS = typing.get_type_hints(Events)


def pack(arrays: Arrays, document: Mapping[str, Any]) -> bytes:
    """Arrays and a JSON document (infinities allowed) as bytes."""
    whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    return bytes(save_arrays(whole, {_DOCUMENT: json.dumps(document)}))


def unpack(data: bytes) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """The arrays and document of `pack`. Raises BadInput for anything else."""
    try:
        size = int.from_bytes(data[:8], "little")
        document = json.loads(json.loads(data[8 : 8 + size])["__metadata__"][_DOCUMENT])
        return load_arrays(data), document
    except Exception as error:
        raise BadInput(f"is not an answer of a cosim server: {error}") from None


def of_reply(reply: Reply) -> bytes:
    """The reply to one reset or act."""
    packed = reply.packed
    document = {
        "avs": packed.avs,
        "newcomers": packed.newcomers,
        "ids": packed.ids,
        "rewards": {av: [*terms] for av, terms in reply.rewards.items()},
        "ended": reply.ended,
        "receipts": [[*receipt] for receipt in reply.receipts],
        "events": asdict(reply.events),
        **{name: getattr(reply, name) for name in Reply._fields[5:]},
        "on_road": reply.avs,
    }
    return pack({name: getattr(packed, name) for name in _PACKED}, document | {"avs": packed.avs})


def to_reply(data: bytes) -> Reply:
    """The reply of `of_reply`."""
    arrays, found = unpack(data)
    packed = Packed(
        avs=tuple(found["avs"]),
        newcomers=tuple(found["newcomers"]),
        ids=tuple(map(tuple, found["ids"])),
        **{name: arrays[name] for name in _PACKED},
    )
    return Reply(
        packed,
        {av: RewardTerms(*terms) for av, terms in found["rewards"].items()},
        found["ended"],
        tuple(Receipt(*receipt) for receipt in found["receipts"]),
        to_events(found["events"]),
        tuple(found["on_road"]),
        *(found[name] for name in Reply._fields[6:]),
    )


def to_events(found: Mapping[str, Any]) -> Events:
    """Events from their JSON document."""
    values = {}
    for name, hint in _EVENTS.items():
        kind = typing.get_args(hint)[0]
        values[name] = tuple(
            kind(**{k: _tuples(v) for k, v in item.items()}) if isinstance(item, dict) else item
            for item in found[name]
        )
    return Events(**values)


def of_snapshot(snapshot: Snapshot) -> bytes:
    """A snapshot with all vehicles."""
    values = {f.name: getattr(snapshot, f.name) for f in fields(Snapshot)}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    names = ("time", "ids", "waiting")
    document = {name: values[name] for name in names} | {"events": asdict(snapshot.events)}
    return pack(arrays, document | {"limits": list(snapshot.limits.items())})


def to_snapshot(data: bytes) -> Snapshot:
    """The snapshot of `of_snapshot`."""
    arrays, found = unpack(data)
    waiting = found["waiting"] and {name: Due(*due) for name, due in found["waiting"].items()}
    about: dict[str, Any] = {"time": found["time"], "ids": tuple(found["ids"]), "waiting": waiting}
    about["limits"] = dict(found["limits"])
    return Snapshot(**about | arrays, events=to_events(found["events"]))


def to_result(document: Mapping[str, Any]) -> EpisodeResult:
    """The result from its `EpisodeResult.document`."""
    units, better = document["units"], document["better"]
    return EpisodeResult(
        **{name: document[name] for name in IDENTITY},
        steps=document["steps"],
        trace_hash=document["trace_hash"],
        metrics={name: Metric(document[name], units[name], better[name]) for name in units},
        collisions=tuple(Collision(**collision) for collision in document["collision_list"]),
        timings=document["timings"],
        validity=tuple(document["not_comparable_because"]),
        mission_vehicle=document["mission_vehicle"],
        mission_guessed=document["mission_guessed"],
        asked={name: document[name] for name in COLUMNS if name in document},
        interventions_by_reason=document["interventions_by_reason"],
        manifest=document["manifest"],
        errors_begun=tuple(
            HumanError(time, who, kind, math.nan, "") for kind, who, time in document["human_error_list"]
        ),
    )


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value

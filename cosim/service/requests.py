"""Requests of runs: the fields of `cosim evaluate`'s Spec, restricted to safe names, as its flags."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictInt, WithJsonSchema, create_model

import sumo_scenarios
from cosim.batch.spec import SEEDS
from cosim.errors import BadInput, hint
from cosim.policies import NAMES as POLICIES
from cosim.rewards import REWARDS
from cosim.scenario import sensing
from cosim.scenario.options import MEASURED, OPTIONS, Option
from cosim.scenario.sumo_outputs import OUTPUTS

MAX_LENGTH = 1000  # characters of a text, items of a list
_NAME = re.compile(r"[\w+-]+(\.[\w+-]+)*", re.ASCII)
_FILE = re.compile(r".*\.(ya?ml|json|xml|gz|py|safetensors|sumocfg)", re.IGNORECASE)
_LABEL = re.compile(r"(?:([\w.+-]+)=)?upload:([0-9a-f]{12})", re.ASCII)
Find = Callable[[str, str], Path]  # upload's id, required kind -> its file; raises BadInput
_ALLOWED: dict[str, Iterable[str]] = {  # only names, so that no code is read and SUMO writes no other file
    **{o.name: o.choices for o in OPTIONS.values() if o.choices},
    "reward": REWARDS,
    "output": OUTPUTS,
}
_ABOUT = {  # options for which HTTP accepts less than the command line
    "scenario": f"scenarios by name ({', '.join(sumo_scenarios.names())}, open/NAME), or upload:ID",
    "demand": "by name (free, dense, contested), or files of the upload; A,B is one demand of two files",
    "policy": f"by name ({', '.join(POLICIES)}), upload:ID or LABEL=upload:ID",
    "errors": "of human drivers: none (default), field or stress",
    "sensing": "of AVs: ideal (default), radar-camera, v2v or harsh; parameters behind it: v2v,delay=0.8",
    "reward": "reward function whose sums are reported",
    "metric": "refused: code is not accepted over HTTP",
}
EXAMPLE: dict[str, Any] = {
    "name": "two policies on the contested merge",
    "scenario": "merge",
    "demand": "contested",
    "policy": ["idm", "altruist-rule"],
    "svo": 45,
    "seeds": "200000:200010",
}


def _schema(option: Option, several: bool) -> dict[str, Any]:
    """JSON schema of an option, of `several` one value or a list; `cosim.batch.spec` checks the values."""
    one: dict[str, Any] = {"type": "string", "minLength": 1} if option.range is None else {"type": "number"}
    if option.name in _ALLOWED:
        one["enum"] = [*_ALLOWED[option.name]]
    other = {"type": "array", "items": one, "minItems": 1} if several else {"type": "null"}
    return {"anyOf": [one, other]}


def _field(option: Option, schema: dict[str, Any]) -> tuple[Any, Any]:
    about = _ABOUT.get(option.name, option.help)
    default = ... if option.name == "scenario" else None
    return Annotated[Any, WithJsonSchema(schema)], Field(default=default, description=about)


_SEEDS = {"type": "string", "pattern": r"^[0-9]{1,19}:[0-9]{1,19}$", "examples": [EXAMPLE["seeds"]]}
_fields: dict[str, Any] = {o.name: _field(o, _schema(o, o.axis or o.several)) for o in OPTIONS.values()} | {
    SEEDS: (
        Annotated[Any, WithJsonSchema(_SEEDS)],
        Field(default=None, description="a:b, the seeds a, a+1, ... b-1"),
    )
}


class _Base(BaseModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [EXAMPLE]})

    name: Annotated[str, Field(max_length=200, description="title in lists")] = ""


if TYPE_CHECKING:
    RunRequest = _Base
else:
    RunRequest = create_model("RunRequest", __base__=_Base, **_fields)
    RunRequest.__doc__ = "The matrix of a run: the fields of `cosim evaluate`, by the same names and rules."


# A session has one value of each axis, and its own fields for seed and reward.
_ONE: dict[str, Any] = {
    o.name: _field(o, _schema(o, False)["anyOf"][0]) for o in OPTIONS.values() if o.scope != MEASURED
}
SESSION_EXAMPLE: dict[str, Any] = {"scenario": "merge", "demand": "contested", "svo": 45, "policy": "idm"}


class _Session(BaseModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [SESSION_EXAMPLE]})

    seed: StrictInt | None = Field(None, ge=0, lt=2**62, description="of the first episode")
    reward: Literal[tuple(REWARDS)] = Field("p", description="reward function of AVs")  # type: ignore[valid-type]
    maps: StrictBool = Field(True, description="whether VelocityMaps are drawn")
    idle_s: float | None = Field(
        None, gt=0.0, le=1e6, allow_inf_nan=False, description="idle time after which the session ends"
    )


if TYPE_CHECKING:
    SessionRequest = _Session
else:
    SessionRequest = create_model("SessionRequest", __base__=_Session, **_ONE)
    SessionRequest.__doc__ = (
        "The scenario of a session; `policy` commands the AVs without a caller's command."
    )


def flags(
    request: BaseModel, find: Find, leave: Iterable[str] = ("name",)
) -> tuple[dict[str, Any], list[str]]:
    """The flags of `cosim.batch.spec.read`, with files only from uploads, and the uploads' ids.

    `leave`: fields of the request that are not flags.

    Raises BadInput: a path, code or a glob instead of a name; an unknown upload.
    """
    given = request.model_dump(exclude_unset=True)
    given = {name: value for name, value in given.items() if name not in leave}
    plain(given)
    uploads: list[str] = []
    found = {name: _axis(name, value, find, uploads) for name, value in given.items()}
    if "demand" in found:
        found["demand"] = _demand(found["demand"], found.get("scenario"), uploads)
    return found, list(dict.fromkeys(uploads))


def plain(value: object, field: str = "", depth: int = 0) -> None:
    """Raises BadInput for invalid JSON: NaN, oversized numbers, texts or lists, NUL in a text."""
    problem = ""
    if isinstance(value, Mapping):
        for name, item in value.items():
            plain(item, str(name) if not depth else field, depth + 1)
    elif isinstance(value, list):
        problem = "" if 0 < len(value) <= MAX_LENGTH else f"a list of 1 to {MAX_LENGTH} is needed"
        for item in value[:MAX_LENGTH]:
            plain(item, field, depth + 1)
    elif isinstance(value, str):
        if len(value) > MAX_LENGTH:
            problem = f"a text of at most {MAX_LENGTH} characters is accepted"
        elif not value.isprintable():
            problem = "contains characters that cannot be printed"
    elif isinstance(value, int | float) and not isinstance(value, bool):
        problem = "" if abs(value) < 2.0**63 and math.isfinite(value) else "is out of range"
    if depth > 4:
        problem = "is nested too deeply"
    if problem:
        raise BadInput(problem, field=field, value=None if isinstance(value, list) else repr(value)[:100])


def _axis(name: str, value: Any, find: Find, uploads: list[str]) -> Any:
    """The value of a field, with texts that are safe as flags."""
    if name == "metric" and value is not None:
        raise BadInput("code is not accepted over HTTP", field=name, value=value)
    if name in ("scenario", "policy"):
        items = value if isinstance(value, list) else [value]
        return [_named(name, item, find, uploads) for item in items]
    if name in _ALLOWED:
        for item in value if isinstance(value, list) else [value]:
            if item is not None and item not in (known := [*_ALLOWED[name]]):
                raise BadInput(f"unknown{hint(str(item), known)}", field=name, value=item)
    if name not in (SEEDS, "demand") and not OPTIONS[name].free:
        for item in value if isinstance(value, list) else [value]:
            text = sensing.base(item) if name == "sensing" and isinstance(item, str) else item
            if isinstance(text, str) and not _is_name(text):
                raise BadInput("a name is needed: no file or code is read", field=name, value=item)
    return value


def _is_name(text: str) -> bool:
    return _NAME.fullmatch(text) is not None and _FILE.fullmatch(text) is None


def _named(name: str, item: Any, find: Find, uploads: list[str]) -> str:
    """A scenario or a policy: its name, or the file of an upload."""
    known = POLICIES if name == "policy" else sumo_scenarios.shipped()
    if not isinstance(item, str):
        raise BadInput("text is needed", field=name, value=item)
    if item in known:
        return item
    upload = _LABEL.fullmatch(item)
    if upload and (name == "policy" or not upload[1]):
        uploads.append(upload[2])
        file = find(upload[2], name)
        return f"{upload[1] or file.stem}={file}" if name == "policy" else str(file)
    if not _is_name(item):
        problem = f"a shipped {name} or upload:ID is needed: no file or code is read"
        raise BadInput(problem, field=name, value=item)
    raise BadInput(f"no such {name}{hint(item, known)}", field=name, value=item)


def _demand(value: Any, scenario: Any, uploads: list[str]) -> list[str]:
    """Demands: names unchanged, files by their paths in the upload that is the only scenario."""
    found = []
    for item in value if isinstance(value, list) else [value]:
        if not isinstance(item, str):
            raise BadInput("text is needed", field="demand", value=item)
        parts = [part.strip() for part in item.split(",")]
        if all(map(_is_name, parts)):
            found.append(item)
            continue
        if not (scenario and len(scenario) == 1 and uploads and uploads[0] in scenario[0]):
            problem = "files are accepted only from an upload that is the only scenario"
            raise BadInput(problem, field="demand", value=item)
        folder = next(p for p in Path(scenario[0]).parents if p.name == uploads[0])
        files = []
        for part in parts:
            inside = {str(p.relative_to(folder)): p for p in folder.rglob("*") if p.is_file()}
            if part not in inside:
                raise BadInput(f"no such file in the upload{hint(part, inside)}", field="demand", value=part)
            files.append(str(inside[part]))
        found.append(",".join(files))
    return found

"""Sensing parameters of AVs: shipped levels, a user's file, single parameters."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml

import sumo_scenarios
from cosim.errors import BadInput, Range, hint, inside
from cosim.files import yaml_input
from cosim.files.xml_input import is_there
from cosim.files.yaml_input import NonNegative, Positive

IDEAL = "ideal"  # the default: every AV knows the present state of all road users
DIGITS = 8  # hexadecimal digits of a file's digest in its name
Share = Annotated[float, Range(0.0, high=1.0)]


@dataclass(frozen=True, slots=True)
class Parameters:
    """One level. The defaults are perfect sensors without latency, and no messages.

    Attributes:
        range: m, range of the AV's own sensors, from centre to centre.
        field_of_view: degrees about the AV's heading.
        line_of_sight: whether vehicles occlude what is behind them.
        buildings: type of polygons that occlude too, including subtypes (`building.house`).
        visible_share: share of an object's angular width that must be visible.
        position_noise: m, standard deviation of each coordinate.
        speed_noise: m/s, standard deviation.
        heading_noise: degrees, standard deviation.
        miss: probability that a visible object is not detected in one frame.
        latency: s from a measurement of own sensors until the tracker has it.
        cam: whether equipped vehicles send their own state (CAM).
        cpm: whether AVs send the detections of their own sensors (CPM).
        mcm: whether AVs send their intentions (MCM).
        equipped: share of human-driven vehicles that send CAMs; all AVs are equipped.
        message_range: m from sender to receiver.
        period: s between two messages of the same kind and sender.
        delay: s, minimum from a message's state until its reception.
        jitter: s, additional delay, mean of an exponential distribution.
        loss: share of the messages that a receiver loses (Gilbert-Elliott channel).
        burst: messages, mean length of a run of losses.
        cam_position_noise: m, standard deviation of each coordinate in a CAM.
        cam_speed_noise: m/s, standard deviation of the speed in a CAM.
        cam_heading_noise: degrees, standard deviation of the heading in a CAM.
        confirm: detections by own sensors before a track is confirmed; one message suffices.
        forget: s without a measurement after which a track ends.
        decision_latency: s from a decision until its commands act, at most until the next decision.
        compensation: prediction of states from measurement time to the present: none (hold), constant
            velocity (cv), constant speed along lanes (lanes), along lanes with the speed predicted by the
            shipped Gaussian process (gp), by the shipped HPN's kinematic branch (hpn), or the true present
            state (truth).
    """

    range: Positive = 1000.0
    field_of_view: Annotated[float, Range(0.0, above=True, high=360.0)] = 360.0
    line_of_sight: bool = False
    buildings: str = "building"
    visible_share: Share = 0.3
    position_noise: NonNegative = 0.0
    speed_noise: NonNegative = 0.0
    heading_noise: NonNegative = 0.0
    miss: Share = 0.0
    latency: NonNegative = 0.0
    cam: bool = False
    cpm: bool = False
    mcm: bool = False
    equipped: Share = 0.0
    message_range: Positive = 300.0
    period: Positive = 0.2
    delay: NonNegative = 0.0
    jitter: NonNegative = 0.0
    loss: Annotated[float, Range(0.0, high=0.99)] = 0.0
    burst: Annotated[float, Range(1.0)] = 1.0
    cam_position_noise: NonNegative = 0.0
    cam_speed_noise: NonNegative = 0.0
    cam_heading_noise: NonNegative = 0.0
    confirm: int = 1
    forget: Positive = 1.0
    decision_latency: NonNegative = 0.0
    compensation: Literal["hold", "cv", "lanes", "gp", "hpn", "truth"] = "hold"

    def __post_init__(self) -> None:
        if self.confirm < 1:
            raise BadInput("must be at least 1", field="confirm", value=self.confirm)
        least = 1.0 / (1.0 - self.loss)  # messages, mean run length of independent losses
        if self.loss and self.burst < least - 1e-9:
            problem = f"must be at least {least:.3g} where {self.loss:g} of the messages are lost"
            raise BadInput(problem, field="burst", value=self.burst)


NAMES = tuple(field.name for field in fields(Parameters))


@dataclass(frozen=True, slots=True)
class Sensing:
    """A shipped level or a user's file, with changed parameters."""

    name: str  # `v2v`; `mine-1a2b3c4d` for mine.yaml; `v2v,delay=0.8` with a changed parameter
    digest: str  # SHA-256 of the parameters
    parameters: Parameters
    file: Path


def read(what: str | None, field: str = "--sensing", file: object = None) -> Sensing | None:
    """The sensing of `LEVEL|FILE[,PARAMETER=VALUE...]`; None: ideal.

    `field`, `file`: origin of `what`, for errors. Raises BadInput naming file, field and value.
    """
    if what is None or what == IDEAL:
        return None
    base, changed = _split(what, field, file)
    shipped = levels()
    path, name = Path(base), base
    if base == IDEAL:
        found, path = Parameters(), sumo_scenarios.SENSING
    elif base in shipped:
        found, path = shipped[base], sumo_scenarios.SENSING
    elif is_there(path):
        found = yaml_input.read(path, Parameters)
        name = f"{path.stem}-{_digest(found)[:DIGITS]}"
    else:
        problem = f"no such level{hint(base, (IDEAL, *shipped))}, and no such file"
        raise BadInput(problem, file=file, field=field, value=base)
    parameters = _changed(found, changed, field, file)
    if parameters == Parameters() and base == IDEAL:
        return None
    text = ",".join((name, *_differences(found, parameters)))
    return Sensing(text, _digest(parameters), parameters, path.absolute())


def asked(what: str, folder: Path = Path(), field: str = "--sensing", file: object = None) -> str | None:
    """`what` in canonical form: a file's absolute path (relative paths start at `folder`), sorted parameters
    without those that change nothing. None: ideal. Raises BadInput."""
    base, changed = _split(what, field, file)
    path = os.path.abspath(folder / base)
    place = path if base not in (IDEAL, *levels()) and is_there(Path(path)) else base
    found = read(",".join((place, *(f"{k}={v}" for k, v in changed.items()))), field, file)
    return None if found is None else ",".join((place, *found.name.split(",")[1:]))


@lru_cache
def levels() -> dict[str, Parameters]:
    """The shipped levels by name. Raises BadInput."""
    file = sumo_scenarios.SENSING
    tables = yaml_input.document(file)
    return {name: yaml_input.dataclass_from(Parameters, table, file, name) for name, table in tables.items()}


def base(what: str) -> str:
    """The level or file of `LEVEL|FILE[,PARAMETER=VALUE...]`."""
    return what.partition(",")[0].strip()


def _split(what: str, field: str, file: object) -> tuple[str, dict[str, str]]:
    base, *words = what.split(",")
    changed = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise BadInput("PARAMETER=VALUE is needed", file=file, field=field, value=word)
        changed[name.strip()] = value.strip()
    return base.strip(), changed


def _changed(found: Parameters, changed: Mapping[str, str], field: str, file: object) -> Parameters:
    with inside(field, file):
        yaml_input.check_known(changed, NAMES)
        try:
            values = {name: yaml.safe_load(text) for name, text in changed.items()}
        except yaml.YAMLError:
            raise BadInput("is no number, true, false or word", value=",".join(changed.values())) from None
        checked = yaml_input.dataclass_from(Parameters, asdict(found) | values, None)
        return replace(found, **{name: getattr(checked, name) for name in changed})


def _differences(base: Parameters, parameters: Parameters) -> list[str]:
    """`delay=0.8` of every parameter that differs, sorted."""
    pairs = [(name, getattr(parameters, name)) for name in sorted(NAMES)]
    return [f"{name}={_text(value)}" for name, value in pairs if value != getattr(base, name)]


def _text(value: Any) -> str:
    return (
        str(value).lower()
        if isinstance(value, bool)
        else f"{value:g}"
        if isinstance(value, float)
        else str(value)
    )


def _digest(parameters: Parameters) -> str:
    return hashlib.sha256(json.dumps(asdict(parameters), sort_keys=True).encode()).hexdigest()

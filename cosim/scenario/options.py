"""The options of an episode, defined once as the fields of `EpisodeOptions`.

Command-line flags, fields of SPEC.yaml and of HTTP requests, arguments of `cosim.open`, the episode's key and
the columns of its row are derived from these fields.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import sumo_scenarios
from cosim.errors import BadInput, Range, check_pattern, inside, one_of
from cosim.files import code
from cosim.files.xml_input import is_there
from cosim.files.yaml_input import NonNegative, Positive, check_known, dataclass_from, mapping, value_of
from cosim.scenario import human_errors, policy_name
from cosim.scenario import sensing as sensing_levels
from cosim.scenario.behaviors import DRIVER_MODELS, LC2013, load_behaviors
from cosim.seeding import FIRST_EXAMPLE_SEED
from cosim.types import IDENTITY, OnCollision, Preset, Traffic

if TYPE_CHECKING:
    from cosim.scenario import Scenario

BEHAVIORS = load_behaviors().names
FLEET = ("av_type", "av_ids", "penetration")  # mutually exclusive ways to choose the AVs
Share = Annotated[float, Range(0.0, high=1.0)]
KEY_LENGTH = 12  # hexadecimal digits: 48 bits, collision probability 2e-7 among 10,000 cells
# Fields in every key. Keys contain other fields only if set, so that older keys stay valid.
IN_EVERY_KEY = (
    *("what", "policy", "seed", "demand", "behavior", "driver_model", "svo_deg", "preset", "duration"),
    *(*FLEET, "outputs"),
)
TRAFFIC, DRIVING, MEASURED = "traffic", "driving", "measured"  # what an option affects
# Converts a user's text to the field's value; arguments: text, folder of relative paths, field, file.
Reader = Callable[[str, Path, str, object], str | None]


@dataclass(frozen=True, slots=True)
class Fleet:
    """Selects the AVs: by vehicle type, by id, or as a share of all vehicles (the first non-empty rule)."""

    type: str | None = None
    ids: str | None = None  # regular expression, full match
    penetration: Share | None = None  # drawn per vehicle id from the seed

    @property
    def may_have_avs(self) -> bool:
        return self.type is not None or self.ids is not None or bool(self.penetration)

    @property
    def words(self) -> dict[str, Any]:
        """The options that select this fleet."""
        values = dict(zip(FLEET, (self.type, self.ids, self.penetration), strict=True))
        return {name: value for name, value in values.items() if value is not None}

    def describe(self) -> str:
        if self.type is not None:
            return f"type {self.type}"
        if self.ids is not None:
            return f"ids {self.ids}"
        return f"penetration {self.penetration:g}" if self.penetration is not None else "none"


@dataclass(frozen=True, slots=True)
class Option:
    """Metadata of one field of `EpisodeOptions`."""

    help: str
    name: str = ""  # for users; "": the field's own name
    metavar: str | None = None
    choices: Sequence[str] = ()
    scope: str = DRIVING
    axis: bool = False  # several values are possible in a matrix
    free: bool = False  # a text that never names a file
    reader: Reader | None = None
    field: str = ""
    kind: Any = None
    default: Any = None

    @property
    def flag(self) -> str:
        """The command-line flag."""
        return "--" + self.name.replace("_", "-")

    @property
    def several(self) -> bool:
        """Whether one episode has a list of values."""
        return typing.get_origin(self.kind) is tuple

    @property
    def item(self) -> Any:
        """The type of one value: `str`, or a number with its `Range`."""
        parts = typing.get_args(self.kind)  # () for `str`, (str, ...) for a tuple, (X, None) for an optional
        return self.kind if typing.get_origin(self.kind) is Annotated or not parts else parts[0]

    @property
    def range(self) -> Range | None:
        """The bounds of a number."""
        return next((part for part in typing.get_args(self.item) if isinstance(part, Range)), None)

    def checked(self, value: object, file: object = None, name: str = "") -> Any:
        """`value` as the field's kind. Raises BadInput naming the option, or `name`, and the `file`."""
        with inside(name or self.name, file):
            found = value_of(self.kind, value)
            for word in (found if self.several else (found,)) if self.choices else ():
                one_of(word, self.choices, "")
            return found

    def read(self, value: Any, folder: Path, name: str, file: object = None) -> Any:
        """The field's value from a user's `value` for `name`; paths are relative to `folder`."""
        found = self.checked(value, file, name)
        if self.reader is not None:
            texts = [self.reader(text, folder, name, file) for text in (found if self.several else (found,))]
            found = tuple(texts) if self.several else texts[0]
        return tuple(dict.fromkeys(found)) if self.several else found


def place(what: str, folder: Path = Path()) -> str:
    """`what` independent of the working directory: the absolute path of a file or folder, or a name."""
    is_path = not sumo_scenarios.ships(what) and is_there(folder / what)
    return os.path.abspath(folder / what) if is_path else what


def option(default: Any, about: str, **how: Any) -> Any:
    """A field of `EpisodeOptions` with its `Option`."""
    return field(default=default, metadata={"option": Option(about, **how)})


@dataclass(frozen=True)
class EpisodeOptions:
    """One requested episode. Files are absolute paths; None: the scenario decides.

    The order of the fields is that of a matrix's cells. Episodes that differ only in the seed form one
    `cell`.

    Raises:
        BadInput: a value of another type, out of its bounds, or none of the choices; two fleets.
    """

    what: str = option(
        dataclasses.MISSING,
        "a scenario's name (`cosim scenarios`), its folder, or a .sumocfg",
        name="scenario",
        metavar="NAME|FILE",
        scope=TRAFFIC,
        axis=True,
        reader=lambda text, folder, *_: place(text, folder),
    )
    _: dataclasses.KW_ONLY
    demand: tuple[str, ...] = option(
        (),
        "a demand by its name, or route files driven together (default: the scenario's)",
        metavar="NAME|FILE",
        scope=TRAFFIC,
        axis=True,
        reader=lambda text, folder, *_: place(text, folder) if "." in text or "/" in text else text,
    )
    behavior: str | None = option(
        None,
        "Table II class of the human drivers (default: mixed; contested: moderate; your files: as-is)",
        choices=BEHAVIORS,
        scope=TRAFFIC,
        axis=True,
    )
    driver_model: str = option(
        LC2013,
        f"of the human drivers (default: {LC2013})",
        choices=DRIVER_MODELS,
        scope=TRAFFIC,
        axis=True,
    )
    penetration: Share | None = option(None, "this share of vehicles are AVs, 0 to 1", metavar="P", axis=True)
    preset: str | None = option(
        None, "safety checks on the AVs (default: the scenario's)", choices=Preset.ALL, axis=True
    )
    errors: str | None = option(
        None,
        "of human drivers: none (default), field, stress, or a YAML file (docs/explanation/driver_errors.md)",
        metavar="LEVEL|FILE",
        scope=TRAFFIC,
        axis=True,
        reader=human_errors.asked,
    )
    sensing: str | None = option(
        None,
        "of AVs: ideal (default), radar-camera, v2v, harsh, or a YAML file; single parameters behind it: "
        "v2v,delay=0.8 (docs/reference/sensing.md)",
        metavar="LEVEL|FILE",
        axis=True,
        reader=sensing_levels.asked,
    )
    policy: str = option(
        "idm",
        "which policy drives the AVs (default: idm): a name; RUN or FILE.safetensors of cosim train; "
        "FILE.py:NAME or MODULE:NAME, your own (docs/guides/extending.md). LABEL= before a file names it in "
        "tables",
        metavar="POLICY",
        axis=True,
        reader=lambda *written: policy_name.read(*written).text,
    )
    svo_deg: Annotated[float, Range(0.0, high=90.0)] = option(
        45.0, "SVO angle in degrees, 0 to 90 (default: 45)", name="svo", metavar="DEG", axis=True
    )
    av_type: str | None = option(None, "AVs are the vehicles of this vType", metavar="T", free=True)
    av_ids: str | None = option(
        None,
        "AVs are the vehicles whose id matches",
        metavar="REGEX",
        free=True,
        reader=lambda text, _, *where: check_pattern(text, *where),
    )
    duration: Positive | None = option(None, "counted s per episode (default: the scenario's)", metavar="S")
    warmup: NonNegative | None = option(
        None,
        "s driven before the counted time begins (default: the scenario's; your files: 0)",
        metavar="S",
    )
    mission: str | None = option(
        None,
        "the mission vehicle: its id, a pattern of ids, none, or auto: guessed, and out of gates "
        "(default: the scenario's; your files: auto)",
        metavar="ID|none|auto",
        free=True,
    )
    on_collision: str | None = option(
        None,
        "of an AV or the mission vehicle (default: scenarios end, your own .sumocfg continue)",
        choices=OnCollision.ALL,
    )
    traffic: str | None = option(
        None,
        "SUMO options of your own .sumocfg: as-is, or controlled, as AVs need them (default: as-is where "
        "cosim drives no vehicle; in a batch, in any cell)",
        choices=Traffic.ALL,
        scope=TRAFFIC,
    )
    reward: str | None = option(
        None,
        "report what AVs earn by it: p, t, or your own",
        metavar="NAME|FILE:NAME",
        scope=MEASURED,
        reader=code.absolute,
    )
    outputs: tuple[str, ...] = option(
        (),
        "have SUMO write its NAME output (tripinfo, fcd, ssm, ...) to DIR/outputs; repeatable",
        name="output",
        metavar="NAME",
        scope=MEASURED,
    )
    metrics: tuple[str, ...] = option(
        (),
        "measure this besides (FILE.py:NAME, MODULE:NAME); repeatable",
        name="metric",
        metavar="FILE:NAME",
        scope=MEASURED,
        reader=code.absolute,
    )
    tilt: str | None = None  # of the errors (`cosim.scenario.tilt`), set by `cosim estimate`
    seed: int = FIRST_EXAMPLE_SEED

    def __post_init__(self) -> None:
        for one in OPTIONS.values():
            if (value := getattr(self, one.field)) is not one.default:
                object.__setattr__(self, one.field, one.checked(value))
        given = [name for name in FLEET if getattr(self, name) is not None]
        if len(given) > 1:
            problem = f"excludes {given[1]}: give one of them"
            raise BadInput(problem, field=given[0], value=getattr(self, given[0]))
        if self.seed < 0:
            raise BadInput("must be a whole number from 0 on", field="seed", value=self.seed)

    @classmethod
    def of(cls, what: str, words: Mapping[str, Any]) -> EpisodeOptions:
        """The episode of `what` with options by name, as in `cosim.open`. Raises BadInput."""
        check_known(words, WORDS)
        return cls(what, **{WORDS[name].field: value for name, value in words.items()})

    @classmethod
    def read(cls, document: object, file: Path | None = None, where: str = "case") -> EpisodeOptions:
        """The episode of a `document()`, at `where` in `file`.

        Raises BadInput: a field is missing, of another type, or out of its bounds.
        """
        with inside(where, file):
            given = mapping(document)
            for name in ("policy", "seed"):  # required: no defaults in a document
                if given.get(name) is None:
                    raise BadInput("is missing", field=name)
        known = {one.name: given[one.name] for one in fields(cls) if given.get(one.name) is not None}
        return dataclass_from(cls, known, file, where)

    @property
    def fleet(self) -> Fleet | None:
        """The requested fleet; None: the scenario's own."""
        fleet = Fleet(self.av_type, self.av_ids, self.penetration)
        return fleet if fleet.words else None

    @property
    def columns(self) -> dict[str, Any]:
        """Row columns of the set options that are not in `Identity`."""
        return {n: v for n, o in COLUMNS.items() if (v := getattr(self, o.field)) != o.default}

    @cached_property
    def cell(self) -> str:
        """A short stable hash of all options but the seed."""
        return hashlib.sha256(self.text().encode()).hexdigest()[:KEY_LENGTH]

    @property
    def key(self) -> str:
        """The name of the episode, unique in a matrix."""
        return f"{self.cell}-{self.seed}"

    def text(self) -> str:
        """All options but the seed as one line of canonical JSON."""
        settings = self.document()
        del settings["seed"]
        return json.dumps(settings, sort_keys=True)

    def document(self) -> dict[str, Any]:
        """Plain JSON values; `EpisodeOptions.read` is the inverse."""
        defaults = {one.name: one.default for one in fields(self)}
        given = {k: v for k, v in asdict(self).items() if k in IN_EVERY_KEY or v != defaults[k]}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in given.items()}

    def with_seed(self, seed: int) -> EpisodeOptions:
        """Another episode of the same cell."""
        return replace(self, seed=seed)

    def scenario(self, options: Sequence[str] = ()) -> Scenario:
        """The requested scenario, with SUMO `options` as typed after `--`; not vetted.

        Raises:
            BadInput: see `cosim.scenario.load`.
        """
        from cosim.scenario import load

        return load(self, options=options)


def _options() -> Iterable[Option]:
    kinds = typing.get_type_hints(EpisodeOptions, include_extras=True)
    for one in fields(EpisodeOptions):
        if about := one.metadata.get("option"):
            name = about.name or one.name
            yield replace(about, name=name, field=one.name, kind=kinds[one.name], default=one.default)


OPTIONS = {one.name: one for one in _options()}  # by users' names
# Keyword options of `load` and `cosim.open`; the other options have parameters of their own.
WORDS = {n: o for n, o in OPTIONS.items() if o.scope != MEASURED and n not in ("scenario", "policy")}
# Row columns that exist only for set options, since `Identity` lacks them.
COLUMNS = {n: o for n, o in WORDS.items() if not {n, o.field} & {*IDENTITY}}


def of_flags(flags: Mapping[str, Any]) -> EpisodeOptions:
    """One episode from the command line; `flags` by option name, None: not given.

    Raises BadInput.
    """
    given = [(one, flags[name]) for name, one in OPTIONS.items() if flags.get(name) is not None]
    return EpisodeOptions(**{one.field: one.read(value, Path(), one.flag) for one, value in given})

"""The vehicle types of a scenario's files, written once more for every driver that replaces their own.

SUMO's car-following model belongs to the type, so that nothing but another type changes it while a vehicle
drives. A type that is made at run time knows only what SUMO's calls can set: no capacities, no parking, no
parameters. So each type is written again before SUMO starts, all attributes and parameters its own but for
the driver's, and lists of types (rerouters, detectors, signals, ...) name it beside the original
(`cosim.scenario.disabled_outputs`).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

from cosim.files.xml_input import scan
from cosim.scenario import Scenario
from cosim.scenario.vet import DEFAULT_TYPES
from cosim.scenario.vet_rules import words

# What describes a driver, not a vehicle: of a family all attributes are replaced, or none.
_FAMILIES = {
    "lc": "lane changes",
    "jm": "junctions",
    **dict.fromkeys(
        words(
            "carFollowModel actionStepLength tau minGap accel decel emergencyDecel apparentDecel sigma delta "
            "stepping startupDelay collisionMinGapFactor maxAccelProfile desAccelProfile"
        ),
        "car following",
    ),
    "laneChangeModel": "lane changes",
}
_FILES = ("imgFile", "osgFile")  # attributes that name a file, relative to their own
_MODEL = "carFollowing-"  # the children of a vType that describe its driver


# Who heeds vehicles of some types only, and the attribute that lists these; of signals it is a parameter.
TYPE_LISTS: Mapping[str, str] = dict.fromkeys(
    words(
        "rerouter calibrator routeProbe edgeData laneData inductionLoop e1Detector instantInductionLoop "
        "laneAreaDetector e2Detector entryExitDetector e3Detector"
    ),
    "vTypes",
)
# Who changes speed limits, and the attributes that say where.
_LIMITS = {"variableSpeedSign": ("lanes", "edges"), "calibrator": ("lane", "edge")}
_DRIVERS = words("vehicle trip flow")
DEFAULT_TYPE = "DEFAULT_VEHTYPE"  # of a vehicle that names none


@dataclass(frozen=True, slots=True)
class WrittenType:
    """A vType as its file has it."""

    file: Path
    attributes: dict[str, str]
    children: list[tuple[str, dict[str, str]]] = field(default_factory=list)  # such as parameters


@dataclass(frozen=True, slots=True)
class Driver:
    """A driver who replaces that of a type; such a type's name is `prefix` + the type's own + `suffix`.

    `attributes` are the driver's, by SUMO's names; none: as the type's own, of SUMO's own types `fallback`.
    `types`: whose; None: all.
    """

    prefix: str
    suffix: str
    attributes: Mapping[str, str]
    types: frozenset[str] | None = None
    fallback: Mapping[str, str] = field(default_factory=dict)

    def of(self, own: str) -> str:
        """The name of type `own` with this driver."""
        return f"{self.prefix}{own}{self.suffix}"

    def replaces(self, attribute: str) -> bool:
        """Whether an attribute of a type is replaced, or dropped."""
        family = _family(attribute)
        return attribute in self.attributes or (family != "" and family in map(_family, self.attributes))


@dataclass(frozen=True, slots=True)
class VehicleTypes:
    """All types of a scenario's files, and those of SUMO's own that they use."""

    types: Mapping[str, WrittenType]
    distributions: Mapping[str, Sequence[str]]  # of types -> the types
    listed: frozenset[str]  # what rerouters, detectors and the like are for
    variable: frozenset[str]  # lanes and edges whose speed limit may change while SUMO drives

    def named(self, name: str) -> frozenset[str]:
        """The types that `name` means: the members of a distribution, or the type itself."""
        return frozenset(self.distributions.get(name, (name,)))

    def write(self, file: Path, drivers: Sequence[Driver]) -> None:
        """An additional file: every type with each of these drivers."""
        written = (
            _written(name, kind, who)
            for who in drivers
            for name, kind in self.types.items()
            if who.types is None or name in who.types
        )
        file.write_text("\n".join(("<additional>", *written, "</additional>", "")), encoding="utf-8")

    def also(self, name: str, drivers: Iterable[Driver]) -> Iterator[str]:
        """Where a list of types names `name`: what such vehicles with these drivers are called."""
        return (
            who.of(own)
            for who in drivers
            for own in sorted(self.named(name))
            if who.types is None or own in who.types
        )


def vehicle_types(scenario: Scenario) -> VehicleTypes:
    """The types of a scenario's files. Raises BadInput: see `cosim.files.xml_input.scan`."""
    return read_types((*scenario.additional, *scenario.demand))


def read_types(files: Iterable[Path]) -> VehicleTypes:
    """The types of these files and of those that they include. Raises BadInput: see `vehicle_types`."""
    reader, waiting = _Reader(), list(files)
    while waiting:
        waiting += reader.read(waiting.pop(0))
    defaults = {
        name: WrittenType(Path(), {"vClass": DEFAULT_TYPES[name]}) for name in sorted(reader.defaults)
    }
    return VehicleTypes(
        defaults | reader.types, reader.distributions, frozenset(reader.listed), frozenset(reader.variable)
    )


class _Reader:
    """What the files read so far say of types."""

    def __init__(self) -> None:
        self.types: dict[str, WrittenType] = {}
        self.distributions: dict[str, list[str]] = {}
        self.defaults: set[str] = set()  # of SUMO's own types, those that are used
        self.listed: set[str] = set()
        self.variable: set[str] = set()
        self._read: set[Path] = set()

    def read(self, path: Path) -> list[Path]:
        """One file; the files that it includes."""
        if path in self._read:
            return []
        self._read.add(path)
        owners: list[tuple[str, str]] = []  # tag and id of every open element
        includes: list[Path] = []

        def start(tag: str, attributes: dict[str, str], _: int) -> None:
            owner, of = owners[-1] if owners else ("", "")
            name = attributes.get("id", attributes.get("refId", ""))
            owners.append((tag, name))
            if tag in _DRIVERS:
                kind = attributes.get("type", DEFAULT_TYPE)
                if kind in DEFAULT_TYPES:
                    self.defaults.add(kind)
            elif tag == "vType":
                if "id" in attributes:
                    self.types[name] = WrittenType(path, attributes)
                if owner == "vTypeDistribution":
                    self.distributions[of].append(name)
            elif owner == "vType" and of in self.types:
                self.types[of].children.append((tag, attributes))
            elif tag == "vTypeDistribution":
                self.distributions[name] = attributes.get("vTypes", "").split()
            elif tag == "include":
                includes.append(path.parent / attributes.get("href", ""))
            if tag in TYPE_LISTS:
                self.listed.update(attributes.get(TYPE_LISTS[tag], "").split())
            for where in _LIMITS.get(tag, ()):
                self.variable.update(attributes.get(where, "").split())

        def end(_: str) -> None:
            owners.pop()

        scan(path, (), start, end)
        return includes


def describes_driver(attribute: str) -> bool:
    """Whether an attribute of a type says how its driver drives."""
    return _family(attribute) != ""


def _family(attribute: str) -> str:
    return _FAMILIES.get(attribute) or _FAMILIES.get(attribute[:2], "")


def _written(name: str, kind: WrittenType, who: Driver) -> str:
    own = {key: value for key, value in kind.attributes.items() if not who.replaces(key)}
    files = {key: str((kind.file.parent / own[key]).absolute()) for key in _FILES if own.get(key)}
    children = [
        f"<{tag}{_attributes(values)}/>"
        for tag, values in kind.children
        if not (who.attributes and tag.startswith(_MODEL))
    ]
    sumos_own = "id" not in kind.attributes
    driver = who.attributes or (who.fallback if sumos_own else {})
    attributes = {**own, **files, **driver, "id": who.of(name)}
    return f"<vType{_attributes(attributes)}>{''.join(children)}</vType>"


def _attributes(values: Mapping[str, str]) -> str:
    return "".join(f" {name}={quoteattr(value)}" for name, value in values.items())

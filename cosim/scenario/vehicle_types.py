"""Derived vTypes: the vehicle types of a scenario's files, written again with other drivers.

In SUMO the car-following model belongs to the vType, so only another vType changes it at run time. A vType
made at run time has only attributes that TraCI can set: no capacities, no parking, no parameters. So each
vType is written again before SUMO starts, with all its attributes and parameters except the driver's. Lists
of vTypes (rerouters, detectors, signals, ...) name it beside the original
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

# Attributes that describe the driver, by family; either all attributes of a family are replaced, or none.
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
_FILES = ("imgFile", "osgFile")  # attributes that name a file, relative to the defining file
_MODEL = "carFollowing-"  # prefix of the children of a vType that describe its driver


# Elements restricted to some vTypes, and the attribute that lists these; signals have a parameter instead.
TYPE_LISTS: Mapping[str, str] = dict.fromkeys(
    words(
        "rerouter calibrator routeProbe edgeData laneData inductionLoop e1Detector instantInductionLoop "
        "laneAreaDetector e2Detector entryExitDetector e3Detector"
    ),
    "vTypes",
)
# Elements that change speed limits, and the attributes with the edges or lanes.
_LIMITS = {"variableSpeedSign": ("lanes", "edges"), "calibrator": ("lane", "edge")}
_DRIVERS = words("vehicle trip flow")
DEFAULT_TYPE = "DEFAULT_VEHTYPE"  # of a vehicle without a type


@dataclass(frozen=True, slots=True)
class WrittenType:
    """A vType as written in its file."""

    file: Path
    attributes: dict[str, str]
    children: list[tuple[str, dict[str, str]]] = field(default_factory=list)  # such as parameters


@dataclass(frozen=True, slots=True)
class Driver:
    """A driver that replaces that of a vType; the derived vType is named `prefix` + own name + `suffix`.

    `attributes`: the driver's, by SUMO's names; if empty, the vType's own, or `fallback` for SUMO's default
    vTypes. `types`: the vTypes concerned; None: all.
    """

    prefix: str
    suffix: str
    attributes: Mapping[str, str]
    types: frozenset[str] | None = None
    fallback: Mapping[str, str] = field(default_factory=dict)

    def of(self, own: str) -> str:
        """The name of vType `own` with this driver."""
        return f"{self.prefix}{own}{self.suffix}"

    def replaces(self, attribute: str) -> bool:
        """Whether an attribute of a vType is replaced or dropped."""
        family = _family(attribute)
        return attribute in self.attributes or (family != "" and family in map(_family, self.attributes))


@dataclass(frozen=True, slots=True)
class VehicleTypes:
    """All vTypes of a scenario's files, and the SUMO default types in use."""

    types: Mapping[str, WrittenType]
    distributions: Mapping[str, Sequence[str]]  # vTypeDistribution -> its vTypes
    listed: frozenset[str]  # vTypes to which rerouters, detectors and the like are restricted
    variable: frozenset[str]  # lanes and edges with a variable speed limit

    def named(self, name: str) -> frozenset[str]:
        """The vTypes of `name`: the members of a distribution, or the vType itself."""
        return frozenset(self.distributions.get(name, (name,)))

    def write(self, file: Path, drivers: Sequence[Driver]) -> None:
        """Write an additional file: every vType with each of these drivers."""
        written = (
            _written(name, kind, driver)
            for driver in drivers
            for name, kind in self.types.items()
            if driver.types is None or name in driver.types
        )
        file.write_text("\n".join(("<additional>", *written, "</additional>", "")), encoding="utf-8")

    def also(self, name: str, drivers: Iterable[Driver]) -> Iterator[str]:
        """The derived vTypes of `name` with these drivers, for lists of vTypes."""
        return (
            driver.of(own)
            for driver in drivers
            for own in sorted(self.named(name))
            if driver.types is None or own in driver.types
        )


def vehicle_types(scenario: Scenario) -> VehicleTypes:
    """The vTypes of a scenario's files. Raises BadInput: see `cosim.files.xml_input.scan`."""
    return read_types((*scenario.additional, *scenario.demand))


def read_types(files: Iterable[Path]) -> VehicleTypes:
    """The vTypes of these files and their includes. Raises BadInput: see `vehicle_types`."""
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
    """Collects the vTypes of several files."""

    def __init__(self) -> None:
        self.types: dict[str, WrittenType] = {}
        self.distributions: dict[str, list[str]] = {}
        self.defaults: set[str] = set()  # SUMO's default types in use
        self.listed: set[str] = set()
        self.variable: set[str] = set()
        self._read: set[Path] = set()

    def read(self, path: Path) -> list[Path]:
        """Read one file; return its includes."""
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
    """Whether an attribute of a vType describes its driver."""
    return _family(attribute) != ""


def _family(attribute: str) -> str:
    return _FAMILIES.get(attribute) or _FAMILIES.get(attribute[:2], "")


def _written(name: str, kind: WrittenType, driver: Driver) -> str:
    own = {key: value for key, value in kind.attributes.items() if not driver.replaces(key)}
    files = {key: str((kind.file.parent / own[key]).absolute()) for key in _FILES if own.get(key)}
    children = [
        f"<{tag}{_attributes(values)}/>"
        for tag, values in kind.children
        if not (driver.attributes and tag.startswith(_MODEL))
    ]
    sumos_own = "id" not in kind.attributes
    changed = driver.attributes or (driver.fallback if sumos_own else {})
    attributes = {**own, **files, **changed, "id": driver.of(name)}
    return f"<vType{_attributes(attributes)}>{''.join(children)}</vType>"


def _attributes(values: Mapping[str, str]) -> str:
    return "".join(f" {name}={quoteattr(value)}" for name, value in values.items())

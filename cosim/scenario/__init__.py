"""What to simulate: a world by name or by its folder, or any user's .sumocfg, read into one `Scenario`."""

import math
import os
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import sumo_scenarios
from cosim.errors import BadInput, check_pattern, hint, one_of
from cosim.files import yaml_input
from cosim.files.xml_input import is_there, regular_file
from cosim.files.yaml_input import NonNegative, Positive
from cosim.scenario import human_errors, sensing, sumocfg, tilt
from cosim.scenario.behaviors import AS_IS, LC2013, MIXED
from cosim.scenario.human_errors import Errors
from cosim.scenario.options import BEHAVIORS as BEHAVIORS
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.options import Fleet as Fleet
from cosim.scenario.options import place as place
from cosim.scenario.sensing import Sensing
from cosim.scenario.tilt import Tilt
from cosim.scenario.traffic import STEP, SUMO_STEP, Changed, check_timing, clocks, settled
from cosim.types import Identity, OnCollision, Preset, Timing, Traffic

CONFIG = ".sumocfg"
DEFINITION = "scenario.yaml"  # what makes a folder a world
FOREIGN_DURATION = 60.0  # s, for a .sumocfg that names no end
NONE, AUTO = "none", "auto"
MISSIONS = ("merge", "exit", "roundabout", "intersection", NONE, AUTO)


@dataclass(frozen=True, slots=True)
class Mission:
    """The vehicle that needs another driver's help. Kind `auto` without `vehicles`: it is guessed from the
    net while running, the first HV on a lane that ends or gives way."""

    kind: str = AUTO
    vehicles: str = ""  # a vehicle's id, or a regular expression on ids; full match
    goal: tuple[str, ...] = ()  # edges; being on one of them is success (off internal lanes)

    @property
    def guessed(self) -> bool:
        return self.kind == AUTO and not self.vehicles

    def includes(self, vehicle: str) -> bool:
        """Whether the vehicle of this id is named as a mission vehicle."""
        named = self.vehicles
        return bool(named) and (vehicle == named or re.fullmatch(named, vehicle) is not None)


ALWAYS = {"keep-lane": Preset.UNGUARDED}  # what it shows is what happens where nobody brakes


@dataclass(frozen=True, slots=True)
class Zone:
    """A conflict zone as written in scenario.yaml: edges, internal edges (":J") included."""

    name: str = ""
    edges: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Scenario:
    """Everything the simulator needs; paths are absolute."""

    name: str
    config: Path  # the .sumocfg
    net: Path
    demand: tuple[Path, ...]
    additional: tuple[Path, ...] = ()
    options: tuple[tuple[str, str], ...] = ()  # further SUMO options that change the traffic
    ignored: tuple[str, ...] = ()  # options of the .sumocfg that were not passed on (outputs and such)
    traffic: str = Traffic.CONTROLLED
    changed: tuple[Changed, ...] = ()  # options of a user's file, for controlled traffic
    begin: float = 0.0  # s
    warmup: float = 0.0  # s, not counted
    duration: float = 60.0  # s, counted
    timing: Timing = Timing()
    preset: str = Preset.LAWFUL
    on_collision: str = OnCollision.END  # of an AV or of the mission vehicle
    mission: Mission = Mission()
    zones: tuple[Zone, ...] = ()
    fleet: Fleet = Fleet()
    demand_name: str = "as-is"
    behavior: str = AS_IS
    driver_model: str = LC2013
    errors: Errors | None = None  # of human drivers and persons; None: nobody errs
    sensing: Sensing | None = None  # of AVs; None: ideal
    tilt: Tilt | None = None  # of these errors; None: they are drawn as they happen
    demands: Mapping[str, Path] | None = None  # name -> file, of a world
    title: str = ""
    definition: Path | None = None  # the scenario.yaml of a world
    asked: EpisodeOptions = EpisodeOptions("")  # what a caller asked for, of which this came
    warnings: tuple[str, ...] = ()  # what `cosim.scenario.vet` found odd: reasons not to compare the result

    @property
    def built_in(self) -> bool:
        """A world, ours or a user's, whose scenario.yaml says everything; not a bare .sumocfg."""
        return self.demands is not None

    @property
    def ships(self) -> bool:
        return self.definition is not None and self.definition.parent.parent == sumo_scenarios.ROOT

    @property
    def decision_latency(self) -> float:
        """s from a decision until its commands act, in whole simulation steps."""
        if self.sensing is None:
            return 0.0
        step = self.timing.step
        return round(math.ceil(self.sensing.parameters.decision_latency / step - 1e-6) * step, 9)

    def identity(self, policy: str, label: str | None, svo_deg: float, seed: int) -> Identity:
        """What an episode of it is called, driven by this policy."""
        return Identity(
            scenario=self.name,
            demand=self.demand_name,
            policy=policy,
            policy_label=label,
            behavior=self.behavior,
            driver_model=self.driver_model,
            penetration=self.fleet.penetration,
            preset=self.preset,
            errors=None if self.errors is None else self.errors.name,
            sensing=None if self.sensing is None else self.sensing.name,
            svo_deg=svo_deg,
            seed=seed,
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that has a say in the traffic, ours included."""
        ours = [sumo_scenarios.TYPES] if self.definition is None else [self.definition]
        if self.behavior != AS_IS:
            ours.append(sumo_scenarios.BEHAVIORS)
        if self.errors is not None:
            ours.append(self.errors.file)
        if self.sensing is not None:
            ours.append(self.sensing.file)
        return (self.config, self.net, *self.demand, *self.additional, *ours)


# Options that replace the scenario's field of the same name; the others have a line each in `load`.
_READ = {"demand", "mission", "errors", "sensing", "tilt", "traffic"}  # into something else
OWN = {f.name for f in fields(Scenario)} & {f.name for f in fields(EpisodeOptions)} - _READ


def load(
    what: str | EpisodeOptions, *, fleet: Fleet | None = None, options: Sequence[str] = (), **words: Any
) -> Scenario:
    """The scenario of an episode as it is asked for.

    `what`: a scenario's name or folder, or a .sumocfg, with `words`, options of `EpisodeOptions` by their
    names, beside it; `fleet` stands for those that choose the AVs. `options`: SUMO options as typed after
    `--`, which win over the file's. Only this file's own syntax is checked: `cosim.scenario.vet` reads the
    rest.

    Raises:
        BadInput: names file (or option), field and value, with the nearest name where one is near.
    """
    words |= {} if fleet is None else fleet.words
    asked = EpisodeOptions.of(what, words) if isinstance(what, str) else what
    chosen = sumocfg.command_line(options)
    replaced = chosen.keys() | ({"route-files"} if asked.demand else set())
    if sumo_scenarios.ships(asked.what):
        scenario = _world(sumo_scenarios.folder(asked.what))
    elif is_there(Path(asked.what) / DEFINITION):
        scenario = _world(Path(os.path.abspath(asked.what)))
    else:
        scenario = _foreign(asked.what, replaced)
    if asked.demand:
        scenario = _with_demand(scenario, asked.demand)
    scenario = _with_sumo_options(scenario, chosen)
    scenario = replace(
        scenario,
        behavior=_default_behavior(scenario),
        errors=human_errors.read(asked.errors, world=scenario.name if scenario.ships else ""),
        sensing=sensing.read(asked.sensing),
        tilt=None if asked.tilt is None else tilt.read(asked.tilt, "tilt"),
    )
    return settled(with_options(scenario, asked), chosen, asked.traffic)


def with_options(scenario: Scenario, asked: EpisodeOptions) -> Scenario:
    """`scenario` with the options that say how it is driven, not whose traffic it is. Raises BadInput."""
    given = {name: value for name in OWN if (value := getattr(asked, name)) is not None}
    if asked.mission is not None:
        given["mission"] = chosen_mission(scenario.mission, asked.mission)
    if asked.fleet is not None:
        check_pattern(asked.fleet.ids or "", "av_ids")
        given["fleet"] = asked.fleet
    return replace(scenario, asked=asked, **given)


def with_preset(asked: EpisodeOptions) -> EpisodeOptions:
    """`asked` with the preset that its episode is driven in, named.

    A policy of `ALWAYS` has one of its own; else it is the one asked for, else that of a user's
    `scenario.yaml` (which cannot ask for `unguarded`), else `lawful`.
    """
    own = ALWAYS.get(asked.policy) or asked.preset
    if own is None and not sumo_scenarios.ships(asked.what) and is_there(Path(asked.what) / DEFINITION):
        own = _world(Path(os.path.abspath(asked.what))).preset
    return replace(asked, preset=own or Preset.LAWFUL)


@dataclass(frozen=True, slots=True)
class _WorldFile:
    """scenario.yaml as written."""

    name: str = ""
    title: str = ""
    duration: Positive = FOREIGN_DURATION
    warmup: NonNegative = 0.0
    timing: Timing = Timing()
    preset: str = Preset.LAWFUL
    behavior: str = ""  # of its own demands; "": mixed, and moderate in `contested`
    on_collision: str = OnCollision.END
    demand: str = ""
    fleet: Fleet = Fleet()
    mission: Mission = Mission()
    conflict_zones: tuple[Zone, ...] = ()


def file_name(config: Path) -> str:
    """The name of a user's .sumocfg: its folder's name and its own, "city/run" of any city/run.sumocfg."""
    path = Path(os.path.abspath(config))
    return "/".join(filter(None, (path.parent.name, path.name.removesuffix(CONFIG))))


def _world(folder: Path) -> Scenario:
    """A world, ours or a user's: its scenario.yaml over its NAME.sumocfg.

    A user's may be in a folder of another name than its own, but may not be called as one that ships.
    """
    file = folder / DEFINITION
    top = yaml_input.read(file, _WorldFile)
    name, ships = top.name or folder.name, folder.parent == sumo_scenarios.ROOT
    if ships and name != folder.name:
        raise BadInput("differs from its folder's name", file=file, field="name", value=name)
    if sumo_scenarios.ROOT not in folder.parents and name in (
        *sumo_scenarios.names(),
        *sumo_scenarios.open_roads(),
    ):
        raise BadInput(
            "a world that ships is called so: name yours otherwise", file=file, field="name", value=name
        )
    # of `open/NAME` the last part; its demands are in their folder
    config = sumocfg.read(folder / f"{Path(name).name}{CONFIG}", ("route-files",))
    demands = {_demand_name(path): path for path in sorted((folder / "demand").glob("*.rou.xml"))}
    if not demands:
        raise BadInput("holds no *.rou.xml", file=file, field="demand", value=str(folder / "demand"))
    demand = one_of(top.demand or next(iter(demands)), demands, "demand", file)
    one_of(top.mission.kind, MISSIONS, "mission.kind", file)
    check_pattern(top.mission.vehicles, "mission.vehicles", file)
    check_pattern(top.fleet.ids or "", "fleet.ids", file)
    check_timing(top.timing, file, "timing.step", top.timing.step)
    preset = one_of(top.preset, Preset.ALL, "preset", file)
    return Scenario(
        behavior=one_of(top.behavior, BEHAVIORS, "behavior", file) if top.behavior else AS_IS,
        on_collision=one_of(top.on_collision, OnCollision.ALL, "on_collision", file),
        name=name,
        title=top.title,
        definition=file,
        config=config.path,
        net=config.net,
        demand=(demands[demand],),
        demand_name=demand,
        demands=demands,
        additional=config.additional,
        options=config.options,
        ignored=config.ignored,
        begin=config.begin,
        warmup=top.warmup,
        duration=top.duration,
        timing=top.timing,
        # only the caller takes the guard away: the files of our worlds, whose digests are part of every
        # shipped episode's key, say `unguarded`, and so do copies of them
        preset=Preset.LAWFUL if preset == Preset.UNGUARDED else preset,
        mission=top.mission,
        zones=tuple(replace(z, name=z.name or f"zone{i}") for i, z in enumerate(top.conflict_zones)),
        fleet=top.fleet,
    )


def _foreign(what: str, replaced: Collection[str]) -> Scenario:
    """A user's .sumocfg as plain SUMO drives it. `replaced`: its files that the command line replaces."""
    path = Path(what)
    if not is_there(path) and path.suffix != CONFIG:
        sumo_scenarios.folder(what)  # raises, with the nearest name
    if path.is_dir():
        raise BadInput(f"a world's folder holds {DEFINITION}", field="scenario", value=what)
    config = sumocfg.read(regular_file(path, file=None, field="scenario"), replaced)
    if config.end is not None and config.end <= config.begin:
        raise BadInput("ends before it begins", file=path, field="end", value=f"{config.end:g}")
    return Scenario(
        name=file_name(path),
        config=config.path,
        net=config.net,
        demand=config.routes,
        additional=config.additional,
        options=config.options,
        ignored=config.ignored,
        traffic=Traffic.AS_IS,
        timing=clocks(sumocfg.time_of(dict(config.options).get(STEP, SUMO_STEP), path, STEP)),
        begin=config.begin,
        duration=FOREIGN_DURATION if config.end is None else config.end - config.begin,
        on_collision=OnCollision.CONTINUE,
    )


def _with_demand(scenario: Scenario, wanted: Sequence[str]) -> Scenario:
    """`--demand`: each a name of the world's demands, or else a file; they replace the file's routes."""
    known = scenario.demands or {}
    files, names = [], []
    for item in wanted:
        if item in known:
            files.append(known[item])
        elif is_there(Path(item)) or item.endswith((".xml", ".gz")):
            files.append(regular_file(Path(item).absolute(), file=None, field="--demand"))
        else:
            problem = f"no such demand{hint(item, known)}"
            raise BadInput(problem, field="--demand", value=item)
        names.append(_demand_name(files[-1]))
    return replace(scenario, demand=tuple(files), demand_name="+".join(names))


def _with_sumo_options(scenario: Scenario, chosen: Mapping[str, str]) -> Scenario:
    """SUMO options typed after `--`: files and clocks to their fields, the rest over the file's own."""
    if not chosen:
        return scenario
    here, place = Path.cwd(), "command line"
    begin = scenario.begin
    duration = scenario.duration
    if "begin" in chosen:
        begin = sumocfg.time_of(chosen["begin"], place, "--begin")
        if not scenario.built_in:
            duration += scenario.begin - begin  # the file's end stays where it is
    if "end" in chosen:
        duration = sumocfg.time_of(chosen["end"], place, "--end") - begin
    if duration <= 0.0:
        raise BadInput("ends before it begins", file=place, field="--begin/--end", value=f"{duration:g} s")
    files = {
        name: sumocfg.files(chosen[name], here, place, f"--{name}")
        for name in sumocfg.INPUTS
        if name in chosen
    }
    others = {k: v for k, v in chosen.items() if k not in (*sumocfg.INPUTS, *sumocfg.CLOCK)}
    return replace(
        scenario,
        net=(*files.get("net-file", ()), scenario.net)[0],
        demand=files.get("route-files", scenario.demand),
        additional=files.get("additional-files", scenario.additional),
        begin=begin,
        duration=duration,
        options=tuple({**dict(scenario.options), **others}.items()),
    )


def _default_behavior(scenario: Scenario) -> str:
    """presets.md: a user's file drives as it is; a scenario as it says, else `mixed`, `contested` with
    moderate HVs."""
    if scenario.demands is None or any(path not in scenario.demands.values() for path in scenario.demand):
        return AS_IS
    if scenario.behavior != AS_IS:
        return scenario.behavior
    return "moderate" if scenario.demand_name == "contested" else MIXED


def chosen_mission(own: Mission, wanted: str) -> Mission:
    """`--mission`: what a scenario's own becomes."""
    if wanted in (NONE, AUTO):
        return Mission(wanted)
    if not wanted:
        raise BadInput("name a vehicle, none or auto", field="--mission", value=wanted)
    check_pattern(wanted, "--mission")
    return replace(own, vehicles=wanted, kind=AUTO if own.kind == NONE else own.kind)


def _demand_name(path: Path) -> str:
    """merge/demand/dense.rou.xml -> dense"""
    return path.name.removesuffix(".gz").removesuffix(".xml").removesuffix(".rou")

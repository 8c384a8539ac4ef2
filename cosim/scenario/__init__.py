"""Loads a `Scenario`: a scenario by its name or folder, or a user's .sumocfg."""

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
DEFINITION = "scenario.yaml"  # marks a scenario folder
FOREIGN_DURATION = 60.0  # s, for a .sumocfg without an end
NONE, AUTO = "none", "auto"
MISSIONS = ("merge", "exit", "roundabout", "intersection", NONE, AUTO)


@dataclass(frozen=True, slots=True)
class Mission:
    """The mission vehicle, which depends on other drivers. Kind `auto` without `vehicles`: guessed during the
    episode, as the first HV on a lane that ends or yields."""

    kind: str = AUTO
    vehicles: str = ""  # a vehicle's id, or a regular expression on ids; full match
    goal: tuple[str, ...] = ()  # edges; reaching one of them is success (without internal lanes)

    @property
    def guessed(self) -> bool:
        return self.kind == AUTO and not self.vehicles

    def includes(self, vehicle: str) -> bool:
        """Whether the vehicle with this id is named as a mission vehicle."""
        named = self.vehicles
        return bool(named) and (vehicle == named or re.fullmatch(named, vehicle) is not None)


ALWAYS = {"keep-lane": Preset.UNGUARDED}  # demonstrates traffic in which no AV brakes


@dataclass(frozen=True, slots=True)
class Zone:
    """A conflict zone as written in scenario.yaml: edges, internal edges (":J") included."""

    name: str = ""
    edges: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Scenario:
    """All inputs of the simulator; paths are absolute."""

    name: str
    config: Path  # the .sumocfg
    net: Path
    demand: tuple[Path, ...]
    additional: tuple[Path, ...] = ()
    options: tuple[tuple[str, str], ...] = ()  # further SUMO options that change the traffic
    ignored: tuple[str, ...] = ()  # options of the .sumocfg that are not passed on (such as outputs)
    traffic: str = Traffic.CONTROLLED
    changed: tuple[Changed, ...] = ()  # options of a user's file, changed for controlled traffic
    begin: float = 0.0  # s
    warmup: float = 0.0  # s, before the counted time
    duration: float = 60.0  # s, of the counted time
    timing: Timing = Timing()
    preset: str = Preset.LAWFUL
    on_collision: str = OnCollision.END  # of an AV or of the mission vehicle
    mission: Mission = Mission()
    zones: tuple[Zone, ...] = ()
    fleet: Fleet = Fleet()
    demand_name: str = "as-is"
    behavior: str = AS_IS
    driver_model: str = LC2013
    errors: Errors | None = None  # of human drivers and persons; None: no errors
    sensing: Sensing | None = None  # of AVs; None: ideal
    tilt: Tilt | None = None  # importance sampling of the errors; None: natural probabilities
    demands: Mapping[str, Path] | None = None  # name -> file, of a scenario folder
    title: str = ""
    definition: Path | None = None  # the scenario.yaml of a scenario folder
    asked: EpisodeOptions = EpisodeOptions("")  # the options as requested by the caller
    warnings: tuple[str, ...] = ()  # from `cosim.scenario.vet`: reasons not to compare the result

    @property
    def built_in(self) -> bool:
        """Whether a scenario.yaml (shipped or a user's) defines the scenario; False for a .sumocfg."""
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
        """The identity of an episode of this scenario under this policy."""
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
        """Every file that affects the traffic, including cosim's own."""
        ours = [sumo_scenarios.TYPES] if self.definition is None else [self.definition]
        if self.behavior != AS_IS:
            ours.append(sumo_scenarios.BEHAVIORS)
        if self.errors is not None:
            ours.append(self.errors.file)
        if self.sensing is not None:
            ours.append(self.sensing.file)
        return (self.config, self.net, *self.demand, *self.additional, *ours)


# Options that replace the scenario's field of the same name; `load` handles the others one by one.
_READ = {"demand", "mission", "errors", "sensing", "tilt", "traffic"}  # converted to another type
OWN = {f.name for f in fields(Scenario)} & {f.name for f in fields(EpisodeOptions)} - _READ


def load(
    what: str | EpisodeOptions, *, fleet: Fleet | None = None, options: Sequence[str] = (), **words: Any
) -> Scenario:
    """The scenario of an episode as requested.

    `what`: a scenario's name or folder, or a .sumocfg. `words`: options of `EpisodeOptions` by their names;
    `fleet` replaces the options that choose the AVs. `options`: SUMO options as typed after `--`, which
    override the file's. Only the syntax of this file is checked; `cosim.scenario.vet` checks the other files.

    Raises:
        BadInput: names file (or option), field and value, and a similar known name if there is one.
    """
    words |= {} if fleet is None else fleet.words
    asked = EpisodeOptions.of(what, words) if isinstance(what, str) else what
    chosen = sumocfg.command_line(options)
    replaced = chosen.keys() | ({"route-files"} if asked.demand else set())
    if sumo_scenarios.ships(asked.what):
        scenario = _from_folder(sumo_scenarios.folder(asked.what))
    elif is_there(Path(asked.what) / DEFINITION):
        scenario = _from_folder(Path(os.path.abspath(asked.what)))
    else:
        scenario = _from_sumocfg(asked.what, replaced)
    if asked.demand:
        scenario = _with_demand(scenario, asked.demand)
    scenario = _with_sumo_options(scenario, chosen)
    scenario = replace(
        scenario,
        behavior=_default_behavior(scenario),
        errors=human_errors.read(asked.errors, scenario=scenario.name if scenario.ships else ""),
        sensing=sensing.read(asked.sensing),
        tilt=None if asked.tilt is None else tilt.read(asked.tilt, "tilt"),
    )
    return settled(with_options(scenario, asked), chosen, asked.traffic)


def with_options(scenario: Scenario, asked: EpisodeOptions) -> Scenario:
    """`scenario` with the options that affect AVs and measurement, not the human traffic. Raises BadInput."""
    given = {name: value for name in OWN if (value := getattr(asked, name)) is not None}
    if asked.mission is not None:
        given["mission"] = chosen_mission(scenario.mission, asked.mission)
    if asked.fleet is not None:
        check_pattern(asked.fleet.ids or "", "av_ids")
        given["fleet"] = asked.fleet
    return replace(scenario, asked=asked, **given)


def with_preset(asked: EpisodeOptions) -> EpisodeOptions:
    """`asked` with the preset of its episode made explicit.

    In order of precedence: the fixed preset of a policy in `ALWAYS`, the requested preset, that of a user's
    `scenario.yaml` (which cannot request `unguarded`), `lawful`.
    """
    own = ALWAYS.get(asked.policy) or asked.preset
    if own is None and not sumo_scenarios.ships(asked.what) and is_there(Path(asked.what) / DEFINITION):
        own = _from_folder(Path(os.path.abspath(asked.what))).preset
    return replace(asked, preset=own or Preset.LAWFUL)


@dataclass(frozen=True, slots=True)
class _Definition:
    """scenario.yaml as written."""

    name: str = ""
    title: str = ""
    duration: Positive = FOREIGN_DURATION
    warmup: NonNegative = 0.0
    timing: Timing = Timing()
    preset: str = Preset.LAWFUL
    behavior: str = ""  # for the scenario's demands; "": mixed, and moderate in `contested`
    on_collision: str = OnCollision.END
    demand: str = ""
    fleet: Fleet = Fleet()
    mission: Mission = Mission()
    conflict_zones: tuple[Zone, ...] = ()


def file_name(config: Path) -> str:
    """The name of a user's .sumocfg, with its folder: "city/run" for city/run.sumocfg anywhere."""
    path = Path(os.path.abspath(config))
    return "/".join(filter(None, (path.parent.name, path.name.removesuffix(CONFIG))))


def _from_folder(folder: Path) -> Scenario:
    """The scenario of a folder: scenario.yaml and NAME.sumocfg, of which the former takes precedence.

    A user's scenario may have another name than its folder, but not the name of a shipped scenario.
    """
    file = folder / DEFINITION
    top = yaml_input.read(file, _Definition)
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
    # the last part of `open/NAME`; the demands are in their own folder
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
        # only the caller may switch the guard off. The shipped scenario.yaml files and copies of them say
        # `unguarded`, and cannot change: their digests are part of every episode key
        preset=Preset.LAWFUL if preset == Preset.UNGUARDED else preset,
        mission=top.mission,
        zones=tuple(replace(z, name=z.name or f"zone{i}") for i, z in enumerate(top.conflict_zones)),
        fleet=top.fleet,
    )


def _from_sumocfg(what: str, replaced: Collection[str]) -> Scenario:
    """The scenario of a user's .sumocfg, as in plain SUMO. `replaced`: files given on the command line."""
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
    """`--demand`: names of the scenario's demands, or files; they replace the routes of the .sumocfg."""
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
    """SUMO options typed after `--`: files and clocks set fields; the rest override the file's options."""
    if not chosen:
        return scenario
    here, place = Path.cwd(), "command line"
    begin = scenario.begin
    duration = scenario.duration
    if "begin" in chosen:
        begin = sumocfg.time_of(chosen["begin"], place, "--begin")
        if not scenario.built_in:
            duration += scenario.begin - begin  # the file's end time stays
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
    """The behavior by presets.md: as-is for a user's routes; else the scenario's, or `mixed`, or `moderate`
    in demand `contested`."""
    if scenario.demands is None or any(path not in scenario.demands.values() for path in scenario.demand):
        return AS_IS
    if scenario.behavior != AS_IS:
        return scenario.behavior
    return "moderate" if scenario.demand_name == "contested" else MIXED


def chosen_mission(own: Mission, wanted: str) -> Mission:
    """The mission for `--mission`, based on the scenario's own."""
    if wanted in (NONE, AUTO):
        return Mission(wanted)
    if not wanted:
        raise BadInput("name a vehicle, none or auto", field="--mission", value=wanted)
    check_pattern(wanted, "--mission")
    return replace(own, vehicles=wanted, kind=AUTO if own.kind == NONE else own.kind)


def _demand_name(path: Path) -> str:
    """merge/demand/dense.rou.xml -> dense"""
    return path.name.removesuffix(".gz").removesuffix(".xml").removesuffix(".rou")

"""The episode loop: observe, decide, command, advance; hooks observe every step."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from cosim.control import to_commands
from cosim.errors import SimulationEnded
from cosim.geometry.compiled import clock, compilation_time
from cosim.metrics import MetricContext, MetricFactory, Metrics, joined
from cosim.observation.observer import Observer
from cosim.scenario import AUTO, NONE, Scenario
from cosim.scenario.manifest import manifest
from cosim.seeding import generator
from cosim.types import (
    TILT,
    Collision,
    Command,
    Decision,
    EpisodeResult,
    Events,
    History,
    HumanError,
    Metric,
    ObservationConfig,
    Offence,
    OnCollision,
    Policy,
    PolicyContext,
    Preset,
    Receipt,
    Simulator,
    Snapshot,
    Timing,
    Traffic,
)

# Share of due vehicles that were never inserted, above which the demand exceeds capacity. A smaller share is
# a normal queue: a vehicle is always due at the very end.
MAX_WAITING_SHARE = 0.05
Progress = Callable[[float, float], None]  # simulated s so far, total s


class Step(NamedTuple):
    """One completed decision period."""

    before: Snapshot
    decisions: Mapping[str, Decision]  # of the commanded AVs
    # Decisions in effect during the period: `decisions`; with a `decision_latency` those of the step before
    carried_out: Mapping[str, Decision]
    commands: tuple[Command, ...]
    receipts: tuple[Receipt, ...]  # of each command
    frames: tuple[Snapshot, ...]  # since `before`, newest last

    @property
    def after(self) -> Snapshot:
        return self.frames[-1]

    @property
    def events(self) -> Events:
        """The events of all its frames."""
        return Events.of(self.frames)


class Observed(Mapping[str, History]):
    """Every AV's present observation, computed by `look` on first access; SUMO's driver never needs it.

    Raises RuntimeError on first access after the next decision period.
    """

    def __init__(self, look: Callable[[], dict[str, History]]) -> None:
        self._look: Callable[[], dict[str, History]] | None = look
        self._found: dict[str, History] | None = None

    def expire(self) -> None:
        """Called when the simulation advances: a missing observation can no longer be computed."""
        self._look = None

    @property
    def _all(self) -> dict[str, History]:
        if self._found is None:
            if self._look is None:
                raise RuntimeError("what the AVs observed was not looked at before the simulation went on")
            self._found = self._look()
        return self._found

    def __getitem__(self, av: str) -> History:
        return self._all[av]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)


class Hook:
    """A passive observer of an episode; override the needed methods."""

    def on_start(self, episode: Episode) -> None:
        """Called after the warm-up (`episode.frames`: its last frames), with the clock at 0."""

    def on_step(self, episode: Episode, step: Step) -> None:
        """Called after a decision period; `episode.histories` are the AVs' present observations."""


class Episode:
    """Consecutive episodes of one scenario on one simulator.

    `start` and `advance` return the observation of every AV on the road. Decisions given to `advance` are
    commanded; SUMO drives AVs without a decision. `terminated` after a collision of an AV or the mission
    vehicle unless the scenario goes on; `truncated` when its duration is over (figures.md, Episode), or when
    another program has ended the simulation.
    `metrics` are measured in addition to `cosim.metrics.METRICS`.
    """

    def __init__(
        self,
        scenario: Scenario,
        simulator: Simulator,
        observation: ObservationConfig,
        metrics: Sequence[MetricFactory] = (),
    ) -> None:
        self.scenario = scenario
        self.simulator = simulator
        self.observation = observation
        self._observer = Observer(simulator.road, observation, scenario.decision_latency)
        self._metrics = Metrics(metrics)

    def start(self, seed: int, hooks: Sequence[Hook] = ()) -> Observed:
        """Begin the episode `seed` and drive its warm-up; `hooks` observe it until the next start."""
        began = clock()
        frames = self.simulator.reset(seed)
        self.timings = dict.fromkeys(("reset_s", "simulation_s", "observation_s", "decision_s"), 0.0)
        self.timings["reset_s"] = clock() - began
        self.seed = seed
        self.steps = 0
        self.snapshot: Snapshot = frames[-1]
        self.frames: tuple[Snapshot, ...] = frames
        self.step: Step | None = None  # the last one
        self.terminated = self.truncated = False
        self._ended = ""  # reason of an early end of the simulation
        self._begin = self.snapshot.time
        self._collisions: list[Collision] = []
        self._interventions: Counter[str] = Counter()  # by reason
        self._errors: list[HumanError] = []
        self._missions: dict[str, None] = {}  # every mission vehicle so far, in order of appearance
        self._tally: dict[str, int] = dict.fromkeys(
            ("decisions", "vetoes", "fallbacks", "lane_changes", "blocked"), 0
        )
        sensing = self.scenario.sensing
        self._hash = hashlib.sha256(b"" if sensing is None else sensing.digest.encode())
        self._late = self.scenario.decision_latency > 0.0
        self._acting: tuple[Mapping[str, Decision], tuple[Command, ...]] = {}, ()  # delayed
        context = MetricContext(
            road=self.simulator.road,
            timing=self.scenario.timing,
            mission_kind=self.scenario.mission.kind,
            mission_guessed=self.scenario.mission.guessed,
            goal=self.simulator.goal_lanes,
            duration=self.scenario.duration,
            ends=self.scenario.on_collision == OnCollision.END,
        )
        self._metrics.reset(self.snapshot, context)
        self._observer.reset()
        self._hooks = hooks
        self._observe(frames)
        for hook in hooks:
            hook.on_start(self)
        return self.histories

    @property
    def collisions(self) -> tuple[Collision, ...]:
        """All collisions so far."""
        return tuple(self._collisions)

    @property
    def offences(self) -> list[Offence]:
        """Offences of AVs so far, as counted in the figures; by time."""
        return self._metrics.offences

    def advance(self, decisions: Mapping[str, Decision]) -> Observed:
        """Carry the decisions out for one decision period."""
        self._trace(decisions)
        self._tally["decisions"] += len(decisions)
        self._tally["vetoes"] += sum(d.vetoed for d in decisions.values())
        self._tally["fallbacks"] += sum(d.fallback for d in decisions.values())
        lawful = self.scenario.preset == Preset.LAWFUL
        commands = to_commands(decisions, self.histories, self.scenario.timing.decision, lawful)
        held: tuple[Mapping[str, Decision], tuple[Command, ...]] = decisions, tuple(commands)
        if self._late:
            held, self._acting = self._acting, held
        self.histories.expire()
        began = clock()
        try:
            receipts, self.frames = self.simulator.advance(commands)
        except SimulationEnded as error:
            self.truncated, self._ended = True, str(error)
            return self.histories
        self.timings["simulation_s"] += clock() - began
        self.step = step = Step(self.snapshot, decisions, *held, receipts, self.frames)
        self.snapshot = step.after
        self.steps += 1
        for command, receipt in zip(step.commands, receipts, strict=True):
            self._tally["lane_changes"] += bool(command.lane_offset and receipt.executed)
            self._tally["blocked"] += not receipt.executed  # of any command
        for frame in self.frames:
            self._metrics.add(frame)
            self._collisions += frame.events.collisions
            self._interventions.update(i.reason for i in frame.events.interventions)
            self._errors += frame.events.errors
            if self.scenario.on_collision == OnCollision.END:
                self.terminated |= any(c.crash for c in frame.events.collisions)
        self.truncated = not self.terminated and self.elapsed >= self.scenario.duration - 1e-6
        self._observe(self.frames)
        for hook in self._hooks:
            hook.on_step(self, step)
        return self.histories

    def context(self, seed: int, svo: float) -> PolicyContext:
        """The policy's context for the episode `seed`; `svo` (phi) in rad."""
        sensing = self.scenario.sensing
        return PolicyContext(
            road=self.simulator.road,
            timing=Timing()
            if self.scenario.traffic == Traffic.AS_IS
            else self.scenario.timing,  # without AVs
            observation=self.observation,
            svo=svo,
            rng=generator(seed, "policy"),
            preset=self.scenario.preset,
            share_perception=sensing is None,
            share_intentions=sensing is None or sensing.parameters.mcm,
        )

    @property
    def over(self) -> bool:
        return self.terminated or self.truncated

    @property
    def elapsed(self) -> float:
        """Counted time in s."""
        return self.snapshot.time - self._begin

    def trace_hash(self) -> str:
        """SHA-256 over every decision so far (figures.md, Reproducibility)."""
        return self._hash.hexdigest()

    def result(self, policy: str, label: str = "", svo: float = 0.0) -> EpisodeResult:
        """The figures of the episode so far; `svo` in rad."""
        counts = self.simulator.counts()
        decided = self._tally["decisions"]
        own = {
            "vehicles_inserted": Metric(counts["inserted"], "vehicles", ""),
            "vehicles_never_inserted": Metric(counts["waiting"], "vehicles", "lower"),
            "veto_rate": Metric(self._tally["vetoes"] / decided if decided else None, "share", "lower"),
            "fallback_rate": Metric(
                self._tally["fallbacks"] / decided if decided else None, "share", "lower"
            ),
            "lane_changes_commanded": Metric(self._tally["lane_changes"], "changes", ""),
            "commands_blocked": Metric(self._tally["blocked"], "commands", "lower"),
        }
        metrics = joined(self._metrics.result(), own)
        named = self.scenario.identity(policy, label, round(math.degrees(svo), 6), self.seed)
        return EpisodeResult(
            **asdict(named),
            steps=self.steps,
            trace_hash=self.trace_hash(),
            metrics=metrics,
            collisions=tuple(self._collisions),
            timings=dict(self.timings),
            validity=self._validity(metrics),
            interventions_by_reason=dict(self._interventions.most_common()),
            errors_begun=tuple(self._errors),
            asked=self.scenario.asked.columns,
            tilt=self._tilt(),
            mission_vehicle=", ".join(self._missions) or None,
            mission_guessed=bool(self._missions) and self.scenario.mission.guessed,
            manifest=manifest(self.scenario, self.seed),
        )

    # ---- inside ----

    def _tilt(self) -> dict[str, Any]:
        tilt = self.scenario.tilt
        if tilt is None:
            return {}
        log_ratio, trials = self.simulator.tilted
        values = tilt.weight(log_ratio), log_ratio, tilt.drawn(self.seed), dict(trials)
        return dict(zip(TILT, values, strict=True))

    def _observe(self, frames: tuple[Snapshot, ...]) -> None:
        began = clock()
        for frame in frames:
            self._observer.add(frame)
            self._missions.update(dict.fromkeys(frame.ids[k] for k in frame.mission.nonzero()[0]))
        self.histories = Observed(self._look)
        self.timings["observation_s"] += clock() - began

    def _look(self) -> dict[str, History]:
        began = clock()
        found = self._observer.histories(self.simulator.route, self.simulator.commanded)
        self.timings["observation_s"] += clock() - began
        return found

    def _trace(self, decisions: Mapping[str, Decision]) -> None:
        s, update = self.snapshot, self._hash.update
        update("\n".join(s.ids).encode())
        for array in (s.x, s.y, s.speed, s.heading):
            update(np.ascontiguousarray(array, np.float64).tobytes())
        update(s.lane.tobytes())
        asked = [(n, int(d.action), *(() if d.accel is None else (d.accel,))) for n, d in decisions.items()]
        update(repr(sorted(asked)).encode())

    def _validity(self, metrics: Mapping[str, Metric]) -> tuple[str, ...]:
        """Reasons why this result is not comparable with others; empty if it is."""
        reasons = list(self.scenario.warnings)
        if self._ended:
            reasons.append(f"ended after {self.elapsed:g} s of {self.scenario.duration:g} s: {self._ended}")
        waiting = metrics["vehicles_never_inserted"].value or 0
        inserted = metrics["vehicles_inserted"].value or 0
        if inserted == 0:
            reasons.append(
                "no vehicle was ever inserted: the demand is empty for this time, or its routes are"
            )
        if waiting > MAX_WAITING_SHARE * (waiting + inserted):
            reasons.append(f"{waiting} vehicles found no room and were never inserted: demand above capacity")
        if teleports := metrics["teleports"].value:
            reasons.append(f"{teleports} vehicles were teleported by SUMO")
        named = self.scenario.asked.mission
        if named not in (None, NONE, AUTO) and not self._missions:
            reasons.append(f"no vehicle is the mission vehicle {named}")
        none_wanted = self.scenario.fleet.penetration == 0.0
        if self.steps and not none_wanted and not self._tally["decisions"] and not self._metrics.had_avs:
            reasons.append("no AV was ever on the road: --penetration, --av-type or --av-ids choose some")
        return tuple(reasons)


def run_episode(
    episode: Episode,
    policy: Policy,
    seed: int,
    *,
    svo: float,
    progress: Progress | None = None,
    hooks: Sequence[Hook] = (),
) -> EpisodeResult:
    """Drive one whole episode with one policy; `svo` (phi) in rad."""
    began, compiled = clock(), compilation_time()
    policy.reset(episode.context(seed, svo))
    episode.start(seed, hooks)
    drive_on(episode, policy, progress=progress)
    episode.timings["compilation_s"] = compilation_time() - compiled
    episode.timings["total_s"] = clock() - began + episode.timings["compilation_s"]
    return episode.result(policy.name, policy.label, svo)


def drive_on(
    episode: Episode, policy: Policy, until: float = math.inf, progress: Progress | None = None
) -> None:
    """The loop: continue a started episode to its end, or to `until` s of counted time."""
    while not episode.over and episode.elapsed < until:
        before, observed = clock(), episode.timings["observation_s"]
        decisions = policy.decide(episode.histories)
        observed -= episode.timings["observation_s"]
        episode.timings["decision_s"] += clock() - before + observed
        episode.advance(decisions)
        if progress is not None:
            progress(episode.elapsed, episode.scenario.duration)

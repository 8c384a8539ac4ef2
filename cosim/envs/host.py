"""The simulation's side of a session: runs in the worker process, one decision at a time."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from cosim.episode import Hook
from cosim.errors import BadInput
from cosim.host import Earnings, Host, SimulatorFactory
from cosim.metrics import MetricFactory
from cosim.observation.view import Packed, Packer
from cosim.policies import make
from cosim.rewards import Reward, RewardTerms
from cosim.road import RoadMap
from cosim.scenario import Scenario
from cosim.types import (
    Bytes,
    ContinuousAction,
    Decision,
    EpisodeResult,
    Events,
    History,
    Kind,
    MetaAction,
    ObservationConfig,
    Policy,
    Receipt,
    Snapshot,
)

PolicyFactory = Callable[[], Policy]


class Reply(NamedTuple):
    """The reply to one reset or act."""

    packed: Packed
    rewards: dict[str, RewardTerms]  # of every AV that was on the road before
    ended: dict[str, str]  # AV -> reason of its termination or truncation in this step
    receipts: tuple[Receipt, ...]
    events: Events  # of the whole decision (after a reset: of the warm-up)
    avs: tuple[str, ...]  # AVs on the road now
    time: float  # s
    elapsed: float  # s, counted
    steps: int  # decisions so far
    terminated: bool
    truncated: bool


class SessionHost(Host):
    """The caller commands the AVs named in `act`. The policy `others`, or SUMO's IDM, commands the remaining
    AVs and observes only these."""

    hooks: Sequence[Hook] = ()  # for every episode

    def __init__(
        self,
        scenario: Scenario,
        observation: ObservationConfig,
        svo: float,
        reward: Reward,
        others: PolicyFactory | None,
        simulator: SimulatorFactory | None,
        metrics: Sequence[str | MetricFactory] = (),
    ) -> None:
        policy = make("idm") if others is None else others()
        super().__init__(
            scenario,
            policy,
            svo,
            observation=_common(observation, policy),
            simulator=simulator,
            metrics=metrics,
        )
        self._earnings = Earnings(reward, svo)
        self._packer = Packer()
        self._painter: Callable[[Snapshot, str | None], Bytes] | None = None
        self._started = False

    def reset(self, seed: int) -> Reply:
        """Begin the episode `seed` and drive its warm-up."""
        self.policy.reset(self.episode.context(seed, self.svo))
        histories = self.episode.start(seed, self.hooks)
        self._started = True
        return self._reply(self._packer.pack(histories, None))

    def act(self, actions: Mapping[str, int | ContinuousAction], see: Collection[str] | None) -> Reply:
        """One decision. `see`: AVs whose views are wanted (None: all)."""
        episode = self.episode
        decisions = {name: _decision(action) for name, action in actions.items()}
        left = {name: h for name, h in episode.histories.items() if name not in actions}
        decisions |= self.policy.decide(left)
        # sorted, because SUMO's result depends on the order of commands, and a dict's order is arbitrary
        ordered = {name: decisions[name] for name in episode.histories if name in decisions}
        seen: Mapping[str, History] = episode.advance(ordered)
        assert episode.step is not None
        before, after, events = episode.step.before, episode.step.after, episode.step.events
        earned = self._earnings.pay(episode.step, before.avs)
        if see is not None:
            seen = {name: h for name, h in seen.items() if name in see}
        packed = self._packer.pack(seen, len(episode.frames))
        return self._reply(packed, earned, self._ended(before.avs, after, events))

    def result(self, policy: str) -> EpisodeResult:
        """The figures of the episode so far."""
        self._check_started()
        return self.episode.result(policy, self.policy.label, self.svo)

    def snapshot(self) -> Snapshot:
        """The present state of every vehicle."""
        self._check_started()
        return self.episode.snapshot

    def partner(self) -> str:
        """The AV that would have to yield: at present speeds the next AV to reach the conflict zone after
        the mission vehicle. "" without a mission vehicle or zone ahead, or without such an AV."""
        self._check_started()
        s, road = self.episode.snapshot, self.simulator.road

        def arrival(row: np.intp) -> float:  # s
            if s.lane[row] < 0:
                return float("inf")
            name = s.ids[row]
            place, length = float(s.lane_position[row]), float(s.length[row])
            ahead = road.ahead(int(s.lane[row]), place, length, self.simulator.route(name))
            return ahead.conflict_distance / max(float(s.speed[row]), 1.0)

        waiting = [t for row in np.flatnonzero(s.mission) if (t := arrival(row)) < float("inf")]
        if not waiting:
            return ""
        avs = [(t, s.ids[row]) for row in np.flatnonzero(s.kind == Kind.AV) if (t := arrival(row)) > 0.0]
        later = [(t, name) for t, name in avs if min(waiting) <= t < float("inf")]
        return min(later, default=(0.0, ""))[1]

    def road(self) -> RoadMap:
        """The net's lanes."""
        return self.simulator.road

    def picture(self, av: str | None) -> Bytes:
        """[rows, columns, 3] the road around one AV (or around the first vehicle) from above."""
        from cosim.envs.picture import Painter

        self._check_started()
        if self._painter is None:
            self._painter = Painter(self.simulator.road).paint
        return self._painter(self.episode.snapshot, av)

    # ---- inside ----

    def _check_started(self) -> None:
        if not self._started:
            raise BadInput("no episode has begun: call reset first")

    def _reply(
        self,
        packed: Packed,
        earned: dict[str, RewardTerms] | None = None,
        ended: dict[str, str] | None = None,
    ) -> Reply:
        e = self.episode
        return Reply(
            packed,
            earned or {},
            ended or {},
            e.step.receipts if e.step else (),
            Events.of(e.frames),
            e.snapshot.avs,
            e.snapshot.time,
            e.elapsed,
            e.steps,
            e.terminated,
            e.truncated,
        )

    def _ended(self, avs: tuple[str, ...], after: Snapshot, events: Events) -> dict[str, str]:
        crashes = [c for c in events.collisions if c.crash]
        crashed = {name for c in crashes for name in (c.collider, c.victim)}
        mission = self.episode.terminated and any(c.involves_mission for c in crashes)
        ended = {}
        for name in avs:
            if name in crashed:
                ended[name] = "collision"
            elif mission:
                ended[name] = "collision of the mission vehicle"
            elif name in events.teleported:
                ended[name] = "teleported"
            elif name not in after.row:
                ended[name] = "arrived"
            elif self.episode.terminated:
                ended[name] = "collision of another AV"
            elif self.episode.truncated:
                ended[name] = "duration"
        return ended


def _decision(action: int | ContinuousAction) -> Decision:
    return action.decision if isinstance(action, ContinuousAction) else Decision(MetaAction(action))


def _common(observation: ObservationConfig, others: Policy) -> ObservationConfig:
    """The common observation of both sides: the caller's, with maps if either side needs them."""
    theirs = others.observation
    if theirs == observation or theirs == replace(observation, maps=True):
        return theirs
    if not theirs.maps:
        return observation
    differ = [f.name for f in fields(theirs) if getattr(theirs, f.name) != getattr(observation, f.name)]
    raise BadInput(
        f"the other AVs' policy '{others.name}' observes otherwise than the session ({', '.join(differ)}): "
        "give both the same observation",
        field="observation",
    )

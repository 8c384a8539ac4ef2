"""A session: a scenario driven step by step by the caller's agent, with the simulation in its own process."""

from __future__ import annotations

import contextlib
import inspect
import math
import multiprocessing
import operator
import pickle
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast

import numpy as np

from cosim.errors import BadInput, hint
from cosim.observation.view import Unpacker, View
from cosim.rewards import Reward, RewardTerms, read
from cosim.scenario import Fleet, Scenario, load
from cosim.scenario.options import WORDS, EpisodeOptions
from cosim.seeding import TRAINING_SEEDS
from cosim.types import (
    COMPACT,
    Bytes,
    ContinuousAction,
    EpisodeResult,
    Events,
    MetaAction,
    ObservationConfig,
    Receipt,
    Snapshot,
)
from cosim.workers.worker import Worker

if TYPE_CHECKING:
    from cosim.envs.host import PolicyFactory, Reply, SessionHost
    from cosim.host import SimulatorFactory
    from cosim.metrics import MetricFactory
    from cosim.road import RoadMap

Action = int | ContinuousAction | tuple[float, int]
TIMEOUT = 120.0  # s without an answer; the first step on a machine compiles the kernels
TERMINAL = ("collision", "collision of the mission vehicle")  # all other reasons truncate


class StepResult(NamedTuple):
    """The result of one `Session.act` (one decision, 0.4 s), by AV.

    Attributes:
        observations: of each AV on the road.
        rewards: of each AV that was on the road before the step; the next four fields likewise.
        terms: the rewards' terms.
        terminated: whether the AV or the mission vehicle crashed.
        truncated: whether the duration is over, the AV left the road (arrived, teleported), or another AV's
            collision ended the episode.
        ended: reason of each termination or truncation.
        receipts: outcome of each command; with a `decision_latency` (sensing), of the previous commands.
        events: of the step.
        info: time and elapsed in s, steps, over.
    """

    observations: dict[str, View]
    rewards: dict[str, float]
    terms: dict[str, RewardTerms]
    terminated: dict[str, bool]
    truncated: dict[str, bool]
    ended: dict[str, str]
    receipts: dict[str, Receipt]
    events: Events
    info: dict[str, Any]


class Caller(Protocol):
    """The part of a worker that a session uses."""

    def call(self, method: str, *arguments: Any) -> Any: ...

    def close(self) -> None: ...


def open(
    what: str | Scenario,
    *,
    fleet: Fleet | None = None,
    options: Sequence[str] = (),
    seed: int | None = None,
    observation: ObservationConfig = COMPACT,
    reward: str | Reward | None = None,
    metrics: Sequence[str | MetricFactory] = (),
    others: PolicyFactory | None = None,
    simulator: SimulatorFactory | None = None,
    timeout: float = TIMEOUT,
    worker: bool = True,
    **words: Any,
) -> Session:
    """Open a scenario to drive it decision by decision.

    Args:
        what: a scenario's name or folder, a path to any .sumocfg, or a `Scenario`.
        fleet: the choice of AVs, in place of `penetration`, `av_type` and `av_ids`.
        options: SUMO's options, as typed after `--`.
        seed: of the first episode.
        observation: of an AV.
        reward: a `cosim.rewards.Reward` (a `RewardConfig`, a function), a name of `REWARDS`, FILE.py:NAME or
            MODULE:NAME; None: P's.
        metrics: additional metrics: classes like those of `cosim.metrics`, or FILE.py:NAME.
        others: builds the policy of the AVs without an action; None: SUMO's IDM.
        simulator: replaces SUMO, for tests (`cosim.simulation.fake`).
        timeout: s without a heartbeat after which the process counts as hung.
        worker: False runs the simulation in this process, for debugging: one simulation at a time, and a
            crash of SUMO ends the process.
        **words: options of `cosim run` by their names: `demand`, `behavior`, `preset`, `duration` in s, `svo`
            in degrees (it weighs the reward), ... (`cosim.scenario.options`). A `Scenario` contains all
            except `svo`; beside a `Scenario` the others are refused.

    Objects are used in the simulation's process: they must be importable.

    Raises:
        BadInput: naming file (or option), field and value.
    """
    chosen = {} if fleet is None else fleet.words
    if isinstance(what, str):
        asked = EpisodeOptions.of(what, words | chosen)
        scenario = load(asked, options=options)
    else:
        asked, scenario = EpisodeOptions.of(what.name, words), what
        for name, value in {**words, "fleet": fleet, "options": options or None}.items():
            if name != "svo" and value is not None:
                raise BadInput("is part of the Scenario that is given", field=name, value=value)
    if simulator is None:
        from cosim.scenario.vet import vetted

        scenario = vetted(scenario)
    arguments = (
        scenario,
        observation,
        math.radians(asked.svo_deg),
        reward or "p",
        others,
        simulator,
        tuple(metrics),
    )
    # a daemonic process (gymnasium's AsyncVectorEnv, SB3's SubprocVecEnv) may not have children, and already
    # isolates the simulation
    in_process = not worker or multiprocessing.current_process().daemon

    def connect() -> Caller:
        if in_process:
            return _InProcess(build_host(*arguments))
        try:
            return Worker(build_host, *arguments, timeout=timeout, name="cosim-session")
        except (pickle.PicklingError, AttributeError) as error:
            problem = f"must be importable, or worker=False: {error}"
            raise BadInput(problem, field="reward, metrics, others, simulator") from None

    return Session(scenario, connect, seed)


_words = [
    inspect.Parameter(o.name, inspect.Parameter.KEYWORD_ONLY, default=o.default, annotation=o.kind)
    for o in WORDS.values()
]
_own = inspect.signature(open)
setattr(open, "__signature__", _own.replace(parameters=[*[*_own.parameters.values()][:-1], *_words]))  # noqa: B010 - for help()


class Session(contextlib.AbstractContextManager["Session"]):
    """One scenario in a supervised process, made by `cosim.open`. Several sessions can be open at once.

    SUMO drives an AV without an action: by IDM, or in `lawful` after an earlier action by the car's Krauss
    driver. When the process ends, the next call raises SimulationCrashed, and `reset` starts a fresh process.
    Use a session in a `with` statement, or close it.
    """

    def __init__(self, scenario: Scenario, connect: Callable[[], Caller], seed: int | None = None) -> None:
        self.scenario = scenario
        self._connect = connect
        self._caller: Caller | None = connect()
        self._unpacker = Unpacker()
        self._next_seed = TRAINING_SEEDS.start if seed is None else seed
        self._views: dict[str, View] | None = None
        self._closed = False
        self.over = False

    def reset(self, seed: int | None = None) -> dict[str, View]:
        """Begin an episode and drive its warm-up.

        Args:
            seed: of the episode; None: the seed after the last.

        Returns:
            The view of each AV, by its id.
        """
        seed = self._next_seed if seed is None else seed
        if not 0 <= seed < 2**63:
            raise BadInput("must be a whole number from 0 on", field="seed", value=seed)
        self._next_seed = seed + 1
        self.seed = seed
        if self._caller is None and not self._closed:
            self._caller = self._connect()
        reply: Reply = self._call("reset", int(seed))
        self._take(reply)
        return self.observe()

    def observe(self) -> dict[str, View]:
        """The view of each AV that `act` requested; begins an episode if none has begun."""
        if self._views is None:
            self.reset()
        assert self._views is not None
        return dict(self._views)

    def act(
        self,
        actions: Mapping[str, Action | None],
        *,
        see: Sequence[str] | None = None,
    ) -> StepResult:
        """Carry out one action per AV for one decision (0.4 s).

        Args:
            actions: AV id -> a meta-action or its number, or a `ContinuousAction` or such a pair. `others`,
                or else SUMO, drives an AV with None or without an action.
            see: the AVs to observe; None: all. Fewer are faster.

        Raises:
            BadInput: an id that is not an AV on the road, an invalid action, no episode.
            SimulationError, SimulationCrashed: SUMO failed; its process ended or hung.
        """
        if self._views is None:
            raise BadInput("no episode has begun: call reset first")
        if self.over:
            raise BadInput("the episode is over: call reset", field="seed", value=self.seed)
        reply: Reply = self._call("act", self._checked(actions), see)
        self._take(reply)
        ended = reply.ended
        return StepResult(
            observations=self.observe(),
            rewards={name: terms.total for name, terms in reply.rewards.items()},
            terms=reply.rewards,
            terminated={name: ended.get(name) in TERMINAL for name in reply.rewards},
            truncated={name: name in ended and ended[name] not in TERMINAL for name in reply.rewards},
            ended=ended,
            receipts=self.receipts,
            events=reply.events,
            info={"time": reply.time, "elapsed": reply.elapsed, "steps": reply.steps, "over": self.over},
        )

    def result(self, policy: str = "external") -> EpisodeResult:
        """The figures of the episode so far; `policy` is the caller's name in the result."""
        return cast(EpisodeResult, self._call("result", policy))

    def snapshot(self) -> Snapshot:
        """Every vehicle on the road (the true state, which an agent must not see)."""
        return cast(Snapshot, self._call("snapshot"))

    def partner(self) -> str:
        """The AV that would have to yield to the mission vehicle; "" without one.

        At present speeds, it is the next AV to reach the conflict zone after the mission vehicle.
        """
        return cast(str, self._call("partner"))

    def road(self) -> RoadMap:
        """The road: lanes, links and signals."""
        return cast("RoadMap", self._call("road"))

    def picture(self, av: str | None = None) -> Bytes:
        """[160, 640, 3] RGB: 64 m x 256 m of road around `av` from above, looking to the right."""
        return cast(Bytes, self._call("picture", av))

    @property
    def pid(self) -> int | None:
        """The simulation's process id; None if it runs in this process or has ended."""
        return getattr(self._caller, "pid", None)

    def close(self) -> None:
        """End the simulation and its process; safe to call twice."""
        self._closed = True
        if self._caller is not None:
            self._caller.close()
            self._caller = None

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def begun(self) -> bool:
        """Whether an episode has begun."""
        return self._views is not None

    # ---- inside ----

    def _call(self, method: str, *arguments: Any) -> Any:
        if self._caller is None:
            raise BadInput("the session is closed" if self._closed else "its process has ended: call reset")
        try:
            return self._caller.call(method, *arguments)
        except BadInput:
            raise
        except BaseException:  # SUMO failed, or Ctrl-C left an answer in the pipe: reset starts a new process
            self._caller.close()
            self._caller = None
            self._views = None
            raise

    def _take(self, reply: Reply) -> None:
        self._views = self._unpacker.unpack(reply.packed)
        self.avs = reply.avs
        self.events = reply.events
        self.receipts = {receipt.vehicle: receipt for receipt in reply.receipts}
        self.elapsed = reply.elapsed
        self.over = reply.terminated or reply.truncated

    def _checked(self, actions: Mapping[str, Action | None]) -> dict[str, int | ContinuousAction]:
        found: dict[str, int | ContinuousAction] = {}
        for name, action in actions.items():
            if action is None:
                continue
            if name not in self.avs:
                problem = f"no AV of that name is on the road{hint(name, self.avs)}"
                raise BadInput(problem, field="actions", value=name)
            if np.ndim(cast(Any, action)):
                found[name] = _continuous(name, action)
                continue
            try:
                found[name] = int(MetaAction(operator.index(cast(Any, action))))
            except (TypeError, ValueError):
                known = ", ".join(f"{a.value} {a.name}" for a in MetaAction)
                raise BadInput(f"is no meta-action ({known})", field=name, value=action) from None
        return found


def _continuous(name: str, action: Any) -> ContinuousAction:
    try:
        accel, offset = map(float, action)
    except (TypeError, ValueError):
        accel, offset = math.nan, math.nan
    if not math.isfinite(accel) or offset not in (-1.0, 0.0, 1.0):
        problem = "is no continuous action (acceleration in m/s2, lane offset +1, 0 or -1)"
        raise BadInput(problem, field=name, value=action)
    return ContinuousAction(accel, int(offset))


class _InProcess:
    """A `Caller` in the present process."""

    def __init__(self, host: SessionHost) -> None:
        self._host = host

    def call(self, method: str, *arguments: Any) -> Any:
        return getattr(self._host, method)(*arguments)

    def close(self) -> None:
        self._host.close()


def build_host(
    scenario: Scenario,
    observation: ObservationConfig,
    svo: float,
    reward: str | Reward,
    others: PolicyFactory | None,
    simulator: SimulatorFactory | None,
    more: Sequence[str | MetricFactory],
) -> SessionHost:
    """Runs in the worker: only there are the loop, numba, libsumo and a user's code imported."""
    from cosim.envs.host import SessionHost

    return SessionHost(scenario, observation, svo, read(reward, "reward"), others, simulator, more)

"""The prediction-aware agent: chain of predictions, value network, safety prioritizer (P, figure 2)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from cosim.errors import BadInput
from cosim.geometry.raster import RoadRaster, rasterize_road
from cosim.road import RoadMap
from cosim.types import (
    Decision,
    Floats32,
    Forecast,
    History,
    MetaAction,
    PolicyContext,
    Preset,
)
from policy.agents.approaches import AgentConfig, compact, shipped
from policy.chain.chain import predict
from policy.checkpoint import load
from policy.inputs.scene import Scene, join
from policy.inputs.tensors import States, pixels, situation_tensor, svo_tensor, to_batch, to_numpy
from policy.networks.extractors import EncodedMaps, FrameMemory
from policy.networks.hpn import HPN
from policy.networks.seeded import seeded
from policy.networks.vfn import VFN, Frames
from policy.prediction.forecast import KinematicForecast
from policy.prediction.predictors import make_predictor
from policy.prediction.traffic import Traffic, foresee
from policy.safety import prioritize

UNTRAINED = "untrained"
RETRY_DELAY = 2.0  # s, the duration of a lane change, before a refused lane change is tried again


class Inputs(NamedTuple):
    """Observations and predictions of B AVs that decide together."""

    scene: Scene
    states: States
    traffic: Traffic


class PredictionAware:
    """`cosim.types.Policy`: commands every AV.

    Untrained weights are seeded, so an untrained agent is the same everywhere; `label` marks it as untrained.
    All AVs decide at once: prediction and action values in one batch, then the prioritizer front to back.
    """

    def __init__(self, name: str = "vfn-p", config: AgentConfig | None = None) -> None:
        self.name = name
        self.config = c = config or compact(name)
        self.observation = c.observation
        self.av_parameters: Mapping[str, str] = {}
        self.vfn, self.hpn = seeded(partial(_networks, c), c.init_seed)
        parts = {"value network": c.vfn_weights}
        if c.vfn_weights is not None:
            load(c.vfn_weights, {"vfn": self.vfn}, {"vfn": c.vfn})
        if self.hpn is not None:
            parts["HPN"] = c.hpn_weights
            if c.hpn_weights is not None:
                load(c.hpn_weights, {"hpn": self.hpn}, {"hpn": c.hpn})
        self.label = c.note or _label(parts)
        used = (*parts.values(), shipped(c.predictor))
        self.files = tuple(path for path in used if path is not None)  # weights that determine the behaviour
        self.vfn.to(memory_format=self.vfn.layout)  # type: ignore[call-overload]
        if self.hpn is not None:
            self.hpn.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._road: RoadMap | None = None
        self._raster: RoadRaster | None = None

    def reset(self, context: PolicyContext) -> None:
        """Start an episode. Raises BadInput when the observation does not match the networks."""
        if context.observation != self.observation:
            raise BadInput("the observation is not the one this agent needs", field="observation")
        for part, dt in (("safety", self.config.safety.dt), ("traffic", self.config.traffic.dt)):
            if dt != context.timing.frame:
                raise BadInput(
                    f"is not the frame of {context.timing.frame:g} s", field=f"{part}.dt", value=dt
                )
        if self._road is not context.road:
            self._road = context.road
            version, predicted = self.observation.road_version, self.config.predicted_maps
            self._raster = rasterize_road(context.road, version) if predicted else None
        self._context = context
        self._safety = replace(self.config.safety, assisted=context.preset == Preset.LAWFUL)
        self._expected: tuple[tuple[str, ...], Traffic, KinematicForecast] | None = None
        self._asked: dict[str, tuple[MetaAction, float]] = {}  # AV -> last lane change commanded, at (s)
        self._memories: dict[VFN, FrameMemory | None] = {}
        self._predictor = make_predictor(
            self.config.predictor, self.config.chain.horizon, context.timing.frame
        )

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        """One decision for every AV, each explained (P, figure 2; `cosim.types.Decision`).

        Args:
            histories: AV -> its observations (`cosim.types.History`), all of the same instant.

        Raises:
            FloatingPointError: the value network returned values that are not finite.
        """
        if not histories:
            return {}
        inputs = self.perceive(histories)
        return self.choose(self.values(inputs), inputs)

    def perceive(self, histories: Mapping[str, History]) -> Inputs:
        """Predict the next seconds: the inputs of value network and prioritizer (P, algorithm 1).

        Args:
            histories: AV -> its observations.

        Returns:
            scene of B AVs and V vehicles, network states of the B AVs, predicted traffic of the V vehicles.
        """
        c, context = self.config, self._context
        scene, traffic, forecast = self.foresee(histories)
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=c.bf16):
            batch = to_batch(scene.histories)
            maps, kinematics = batch.maps, batch.kinematics
            if c.predicted_maps:
                assert self._raster is not None
                ahead = predict(
                    c.chain, c.observation, self._raster, self.hpn, scene, batch, forecast, traffic
                )
                maps = torch.cat([maps, pixels(ahead.maps)], 1)
                kinematics = torch.cat([kinematics, ahead.kinematics], 1)
        known = situation_tensor(scene.histories, context.road, scene.shared)
        return Inputs(scene, States(maps, kinematics, known, svo_tensor(context.svo, len(known))), traffic)

    def encoded(self, inputs: Inputs) -> Inputs:
        """Inputs with latents [B,T,L] in place of maps, if the value network has an encoder."""
        if not isinstance(self.vfn.maps, EncodedMaps):
            return inputs
        memory, states = self._memory(self.vfn), inputs.states
        assert memory is not None
        with torch.inference_mode():
            latents = memory.frames(inputs.scene.agents, states.maps).flatten(2)
        return inputs._replace(states=states._replace(maps=latents))

    def foresee(self, histories: Mapping[str, History]) -> tuple[Scene, Traffic, KinematicForecast]:
        """The joined scene of all AVs and the forecast of its vehicles."""
        c, context = self.config, self._context
        scene = join(histories, context.pooled)
        forecast, traffic = foresee(scene, self._predictor, context.road, c.traffic, c.safety.frames)
        self._expected = scene.vehicles, traffic, forecast
        return scene, traffic, forecast

    def values(self, inputs: Inputs) -> Floats32:
        """The action values [B,A]."""
        return self.valued(self.vfn, inputs.scene.agents, inputs.states)

    def valued(self, network: VFN, agents: Sequence[str], states: States) -> Floats32:
        """Action values [B,A] of `network`.

        Args:
            network: the value network.
            agents: names of the B AVs.
            states: their inputs.

        Raises:
            FloatingPointError: a value is not finite.
        """
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=self.config.bf16):
            memory = self._memory(network) if states.maps.dim() == 5 else None  # else latents
            maps = states.maps if memory is None else Frames(memory.frames(agents, states.maps))
            q = to_numpy(network(maps, *states[1:]))
        if not np.isfinite(q).all():
            raise FloatingPointError("the value network returned values that are not finite")
        return q

    def _memory(self, network: VFN) -> FrameMemory | None:
        if network not in self._memories:
            timing = self._context.timing
            fresh = round(timing.decision / timing.frame)
            self._memories[network] = network.memory(self.observation.frames, fresh)
        return self._memories[network]

    def choose(self, q: Floats32, inputs: Inputs) -> dict[str, Decision]:
        """The safety prioritizer's choice (P, algorithm 3); without a mask the action of highest value.

        Args:
            q: [B,A] action values, in the order of `inputs.scene.agents`.
            inputs: as `perceive` returns them.
        """
        c, context, scene = self.config, self._context, inputs.scene
        if not c.mask:
            best = q.argmax(1)
            return {
                a: Decision(MetaAction(k), q=row) for a, k, row in zip(scene.agents, best, q, strict=True)
            }
        now = dict(zip(scene.agents, scene.histories, strict=True))
        decisions = prioritize(
            q, scene, inputs.traffic, context.road, self._safety, context.share_intentions, self._refused(now)
        )
        for name, decision in decisions.items():
            if decision.action in (MetaAction.LANE_LEFT, MetaAction.LANE_RIGHT):
                self._asked[name] = (decision.action, now[name].time)
        return decisions

    @property
    def last_forecast(self) -> Forecast | None:
        """The mask's forecast of all vehicles at the last decision, before intentions were shared."""
        if self._expected is None:
            return None
        names, traffic, forecast = self._expected
        first = {name: row for row, name in reversed(list(enumerate(names))) if traffic.known[row]}
        rows = np.array(list(first.values()), np.int64)  # without V2V a vehicle has a row per AV: the first
        m = min(forecast.x.shape[1], traffic.rollout.x.shape[1] - 1)
        out, ahead = traffic.rollout, slice(1, m + 1)
        return Forecast(
            tuple(first),
            out.x[rows, ahead],
            out.y[rows, ahead],
            out.heading[rows, ahead],
            forecast.along_std[rows, :m],
            forecast.across_std[rows, :m],
            self._context.timing.frame,
        )

    def _refused(self, histories: Mapping[str, History]) -> dict[str, MetaAction]:
        """Lane changes commanded within RETRY_DELAY s that did not begin (a closed lane, a solid line)."""
        for name, history in histories.items():
            _, when = self._asked.get(name, (None, np.inf))
            if history.lane_changing or history.time - when > RETRY_DELAY:
                self._asked.pop(name, None)
        return {name: action for name, (action, _) in self._asked.items() if name in histories}


def _networks(c: AgentConfig) -> tuple[VFN, HPN | None]:
    """Untrained networks."""
    vfn = VFN(c.vfn).eval()
    return vfn, HPN(c.hpn).eval() if c.predicted_maps and c.chain.source == "hpn" else None


def _label(parts: Mapping[str, Path | None]) -> str:
    """The label's warning: empty, `untrained`, or the untrained part."""
    missing = [part for part, weights in parts.items() if weights is None]
    which = "" if len(missing) == len(parts) else f" {', '.join(missing)}"
    return UNTRAINED + which if missing else ""

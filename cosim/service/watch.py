"""The simulation's side of watching a session: JSON for the page, computed only while viewers exist.

A `Scene` comes first. Then every decision brings persistent data (`lasting`: words, vehicles, events) and a
step. A step may be lost on its way, so it has whole positions instead of differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cosim.envs.host import SessionHost
from cosim.episode import Episode, Hook, Step
from cosim.policies import Explainer, explainer
from cosim.recording.recorder import Choice, beliefs
from cosim.report.replay.packing import (
    DrawnRoad,
    Names,
    collision,
    facts,
    forecast_interval,
    ms,
    shapes,
    vehicle,
)
from cosim.scenario.behaviors import AS_IS
from cosim.service.views import to_json
from cosim.types import Actor, HumanError, Intervention, Kind, Policy, Simulator, Snapshot

FIGURES_EVERY = 2  # decisions between two tables of figures


class Scene(NamedTuple):
    """The data for a new viewer."""

    road: str
    episode: str
    lasting: list[str]
    step: str


class Notes(Hook):
    """The history of the episode, and results of the session's earlier episodes."""

    def __init__(self) -> None:
        self.ended: dict[int, dict[str, Any]] = {}  # seed -> figures of its last whole episode
        self.picture: Picture | None = None

    def on_start(self, episode: Episode) -> None:
        """Begin an episode; errors of the warm-up that still last belong to it."""
        now = episode.snapshot.time
        self.interventions: list[Intervention] = []
        self.errors: list[HumanError] = [
            e for frame in episode.frames for e in frame.events.errors if e.until > now
        ]
        self.picture = None

    def on_step(self, episode: Episode, step: Step) -> None:
        """Note the events of one decision."""
        events = step.events
        self.interventions += events.interventions
        self.errors += events.errors
        if episode.over:
            result = episode.result("")
            self.ended[result.seed] = {name: m.value for name, m in result.metrics.items()}
        if self.picture is not None:
            self.picture.draw(episode, step)


class Picture:
    """One episode for its viewers."""

    def __init__(
        self,
        road: DrawnRoad,
        policy: Policy,
        simulator: Simulator,
        notes: Notes,
        svo: float,
        explained: Explainer | None,
    ) -> None:
        self._road, self._policy, self._simulator, self._notes = road, policy, simulator, notes
        self._svo, self._explained = svo, explained
        self._names = Names()
        self._told = dict.fromkeys(("words", "collisions", "violations", "interventions", "errors"), 0)
        self.lasting: list[str] = []  # not sent yet
        self.step = ""  # the last one

    def begin(self, episode: Episode) -> Scene:
        """The present scene."""
        self.step = _text({"frames": [self._frame(episode.snapshot)], **self._now(episode)})
        self._note(episode)
        head = {
            "begin": ms(episode.snapshot.time - episode.elapsed),
            "shapes": shapes([*Actor]),
            "signals": len(self._road.signals),
            "facts": {**self._facts(episode), "duration": episode.scenario.duration},
        }
        return Scene(_text(self._road.document), _text(head), self.told(), self.step)

    def draw(self, episode: Episode, step: Step) -> None:
        """Draw one decision: its choices, predictions and beliefs, and the frames after it."""
        frames = [self._frame(frame) for frame in step.frames]
        outcomes = zip(step.commands, step.receipts, strict=True)
        choices = {
            c.vehicle: Choice(step.carried_out[c.vehicle], c.target_speed, r.blocked) for c, r in outcomes
        }
        forecast = getattr(self._policy, "last_forecast", None) if step.decisions else None
        found: dict[str, Any] = {
            "decided": [
                *(ms(step.before.time), self._names.choices(choices), self._names.forecast(forecast)),
                self._names.beliefs(beliefs(step.before)),
            ],
            "frames": frames,
            **self._now(episode),
        }
        explained = self._explained
        if explained is not None and explained.uses and explained.asked in self._names.vehicles:
            uses = [[name, how, action, round(dq, 4)] for name, how, action, dq in explained.uses]
            found["uses"] = [self._names.vehicles[explained.asked], uses]
        if forecast is not None:
            found["interval"] = forecast_interval(forecast)
        if episode.over or episode.steps % FIGURES_EVERY == 0:
            found["facts"] = self._facts(episode)
        self._note(episode)
        self.step = _text(found)

    def told(self) -> list[str]:
        """New persistent data, each once."""
        found, self.lasting = self.lasting, []
        return found

    def _facts(self, episode: Episode) -> dict[str, Any]:
        result = episode.result(self._policy.name, self._policy.label, self._svo).document()
        if not episode.over:
            result["trace_hash"] = None
        return {**facts(result), "tally": tally([*self._notes.ended.values()])}

    def _now(self, episode: Episode) -> dict[str, Any]:
        return {"elapsed": round(episode.elapsed, 3), "over": episode.over}

    def _frame(self, s: Snapshot) -> list[Any]:
        """[ms, vehicles, x cm, y cm, heading mrad, speed cm/s, acceleration cm/s2, lane, signals]; signals as
        one text."""
        self._number(s)
        numbers = [self._names.vehicles[name] for name in s.ids]
        columns = (s.x, 100.0), (s.y, 100.0), (s.heading, 1000.0), (s.speed, 100.0), (s.accel, 100.0)
        whole = [np.rint(np.nan_to_num(c * unit)).astype(np.int64).tolist() for c, unit in columns]
        lanes = [self._road.lanes.get(lane, -1) for lane in s.lane.tolist()]
        signals = "".join(chr(s.signals[k]) for k in self._road.signals)
        return [ms(s.time), numbers, *whole, lanes, signals]

    def _number(self, s: Snapshot) -> None:
        """Give numbers to new vehicles."""
        known = self._names.vehicles
        if not (new := [k for k, name in enumerate(s.ids) if name not in known]):
            return
        classes: Mapping[str, str] = getattr(
            self._simulator, "driver_classes", dict
        )()  # known only to SUMO's simulator
        for k in new:
            known[s.ids[k]] = len(known)
            driver = classes.get(s.ids[k], AS_IS) if s.kind[k] == Kind.HV else ""
            row = vehicle(
                s.ids[k], s.kind[k], bool(s.mission[k]), driver, s.length[k], s.width[k], s.actor[k]
            )
            self.lasting.append(_text(["vehicles", row]))

    def _note(self, episode: Episode) -> None:
        """Add new events to `lasting`, after the words that they and the step's choices use."""
        names, notes = self._names, self._notes
        found: list[Any] = []
        events: dict[str, Sequence[Any]] = {
            "collisions": episode.collisions,
            "violations": episode.offences,
            "interventions": notes.interventions,
            "errors": notes.errors,
        }
        for kind, every in events.items():
            new = every[self._told[kind] :]
            self._told[kind] = len(every)
            rows = [*map(collision, new)] if kind == "collisions" else getattr(names, kind)(new)
            found += [[kind, row] for row in rows]
        words = [*names.words][self._told["words"] :]
        self._told["words"] = len(names.words)
        self.lasting += [_text(["words", word]) for word in words] + [_text(one) for one in found]


class WatchedHost(SessionHost):
    """A session's host that can be watched."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._notes = Notes()
        self.hooks = (self._notes,)
        self._explainer = explainer(self.policy)
        self._road: DrawnRoad | None = None

    def scene(self) -> Scene:
        """Start or restart watching."""
        self._check_started()
        if self._road is None:
            s = self.simulator
            self._road = DrawnRoad(s.road, s.goal_lanes, len(self.episode.snapshot.signals))
        picture = Picture(self._road, self.policy, self.simulator, self._notes, self.svo, self._explainer)
        self._notes.picture = picture
        return picture.begin(self.episode)

    def explain(self, av: str | None) -> None:
        """Select the AV for attribution from the next decision on; None: no AV."""
        if self._explainer is not None:
            self._explainer.asked, self._explainer.uses = av, ()

    def drawn(self) -> tuple[list[str], str]:
        """Persistent data and step of the last decision. Call it after `scene` in the same episode."""
        picture = self._notes.picture
        assert picture is not None
        return picture.told(), picture.step

    def unwatched(self) -> None:
        """Stop watching."""
        self._notes.picture = None
        self.explain(None)


def tally(ended: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures of whole episodes, one per seed.

    Number of episodes, shares of crashes (C%) and missions with 95 % intervals, mean distance in m, and
    smallest time to collision in s.
    """
    if not ended:
        return {"episodes": 0}
    from cosim.report.statistics import share  # scipy.stats: at the end of the first episode

    def rate(name: str) -> dict[str, Any] | None:
        values = [one[name] for one in ended if one[name] is not None]
        if not values:
            return None
        return {"hits": sum(values), "n": len(values), **share(sum(values), len(values)).document()}

    distances = [one["dt_mean_m"] for one in ended if one["dt_mean_m"] is not None]
    least = min((one["min_ttc_s"] for one in ended if one["min_ttc_s"] is not None), default=None)
    return {
        "episodes": len(ended),
        "crashed": rate("crashed"),
        "mission_success": rate("mission_success"),
        "dt_mean_m": sum(distances) / len(distances) if distances else None,
        "min_ttc_s": least,
    }


def _text(value: Any) -> str:
    return to_json(value).decode()

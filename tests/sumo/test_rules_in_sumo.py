"""What AVs see of the law is what SUMO itself says of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest

from cosim.host import Host
from cosim.observation.observer import Observer
from cosim.scenario import Fleet, load
from cosim.scenario.vet import vetted
from cosim.types import ObservationConfig, Preset
from cosim.workers.worker import Worker

DECISIONS = 150


class Drive:
    """Runs in a worker: SUMO drives everybody; what its AVs see beside what SUMO says, a row per AV."""

    def __init__(self, config: str) -> None:
        scenario = load(config, fleet=Fleet(penetration=0.5), preset=Preset.LAWFUL)
        self._host = Host(vetted(scenario), "idm", 0.0)

    def rows(self, seed: int) -> list[dict[str, Any]]:
        """Signals, persons and limits, every second decision."""
        episode, found = self._host.episode, []
        self._host.policy.reset(episode.context(seed, 0.0))
        episode.start(seed)
        road, simulator = self._host.simulator.road, self._host.simulator
        observer = Observer(road, ObservationConfig(maps=False, signal_timing=True))
        for _ in range(DECISIONS):
            episode.advance({})
            observer.add(episode.snapshot)
            for av, history in observer.histories(simulator.route, simulator.commanded).items():
                rules = history.rules
                lights = libsumo.vehicle.getNextTLS(av)
                lane = road.lanes[history.route.paths[1].lanes[0]]  # type: ignore[union-attr]
                row: dict[str, Any] = {"rules": rules, "speed": history.ego_speed, "lane": lane.id}
                row["dead_end"] = history.route.to_end(1) < np.inf
                if lights:
                    light, _, distance, state = lights[0]
                    left = libsumo.trafficlight.getNextSwitch(light) - libsumo.simulation.getTime()
                    row |= {"state": state, "distance": distance, "left": left}
                if rules.signal:
                    row["light"] = road.signals[rules.signal_index][0]
                found.append(row)
        return found

    def close(self) -> None:
        """End SUMO."""
        self._host.close()


@pytest.fixture
def drive(law_worlds: dict[str, Path]) -> Callable[[str], list[dict[str, Any]]]:
    """The rows of one world."""

    def rows(world: str) -> list[dict[str, Any]]:
        with Worker(Drive, str(law_worlds[world]), timeout=120.0) as worker:
            return list(worker.call("rows", 0))

    return rows


def test_the_next_signal_is_the_one_that_sumo_names(drive: Callable[[str], list[dict[str, Any]]]) -> None:
    rows = [row for row in drive("grid_signals") if not row["dead_end"] and "state" in row]
    near = [row for row in rows if row["distance"] < 150.0]
    assert len(near) > 200
    assert {row["rules"].signal for row in near} >= {"r", "G"}
    for row in near:
        assert row["rules"].signal == row["state"]
        assert row["rules"].signal_distance == pytest.approx(row["distance"], abs=1.0)
        assert row["rules"].switch_in == pytest.approx(row["left"])


def test_persons_on_a_crossing_are_seen(drive: Callable[[str], list[dict[str, Any]]]) -> None:
    """Now and then somebody is on the next crossing, now and then nobody."""
    rows = drive("crossing_unsignalled")
    assert any(row["rules"].person_distance < 50.0 for row in rows)
    assert any(row["rules"].person_distance > 50.0 > row["rules"].crossing_distance for row in rows)

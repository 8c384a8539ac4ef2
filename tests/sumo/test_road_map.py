"""The road as cosim reads it through libsumo is the road that sumolib, SUMO's own reader of nets, finds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import sumolib

from benchmarks.real_nets import a10kw
from cosim.road import RoadMap
from cosim.simulation.convert import MOTOR_CLASSES
from cosim.simulation.net import NetReader
from cosim.workers.worker import Worker
from sumo_scenarios import folder, names

Roads = tuple[RoadMap, sumolib.net.Net]
NETS = {name: folder(name) / "net.net.xml" for name in names()} | {
    "a10kw": a10kw().parent / "A10KW" / "osm.net.xml"
}


@pytest.fixture(scope="module", params=NETS.values(), ids=NETS)
def roads(request: pytest.FixtureRequest) -> Iterator[Roads]:
    """(ours, sumolib's) of one of our worlds, and of a motorway interchange that is not ours."""
    net: Path = request.param
    worker = Worker(NetReader, net, timeout=60.0)
    try:
        yield worker.call("road"), sumolib.net.readNet(str(net), withInternal=True)
    finally:
        worker.close()


def driven(net: sumolib.net.Net) -> dict[str, sumolib.net.lane.Lane]:
    """sumolib's lanes that a motor vehicle may use, by id."""
    lanes = [lane for edge in net.getEdges() for lane in edge.getLanes()]
    return {lane.getID(): lane for lane in lanes if MOTOR_CLASSES.intersection(lane.getPermissions())}


def test_both_find_the_same_lanes_of_the_same_length_width_speed_and_line(roads: Roads) -> None:
    ours, theirs = roads
    lanes = driven(theirs)
    assert {lane.id for lane in ours.lanes} == set(lanes)
    for lane in ours.lanes:
        other = lanes[lane.id]
        assert lane.length == pytest.approx(other.getLength(), abs=0.01)
        assert lane.width == pytest.approx(other.getWidth())
        assert lane.speed_limit == pytest.approx(other.getSpeed(), abs=0.01)
        np.testing.assert_allclose(lane.shape, [point[:2] for point in other.getShape()], atol=0.01)
        assert lane.internal == (other.getEdge().getFunction() == "internal")


def test_both_connect_the_same_lanes(roads: Roads) -> None:
    ours, theirs = roads
    lanes = driven(theirs)
    for lane in ours.lanes:
        outgoing = lanes[lane.id].getOutgoing()
        followers = {link.getViaLaneID() or link.getToLane().getID() for link in outgoing}
        assert {ours.lanes[k].id for k in lane.successors} == followers & set(lanes)


def test_both_know_which_lane_lies_beside_which(roads: Roads) -> None:
    ours, theirs = roads
    for name, lane in driven(theirs).items():
        here = ours.lanes[ours.index[name]]
        beside = {lane.getIndex() + 1: here.left, lane.getIndex() - 1: here.right}
        for index, neighbour in beside.items():
            if neighbour >= 0:  # -1: there is none, or the change is forbidden
                assert ours.lanes[neighbour].id == lane.getEdge().getLane(index).getID()

"""Published capacities of the six open roads, from formulas of the Highway Capacity Manual (HCM).

TRB, Highway Capacity Manual, 6th edition, Washington DC 2016: chapters 12 (motorways), 13 (weaving),
19 (signals), 20 (two-way stops) and 22 (roundabouts). Values are for passenger cars, HCM's speeds in mi/h.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from sumo_scenarios.roads import Arterial, LaneDrop, Minor, OnRamp, Road, Roundabout, Weave

MILE_PER_HOUR = 0.44704  # m/s
FOOT = 0.3048  # m
HOUR = 3600.0  # s
SATURATION_FLOW = 1900.0  # vehicles/h of green per lane
# critical headway and follow-up time at a minor road, s, for a major road with two lanes in all
LEFT, RIGHT = (7.1, 3.5), (6.2, 3.3)
# Left of two entry lanes into a two-lane ring: vehicles/h without conflicting flow, decay with that flow
ENTRY_LANE = (1350.0, 0.92e-3)


def capacity(road: Road) -> float:
    """Vehicles/h of all origins together, at the road's flow shares."""
    return float(PUBLISHED[type(road)](road))


def motorway_lane(speed: float) -> float:
    """Vehicles/h of a basic motorway lane; `speed`: m/s."""
    return min(2200.0 + 10.0 * (speed / MILE_PER_HOUR - 50.0), 2400.0)


def gap_acceptance(conflicting: float, critical: float, following: float) -> float:
    """Vehicles/h of a minor movement; `conflicting` in vehicles/h, the others in s."""
    if conflicting <= 0.0:
        return HOUR / following
    passing = math.exp(-conflicting * critical / HOUR)
    return conflicting * passing / (1.0 - math.exp(-conflicting * following / HOUR))


# ---- inside ----


def _weave(road: Weave) -> float:
    share = road.on_share + road.off_share
    of_lane = motorway_lane(road.speed) - 438.2 * math.pow(1.0 + share, 1.6)
    of_lane += 0.0765 * road.weave_m / FOOT + 119.8 * 2  # one lane change per weaving movement
    return of_lane * (road.lanes + 1)


def _roundabout(road: Roundabout) -> float:
    """With equal arms; the conflicting flow of an entry lane is the ring flow past the entry."""
    flows = road.flows()
    passing = sum(f.share for f in flows if _passes(f.origin, f.destination, road.arms))
    entering = 1.0 / road.arms / road.lanes  # of each entry lane, of all vehicles
    full, decay = ENTRY_LANE
    return _solved(lambda total: full * math.exp(-decay * passing * total) - entering * total)


def _passes(origin: str, destination: str, arms: int) -> bool:
    """Whether vehicles of this flow pass the entry of arm 0 on the ring."""
    begin, end = int(origin[2:]), int(destination[3:])
    return begin != 0 and (end - begin) % arms > (0 - begin) % arms


def _minor(road: Minor) -> float:
    """Left and right turns share the lane; their service times are weighted by their flows."""
    main, minor = (1.0 - road.minor_share) / 2.0, road.minor_share

    def spare(total: float) -> float:
        right = gap_acceptance(main * (1.0 - road.into_share / 2.0) * total, *RIGHT)
        left = gap_acceptance(2.0 * main * (1.0 - road.into_share / 4.0) * total, *LEFT)
        return 1.0 / (0.5 / left + 0.5 / right) - minor * total

    return _solved(spare)


def _arterial(road: Arterial) -> float:
    cycle = road.main_green + road.side_green + 6.0  # s, with both yellows
    return 2.0 * road.lanes * SATURATION_FLOW * road.main_green / cycle / (1.0 - road.side_share)


def _solved(spare: Callable[[float], float]) -> float:
    """Root of a function that decreases with the total flow, to 1 vehicle/h."""
    low, high = 1.0, 20000.0
    while high - low > 1.0:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if spare(middle) > 0.0 else (low, middle)
    return low


PUBLISHED: Mapping[type[Road], Callable[..., float]] = {
    LaneDrop: lambda road: motorway_lane(road.speed) * road.after,
    OnRamp: lambda road: motorway_lane(road.speed) * road.lanes,
    Weave: _weave,
    Roundabout: _roundabout,
    Minor: _minor,
    Arterial: _arterial,
}

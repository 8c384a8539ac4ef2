"""Sensors, messages and tracks of all AVs in one frame (numba kernels).

`S` slots of objects (vehicles and persons), `A` slots of AVs, `T` frames in a ring buffer: frame `f` is at
index `f % T`. SI units, rad. A frame has an integer number on the simulation's clock. Every random number is
a hash of vehicles, a purpose and a frame's or message's number: it does not depend on other vehicles.
"""

import math

import numpy as np
import numpy.typing as npt

from cosim.arrays import Floats
from cosim.geometry.compiled import compiled

Flags = npt.NDArray[np.uint8]
Lists = npt.NDArray[np.int32]
Streams = npt.NDArray[np.uint64]
Rows = npt.NDArray[np.int64]
Outlines = tuple[Rows, Floats, Floats, Floats]  # as `cosim.sensing.walls.Walls`
Radio = tuple[float, float, float, float, float, float]  # range m, period s, delay s, jitter s, loss, burst

# Values of `seen`: detection of an object by an AV's own sensors.
OUT_OF_RANGE, HIDDEN, MISSED, DETECTED = 0, 1, 2, 3
# Values of `source`, as `cosim.types.Source`.
SENSOR, CAM, CPM = 1, 2, 3
HOLD, CONSTANT_VELOCITY, LANES, TRUTH = 0, 1, 2, 3
# Columns of the ring of true states.
X, Y, HEADING, SPEED, LANE, POSITION, INDICATOR = range(7)
STATES = 7
# Columns of a track: time (s, nan: none), x, y (m), velocity (m/s), heading (rad), variance of a coordinate,
# its covariance with speed, variances of speed and heading; last accepted measurement (s), lane, front bumper
# on it (m), source, detections, acceleration (m/s2), time of the newest CAM (s), whether a CAM was received,
# turn indicator.
T_TIME, T_X, T_Y, T_VX, T_VY, T_HEADING, T_XX, T_XV, T_VV, T_HH, T_ACCEPTED, T_LANE, T_POSITION = range(13)
T_SOURCE, T_HITS, T_ACCEL, T_CAM, T_TOLD, T_INDICATOR = range(13, 19)
TRACK = 19
# Columns of a belief: an object's present state as estimated by an AV, its age (s), source (`OWN`: the AV
# itself), whether a CAM was received, and its turn indicator.
B_X, B_Y, B_HEADING, B_SPEED, B_ACCEL, B_LANE, B_POSITION, B_AGE, B_SOURCE, B_TOLD, B_INDICATOR = range(11)
BELIEF = 11
OWN = -1.0

BINS = 720  # number of directions of the line of sight, half a degree each
BIN = 2.0 * math.pi / BINS  # rad
_COS, _SIN = np.cos((np.arange(BINS) + 0.5) * BIN), np.sin((np.arange(BINS) + 0.5) * BIN)
TOUCH = 0.05  # m, minimum difference of two distances in one direction
ACCELERATION_NOISE = 4.0  # m2/s3, spectral density of the constant-velocity model: (2 m/s2)^2 over 1 s
TURN_NOISE = 0.05  # rad2/s, spectral density of the constant-heading model: 0.22 rad in 1 s
GATE = 18.47  # chi-squared with 4 degrees of freedom, 99.9 %: beyond it a track is reinitialised
LEAST_VARIANCE = 1e-6  # of a measurement without noise
SMOOTHING = 0.5  # weight of the newest value in the smoothed acceleration
FURTHEST_BACK = 100_000  # messages, search limit for a channel's state, never reached in practice

_GOLD = np.uint64(0x9E3779B97F4A7C15)
_M1, _M2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_ONE = np.uint64(1)
# Purposes of draws: detection, noise of own sensors (six), of a sender (six), phase of its messages; loss and
# delay of each kind of message.
_DETECTS, _NOISE, _STATES, _PHASE = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
_LOSS, _DELAY = np.uint64(16), np.uint64(32)
CAM_KIND, CPM_KIND, MCM_KIND = np.uint64(1), np.uint64(2), np.uint64(3)


# ---- draws ----


@compiled
def _mixed(z: np.uint64) -> np.uint64:
    z = (z ^ (z >> _30)) * _M1
    z = (z ^ (z >> _27)) * _M2
    return z ^ (z >> _31)


@compiled
def stream_of(first: np.uint64, second: np.uint64, purpose: np.uint64) -> np.uint64:
    """The random stream of an ordered pair of vehicles for a purpose."""
    return _mixed(first + _mixed(second + purpose * _GOLD))


@compiled
def draw(stream: np.uint64, number: int) -> float:
    """The `number`-th draw of a stream in [0, 1)."""
    return float(_mixed(stream + _GOLD * (np.uint64(number) + _ONE)) >> _11) * 2.0**-53


@compiled
def normal(stream: np.uint64, number: int) -> float:
    """The `number`-th standard normal draw of a stream (Box and Muller 1958)."""
    u, v = draw(stream, 2 * number), draw(stream, 2 * number + 1)
    return math.sqrt(-2.0 * math.log(1.0 - u)) * math.cos(2.0 * math.pi * v)


@compiled
def lost(stream: np.uint64, number: int, loss: float, burst: float) -> bool:
    """Whether message `number` of a channel is lost (Gilbert's two-state model; the bad state loses all).

    A draw below the probability of becoming bad makes the state bad from either state; a draw above the
    probability of staying bad makes it good. The state therefore follows from the newest such draw alone.

    Args:
        loss: share of lost messages.
        burst: mean length of a run of losses; at least 1 / (1 - loss).
    """
    if loss <= 0.0:
        return False
    becomes_bad, stays_bad = loss / (burst * (1.0 - loss)), 1.0 - 1.0 / burst
    for back in range(FURTHEST_BACK):
        u = draw(stream, number - back)
        if u < becomes_bad:
            return True
        if u >= stays_bad:
            return False
    return True


@compiled
def newest_message(
    now: float,  # s
    after: float,  # s, only messages of a later state
    sender: np.uint64,
    receiver: np.uint64,
    kind: np.uint64,
    period: float,  # s
    delay: float,  # s
    jitter: float,  # s
    loss: float,
    burst: float,
) -> tuple[float, int]:
    """Time (s) and number of the newest arrived message of one kind; (-1, 0): none."""
    phase = draw(stream_of(sender, sender, _PHASE + kind), 0)
    number = math.floor(now / period - phase + 1e-9)
    channel = stream_of(sender, receiver, _LOSS + kind)
    late = stream_of(sender, receiver, _DELAY + kind)
    while number >= 0:
        time = (number + phase) * period
        if time <= after + 1e-9:
            break
        wait = delay
        if jitter > 0.0:
            wait -= jitter * math.log(1.0 - draw(late, number))
        if time + wait <= now + 1e-9 and not lost(channel, number, loss, burst):
            return time, number
        number -= 1
    return -1.0, 0


# ---- line of sight ----


@compiled
def _entry(dx: float, dy: float, ux: float, uy: float, c: float, s: float, half: float, side: float) -> float:
    """m along the direction (ux, uy) to a box with its centre at (dx, dy); inf if it misses the box."""
    ox, oy = -(c * dx + s * dy), s * dx - c * dy  # the origin in the box's frame
    vx, vy = c * ux + s * uy, c * uy - s * ux
    near, far = 0.0, np.inf
    if abs(vx) < 1e-12:
        if abs(ox) > half:
            return np.inf
    else:
        a, b = (-half - ox) / vx, (half - ox) / vx
        near, far = max(near, min(a, b)), min(far, max(a, b))
    if abs(vy) < 1e-12:
        if abs(oy) > side:
            return np.inf
    else:
        a, b = (-side - oy) / vy, (side - oy) / vy
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near if near <= far else np.inf


@compiled
def _spread(dx: float, dy: float, c: float, s: float, half: float, side: float) -> tuple[float, float]:
    """Smallest and largest direction (rad) of a box, relative to its centre's direction."""
    middle = math.atan2(dy, dx)
    low, high = 0.0, 0.0
    for along in (-half, half):
        for across in (-side, side):
            x, y = dx + c * along - s * across, dy + s * along + c * across
            turn = math.atan2(y, x) - middle
            turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
            low, high = min(low, turn), max(high, turn)
    return middle + low, middle + high


@compiled
def _within(points: Floats, first: int, last: int, x: float, y: float) -> bool:
    """Whether a point (m) is inside the closed polygon of the points `first` to `last`."""
    inside = False
    for k in range(first, last):
        ax, ay, bx, by = points[k, 0], points[k, 1], points[k + 1, 0], points[k + 1, 1]
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
    return inside


@compiled
def _behind_walls(walls: Outlines, x0: float, y0: float, reach: float, depth: Floats) -> None:
    """Lower `depth` [BINS] (m) to the nearest wall in each direction from (x0, y0); `reach` in m.

    A building around (x0, y0) hides nothing: the car is below it, or the polygon is wrong.
    """
    begin, points, centre, radius = walls
    for b in range(radius.shape[0]):
        away = math.hypot(centre[b, 0] - x0, centre[b, 1] - y0)
        if away > reach + radius[b]:
            continue
        if away < radius[b] and _within(points, begin[b], begin[b + 1] - 1, x0, y0):
            continue
        for k in range(begin[b], begin[b + 1] - 1):
            px, py = points[k, 0] - x0, points[k, 1] - y0
            dx, dy = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
            low = math.atan2(py, px)
            turn = math.atan2(py + dy, px + dx) - low
            turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
            low = min(low, low + turn)
            side = px * dy - py * dx
            for i in range(math.floor(low / BIN), math.floor((low + abs(turn)) / BIN) + 1):
                ux, uy = _COS[i % BINS], _SIN[i % BINS]
                across = ux * dy - uy * dx
                if across == 0.0:
                    continue
                far, share = side / across, (px * uy - py * ux) / across
                if far >= 0.0 and -1e-9 <= share <= 1.0 + 1e-9:
                    depth[i % BINS] = min(depth[i % BINS], far)


@compiled
def detect(
    state: Floats,  # [S,7] true states, x nan where absent
    length: Floats,  # [S] m
    width: Floats,  # [S] m
    hides: Flags,  # [S] whether the body hides objects behind it
    egos: Rows,  # [A] slot of each AV, -1: none
    streams: Streams,  # [S]
    step: int,  # the frame's number on the clock
    reach: float,  # m
    half_view: float,  # rad
    line_of_sight: bool,
    visible_share: float,
    miss: float,
    walls: Outlines,
    seen: Flags,  # [A,S] out
    found: Lists,  # [A,S] out: the slots that are DETECTED, then -1
) -> None:
    """Detection of every object by own sensors in this frame."""
    slots = state.shape[0]
    depth = np.empty(BINS)  # m to the nearest body in each direction
    for a in range(egos.shape[0]):
        ego = egos[a]
        seen[a], found[a, 0] = OUT_OF_RANGE, -1
        if ego < 0:
            continue
        x0, y0, h0 = state[ego, X], state[ego, Y], state[ego, HEADING]
        if line_of_sight:
            depth[:] = np.inf
            _behind_walls(walls, x0, y0, reach, depth)
        for o in range(slots):
            dx, dy = state[o, X] - x0, state[o, Y] - y0
            if o == ego or not dx * dx + dy * dy <= reach * reach:
                continue
            seen[a, o] = DETECTED
            if line_of_sight and hides[o]:
                c, s = math.cos(state[o, HEADING]), math.sin(state[o, HEADING])
                half, side = 0.5 * length[o], 0.5 * width[o]
                low, high = _spread(dx, dy, c, s, half, side)
                for k in range(math.floor(low / BIN), math.floor(high / BIN) + 1):
                    bin_ = k % BINS
                    away = _entry(dx, dy, _COS[bin_], _SIN[bin_], c, s, half, side)
                    depth[bin_] = min(depth[bin_], away)
        many = 0
        for o in range(slots):
            if seen[a, o] == OUT_OF_RANGE:
                continue
            dx, dy = state[o, X] - x0, state[o, Y] - y0
            turn = math.atan2(dy, dx) - h0
            turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
            if abs(turn) > half_view:
                seen[a, o] = OUT_OF_RANGE
                continue
            if line_of_sight and not _in_sight(
                depth, dx, dy, state[o, HEADING], length[o], width[o], visible_share
            ):
                seen[a, o] = HIDDEN
                continue
            if miss > 0.0 and draw(stream_of(streams[ego], streams[o], _DETECTS), step) < miss:
                seen[a, o] = MISSED
                continue
            found[a, many] = o
            many += 1
        found[a, many] = -1


@compiled
def _in_sight(
    depth: Floats, dx: float, dy: float, heading: float, length: float, width: float, share: float
) -> bool:
    """Whether the given share of a box's angular width is unobstructed."""
    c, s = math.cos(heading), math.sin(heading)
    half, side = 0.5 * length, 0.5 * width
    low, high = _spread(dx, dy, c, s, half, side)
    free, all_ = 0, 0
    for k in range(math.floor(low / BIN), math.floor(high / BIN) + 1):
        bin_ = k % BINS
        away = _entry(dx, dy, _COS[bin_], _SIN[bin_], c, s, half, side)
        if away < np.inf:
            all_ += 1
            free += away <= depth[bin_] + TOUCH
    if all_ == 0:  # narrower than a direction
        k = math.floor(0.5 * (low + high) / BIN)
        return bool(math.hypot(dx, dy) <= depth[k % BINS] + TOUCH + half)
    return bool(free > 0 and free >= share * all_)


# ---- tracks ----


@compiled
def _update(
    track: Floats,  # [18]
    time: float,  # s, of the measurement
    now: float,  # s
    x: float,
    y: float,
    heading: float,
    speed: float,
    position_variance: float,  # m2
    speed_variance: float,  # m2/s2
    heading_variance: float,  # rad2
    source: int,
) -> None:
    """One step of a constant-velocity Kalman filter, shared by both coordinates (equal variances), and of the
    heading's filter. A measurement outside the gate reinitialises the track."""
    dt = time - track[T_TIME]
    vx, vy = speed * math.cos(heading), speed * math.sin(heading)
    r_x = max(position_variance, LEAST_VARIANCE)
    r_v = max(speed_variance + speed * speed * heading_variance, LEAST_VARIANCE)
    r_h = max(heading_variance, LEAST_VARIANCE)
    hits = 1.0 if math.isnan(track[T_TIME]) else track[T_HITS] + 1.0
    begins = math.isnan(track[T_TIME])
    if not begins:
        q = ACCELERATION_NOISE
        xx = track[T_XX] + 2.0 * dt * track[T_XV] + dt * dt * track[T_VV] + q * dt**3 / 3.0
        xv = track[T_XV] + dt * track[T_VV] + 0.5 * q * dt * dt
        vv = track[T_VV] + q * dt
        px, py = track[T_X] + dt * track[T_VX], track[T_Y] + dt * track[T_VY]
        ex, ey, evx, evy = x - px, y - py, vx - track[T_VX], vy - track[T_VY]
        s_x, s_v = xx + r_x, vv + r_v
        det = s_x * s_v - xv * xv
        i_x, i_v, i_xv = s_v / det, s_x / det, -xv / det  # inverse of the innovation's covariance
        far = i_x * (ex * ex + ey * ey) + 2.0 * i_xv * (ex * evx + ey * evy) + i_v * (evx * evx + evy * evy)
        begins = far > GATE
    if begins:
        track[T_X], track[T_Y], track[T_VX], track[T_VY], track[T_HEADING] = x, y, vx, vy, heading
        track[T_XX], track[T_XV], track[T_VV], track[T_HH] = r_x, 0.0, r_v, r_h
        track[T_ACCEL] = 0.0
    else:
        before = math.hypot(track[T_VX], track[T_VY])
        k_xx, k_xv = xx * i_x + xv * i_xv, xx * i_xv + xv * i_v
        k_vx, k_vv = xv * i_x + vv * i_xv, xv * i_xv + vv * i_v
        track[T_X], track[T_Y] = px + k_xx * ex + k_xv * evx, py + k_xx * ey + k_xv * evy
        track[T_VX] += k_vx * ex + k_vv * evx
        track[T_VY] += k_vx * ey + k_vv * evy
        track[T_XX], track[T_XV] = (1.0 - k_xx) * xx - k_xv * xv, (1.0 - k_xx) * xv - k_xv * vv
        track[T_VV] = (1.0 - k_vv) * vv - k_vx * xv
        gained = (math.hypot(track[T_VX], track[T_VY]) - before) / dt
        track[T_ACCEL] += SMOOTHING * (gained - track[T_ACCEL])
        turn = heading - track[T_HEADING]
        turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
        hh = track[T_HH] + TURN_NOISE * dt
        track[T_HEADING] += turn * hh / (hh + r_h)
        track[T_HH] = hh * r_h / (hh + r_h)
    track[T_TIME], track[T_ACCEPTED], track[T_SOURCE], track[T_HITS] = time, now, source, hits


@compiled
def _between(ring: Floats, at: float, newest: int, held: int, slot: int, out: Floats) -> bool:
    """The true state of a slot `at` frames after the newest (negative: before); False if unknown."""
    size = ring.shape[0]
    first = math.floor(at + 1e-6)
    if first < 1 - held or first > 0:
        return False
    before = ring[(newest + first) % size, slot]
    if math.isnan(before[X]):
        return False
    out[:] = before
    share = at - first
    if share < 1e-6 or first == 0:
        return True
    after = ring[(newest + first + 1) % size, slot]
    if math.isnan(after[X]):
        return True
    turn = after[HEADING] - before[HEADING]
    turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    for k in (X, Y, SPEED):
        out[k] = before[k] + share * (after[k] - before[k])
    out[HEADING] = before[HEADING] + share * turn
    if after[LANE] == before[LANE]:
        out[POSITION] = before[POSITION] + share * (after[POSITION] - before[POSITION])
    else:  # on the earlier lane: `believe` advances to the next lane
        out[POSITION] = before[POSITION] + math.hypot(out[X] - before[X], out[Y] - before[Y])
    return True


@compiled
def follow(
    ring: Floats,  # [T,S,7]
    seen: Flags,  # [T,A,S]
    found: Lists,  # [T,A,S] from `detect`; slots of objects that left are not DETECTED in `seen`
    newest: int,  # newest frame in the rings
    held: int,  # number of frames in the rings
    egos: Rows,  # [A]
    equipped: Flags,  # [S] whether it sends CAMs
    streams: Streams,  # [S]
    step: int,
    now: float,  # s
    frame: float,  # s between frames
    lag: int,  # frames of delay of own measurements
    noise: Floats,  # [3] of own sensors: m, m/s, rad
    contents: Flags,  # [2] CAMs enabled, CPMs enabled
    radio: Radio,
    sender_noise: Floats,  # [3]
    tracks: Floats,  # [A,S,19] in and out
    heard: Floats,  # [A,A] time of the newest CPM of each sender, in and out
) -> None:
    """Update every AV's tracks with the newest measurement of each object in this frame."""
    size, slots = ring.shape[0], ring.shape[1]
    best = np.empty(slots)  # s, time of the newest measurement
    source = np.empty(slots, np.int64)
    whose = np.empty(slots, np.int64)  # slot of the measuring vehicle; for a CAM the message's number
    truth = np.empty(STATES)
    reach, period, delay, jitter, loss, burst = radio
    oldest = now - (held - 1) * frame - 1e-6  # s: earlier states are no longer in the rings
    for a in range(egos.shape[0]):
        ego = egos[a]
        if ego < 0:
            continue
        best[:] = -1.0
        x0, y0 = ring[newest % size, ego, X], ring[newest % size, ego, Y]
        if lag < held:
            k = (newest - lag) % size
            for o in found[k, a]:
                if o < 0:
                    break
                if seen[k, a, o] == DETECTED:
                    best[o], source[o], whose[o] = now - lag * frame, SENSOR, ego
        if contents[0]:
            for o in range(slots):
                if not equipped[o] or o == ego:
                    continue
                dx, dy = ring[newest % size, o, X] - x0, ring[newest % size, o, Y] - y0
                if not dx * dx + dy * dy <= reach * reach:
                    continue
                after = max(tracks[a, o, T_CAM], oldest)
                time, number = newest_message(
                    now, after, streams[o], streams[ego], CAM_KIND, period, delay, jitter, loss, burst
                )
                if time < 0.0:
                    continue
                tracks[a, o, T_CAM], tracks[a, o, T_TOLD] = time, 1.0
                if time > best[o]:
                    best[o], source[o], whose[o] = time, CAM, number
        if contents[1]:
            for b in range(egos.shape[0]):
                sender = egos[b]
                if b == a or sender < 0:
                    continue
                dx, dy = ring[newest % size, sender, X] - x0, ring[newest % size, sender, Y] - y0
                if not dx * dx + dy * dy <= reach * reach:
                    continue
                after = max(heard[a, b], oldest)
                time, number = newest_message(
                    now, after, streams[sender], streams[ego], CPM_KIND, period, delay, jitter, loss, burst
                )
                if time < 0.0:
                    continue
                heard[a, b] = time
                back = lag - math.floor((time - now) / frame + 1e-6)  # frames
                if back >= held:
                    continue
                k, when = (newest - back) % size, now - back * frame
                for o in found[k, b]:
                    if o < 0:
                        break
                    if seen[k, b, o] == DETECTED and when > best[o] and o != ego:
                        best[o], source[o], whose[o] = when, CPM, sender
        for o in range(slots):
            if best[o] < 0.0 or best[o] <= tracks[a, o, T_TIME] + 1e-6:
                continue
            track = tracks[a, o]
            if not _between(ring, (best[o] - now) / frame, newest, held, o, truth):
                continue
            if source[o] == CAM:
                sigma, drawn = sender_noise, stream_of(streams[o], streams[o], _STATES)
                number = 4 * whose[o]
            else:
                sigma, drawn = noise, stream_of(streams[whose[o]], streams[o], _NOISE)
                number = 4 * (step + round((best[o] - now) / frame))
            x, y, heading, speed = truth[X], truth[Y], truth[HEADING], truth[SPEED]
            if sigma[0] > 0.0:
                x += sigma[0] * normal(drawn, number)
                y += sigma[0] * normal(drawn, number + 1)
            if sigma[1] > 0.0:
                speed = max(speed + sigma[1] * normal(drawn, number + 2), 0.0)
            if sigma[2] > 0.0:
                heading += sigma[2] * normal(drawn, number + 3)
            _update(
                track,
                best[o],
                now,
                x,
                y,
                heading,
                speed,
                sigma[0] ** 2,
                sigma[1] ** 2,
                sigma[2] ** 2,
                source[o],
            )
            ahead = (track[T_X] - truth[X]) * math.cos(truth[HEADING])
            ahead += (track[T_Y] - truth[Y]) * math.sin(truth[HEADING])
            track[T_LANE], track[T_POSITION] = truth[LANE], truth[POSITION] + ahead
            track[T_INDICATOR] = truth[INDICATOR]


@compiled
def intentions_heard(
    state: Floats,  # [S,7] now
    egos: Rows,  # [A]
    streams: Streams,  # [S]
    now: float,  # s
    decision: float,  # s, deadline for an intention
    radio: Radio,
    heard: Flags,  # [A,A] out
) -> None:
    """Whether each AV receives each other AV's present intention: its newest MCM arrives in time."""
    reach, period, delay, jitter, loss, burst = radio
    heard[:] = 0
    for a in range(egos.shape[0]):
        for b in range(egos.shape[0]):
            me, other = egos[a], egos[b]
            if a == b or me < 0 or other < 0:
                continue
            dx, dy = state[other, X] - state[me, X], state[other, Y] - state[me, Y]
            if not dx * dx + dy * dy <= reach * reach:
                continue
            number = math.floor(now / period + 1e-9)
            wait = delay
            if jitter > 0.0:
                late = stream_of(streams[other], streams[me], _DELAY + MCM_KIND)
                wait -= jitter * math.log(1.0 - draw(late, number))
            channel = stream_of(streams[other], streams[me], _LOSS + MCM_KIND)
            heard[a, b] = wait <= decision and not lost(channel, number, loss, burst)


# ---- beliefs ----


@compiled
def _on_lane(
    begin: Rows, points: Floats, scale: Floats, lane: int, position: float
) -> tuple[float, float, float]:
    """x, y (m) and heading (rad) at a position (m, SUMO's) of a lane; straight beyond its ends."""
    first, last = begin[lane], begin[lane + 1] - 1
    arc = position * scale[lane]
    k = first
    while k < last - 1 and points[k + 1, 2] <= arc:
        k += 1
    dx, dy = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
    span = max(points[k + 1, 2] - points[k, 2], 1e-9)
    share = (arc - points[k, 2]) / span
    return points[k, 0] + share * dx, points[k, 1] + share * dy, math.atan2(dy, dx)


@compiled
def _drive_on(following: Rows, length: Floats, lane: int, position: float) -> tuple[int, float]:
    """Lane and position (m) of a vehicle after it drove straight on beyond the end of `lane`."""
    while position > length[lane] and following[lane] >= 0:
        position -= length[lane]
        lane = following[lane]
    return lane, position


@compiled
def drive_on(following: Rows, length: Floats, lane: Rows, position: Floats) -> None:
    """`_drive_on` in place for arrays of `lane` and `position` (m)."""
    for k in range(lane.shape[0]):
        if lane[k] >= 0:
            lane[k], position[k] = _drive_on(following, length, lane[k], position[k])


@compiled
def resample(
    time: Floats,  # [V,N] s of each measurement, in order; nan: none
    state: Floats,  # [V,N,C] columns of each measurement
    frame: float,  # s
    out: Floats,  # [V,N,C] `frame` s apart, the last unchanged; nan where unknown
) -> None:
    """Irregular series of measurements, resampled at equal intervals by linear interpolation."""
    frames = time.shape[1]
    for v in range(time.shape[0]):
        out[v] = np.nan
        out[v, frames - 1] = state[v, frames - 1]
        later = frames - 1
        for k in range(frames - 2, -1, -1):
            at = time[v, frames - 1] - (frames - 1 - k) * frame
            earlier = later
            while earlier >= 0 and time[v, earlier] > at + 1e-6:
                later = earlier
                earlier -= 1
            if earlier < 0 or not time[v, earlier] <= at + 1e-6:  # or nan
                break
            span = time[v, later] - time[v, earlier]
            share = (at - time[v, earlier]) / span if span > 1e-9 else 0.0
            share = 0.0 if share < 1e-6 else share
            for c in range(state.shape[2]):
                gain = 0.0 if share == 0.0 else share * (state[v, later, c] - state[v, earlier, c])
                out[v, k, c] = state[v, earlier, c] + gain


@compiled
def believe(
    state: Floats,  # [S,7] now, for compensation with the truth
    length: Floats,  # [S] m
    egos: Rows,  # [A]
    now: float,  # s
    confirm: int,
    forget: float,  # s
    compensation: int,
    begin: Rows,  # [l+1] first point of each lane
    points: Floats,  # [p,3] x m, y m, m along the lane
    scale: Floats,  # [l] m along the centre line per SUMO's m
    following: Rows,  # [l]
    lane_length: Floats,  # [l] m
    tracks: Floats,  # [A,S,19] in and out: ended tracks are cleared
    first: Rows,  # [A+1] out: first of the M beliefs of each AV
    slot: Rows,  # [A*S] out, the first M: slot of the object; ascending for one AV
    beliefs: Floats,  # [A*S,11] out, the first M
) -> None:
    """Every AV's belief about the present state of all objects; its own state is exact, acceleration 0."""
    many = 0
    for a in range(egos.shape[0]):
        first[a] = many
        if egos[a] < 0:
            continue
        for o in range(state.shape[0]):
            if o == egos[a]:
                belief = beliefs[many]
                slot[many] = o
                many += 1
                belief[B_X], belief[B_Y], belief[B_HEADING] = state[o, X], state[o, Y], state[o, HEADING]
                belief[B_SPEED], belief[B_LANE] = state[o, SPEED], state[o, LANE]
                belief[B_POSITION], belief[B_ACCEL] = state[o, POSITION], 0.0
                belief[B_AGE], belief[B_SOURCE], belief[B_TOLD] = 0.0, OWN, 1.0
                belief[B_INDICATOR] = state[o, INDICATOR]
                continue
            track = tracks[a, o]
            if math.isnan(track[T_TIME]):
                continue
            if now - track[T_ACCEPTED] > forget + 1e-6:
                track[:] = np.nan
                track[T_CAM], track[T_TOLD] = -1.0, 0.0
                continue
            if track[T_HITS] < confirm and track[T_SOURCE] == SENSOR:
                continue
            belief = beliefs[many]
            slot[many] = o
            many += 1
            heading, lane, position = track[T_HEADING], int(track[T_LANE]), track[T_POSITION]
            if lane >= 0:  # noise alone does not carry an object over the end of its lane
                position = max(min(position, lane_length[lane] - math.sqrt(track[T_XX])), 0.0)
            speed = max(track[T_VX] * math.cos(heading) + track[T_VY] * math.sin(heading), 0.0)
            x, y, age = track[T_X], track[T_Y], now - track[T_TIME]
            belief[B_AGE], belief[B_SOURCE], belief[B_TOLD] = age, track[T_SOURCE], track[T_TOLD]
            belief[B_ACCEL], belief[B_INDICATOR] = track[T_ACCEL], track[T_INDICATOR]
            if compensation == TRUTH and not math.isnan(state[o, X]):
                x, y, heading, speed = state[o, X], state[o, Y], state[o, HEADING], state[o, SPEED]
                lane, position = int(state[o, LANE]), state[o, POSITION]
            elif compensation != HOLD:
                way = speed * age
                if compensation == CONSTANT_VELOCITY or lane < 0:
                    x, y = x + way * math.cos(heading), y + way * math.sin(heading)
                else:
                    centre = position - 0.5 * length[o]
                    px, py, ph = _on_lane(begin, points, scale, lane, centre)
                    c, s = math.cos(ph), math.sin(ph)
                    along, left = c * (x - px) + s * (y - py), c * (y - py) - s * (x - px)
                    there, centre = _drive_on(following, lane_length, lane, centre + way)
                    qx, qy, qh = _on_lane(begin, points, scale, there, centre)
                    c, s = math.cos(qh), math.sin(qh)
                    x, y = qx + c * along - s * left, qy + s * along + c * left
                    heading += qh - ph
                position += way
            if lane >= 0:
                lane, position = _drive_on(following, lane_length, lane, position)
            belief[B_X], belief[B_Y], belief[B_HEADING], belief[B_SPEED] = x, y, heading, speed
            belief[B_LANE], belief[B_POSITION] = lane, position
    first[egos.shape[0]] = many


@compiled
def arrange(
    first: Rows,  # [A+1], [M] and [M,11] of `believe`
    slot: Rows,
    beliefs: Floats,
    place: Rows,  # [k] of S slots, in the wanted order
    slots: int,  # S
    rows: Rows,  # [M] out: index among the k of each belief's object
    columns: Floats,  # [11,M] out
) -> None:
    """The beliefs of each AV in the order of `place`."""
    at = np.full(slots, -1)  # the belief about each
    for a in range(first.shape[0] - 1):
        for m in range(first[a], first[a + 1]):
            at[slot[m]] = m
        n = first[a]
        for k in range(place.shape[0]):
            m = at[place[k]]
            if m >= 0:
                rows[n], at[place[k]] = k, -1
                for c in range(BELIEF):
                    columns[c, n] = beliefs[m, c]
                n += 1

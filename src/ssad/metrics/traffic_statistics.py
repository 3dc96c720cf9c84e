"""Statistics of traffic that are published for human drivers: following, braking, junctions, signals, lanes.

All functions are pure. T steps, N vehicles; `present` [T, N] tells where a vehicle is in the traffic, and rows where it
is not are ignored. Vehicles of several scenes may stand side by side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Bool

Ints = npt.NDArray[np.int64]

STANDS = 0.2  # m/s
FOLLOWS = 5.0  # s: a vehicle with a larger time gap drives freely
MOVES = 3.0  # m/s from which a time gap says something
QUEUE_GAP = 8.0  # m between two that stand in one queue, at most
CELL = 1.0  # m, side of the cells in which paths cross
CROSSES = math.radians(30.0)  # least difference of two headings of paths that cross
QUEUE_START = 4  # first position in a queue whose headway counts as saturated (Highway Capacity Manual)


def begins(state: Bool) -> Bool:
    """Return where a state [T, N] begins: it holds, and did not one step before. The first stay_row never counts."""
    starts = np.zeros_like(state)
    starts[1:] = state[1:] & ~state[:-1]
    return starts


def braking_onsets(acceleration: F64, present: Bool, threshold: float) -> int:
    """Count how often vehicles begin to brake harder than a threshold.

    Args:
        acceleration: [T, N] m/s^2 along the heading.
        present: [T, N].
        threshold: m/s^2, positive.
    """
    both = present.copy()
    both[1:] &= present[:-1]
    return int((begins(acceleration < -threshold) & both).sum())


def distance(speed: F64, present: Bool, time_step: float) -> float:
    """Return the metres that all vehicles travel together; speed [T, N] m/s, time_step s."""
    return float(np.abs(speed)[present].sum() * time_step)


def jerk(acceleration: F64, present: Bool, time_step: float) -> F64:
    """Return the jerk of all vehicles in one stay_row, m/s^3: differences of acceleration [T, N] over time_step s."""
    both = present[1:] & present[:-1]
    return np.asarray(np.diff(acceleration, axis=0)[both] / time_step, np.float64)


def lateral_acceleration(speed: F64, yaw: F64, present: Bool, time_step: float) -> F64:
    """Return the magnitude of the acceleration to the side in one stay_row, m/s^2: speed times rate of turn.

    Args:
        speed: [T, N] m/s.
        yaw: [T, N] rad.
        present: [T, N].
        time_step: s.
    """
    both = present[1:] & present[:-1]
    rate = np.asarray(wrap_angle(np.diff(yaw, axis=0))) / time_step
    return np.asarray(np.abs(0.5 * (speed[1:] + speed[:-1]) * rate)[both], np.float64)


def time_gaps(gap: F64, speed: F64, present: Bool) -> F64:
    """Return the time gaps of followers in one stay_row, s: gap over speed, where it is below 5 s and they move.

    Args:
        gap: [T, N] m from front bumper to the leader's rear; infinite without a leader.
        speed: [T, N] m/s.
        present: [T, N].
    """
    moving = present & (speed > MOVES) & np.isfinite(gap)
    values = gap[moving] / speed[moving]
    return np.asarray(values[values < FOLLOWS], np.float64)


def standstill_gaps(gap: F64, speed: F64, leader_speed: F64, present: Bool) -> F64:
    """Return the gaps of vehicles that stand behind a standing leader, m: one value for each stop, at its end.

    Gaps above 8 m are left out: such a vehicle stands for another reason.

    Args:
        gap: [T, N] m, infinite without a leader.
        speed: [T, N] m/s.
        leader_speed: [T, N] m/s.
        present: [T, N].
    """
    stands = present & (np.abs(speed) < STANDS) & (np.abs(leader_speed) < STANDS) & np.isfinite(gap)
    last = stands.copy()
    last[:-1] &= ~stands[1:]
    return np.asarray(gap[last & (gap < QUEUE_GAP)], np.float64)


def lane_changes(lane: Ints, left: Ints, right: Ints, present: Bool) -> int:
    """Count lane changes: steps in which a vehicle comes onto the lane beside its own.

    Args:
        lane: [T, N] lane under the vehicle, -1: none.
        left: [L] lane on the left of each lane, -1: none.
        right: [L] lane on its right.
        present: [T, N].
    """
    before, after = lane[:-1], lane[1:]
    usable = (before >= 0) & (after >= 0) & (before != after) & present[1:] & present[:-1]
    beside = (left[np.maximum(before, 0)] == after) | (right[np.maximum(before, 0)] == after)
    return int((usable & beside).sum())


@dataclass(frozen=True)
class Discharge:
    """Discharge of queues at signals.

    Attributes:
        headways: Saturated headways, s: from the fourth vehicle of a queue on.
        first: Time from the beginning of green until the first vehicle of a queue crosses the line, s.
        lost: Start-up lost time, s: what the first three headways exceed the mean saturated one, summed; NaN with fewer
            than `min_headways` saturated headways.
    """

    headways: F64
    first: F64
    lost: float


def queue_discharge(since_green: F64, group: Ints, queued: Bool, *, min_headways: int = 10) -> Discharge:
    """Measure the discharge of queues from the moments at which vehicles cross stop lines.

    Args:
        since_green: [E] s from the beginning of green to each crossing.
        group: [E] number of the queue: one line in one cycle.
        queued: [E] whether the vehicle stood before the line during red. A queue ends before the first that did not.
        min_headways: Saturated headways without which there is no lost time.

    Source: Highway Capacity Manual, 7th edition, chapter 31 (field measurement of saturation flow).
    """
    order = np.lexsort((since_green, group))
    early: list[list[float]] = [[] for _ in range(QUEUE_START - 1)]
    saturated: list[float] = []
    for number in np.unique(group):
        moments = since_green[order][group[order] == number]
        stood = queued[order][group[order] == number]
        length = len(stood) if stood.all() else int(np.argmin(stood))
        for position, headway in enumerate(np.diff(moments[:length], prepend=0.0).tolist()):
            (early[position] if position < QUEUE_START - 1 else saturated).append(headway)
    lost = math.nan
    if len(saturated) >= min_headways:
        mean = float(np.mean(saturated))
        lost = sum(float(np.mean(values)) - mean for values in early if values)
    return Discharge(np.array(saturated), np.array(early[0]), lost)


@dataclass(frozen=True)
class Visits:
    """Stays of vehicles in cells of the ground, one stay_row each, sorted by scene, cell and time.

    Attributes:
        place: [V] number of scene and cell.
        vehicle: [V] column of the vehicle.
        first: [V] step in which it is there first.
        last: [V] step in which it is there last.
        yaw: [V] its heading when it comes, rad.
    """

    place: Ints
    vehicle: Ints
    first: Ints
    last: Ints
    yaw: F64


def visits(pose: F64, length: F64, scene: Ints, present: Bool, *, pause: int = 50) -> Visits:
    """Find the stays of vehicles in cells of one square metre along the middle of their bodies.

    Args:
        pose: [T, N, 3] x, y (m), yaw (rad).
        length: [N] m.
        scene: [N] number of each vehicle's scene.
        present: [T, N] where they count, for example inside junctions.
        pause: Steps after which a vehicle that comes again makes another stay.
    """
    step, vehicle = np.nonzero(present)
    half = 0.5 * length[vehicle]
    points = max(2, int(np.ceil(length.max(initial=1.0) / CELL)) + 1)
    share = np.linspace(-1.0, 1.0, points)
    east, north, yaw = (pose[step, vehicle, axis] for axis in range(3))
    columns = np.floor((east[:, None] + np.cos(yaw)[:, None] * half[:, None] * share) / CELL).astype(np.int64)
    lines = np.floor((north[:, None] + np.sin(yaw)[:, None] * half[:, None] * share) / CELL).astype(np.int64)
    place = ((scene[vehicle][:, None] << 40) + ((columns + (1 << 19)) << 20) + (lines + (1 << 19))).ravel()
    rows = np.stack([place, np.repeat(vehicle, points), np.repeat(step, points)], 1)
    rows, index = np.unique(rows, axis=0, return_index=True)
    if not len(rows):
        nothing = np.zeros(0, np.int64)
        return Visits(nothing, nothing, nothing, nothing, np.zeros(0))
    same = (rows[1:, :2] == rows[:-1, :2]).all(1) & (np.diff(rows[:, 2]) <= pause)
    start = np.append(True, ~same)
    end = np.append(~same, True)
    stay = np.stack([rows[start, 0], rows[start, 1], rows[start, 2], rows[end, 2]], 1)
    heading = np.repeat(yaw, points)[index][start]
    order = np.lexsort((stay[:, 2], stay[:, 0]))
    stay = stay[order]
    return Visits(stay[:, 0], stay[:, 1], stay[:, 2], stay[:, 3], heading[order])


def post_encroachment_times(
    stays: Visits, time_step: float, *, longest: float = 10.0, apart: Bool | None = None
) -> F64:
    """Return the post-encroachment times of vehicles whose paths cross, s: one for each two vehicles, the least.

    It is the time from when one leaves a place until another, on a crossing path, comes there.

    Args:
        stays: Stays of all vehicles.
        time_step: s.
        longest: Times above it, s, are left out.
        apart: [N] Only pairs of which exactly one is marked count, such as walkers among vehicles; None: all pairs.

    Source: Allen, B. L., Shin, B. T. and Cooper, P. J. (1978), Transportation Research Record 667.
    """
    next_same = stays.place[1:] == stays.place[:-1]
    crossing = np.abs(np.asarray(wrap_angle(stays.yaw[1:] - stays.yaw[:-1]))) > CROSSES
    other = stays.vehicle[1:] != stays.vehicle[:-1]
    if apart is not None:
        other &= apart[stays.vehicle[1:]] != apart[stays.vehicle[:-1]]
    time = np.maximum(stays.first[1:] - stays.last[:-1], 0) * time_step
    rows = np.flatnonzero(next_same & crossing & other & (time <= longest))
    shortest_times: dict[tuple[int, int], float] = {}
    for stay_row in rows.tolist():
        pair = (int(stays.vehicle[stay_row]), int(stays.vehicle[stay_row + 1]))
        shortest_times[pair] = min(shortest_times.get(pair, math.inf), float(time[stay_row]))
    return np.array(sorted(shortest_times.values()))


def gap_choices(stays: Visits, entries: Ints, time_step: float, *, longest: float = 15.0) -> tuple[F64, F64]:
    """Return the gaps in crossing traffic that waiting vehicles accepted and rejected, s.

    A gap lies between two vehicles that come past the place where the waiting one's path crosses theirs; the first
    begins with the wait.

    Args:
        stays: Stays inside the junctions.
        entries: [E, 3] vehicle, step in which it began to wait before a junction, step in which it entered.
        time_step: s.
        longest: Gaps above it, s, are left out: they need no decision.
    """
    accepted: list[float] = []
    rejected: list[float] = []
    for vehicle, waited, entered in entries.tolist():
        path = np.flatnonzero(
            (stays.vehicle == vehicle) & (stays.first >= entered) & (stays.first < entered + 15 / time_step)
        )
        moments: dict[int, int] = {}
        for stay_row in path.tolist():
            low, high = np.searchsorted(stays.place, [stays.place[stay_row], stays.place[stay_row] + 1])
            for other in range(int(low), int(high)):
                turn = abs(float(wrap_angle(stays.yaw[other] - stays.yaw[stay_row])))
                name = int(stays.vehicle[other])
                if name != vehicle and turn > CROSSES:
                    moments[name] = min(moments.get(name, 1 << 40), int(stays.first[other]))
        times = np.array(sorted(moment for moment in moments.values() if moment >= waited))
        before, after = times[times < entered], times[times >= entered]
        edges = np.append(waited, before)
        rejected += (np.diff(edges) * time_step).tolist()
        if len(after):
            accepted.append(float(after[0] - edges[-1]) * time_step)
    return (
        np.array([gap for gap in accepted if gap <= longest]),
        np.array([gap for gap in rejected if 0.0 < gap <= longest]),
    )


def critical_gap(accepted: F64, rejected: F64) -> float:
    """Return the critical gap, s: as many accepted gaps are shorter as rejected ones are longer; NaN without both.

    Source: Raff, M. S. (1950). A volume warrant for urban stop signs. Eno Foundation.
    """
    if not len(accepted) or not len(rejected):
        return math.nan
    times = np.unique(np.concatenate([accepted, rejected]))
    shorter = np.searchsorted(np.sort(accepted), times, side="left")
    longer = len(rejected) - np.searchsorted(np.sort(rejected), times, side="right")
    return float(times[int(np.argmax(shorter >= longer))])


def quantiles(values: F64) -> dict[str, float]:
    """Return count, mean, standard deviation and percentiles 5, 50, 95 and 99 of values; empty without values."""
    if not len(values):
        return {}
    low, middle, high, top = np.percentile(values, [5, 50, 95, 99]).tolist()
    return {
        "count": float(len(values)),
        "mean": float(values.mean()),
        "sd": float(values.std()),
        "p5": low,
        "p50": middle,
        "p95": high,
        "p99": top,
    }

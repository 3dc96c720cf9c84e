"""Proven collisions: closed-form drives on a straight road of one lane in each direction."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from helpers.metric_traces import make_trace, straight

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import AgentKind, EpisodeTrace
from ssad.metrics.proven_collisions import (
    Accelerations,
    lane_directions,
    peak_accelerations,
    prove_collision,
    takes_wrong_side,
    touches_others,
    wrong_way_steps,
)

STEPS = 31
TIME = 0.1 * np.arange(STEPS)
CAR = Accelerations(3.5, 8.0, 7.0)


def road(*, overlapping: bool = False) -> LaneGraph:
    """Two lanes 4 m wide along x: eastbound about y = 0, westbound about y = 4; a lane northwards across them."""
    lanes = [[(-100.0, 0.0), (0.0, 0.0), (200.0, 0.0)], [(200.0, 4.0), (-100.0, 4.0)]]
    lanes += [[(50.0, -10.0), (50.0, 10.0)]] if overlapping else []
    points = np.array([point for lane in lanes for point in lane], np.float32)
    offset = np.cumsum([0, *map(len, lanes)])
    kind = np.ones(len(lanes), np.uint8)
    fields = {"xy": points, "offset": offset, "kind": kind, "width": np.full(len(points), 4.0), "cache": {}}
    return cast(LaneGraph, SimpleNamespace(**fields, lane_count=len(lanes)))


def collision(*bodies: Any, contact: int = STEPS - 1, agent: int = 1, **changes: Any) -> EpisodeTrace:
    """A drive of an ego and others that ends with a contact."""
    flags = (np.arange(STEPS) == contact).astype(np.uint8)
    agents = np.where(flags, agent, -1).astype(np.int32)
    return make_trace(STEPS, bodies, contact=flags, contact_agent=agents, **changes)


def cut_in() -> tuple[Any, Any]:
    """The ego at 10 m/s, and a slower car that moves over from y = -3 in front of it within 2 s."""
    sideways = -3.0 + 3.0 * np.clip(TIME / 2.0, 0.0, 1.0)
    return straight(0.0, 0.0, 0.0, 10.0, STEPS), (16.0 + 5.0 * TIME, sideways, 0.0, 5.0)


def test_a_lawful_cut_in_that_a_careful_driver_avoids_is_proven() -> None:
    trace = collision(*cut_in())
    proof = prove_collision(trace, road(), [1], CAR, avoidable=True)
    assert proof.is_candidate
    assert proof.is_proven is True
    assert proof.within_limits is True
    assert prove_collision(trace, road(), [1], CAR, avoidable=False).is_proven is False
    assert prove_collision(trace, road(), [1], CAR).is_proven is None


def test_a_head_on_collision_with_an_ego_that_stands_is_not_proven() -> None:
    oncoming = straight(54.0, 0.0, np.pi, 10.0, STEPS)
    proof = prove_collision(collision((20.0, 0.0, 0.0, 0.0), oncoming), road(), [1], CAR, avoidable=True)
    assert not proof.ego_moves
    assert not proof.lawful_side
    assert proof.is_proven is False


def test_each_condition_alone_decides() -> None:
    ego, other = cut_in()
    standing = (35.0, 0.0, 0.0, 0.4)
    assert prove_collision(collision(standing, other), road(), [1], CAR, avoidable=True).is_proven is False
    bystander = prove_collision(collision(ego, other), road(), [2], CAR, avoidable=True)
    assert not bystander.has_adversary
    assert bystander.is_proven is False
    weak = Accelerations(3.5, 8.0, 7.0)
    braking = (16.0 + 12.0 * TIME - 0.5 * 9.5 * np.minimum(TIME, 1.2) ** 2, 0.0, 0.0, 5.0)
    harsh = prove_collision(collision(ego, braking), road(), [1], weak, avoidable=True)
    assert harsh.within_limits is False
    assert harsh.is_proven is False
    third = (34.0, 0.0, 0.0, 0.0)  # the other's front reaches 33 m, beyond its rear
    assert prove_collision(collision(ego, other, third), road(), [1], CAR, avoidable=True).is_proven is False
    against = prove_collision(collision(ego, straight(62.0, 0.0, np.pi, 10.0, STEPS)), road(), [1], CAR, avoidable=True)
    assert against.ego_moves
    assert against.is_proven is False
    walker = dataclasses.replace(collision(ego, (30.0, -3.0 + TIME, np.pi / 2, 1.0)), kind=np.array([1, 6], np.uint8))
    assert prove_collision(walker, road(), [1], None, avoidable=True).is_proven is True


def test_the_direction_of_the_lane_decides_where_a_vehicle_drives_against_traffic() -> None:
    def steps(
        y: float, yaw: float, speed: float = 8.0, *, x: float = 45.0, kind: int = 1, crossing: bool = False
    ) -> int:
        body = straight(x, y, yaw, speed, STEPS)
        trace = make_trace(STEPS, [straight(0.0, 50.0, 0.0, 0.0, STEPS), body], kind=np.array([1, kind], np.uint8))
        return int(wrong_way_steps(trace, road(overlapping=crossing), 1).sum())

    assert steps(0.0, 0.0) == 0
    assert steps(4.0, np.pi) == 0
    assert steps(0.0, np.pi) == STEPS
    assert steps(4.0, 0.0) == STEPS
    assert steps(0.0, 0.0, -8.0) == STEPS  # backwards
    assert steps(0.0, np.pi, 0.3) == 0  # as good as standing
    assert steps(0.0, np.pi, kind=6) == 0
    assert steps(0.0, np.pi / 2) == 0  # crosses
    assert steps(-20.0, np.pi) == 0  # on no lane
    # The lane northwards is not opposed, and one such lane is enough: 5 steps of 0.8 m between x = 48 and 52.
    assert steps(0.0, np.pi, x=60.3, crossing=True) == STEPS - 5


def test_an_excursion_counts_from_three_tenths_of_a_second_or_at_the_contact() -> None:
    def excursion(start: int, length: int) -> EpisodeTrace:
        rows = np.arange(STEPS)
        y = np.where((rows >= start) & (rows < start + length), 4.0, 0.0)
        return make_trace(STEPS, [straight(0.0, 50.0, 0.0, 0.0, STEPS), (10.0 + 5.0 * TIME, y, 0.0, 5.0)])

    assert not takes_wrong_side(excursion(10, 2), road(), 1)
    assert takes_wrong_side(excursion(10, 3), road(), 1)
    assert takes_wrong_side(excursion(10, 1), road(), 1, contact=10)
    assert not takes_wrong_side(excursion(20, 5), road(), 1, contact=19)


def test_lane_directions_are_those_of_the_lanes_that_contain_a_point() -> None:
    point, direction = lane_directions(road(overlapping=True), [(50.0, 4.0), (0.0, 1.0), (0.0, -2.5)])
    assert sorted(zip(point.tolist(), np.abs(direction).round(3).tolist(), strict=True))[:2] == [
        (0, round(np.pi / 2, 3)),
        (0, round(np.pi, 3)),
    ]
    assert set(direction[point == 1].tolist()) == {0.0}
    assert 2 not in point


def test_peaks_are_those_of_each_step() -> None:
    still = straight(0.0, 50.0, 0.0, 0.0, STEPS)

    def peaks(x: Any, yaw: Any = 0.0, y: Any = 0.0, **changes: Any) -> Accelerations:
        found = peak_accelerations(make_trace(STEPS, [still, (x, y, yaw, 99.0)], **changes), 1)
        assert found is not None
        return found

    # The recorded speed is wrong on purpose: positions decide.
    speeding = peaks(10.0 * TIME + TIME**2)
    assert (speeding.forward, speeding.braking) == pytest.approx((2.0, 0.0), abs=0.02)
    braking = peaks(-(10.0 * TIME - 1.5 * TIME**2), np.pi)
    assert (braking.forward, braking.braking) == pytest.approx((0.0, 3.0), abs=0.02)
    backwards = peaks(-5.0 * TIME - TIME**2)
    assert backwards.forward == pytest.approx(2.0, abs=0.02)
    angle = 0.5 * TIME  # 8 m/s on a circle of 16 m: 4 m/s^2
    circle = peaks(16.0 * np.sin(angle), angle, 16.0 - 16.0 * np.cos(angle))
    assert circle.lateral == pytest.approx(4.0, abs=0.02)
    # Rows of 0.25 s, linear between them: a braking of 4 m/s^2 becomes jumps of 1 m/s within a step.
    rows = 0.25 * np.arange(13)
    coarse = peaks(np.interp(TIME, rows, 14.0 * rows - 2.0 * rows**2))
    assert coarse.braking > 6.0
    # An absence is no motion.
    active = np.ones((STEPS, 2), bool)
    active[10:20, 1] = False
    assert peaks(np.where(TIME < 1.5, 5.0 * TIME, 80.0 + 5.0 * TIME), active=active).forward == pytest.approx(
        0, abs=0.02
    )
    active[3:, 1] = active[1, 1] = False
    assert peak_accelerations(make_trace(STEPS, [still, still], active=active), 1) is None


def test_contacts_after_the_collision_or_from_the_start_do_not_count() -> None:
    ego = straight(0.0, 50.0, 0.0, 0.0, STEPS)
    mover = straight(0.0, 0.0, 0.0, 10.0, STEPS)  # its front reaches 20 m after 1.6 s
    trace = make_trace(STEPS, [ego, mover, straight(20.0, 0.0, 0.0, 0.0, STEPS)])
    assert touches_others(trace, 1)
    assert touches_others(trace, 1, until=17)
    assert not touches_others(trace, 1, until=15)
    walkers = dataclasses.replace(
        trace, kind=np.array([AgentKind.CAR, AgentKind.WALKER, AgentKind.WALKER], trace.kind.dtype)
    )
    assert not touches_others(walkers, 1)  # those of a group walk shoulder to shoulder
    beside = make_trace(STEPS, [ego, straight(0.0, 0.0, 0.0, 0.0, STEPS), straight(3.0, 0.0, 0.0, 0.0, STEPS)])
    assert not touches_others(beside, 1)

"""What was perceived in a drive, in cases that can be worked out by hand."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from helpers.metric_traces import make_trace, straight

from ssad.core.perception import DrivePerception, Objects, Tracks, no_objects
from ssad.core.types import AgentKind, Contact, EpisodeTrace
from ssad.drivers.perceiving.tracker import KalmanTracker, TrackerSettings
from ssad.metrics.perception_in_drive import (
    BANDS,
    REACH,
    cause_of_collision,
    component_metrics,
    hard_braking,
    impact_speed,
    in_view,
    phantom_stop,
    relevant_agent,
    sign_metrics,
    track_metrics,
)
from ssad.rendering.camera.rig import rig_camera

CAMERAS = {"front": rig_camera("CAM_FRONT", 640)}
STEPS = 41


def objects(*places: tuple[float, float], score: float = 0.9) -> Objects:
    n = len(places)
    return Objects(
        np.zeros(n, np.int64),
        np.array(places, float).reshape(n, 2),
        np.tile(0.09 * np.eye(2), (n, 1, 1)),
        np.zeros(n),
        np.tile([4.5, 1.9], (n, 1)),
        np.full((n, 2), np.nan),
        np.full(n, int(AgentKind.CAR)),
        np.full(n, score),
    )


def tracks(*places: tuple[float, float]) -> Tracks:
    tracker = KalmanTracker(TrackerSettings(confirm=1))
    tracker.update(np.array([0]), np.zeros(1), objects(*places))
    return tracker.confirmed(np.array([0]), np.zeros(1))


def perceived(trace: EpisodeTrace, found: Any, known: Any) -> DrivePerception:
    """`found` and `known` give places for a step; None: no picture."""
    looks = [(k * trace.dt, None if found(k) is None else objects(*found(k))) for k in range(0, STEPS, 2)]
    return DrivePerception(looks, [(k * trace.dt, tracks(*known(k))) for k in range(STEPS)], CAMERAS)


def towards(gap: float = 25.0, speed: float = 5.0, **changes: Any) -> EpisodeTrace:
    """The ego drives at a standing car; at 4 s, and 5 m before its middle, they touch."""
    struck = np.full(STEPS, -1)
    struck[-1] = 1
    contact = np.zeros(STEPS)
    contact[-1] = Contact.VEHICLE
    bodies = (straight(0.0, 0.0, 0.0, speed, STEPS), straight(gap, 0.0, 0.0, 0.0, STEPS))
    return make_trace(STEPS, bodies, **({"contact_agent": struck, "contact": contact} | changes))


def test_in_view_is_what_a_camera_shows_and_nothing_hides() -> None:
    bodies = (
        (0.0, 0.0, 0.0, 0.0),
        (15.0, 0.0, 0.0, 0.0),
        (30.0, 0.0, 0.0, 0.0),
        (-9.0, 0.0, 0.0, 0.0),
        (5.0, 9.0, 0, 0),
    )
    assert in_view(make_trace(2, bodies), [0, 1], CAMERAS).tolist() == [[False, True, False, False, False]] * 2
    left = CAMERAS | {"left": rig_camera("CAM_FRONT_LEFT", 640)}
    assert in_view(make_trace(2, bodies), [1], left).tolist() == [[False, True, False, False, True]]


def test_what_is_found_where_it_is_scores_one_and_what_is_not_found_zero() -> None:
    trace = towards()
    good = component_metrics(
        trace, perceived(trace, lambda k: [(25.0, 0.0)], lambda k: [(25.0, 0.0)]), phantom_score=0.3
    )
    assert good["AP"] == pytest.approx(1.0)
    assert [good[n] for n in ("recall", "target_recall", "distance_error", "phantoms", "believed", "switches")] == [
        1.0,
        1.0,
        0.0,
        0.0,
        1.0,
        0.0,
    ]
    assert good["target_recall_30_60"] is None
    assert good["target_recall_15_30"] == 1.0
    none = component_metrics(trace, perceived(trace, lambda k: [], lambda k: []), phantom_score=0.3)
    assert [none[n] for n in ("AP", "recall", "target_recall", "believed")] == [0.0, 0.0, 0.0, 0.0]
    assert none["distance_error"] is None
    assert none["switches"] is None


def test_tracks_are_scored_against_who_is_in_view() -> None:
    trace = towards()
    good = track_metrics(trace, perceived(trace, lambda k: [], lambda k: [(25.0, 0.0)]))
    assert good == {"HOTA": 1.0, "MOTA": 1.0, "IDF1": 1.0}
    half = track_metrics(trace, perceived(trace, lambda k: [], lambda k: [(25.0, 0.0)] * (k % 2)))
    assert half["MOTA"] == pytest.approx(20 / 41)
    invented = track_metrics(trace, perceived(trace, lambda k: [], lambda k: [(25.0, 0.0), (40.0, 9.0)]))
    assert invented["MOTA"] == 0.0
    assert invented["IDF1"] == pytest.approx(2 / 3)
    bodies = (straight(0.0, 0.0, 0.0, 5.0, STEPS), straight(25.0, 0.0, 0.0, 0.0, STEPS))
    passed = make_trace(STEPS, (*bodies, straight(-12.0, 3.0, 0.0, 5.0, STEPS)))
    kept = track_metrics(passed, perceived(passed, lambda k: [], lambda k: [(25.0, 0.0), (-12.0 + 0.5 * k, 3.0)]))
    assert kept["MOTA"] == 1.0  # who is behind is known and out of view


def test_misplaced_objects_have_a_distance_error_and_invented_ones_are_phantoms() -> None:
    trace = towards()
    found = component_metrics(
        trace, perceived(trace, lambda k: [(28.0, 0.0), (40.0, 9.0)], lambda k: []), phantom_score=0.3
    )
    assert found["target_recall"] == 0.0
    assert found["distance_error"] == pytest.approx(3.0)
    assert found["phantoms"] == 1.0
    unsure = component_metrics(trace, perceived(trace, lambda k: [(40.0, 9.0)], lambda k: []), phantom_score=0.95)
    assert unsure["phantoms"] == 0.0


def test_a_drive_without_others_has_nothing_to_measure() -> None:
    trace = make_trace(STEPS)
    alone = component_metrics(trace, perceived(trace, lambda k: [], lambda k: []), phantom_score=0.3)
    assert all(alone[name] is None for name in ("AP", "recall", "target_recall", "believed"))
    assert alone["phantoms"] == 0.0


@pytest.mark.parametrize(
    ("found", "known", "cause"),
    [
        (lambda k: [], lambda k: [], "missed"),
        (lambda k: None, lambda k: [], "missed"),
        (lambda k: [(29.0, 0.0)], lambda k: [], "misplaced"),
        (lambda k: [(25.0, 0.0)], lambda k: [], "late"),
        (lambda k: [], lambda k: [(25.5, 0.0)], "known"),
    ],
)
def test_the_cause_is_what_was_commonest_before_the_contact(found: Any, known: Any, cause: str) -> None:
    trace = towards()
    told = cause_of_collision(trace, perceived(trace, found, known))
    assert told is not None
    assert told["cause"] == cause
    assert told["agent"] == "agent1"
    assert told["unknown_s"] == pytest.approx(0.0 if cause == "known" else 3.0)


def test_who_comes_from_behind_was_hidden() -> None:
    struck = np.full(STEPS, -1)
    struck[-1] = 1
    trace = make_trace(STEPS, ((0.0, 0.0, 0.0, 0.0), straight(-25.0, 0.0, 0.0, 5.0, STEPS)), contact_agent=struck)
    told = cause_of_collision(trace, perceived(trace, lambda k: [], lambda k: []))
    assert told is not None
    assert told["cause"] == "hidden"


def test_how_long_it_was_unknown_counts_from_the_last_step_in_which_it_was_known() -> None:
    trace = towards()
    told = cause_of_collision(trace, perceived(trace, lambda k: [], lambda k: [(25.0, 0.0)] if k < 32 else []))
    assert told is not None
    assert told["unknown_s"] == pytest.approx(0.8)
    assert cause_of_collision(make_trace(STEPS), perceived(make_trace(STEPS), lambda k: [], lambda k: [])) is None


def test_impact_speed_hard_braking_and_the_object_that_matters() -> None:
    trace = towards(speed=6.0)
    assert impact_speed(trace) == pytest.approx(6.0)
    assert impact_speed(make_trace(STEPS)) is None
    accel = np.zeros(STEPS)
    accel[[3, 4, 9]] = -5.0
    accel[20] = -3.0
    assert hard_braking(make_trace(STEPS, accel=accel)) == 2
    assert relevant_agent(trace) == 1
    bodies = ((0.0, 0.0, 0.0, 0.0), (30.0, 0.0, 0.0, 0.0), (0.0, 9.0, 0.0, 0.0))
    assert relevant_agent(make_trace(STEPS, bodies)) == 2
    assert relevant_agent(make_trace(STEPS)) is None


def test_who_stands_before_nothing_stands_before_a_phantom() -> None:
    bodies = ((0.0, 0.0, 0.0, 0.0), (30.0, 0.0, 0.0, 0.0))
    trace = make_trace(STEPS, bodies)
    assert phantom_stop(trace, perceived(trace, lambda k: [], lambda k: [(10.0, 0.5)])) == pytest.approx(0.1 * STEPS)
    assert phantom_stop(trace, perceived(trace, lambda k: [], lambda k: [(10.0, 5.0)])) == 0.0
    there = make_trace(STEPS, (bodies[0], (11.0, 0.0, 0.0, 0.0)))
    assert phantom_stop(there, perceived(there, lambda k: [], lambda k: [(10.0, 0.5)])) == 0.0
    moving = make_trace(STEPS, ((*straight(0.0, 0.0, 0.0, 0.1, STEPS)[:3], 5.0), bodies[1]))
    assert phantom_stop(moving, perceived(moving, lambda k: [], lambda k: [(10.0, 0.5)])) == 0.0


def test_lost_pictures_count_as_looks_in_which_nothing_was_found() -> None:
    trace = towards()
    half = perceived(trace, lambda k: [(25.0, 0.0)] if k % 4 else None, lambda k: [])
    assert component_metrics(trace, half, phantom_score=0.3)["target_recall"] == pytest.approx(10 / 21)
    assert no_objects().score.shape == (0,)


def test_signs_are_read_from_how_far_and_where_they_stand() -> None:
    trace = make_trace(STEPS, (straight(0.0, 0.0, 0.0, 5.0, STEPS),))
    sign = np.array([[30.0, 3.0]])
    # read from 15 m on; before, something is read where no sign stands
    looks = [(k * trace.dt, sign if 30.0 - 0.5 * k <= 15.0 else sign + np.array([0.0, 20.0])) for k in range(STEPS)]
    found = sign_metrics(trace, DrivePerception([], [], CAMERAS, looks), sign)
    assert found["sign_recall"] == pytest.approx(11 / 41)
    assert (found["sign_recall_5_20"], found["sign_recall_20_40"]) == (pytest.approx(11 / 20), 0.0)
    assert found["sign_read_at"] == pytest.approx(np.hypot(15.0, 3.0))
    nowhere = sign_metrics(trace, DrivePerception([], [], CAMERAS, looks), np.zeros((0, 2)))
    assert set(nowhere.values()) == {None}


def test_how_a_detector_fails_is_what_a_perfect_one_takes_to_fail_alike() -> None:
    bodies = ((0.0, 0.0, 0.0, 0.0), (20.0, 0.0, 0.0, 0.0), (12.0, 5.0, 0.0, 0.0))
    trace = make_trace(STEPS, bodies)

    def found(k: int) -> list[tuple[float, float]]:
        """The first is missed for 3 looks and for 1, else told 5 % too far; the second is there at all looks."""
        look = k // 2
        return [(12.0, 5.0)] if look in {4, 5, 6, 10} else [(21.0, 0.0), (12.0, 5.0)]

    metrics = component_metrics(trace, perceived(trace, found, lambda k: []), phantom_score=0.3)
    assert metrics["recall"] == pytest.approx(1.0 - 4 / 42)
    assert metrics["missed_burst"] == pytest.approx(2.0)
    assert metrics["distance_share"] == pytest.approx(np.sqrt(17 * 0.05**2 / (17 + 21)))
    all_ = component_metrics(
        trace, perceived(trace, lambda k: [(20.0, 0.0), (12.0, 5.0)], lambda k: []), phantom_score=0.3
    )
    assert all_["missed_burst"] is None
    assert all_["distance_share"] == pytest.approx(0.0, abs=1e-9)


def test_who_is_touched_matters_more_than_who_is_near() -> None:
    bodies = ((0.0, 0.0, 0.0, 0.0), (30.0, 0.0, 0.0, 0.0), (5.0, 0.0, 0.0, 0.0))
    touched = np.full(STEPS, -1)
    touched[-3:] = 1
    assert relevant_agent(make_trace(STEPS, bodies, contact_agent=touched)) == 1
    assert relevant_agent(make_trace(STEPS, bodies)) == 2


def test_the_nearest_agent_is_that_whose_end_is_nearest() -> None:
    """A lorry of 12 m whose middle is 11 m away ends 5 m away; a car of 4.5 m, 8 m away, ends at 5.75 m."""
    bodies = ((0.0, 0.0, 0.0, 0.0), (11.0, 0.0, 0.0, 0.0), (8.0, 0.0, 0.0, 0.0), (14.0, 0.0, 0.0, 0.0))
    trace = make_trace(STEPS, bodies)
    trace.length[:] = [4.5, 12.0, 4.5, 15.0]
    assert relevant_agent(trace) == 1
    trace.active[:, 1] = False
    assert relevant_agent(trace) == 2
    trace.active[:, 1:] = False
    assert relevant_agent(trace) is None


def test_bands_of_distance_join_and_reach_as_far_as_objects_count() -> None:
    assert BANDS[0][0] == 0.0
    assert BANDS[-1][1] == REACH
    assert all(near[1] == far[0] for near, far in itertools.pairwise(BANDS))


@pytest.mark.parametrize(("off", "found"), [(1.99, 1.0), (2.0, 0.0)])
def test_an_object_is_found_within_2_m(off: float, found: float) -> None:
    trace = make_trace(STEPS, ((0.0, 0.0, 0.0, 0.0), (20.0, 0.0, 0.0, 0.0)))
    metrics = component_metrics(trace, perceived(trace, lambda k: [(20.0, off)], lambda k: []), phantom_score=0.3)
    assert (metrics["recall"], metrics["target_recall"]) == (found, found)


@pytest.mark.parametrize(("off", "phantoms"), [(5.0, 0.0), (5.01, 1.0)])
def test_a_phantom_is_more_than_5_m_from_everybody(off: float, phantoms: float) -> None:
    trace = make_trace(STEPS, ((0.0, 0.0, 0.0, 0.0), (20.0, 0.0, 0.0, 0.0)))
    metrics = component_metrics(trace, perceived(trace, lambda k: [(20.0, off)], lambda k: []), phantom_score=0.3)
    assert metrics["phantoms"] == phantoms


@pytest.mark.parametrize(("place", "stood"), [((0.0, 0.0), False), ((0.1, 0.0), True), ((-0.1, 0.0), False)])
def test_a_phantom_before_the_ego_is_ahead_of_its_middle(place: tuple[float, float], stood: bool) -> None:
    trace = make_trace(STEPS, ((0.0, 0.0, 0.0, 0.0), (30.0, 0.0, 0.0, 0.0)))
    seconds = phantom_stop(trace, perceived(trace, lambda k: [], lambda k: [place]))
    assert (seconds > 0.0) == stood


def test_tracks_on_the_ego_itself_are_false() -> None:
    """The ego is nobody that is out of view: what is believed where it is counts against the tracks."""
    trace = make_trace(STEPS, ((0.0, 0.0, 0.0, 0.0), (20.0, 0.0, 0.0, 0.0)))
    found = track_metrics(trace, perceived(trace, lambda k: [], lambda k: [(20.0, 0.0), (0.0, 0.0)]))
    assert found["MOTA"] == 0.0


def test_a_sign_far_to_the_side_is_not_one_before_the_ego() -> None:
    trace = make_trace(STEPS, ((0.0, 0.0, 0.0, 0.0),))
    read = [(0.0, np.array([[10.0, 4.9]]))]
    assert sign_metrics(trace, DrivePerception([], [], CAMERAS, read), np.array([[10.0, 4.9]]))["sign_recall"] == 1.0
    assert sign_metrics(trace, DrivePerception([], [], CAMERAS, read), np.array([[10.0, 5.1]]))["sign_recall"] is None


def test_a_look_at_the_step_itself_counts_for_the_cause() -> None:
    """It finds the object from the first look on at which something is found, not from the look after it."""
    struck = np.full(STEPS, -1)
    struck[-1] = 1
    trace = make_trace(STEPS, (straight(0.0, 0.0, 0.0, 5.0, STEPS), (25.0, 0.0, 0.0, 0.0)), contact_agent=struck)
    looks = [(k * trace.dt, objects((25.0, 0.0)) if k >= 20 else objects()) for k in range(STEPS)]
    told = cause_of_collision(trace, DrivePerception(looks, [], CAMERAS))
    assert told is not None
    # from 3 s before the contact to 0.5 s before it: steps 10 to 34, of which 15 have found it and no track has
    assert told["shares"]["late"] == pytest.approx(15 / 25)
    assert told["shares"]["missed"] == pytest.approx(10 / 25)

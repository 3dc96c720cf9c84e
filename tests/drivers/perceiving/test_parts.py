"""Parts of a perceiving driver: own perceivers, trackers and planners, their errors, and their checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.gap_parts import Ahead, Brake, Last, boxes

from ssad import World, build_episode, load_scenarios, load_town, make_system, rollout
from ssad.core.driving import Believer, Observation
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.types import AgentKind, Controller, Episode, EpisodeLimits
from ssad.drivers.perceiving.check import PartCheckError, check_perceiver, check_planner, check_tracker
from ssad.drivers.perceiving.driver import PerceivingDriver, PerceptionEvent
from ssad.drivers.perceiving.parts import (
    make_perceiver,
    make_planner,
    make_tracker,
    part_names,
    part_version,
)
from ssad.drivers.perceiving.perceivers import CameraPerceiver, PerfectPerceiver
from ssad.drivers.perceiving.signs import SignReading
from ssad.drivers.perceiving.tracker import KalmanTracker, TrackerSettings
from ssad.simulators.closed_loop import system_version
from ssad.world.rollout import Loop

PARTS = "helpers.gap_parts"


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    scenarios = load_scenarios("LaneChanging")[:2]
    town = load_town(scenarios[0].town)
    made = [build_episode(scenario, town, seed=0) for scenario in scenarios]
    return [replace(one, limits=EpisodeLimits(max_steps=120)) for one in made]


@pytest.fixture(scope="module")
def simulator(episodes: list[Episode]) -> Callable[[Any], World]:
    town = load_town(episodes[0].town)
    return lambda assign: World(episodes, {town.name: town}, assign=np.array(assign))


def view_at(time: float, *poses: tuple[float, float, float], **readings: Any) -> Observation:
    n = len(poses)
    none = np.zeros(n, np.float32)
    return Observation(
        scene=np.arange(n, dtype=np.int32),
        agent=np.zeros(n, np.int32),
        time=none + np.float32(time),
        speed=none,
        accel=none,
        pose=np.array(poses, np.float32),
        target_speed=none,
        route=np.zeros((n, 40, 2), np.float32),
        lane_offset=none,
        heading_error=none,
        others=np.ones((n, 16, 7), np.float32),
        others_lane=np.ones((n, 16), np.uint8),
        signal=np.zeros((n, 2), np.float32),
        done=np.zeros(n, bool),
        readings=readings,
    )


class Given:
    """A perceiver that returns what it is given."""

    sensors, classes = ("points",), ("car", "tree", "stop_sign")

    def __init__(self, give: Callable[[Any, Any], Any]) -> None:
        self.give = give

    def reset(self, episodes: Any) -> None: ...

    def perceive(self, view: Any, rows: Any) -> Any:
        return self.give(view, rows)


def driver_of(give: Callable[[Any, Any], Any], **settings: Any) -> PerceivingDriver:
    driver = PerceivingDriver(Given(give), latency=0.0, **({"tracking": TrackerSettings(confirm=1)} | settings))
    driver.reset([None, None])  # type: ignore[list-item]
    return driver


def test_boxes_are_believed_where_they_are_from_each_ego() -> None:
    driver = driver_of(lambda view, rows: [boxes((10.0, 2.0)), boxes((8.0, 0.0), (30.0, -3.0))])
    belief = driver.believe(view_at(0.0, (5.0, 1.0, 0.0), (100.0, 50.0, np.pi / 2)))
    assert (belief.kind == AgentKind.CAR).sum(1).tolist() == [1, 2]
    np.testing.assert_allclose(belief.pose[0, 0], [15.0, 3.0, 0.0], atol=1e-5)
    nearest = belief.pose[1, np.argsort(belief.pose[1, :, 1])]
    np.testing.assert_allclose(nearest[:, :2], [[100.0, 58.0], [103.0, 80.0]], atol=1e-4)
    np.testing.assert_allclose(nearest[:, 2], np.pi / 2, atol=1e-5)


def test_the_covariance_and_the_velocity_of_boxes_turn_with_the_ego() -> None:
    told: list[Any] = []
    given = replace(
        boxes((10.0, 0.0)), covariance=np.array([[[4.0, 0.0], [0.0, 1.0]]]), velocity=np.array([[3.0, 0.0]])
    )
    driver = driver_of(lambda view, rows: [given], watch=told.append)
    driver.believe(view_at(0.0, (0.0, 0.0, np.pi / 2)))
    found = next(event.objects for event in told if isinstance(event, PerceptionEvent))
    np.testing.assert_allclose(found.covariance[0], [[1.0, 0.0], [0.0, 4.0]], atol=1e-6)
    np.testing.assert_allclose(found.velocity[0], [0.0, 3.0], atol=1e-6)
    nearer, farther = (
        driver_of(lambda view, rows, x=x: [boxes((x, 0.0))], watch=told.append)  # type: ignore[misc]
        for x in (5.0, 50.0)
    )
    nearer.believe(view_at(0.0, (0.0, 0.0, 0.0)))
    farther.believe(view_at(0.0, (0.0, 0.0, 0.0)))
    near, far = (event.objects.covariance[0] for event in told[-4:] if isinstance(event, PerceptionEvent))
    assert far[0, 0] > 4.0 * near[0, 0] > 0.0


def test_classes_that_are_no_road_users_are_left_out() -> None:
    driver = driver_of(lambda view, rows: [boxes((10.0, 0.0), label=1)])
    assert not (driver.believe(view_at(0.0, (0.0, 0.0, 0.0))).kind != AgentKind.NONE).any()


def test_no_reading_is_not_an_empty_scene() -> None:
    for absent, left in ((None, 1), (boxes(), 0)):
        driver = driver_of(
            lambda view, rows, absent=absent: [boxes((10.0, 0.0)) if view.time[0] < 0.5 else absent],  # type: ignore[misc]
            tracking=TrackerSettings(confirm=1, reserve=2),
        )
        counts = [
            int((driver.believe(view_at(0.2 * k, (0.0, 0.0, 0.0))).kind != AgentKind.NONE).sum()) for k in range(10)
        ]
        assert counts[1] == 1
        assert counts[-1] == left


def test_it_does_not_see_the_truth() -> None:
    views: list[Any] = []

    def give(view: Any, rows: Any) -> Any:
        views.append(view)
        return [boxes()]

    view = view_at(0.0, (0.0, 0.0, 0.0), points=7)
    driver_of(give).believe(view)
    assert not views[0].others.any()
    assert not views[0].others_lane.any()
    assert views[0].readings["points"] == 7
    assert view.others.all()


def test_stop_signs_are_read_from_boxes() -> None:
    driver = driver_of(lambda view, rows: [boxes((20.0, -3.0), label=2)], signs=SignReading(confirm=2))
    seen = [driver.believe(view_at(0.2 * k, (0.0, 0.0, 0.0))).stop_sign for k in range(2)]
    assert [int(one[0]) for one in seen if one is not None] == [0, 1]


@pytest.mark.parametrize(
    ("give", "words"),
    [
        (lambda view, rows: [], "expected a list of 1 rows"),
        (lambda view, rows: boxes((1.0, 0.0)), "expected a list of 1 rows"),
        (lambda view, rows: [7], "a row of type int; expected"),
        (lambda view, rows: {"front": [None]}, r"expected those of its cameras \(none\)"),
        (lambda view, rows: [replace(boxes((1.0, 0.0)), centre=np.zeros((1, 2)))], r"centre has shape \(1, 2\)"),
        (lambda view, rows: [replace(boxes((1.0, 0.0)), centre=np.full((1, 3), np.nan))], "centre holds a number"),
        (lambda view, rows: [replace(boxes((1.0, 0.0)), yaw=np.array([np.inf]))], "yaw is infinite"),
        (lambda view, rows: [boxes((1.0, 0.0), label=3)], "label must be an integer from 0 to 2"),
        (lambda view, rows: [boxes((1.0, 0.0), score=1.5)], "score must lie between 0 and 1"),
        (lambda view, rows: [replace(boxes((1.0, 0.0)), size_lwh=np.zeros((1, 3)))], "size_lwh must be above 0"),
    ],
)
def test_percepts_that_are_wrong_are_one_line(give: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=f"perceiver Given: .*{words}"):
        driver_of(give).believe(view_at(0.0, (0.0, 0.0, 0.0)))


def test_a_tracker_of_another_author_is_believed(episodes: list[Episode], simulator: Any) -> None:
    driver = PerceivingDriver(PerfectPerceiver(), tracker=Last(), latency=0.0)
    traces = rollout(simulator([0, 1]), driver)
    assert all(trace.end != "collision" for trace in traces)
    blind = PerceivingDriver(PerfectPerceiver(), tracker=Last(least=2.0), latency=0.0)
    assert any(trace.end == "collision" for trace in rollout(simulator([0, 1]), blind))


def test_tracks_that_are_wrong_are_one_line() -> None:
    class Wrong(Last):
        def confirmed(self, scenes: Any, times: Any) -> Any:
            tracks = super().confirmed(scenes, times)
            return replace(tracks, **self.change) if self.change else "nothing"

    cases: list[tuple[Any, str]] = [
        ({}, "returned str"),
        ({"place": np.zeros((1, 3))}, r"place has shape \(1, 3\)"),
        ({"scene": np.array([5])}, "not asked for"),
    ]
    for change, words in cases:
        tracker = Wrong()
        tracker.change = change  # type: ignore[attr-defined]
        driver = driver_of(lambda view, rows: [boxes((9.0, 0.0))], tracker=tracker, tracking=None)
        with pytest.raises(ConfigError, match=f"tracker Wrong: .*{words}"):
            driver.believe(view_at(0.0, (0.0, 0.0, 0.0)))


def test_a_planner_of_another_author_drives(simulator: Any) -> None:
    driver = PerceivingDriver(PerfectPerceiver(), planner=Brake(), rate=10.0, latency=0.0)
    assert driver.controller == Controller.EXTERNAL
    assert not isinstance(driver, Believer)
    assert isinstance(PerceivingDriver(PerfectPerceiver()), Believer)
    (trace,) = rollout(simulator([0]), driver)
    assert trace.brake.max() == 1.0  # for the car ahead
    assert trace.end != "collision"
    (reckless,) = rollout(simulator([0]), PerceivingDriver(PerfectPerceiver(), planner=Brake(distance=0.0)))
    assert reckless.end == "collision"
    assert reckless.brake.max() == 0.0


def test_parts_without_snapshots_go_on_to_the_bit(simulator: Any) -> None:
    driver = PerceivingDriver(PerfectPerceiver(missed=0.3), tracker=Last(), planner=Brake(), latency=0.15)
    loop = Loop(simulator([0, 1]), {0: driver})
    loop.reset()
    for _ in range(9):
        loop.step()
    kept = loop.simulator.snapshot(), driver.snapshot_batch()  # type: ignore[attr-defined]
    ends = []
    for _ in range(2):
        for _ in range(9):
            loop.step()
        ends.append(loop.simulator.hashes())  # type: ignore[attr-defined]
        loop.simulator.restore(kept[0])  # type: ignore[attr-defined]
        driver.restore_batch(kept[1])
    assert ends[0] == ends[1]


def test_parts_have_names_and_arguments() -> None:
    assert {"camera", "truth"} <= set(part_names("perceiver"))
    assert isinstance(make_perceiver("truth", missed=0.2), PerfectPerceiver)
    eyes = make_perceiver("camera", detector="yolov5n", cameras=["CAM_BACK"], width=64)
    assert isinstance(eyes, CameraPerceiver)
    assert (eyes.sensors, eyes.threshold, eyes.detector.name) == (("CAM_BACK",), 0.1, "yolov5n")
    tracker = make_tracker("kalman", confirm=4)
    assert isinstance(tracker, KalmanTracker)
    assert tracker.settings.confirm == 4
    assert make_planner("autopilot").controller == Controller.AUTOPILOT  # type: ignore[attr-defined]
    ahead = make_perceiver(f"{PARTS}:Ahead?distance=9")
    assert isinstance(ahead, Ahead)
    assert ahead.distance == 9


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: make_perceiver("cameras"), "unknown perceiver 'cameras'; closest: camera.*ssad list perceivers"),
        (lambda: make_tracker("kalmann"), "closest: kalman.*ssad list trackers"),
        (lambda: make_planner("auto"), "closest: autopilot"),
        (lambda: make_perceiver(f"{PARTS}:Ahed"), "has no 'Ahed'; closest: Ahead"),
        (lambda: make_perceiver(f"{PARTS}:NoPerceive"), "lacks perceive; it needs sensors, classes, reset, perceive"),
        (lambda: make_perceiver(f"{PARTS}:NoLists"), "classes must be a tuple of names, not 'car'"),
        (lambda: make_tracker(f"{PARTS}:Brake"), "lacks update, confirmed"),
        (lambda: make_perceiver(f"{PARTS}:Ahead", reach=3), "unexpected keyword argument 'reach'; it takes distance"),
        (lambda: make_perceiver("camera", cameras=["CAM"]), "cameras must be a list of some of CAM_FRONT"),
        (lambda: make_tracker("kalman", confirm=0), "confirm >= 1"),
        (lambda: make_tracker("kalman", hits=1), "unexpected keyword argument 'hits'; it takes confirm, reserve"),
    ],
)
def test_parts_that_cannot_be_made_are_one_line(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as error:
        make()
    assert "\n" not in str(error.value)
    assert isinstance(error.value, UnknownNameError) == ("closest" in words and "unknown" in str(error.value))


def test_a_tracker_and_settings_of_the_built_in_one_exclude_each_other() -> None:
    with pytest.raises(ConfigError, match="not both"):
        PerceivingDriver(PerfectPerceiver(), tracker=Last(), tracking=TrackerSettings())


def test_the_source_the_files_and_the_weights_of_a_part_are_its_version(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    source = tmp_path / "my_own_eyes.py"
    text = "class Eyes:\n    sensors = classes = ('truth',)\n    def __init__(self, file=''): ...\n"
    text += "    def reset(self, episodes): ...\n    def perceive(self, view, rows): ...\n"
    source.write_text(text)
    versions = []
    for change in ("", "# other"):
        source.write_text(text + change)
        part = make_perceiver("my_own_eyes:Eyes")
        versions.append(part_version("perceiver", "my_own_eyes:Eyes", part, {}))
    (tmp_path / "weights.bin").write_bytes(b"1")
    versions.append(part_version("perceiver", "my_own_eyes:Eyes", part, {"file": "weights.bin"}))
    (tmp_path / "weights.bin").write_bytes(b"2")
    versions.append(part_version("perceiver", "my_own_eyes:Eyes", part, {"file": "weights.bin"}))
    assert len(set(versions)) == 4
    assert "" not in versions
    assert part_version("tracker", "kalman", make_tracker("kalman"), {}) == ""
    system = "perceiving?perceiver=my_own_eyes:Eyes@mine"
    before = system_version(system)
    source.write_text(text + "# another")
    assert system_version(system) != before
    assert system_version("perceiving?perceiver=truth").split() == system_version("perceiving-perfect").split()


def test_a_system_of_named_parts_drives_in_every_suite(episodes: list[Episode], simulator: Any) -> None:
    name = f"perceiving?perceiver=truth&tracker={PARTS}:Last&planner={PARTS}:Brake?distance=30&latency=0@mine"
    system = make_system(name)
    assert (system.name, system.controller) == ("mine", Controller.EXTERNAL)
    (trace,) = rollout(simulator([0]), system)
    assert trace.end != "collision"
    perfect, same = (
        rollout(simulator([0]), make_system(name))[0] for name in ("perceiving-perfect", "perceiving?perceiver=truth")
    )
    np.testing.assert_array_equal(perfect.x, same.x)
    with pytest.raises(ConfigError, match="unknown tracker 'kalma'"):
        make_system("perceiving?tracker=kalma&perceiver=truth")


# ---------------------------------------------------------------- checks


class Far(PerfectPerceiver):
    def __init__(self, **settings: Any) -> None:
        super().__init__(reach=100.0, **settings)


class Moody(Far):
    """Finds less at each further look since it was made."""

    looks = 0

    def perceive(self, view: Any, rows: Any) -> Any:
        self.looks += 1
        self.reach = 100.0 - 2.0 * self.looks
        return super().perceive(view, rows)


class Jealous(Far):
    """Sees less far where there are several scenes."""

    def reset(self, episodes: Any) -> None:
        super().reset(episodes)
        self.reach = 100.0 if len(episodes) < 2 else 12.0


class Spoiling(Far):
    """Changes what it is given."""

    def perceive(self, view: Any, rows: Any) -> Any:
        found = super().perceive(view, rows)
        view.readings["truth"].pose[:] = 0.0
        return found


class Forgetful(Far):
    """Its snapshots leave something out."""

    def snapshot(self) -> Any:
        return None

    def restore(self, snapshot: Any) -> None: ...


class NotFinite(Ahead):
    sensors, classes = ("truth",), ("car",)

    def perceive(self, view: Any, rows: Any) -> Any:
        return [replace(boxes((9.0, 0.0)), centre=np.full((1, 3), np.nan)) for _ in rows]


class Senseless(Ahead):
    sensors = ()


@pytest.mark.parametrize(
    ("part", "promise"),
    [
        (Moody, "reset makes it forget"),
        (Jealous, "a scene alone is perceived as it is in a batch"),
        (Spoiling, "it changes nothing that it is given"),
        (NotFinite, "as its protocol says: .*centre holds a number"),
        (Senseless, "it reads a sensor"),
        (lambda: PerfectPerceiver(reach=5.0), "an object is detected"),
        (Last, "it has the methods and attributes"),
    ],
)
def test_a_broken_perceiver_fails_its_check(simulator: Any, part: Any, promise: str) -> None:
    with pytest.raises(PartCheckError, match=promise):
        check_perceiver(part, simulator, episodes=2, steps=20)


def test_a_snapshot_that_leaves_something_out_fails_the_check(simulator: Any) -> None:
    with pytest.raises(PartCheckError, match="a restored snapshot continues as before"):
        check_perceiver(lambda: Forgetful(missed=0.5, noise=0.2), simulator, episodes=2, steps=10)


def test_the_built_in_parts_pass_their_checks(simulator: Any, episodes: list[Episode]) -> None:
    check_perceiver(lambda: Far(missed=0.4, noise=0.1, phantoms=0.5), simulator, episodes=2)
    check_tracker(KalmanTracker, episodes=episodes)
    check_planner(Brake, simulator, episodes=2, steps=20)
    check_planner(lambda: make_planner("autopilot"), simulator, episodes=2, steps=10)


@pytest.mark.slow
def test_a_perceiver_of_images_passes_its_check(simulator: Any) -> None:
    check_perceiver(Ahead, simulator, episodes=2, steps=3)


class Still(KalmanTracker):
    """Does not predict."""

    def confirmed(self, scenes: Any, times: Any) -> Any:
        return replace(super().confirmed(scenes, times), place=self.tracks.take(self._sure(scenes)).mean[:, :2])

    def _sure(self, scenes: Any) -> Any:
        return (self.tracks.hits >= self.settings.confirm) & np.isin(self.tracks.scene, scenes)


class Renaming(KalmanTracker):
    """Gives its tracks other numbers at each look."""

    looks = 0

    def reset(self, episodes: Any) -> None:
        super().reset(episodes)
        self.looks = 0

    def update(self, scenes: Any, times: Any, found: Any, poses: Any = None) -> None:
        super().update(scenes, times, found)
        self.looks += 1

    def confirmed(self, scenes: Any, times: Any) -> Any:
        tracks = super().confirmed(scenes, times)
        return replace(tracks, ident=tracks.ident + 100 * self.looks)


class Keeping(KalmanTracker):
    """Does not forget."""

    def reset(self, episodes: Any) -> None:
        if len(self._track_counts) != len(episodes):
            super().reset(episodes)


class Sharing(KalmanTracker):
    """Confirms later where there are more scenes."""

    def reset(self, episodes: Any) -> None:
        super().reset(episodes)
        self.settings = TrackerSettings(confirm=len(episodes))


class Twins(KalmanTracker):
    """Gives all tracks of a scene one number."""

    def confirmed(self, scenes: Any, times: Any) -> Any:
        tracks = super().confirmed(scenes, times)
        return replace(tracks, ident=tracks.ident * 0)


class Amnesiac(KalmanTracker):
    """Restores nothing."""

    def restore(self, snapshot: Any) -> None: ...


class Rough(KalmanTracker):
    """Changes the detections."""

    def update(self, scenes: Any, times: Any, found: Any, poses: Any = None) -> None:
        super().update(scenes, times, found)
        found.score[:] = 0.5


@pytest.mark.parametrize(
    ("part", "promise"),
    [
        (Still, "predicted to the present"),
        (Renaming, "keeps its number"),
        (Keeping, "reset makes it forget"),
        (Sharing, "a scene alone is tracked as it is in a batch"),
        (Twins, "unique in a scene"),
        (Amnesiac, "a restored snapshot continues as before"),
        (Rough, "it changes nothing that it is given"),
        (Brake, "it has the methods"),
    ],
)
def test_a_broken_tracker_fails_its_check(episodes: list[Episode], part: Any, promise: str) -> None:
    with pytest.raises(PartCheckError, match=promise):
        check_tracker(part, episodes=episodes)


class Wild(Brake):
    def plan(self, view: Any, belief: Any) -> Any:
        return super().plan(view, belief) * 3.0


class Aging(Brake):
    def plan(self, view: Any, belief: Any) -> Any:
        self.distance += 1.0
        return super().plan(view, belief)


@pytest.mark.parametrize(
    ("part", "promise"), [(Wild, "in range"), (Aging, "reset makes it forget"), (Last, "it has the methods")]
)
def test_a_broken_planner_fails_its_check(simulator: Any, part: Any, promise: str) -> None:
    with pytest.raises(PartCheckError, match=promise):
        check_planner(part, simulator, episodes=2)

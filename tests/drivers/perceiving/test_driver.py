"""The perceiving driver in the loop: what it asks for and when, what it believes, and what goes wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ssad import World, build_episode, load_scenarios, load_town, make_system, rollout
from ssad.core.detections import Detections, Solids
from ssad.core.driving import Observation
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.traces import trace_hash
from ssad.core.types import AgentKind, Episode, EpisodeLimits
from ssad.drivers.perceiving.driver import PerceivingDriver, PerceptionEvent
from ssad.drivers.perceiving.perceivers import CameraPerceiver, PerfectPerceiver
from ssad.drivers.perceiving.systems import Fcos3d, OneCamera, PgdDet, Yolov5n
from ssad.drivers.perceiving.tracker import TrackerSettings, tracking_settings
from ssad.simulators.closed_loop import system_version
from ssad.world.rollout import Loop

CAMERA = Camera.typical(64, 36)


def episodes(name: str = "StraightObstacle", count: int = 2, steps: int = 60) -> tuple[list[Episode], Any]:
    scenarios = load_scenarios(name)[:count]
    town = load_town(scenarios[0].town)
    made = [build_episode(scenario, town, seed=0) for scenario in scenarios]
    return [replace(one, limits=EpisodeLimits(max_steps=steps)) for one in made], town


def run(driver: Any, made: list[Episode], town: Any, **more: Any) -> list[Any]:
    return rollout(World(made, {town.name: town}), driver, **more)


def steady_view(time: float, scenes: int = 1, **readings: Any) -> Observation:
    none = np.zeros(scenes, np.float32)
    return Observation(
        scene=np.arange(scenes, dtype=np.int32),
        agent=np.zeros(scenes, np.int32),
        time=none + np.float32(time),
        speed=none,
        accel=none,
        pose=np.zeros((scenes, 3), np.float32),
        target_speed=none,
        route=np.zeros((scenes, 40, 2), np.float32),
        lane_offset=none,
        heading_error=none,
        others=np.zeros((scenes, 16, 7), np.float32),
        others_lane=np.zeros((scenes, 16), np.uint8),
        signal=np.zeros((scenes, 2), np.float32),
        done=np.zeros(scenes, bool),
        readings=readings,
    )


class OneCar:
    """A detector that finds one car 15 m ahead where the picture is bright."""

    name, task, classes = "one-car", "3d", ("pedestrian", "car")

    def __init__(self, change: Callable[[Detections], Detections] = lambda found: found) -> None:
        self.change = change

    def predict(self, images: Any, intrinsic: Any = None, *, threshold: float | None = None) -> list[Detections]:
        found = []
        for image in images:
            n = int(image.mean() > 0.5)
            solid = Solids(
                torch.tensor([[0.0, 0.8, 15.0]])[:n],
                torch.tensor([[4.5, 1.6, 1.9]])[:n],
                torch.zeros(1)[:n],
                torch.zeros(1, 2)[:n],
                torch.zeros(1, dtype=torch.int64)[:n],
            )
            one = Detections(torch.ones(1)[:n], torch.ones(1, dtype=torch.int64)[:n], torch.zeros(1, 4)[:n], solid)
            found.append(self.change(one))
        return found


def seeing(times: list[float], driver: PerceivingDriver, picture: Callable[[float], int]) -> list[int]:
    """How many objects are believed at each time, where the camera shows one value everywhere."""
    driver.reset([None])  # type: ignore[list-item]
    counts = []
    for time in times:
        pictures = np.full((1, 3, CAMERA.height, CAMERA.width), picture(time), np.uint8)
        belief = driver.believe(steady_view(time, front=pictures))
        counts.append(int((belief.kind != AgentKind.NONE).sum()))
    return counts


def test_a_perfect_detector_lets_it_stop_where_the_blind_one_hits() -> None:
    made, town = episodes(count=1, steps=100)
    ends = [trace.end for trace in run(make_system("perceiving-perfect"), made, town)]
    assert "collision" not in ends
    assert all(trace.end == "collision" for trace in run(make_system("blind"), made, town))


def test_it_looks_at_its_rate_and_nothing_is_rendered_in_between() -> None:
    made, town = episodes(count=1, steps=20)
    calls = []

    def camera(simulator: Any, agents: Any) -> Any:
        calls.append(float(simulator.state().time[0]))
        return np.full((len(agents), 3, CAMERA.height, CAMERA.width), 9, np.uint8)

    driver = PerceivingDriver(CameraPerceiver(OneCar(), {"front": CAMERA}), rate=2.5)
    run(driver, made, town, sensors={"front": camera})
    np.testing.assert_allclose(calls, [0.0, 0.4, 0.8, 1.2, 1.6], atol=1e-5)


def test_a_car_is_believed_after_its_hits_and_the_latency_and_where_it_is() -> None:
    times = [0.1 * k for k in range(8)]
    for confirm, latency, first in ((1, 0.0, 0), (3, 0.0, 4), (1, 0.3, 3), (2, 0.1, 3)):
        eyes = CameraPerceiver(OneCar(), {"front": CAMERA})
        driver = PerceivingDriver(eyes, rate=5.0, latency=latency, tracking=TrackerSettings(confirm=confirm))
        counts = seeing(times, driver, lambda _: 200)
        assert counts.index(1) == first
    belief = driver.believe(steady_view(0.8, front=np.zeros((1, 3, CAMERA.height, CAMERA.width), np.uint8)))
    np.testing.assert_allclose(belief.pose[0, 0, :2], [15.0 + CAMERA.to_ego[0, 3], 0.0], atol=1e-3)


def test_a_dark_picture_is_a_miss_and_a_lost_signal_is_not() -> None:
    times = [0.2 * k for k in range(12)]
    for value, left in ((1, 0), (0, 1)):
        eyes = CameraPerceiver(OneCar(), {"front": CAMERA})
        driver = PerceivingDriver(eyes, rate=5.0, latency=0.0, tracking=TrackerSettings(confirm=1, reserve=3))
        counts = seeing(times, driver, lambda time, value=value: 200 if time < 0.5 else value)  # type: ignore[misc]
        assert counts[2] == 1
        assert counts[-1] == left


def test_its_scenes_do_not_depend_on_their_batch_and_runs_are_equal_to_the_bit() -> None:
    made, town = episodes("TurningObstacle", count=2, steps=24)

    def driver() -> PerceivingDriver:
        return PerceivingDriver(PerfectPerceiver(missed=0.4, noise=0.05, phantoms=0.3))

    together = [trace_hash(trace) for trace in run(driver(), made, town)]
    assert [trace_hash(trace) for trace in run(driver(), made, town)] == together
    assert [trace_hash(run(driver(), [one], town)[0]) for one in made[1:]] == together[1:]


def test_with_snapshots_of_world_and_driver_it_goes_on_to_the_bit() -> None:
    made, town = episodes(count=2, steps=40)
    driver = PerceivingDriver(PerfectPerceiver(missed=0.3, noise=0.05, phantoms=0.3), latency=0.15)
    loop = Loop(World(made, {town.name: town}), {0: driver})
    loop.reset()
    for _ in range(13):
        loop.step()
    kept = loop.simulator.snapshot(), driver.snapshot_batch()  # type: ignore[attr-defined]
    ends = []
    for _ in range(2):
        for _ in range(13):
            loop.step()
        ends.append(loop.simulator.hashes())  # type: ignore[attr-defined]
        loop.simulator.restore(kept[0])  # type: ignore[attr-defined]
        driver.restore_batch(kept[1])
    assert ends[0] == ends[1]


def test_missed_and_phantom_objects_are_missed_and_there() -> None:
    made, town = episodes(count=1, steps=41)
    counts = {}
    for name, change in (("none", {}), ("missed", {"missed": 0.5, "burst": 2.0}), ("phantoms", {"phantoms": 1.0})):
        told: list[Any] = []
        run(PerceivingDriver(PerfectPerceiver(**change), watch=told.append), made, town)  # type: ignore[arg-type]
        seen = [one for one in told if isinstance(one, PerceptionEvent)]
        counts[name] = float(np.mean([len(one.objects) for one in seen[:20] if one.objects is not None]))
    assert counts["missed"] < counts["none"] < counts["phantoms"]


@pytest.mark.parametrize("field", ["score", "label"])
def test_a_detector_that_returns_nonsense_fails_with_a_line(field: str) -> None:
    made, town = episodes(count=1, steps=10)

    def spoilt(found: Detections) -> Detections:
        return replace(found, **{field: found.score * torch.nan if field == "score" else found.label + 7})

    def camera(simulator: Any, agents: Any) -> Any:
        return np.full((len(agents), 3, CAMERA.height, CAMERA.width), 200, np.uint8)

    driver = PerceivingDriver(CameraPerceiver(OneCar(spoilt), {"front": CAMERA}))
    with pytest.raises(ConfigError, match="the detector returned"):
        run(driver, made, town, sensors={"front": camera})


def test_what_is_read_after_the_step_is_a_line() -> None:
    made, town = episodes(count=1, steps=3)
    kept: list[Observation] = []

    class Late:
        name, controller, sensors = "late", make_system("perceiving-perfect").controller, ("truth", "above")

        def reset(self, episodes: Any) -> None: ...

        def act(self, view: Any) -> Any: ...

        def believe(self, view: Observation) -> Any:
            kept.append(view)
            return view.readings["truth"]

    run(Late(), made, town)
    assert kept[0].readings["truth"].kind.shape[0] == 1
    with pytest.raises(ConfigError, match="was not read in its step"):
        kept[0].readings["above"]


def test_settings_out_of_range_are_one_line() -> None:
    with pytest.raises(ConfigError, match="rate above 0"):
        PerceivingDriver(PerfectPerceiver(), rate=0.0)
    with pytest.raises(ConfigError, match="missed in"):
        PerfectPerceiver(missed=1.0)
    eyes = CameraPerceiver(OneCar(), {"front": CAMERA})
    with pytest.raises(ConfigError, match="expected"):
        eyes.perceive(steady_view(0.0, front=np.ones((1, 3, 5, 5), np.uint8)), np.array([0]))


def test_results_depend_on_the_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    before = system_version("perceiving-yolov5n")
    (tmp_path / "yolov5n.json").write_text('{"hash": "0123456789abcdef"}')
    monkeypatch.setattr("ssad.detectors.SHIPPED", tmp_path)
    after = system_version("perceiving-yolov5n")
    assert after == f"{before.split()[0]} 0123456789ab"
    assert after != before
    assert " " not in system_version("perceiving-perfect")


@pytest.mark.parametrize("system", [Fcos3d, PgdDet, Yolov5n])
def test_what_the_tracker_may_use_is_what_the_detector_is_asked_for(system: type[OneCamera]) -> None:
    for made, low in (
        (system(), tracking_settings(system.weights).low),
        (system(tracking=TrackerSettings(high=0.5, low=0.2)), 0.2),
    ):
        assert isinstance(made.perceiver, CameraPerceiver)
        assert made.perceiver.threshold == made.tracking.low == low
    scores = [tracking_settings(system.weights).high for system in (PgdDet, Fcos3d, Yolov5n)]
    assert scores == sorted(set(scores))


@pytest.mark.parametrize(
    ("detector", "said", "expected"),
    [
        ("yolov5n", {}, (0.3, 0.1)),
        ("pgd-det-light?input_width=640@mine", {}, (0.13, 0.05)),
        ("pgd-det-light", {"high": 0.03}, (0.03, 0.03)),
        ("pgd-det-light", {"low": 0.2}, (0.2, 0.2)),
        ("fcos3d-light", {"high": 0.5, "low": 0.0}, (0.5, 0.0)),
    ],
)
def test_a_suite_takes_the_scores_that_suit_the_detector(
    detector: str, said: dict[str, float], expected: tuple[float, float]
) -> None:
    settings = tracking_settings(detector, confirm=3, **said)
    assert (settings.high, settings.low, settings.confirm) == (*expected, 3)
    with pytest.raises(ConfigError, match="low <= high"):
        tracking_settings(detector, high=0.1, low=0.2)

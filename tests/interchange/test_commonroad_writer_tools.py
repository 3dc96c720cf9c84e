"""CommonRoad's own tools on what is written here: its reader, its collision checker, its criticality metrics.

They need environments of their own: `python -m benchmarks.extras commonroad crime`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.geometry import obb_distance
from ssad.core.types import Actor, EpisodeLimits, EpisodeTrace, Pose, Scenario
from ssad.drivers import make_system
from ssad.interchange.commonroad_reader import read_commonroad
from ssad.interchange.export import export_commonroad
from ssad.metrics import criticality
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

pytest.importorskip("commonroad", reason="the extra 'commonroad' is not installed", exc_type=ImportError)
pytestmark = pytest.mark.filterwarnings("ignore")  # theirs
EGO = 9_999_999  # its id as an obstacle
TOUCHING = 1e-4  # m within which float32 poses may differ over whether bodies touch


def driven(scenarios: list[Scenario], folder: Path) -> Iterator[tuple[Path, EpisodeTrace]]:
    """Files, and what happens in what they hold when `blind` drives."""
    files, _ = export_commonroad(scenarios, folder, system="blind")
    episodes = [
        build_episode(read_commonroad(path).scenario, load_town(s.town), seed=0)
        for path, s in zip(files, scenarios, strict=True)
    ]
    world = World(episodes, {s.town: load_town(s.town) for s in scenarios})
    yield from zip(files, rollout(world, make_system("blind")), strict=True)


def opened(path: Path) -> Any:
    from commonroad.common.file_reader import CommonRoadFileReader

    scenario, problems = CommonRoadFileReader(str(path)).open()
    assert len(problems.planning_problem_dict) == 1
    return scenario


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("every", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_files_are_valid_and_collide_where_bodies_do(every: int, tmp_path: Path) -> None:
    """The pre-crash scenarios, in which contacts are counted and do not end the episode, at every step."""
    import commonroad
    from lxml import etree

    pycrcc = pytest.importorskip("commonroad_dc.pycrcc")
    from commonroad_dc.collision.collision_detection.pycrcc_collision_dispatch import create_collision_checker

    folder = Path(commonroad.__path__[0]) / "scenario_definition/xml_definition_files"
    schema = etree.XMLSchema(etree.parse(folder / "XML_commonRoad_XSD.xsd"))
    scenarios = [replace(s, limits=replace(s.limits, contact="count")) for s in load_scenarios("precrash")[::every]]
    together = 0
    for path, trace in driven(scenarios, tmp_path):
        assert schema.validate(etree.parse(path)), schema.error_log
        checker = create_collision_checker(opened(path))
        boxes = criticality.trace_boxes(trace)
        gap = obb_distance(boxes[:, :1], boxes[:, 1:])
        gap = np.where(trace.active[:, 1:], gap, np.inf).min(1)
        for step, (x, y, yaw, length, width) in enumerate(boxes[:, 0].tolist()):
            theirs = checker.time_slice(step).collide(pycrcc.RectOBB(0.5 * length, 0.5 * width, yaw, x, y))
            if not theirs and gap[step] > 0.0:
                continue
            assert theirs == (gap[step] <= 0.0) or gap[step] < TOUCHING, (path.name, step, gap[step])
            together += theirs
    assert together > 20 // every


def test_bodies_overlap_as_the_collision_checker_says() -> None:
    pycrcc = pytest.importorskip("commonroad_dc.pycrcc")
    random = np.random.default_rng(7)
    size = random.uniform((0.3, 0.3), (10.0, 2.6), (4000, 2, 2))
    place = np.concatenate([random.uniform(-7.0, 7.0, (4000, 2, 2)), random.uniform(-4.0, 4.0, (4000, 2, 1))], -1)
    boxes = np.concatenate([place, size], -1)
    gap = obb_distance(boxes[:, 0], boxes[:, 1])
    bodies = [[pycrcc.RectOBB(0.5 * b[3], 0.5 * b[4], b[2], b[0], b[1]) for b in pair] for pair in boxes.tolist()]
    theirs = np.array([one.collide(other) for one, other in bodies])
    assert 0.1 < theirs.mean() < 0.9
    assert np.array_equal(theirs, gap <= 0.0)


def with_ego(scenario: Any, trace: EpisodeTrace) -> Any:
    """A configuration of CriMe for a scenario whose ego is an obstacle that does what the trace says."""
    from commonroad.geometry.shape import Rectangle
    from commonroad.prediction.prediction import TrajectoryPrediction
    from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
    from commonroad.scenario.state import InitialState, KSState
    from commonroad.scenario.trajectory import Trajectory
    from commonroad_crime.data_structure.configuration import CriMeConfiguration

    rows = np.stack([trace.x[:, 0], trace.y[:, 0], trace.yaw[:, 0], trace.speed[:, 0]], 1).astype(float)
    shape = Rectangle(float(trace.length[0]), float(trace.width[0]))
    states = [
        KSState(time_step=k, position=row[:2], orientation=row[2], velocity=row[3], steering_angle=0.0)
        for k, row in enumerate(rows)
        if k
    ]
    start = InitialState(
        time_step=0,
        position=rows[0, :2],
        orientation=rows[0, 2],
        velocity=rows[0, 3],
        acceleration=0.0,
        yaw_rate=0.0,
        slip_angle=0.0,
    )
    ego = DynamicObstacle(EGO, ObstacleType.CAR, shape, start, TrajectoryPrediction(Trajectory(1, states), shape))
    scenario.add_objects(ego)
    scenario.assign_obstacles_to_lanelets(obstacle_ids={EGO})
    config = CriMeConfiguration()
    config.update(ego_id=EGO, sce=scenario)
    return config


def others(scenario: Any) -> list[int]:
    return [obstacle.obstacle_id for obstacle in scenario.obstacles if obstacle.obstacle_id != EGO]


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("every", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_least_distance_is_that_of_crime(every: int, tmp_path: Path) -> None:
    """Its distance of closest encounter (DCE) leaves out the last step, and rounds to centimetres."""
    measures = pytest.importorskip("commonroad_crime.measure")
    compared = 0
    for path, trace in driven(load_scenarios("precrash")[::every], tmp_path):
        scenario = opened(path)
        config = with_ego(scenario, trace)
        shorter = replace(trace, **{k: getattr(trace, k)[:-1] for k in ("x", "y", "yaw", "speed", "active")})
        theirs = min(measures.DCE(config).compute(other, 0, verbose=False) for other in others(scenario))
        assert criticality.min_distance(shorter) == pytest.approx(theirs, abs=0.006), path.name
        compared += 1
    assert compared >= 32 // every


def test_time_to_collision_is_that_of_crime_behind_a_slower_car(tmp_path: Path) -> None:
    """On a straight lane that runs east, at constant speeds; else its TTC goes by accelerations, and by lanes alone."""
    measures = pytest.importorskip("commonroad_crime.measure")
    speed, ahead = 3.0, 45.0
    graph = load_town("ProvingGround")
    lane = next(
        k
        for k in range(graph.lane_count)
        if graph.kind[k] == 1
        and graph.length[k] > 140.0
        and np.ptp(graph.yaw[graph.points(k)]) < 1e-3
        and abs(float(graph.yaw[graph.offset[k]])) < 1e-3
    )
    x, y, *_ = graph.at(lane, 10.0)
    rows = tuple((t, x + ahead + speed * t, y, 0.0) for t in (0.0, 20.0))
    scenario = Scenario(
        "behind",
        "Custom",
        "ProvingGround",
        (Pose(x, y), Pose(x + 110.0, y)),
        parameters={"ego_speed": 8.0},
        actors=(Actor("slow", "suv", Pose(*rows[0][1:]), trajectory=rows),),
        limits=EpisodeLimits(max_steps=70),
        target_speed=8.0,
    )
    ((path, trace),) = driven([scenario], tmp_path)
    ours = criticality.ttc(trace)[:, 0]
    found = opened(path)
    config = with_ego(found, trace)
    (other,) = others(found)
    steps = [k for k in range(20, 60, 5) if abs(float(trace.accel[k])) < 0.05 and math.isfinite(ours[k])]
    assert len(steps) > 4
    for step in steps:
        theirs = measures.TTC(config).compute(other, step, verbose=False)
        assert theirs == pytest.approx(ours[step], abs=0.02), step
        headway = measures.HW(config).compute(other, step, verbose=False)
        bodies = criticality.trace_boxes(trace)[step]
        assert headway == pytest.approx(float(obb_distance(bodies[0], bodies[1])), abs=0.02)

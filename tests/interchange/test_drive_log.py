"""Logged drives as scenarios: others where the log has them, the ego driven anew, and towns where there is no map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.sharing import Shared

from ssad.core.errors import ConfigError, RouteError
from ssad.core.import_report import ImportReport
from ssad.core.rotations import yaw_to_quaternion
from ssad.core.types import LaneType
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.writer import NuScenesWriter
from ssad.drivers import make_system
from ssad.interchange.drive_log import AXLE_TO_MIDDLE, model_of, scenario_of_drive
from ssad.recorders.nuscenes import Recording, record_nuscenes
from ssad.scenarios.dynamic import build_episode, read_scenarios
from ssad.scenarios.dynamic.frozen import drop_collinear_rows
from ssad.world.episode_arrays import MAX_AGENTS
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

SCENE = "scene-twinford-000"


@pytest.fixture(scope="session")
def logged(shared: Shared) -> Path:
    """What `ssad record` writes: 4.5 s in Twinford."""

    def make(out: Path) -> None:
        record_nuscenes(Recording(out, ("Twinford",), (), scenes=1, seconds=4.5, width=64), workers=0)

    return shared("logged", make)


@pytest.fixture
def foreign(logged: Path, tmp_path: Path) -> Path:
    """The same tables as if somebody else's car had logged them."""
    shutil.copytree(logged / "v1.0-ssad", tmp_path / "foreign" / "v1.0-ssad")
    log = tmp_path / "foreign" / "v1.0-ssad" / "log.json"
    rows = json.loads(log.read_text())
    log.write_text(json.dumps([row | {"vehicle": "n015", "location": "singapore-queenstown"} for row in rows]))
    return tmp_path / "foreign"


@pytest.mark.parametrize("place", ["the town it says", "paths", "a map"])
def test_a_logged_drive_replays_within_a_centimetre(place: str, logged: Path, foreign: Path, tmp_path: Path) -> None:
    home = tmp_path / "Elsewhere.npz"
    if place == "a map":
        from ssad.core.lane_graph import save_graph

        save_graph(load_town("Twinford"), home)
    with NuScenes(logged if place == "the town it says" else foreign) as data:
        drive = scenario_of_drive(data, SCENE, town="Logged", map_name=str(home) if place == "a map" else None)
        scene = data.scene(SCENE)
    assert drive.is_known_town == (place == "the town it says")
    assert drive.graph.name == drive.scenario.town == ("Twinford" if drive.is_known_town else "Logged")
    assert (drive.graph.lane_count < 20) == (place == "paths")
    episode = build_episode(drive.scenario, drive.graph, seed=0)
    (trace,) = rollout(World([episode], {drive.graph.name: drive.graph}), make_system("autopilot"))
    assert trace.end == "complete"
    assert not trace.off_road.any()

    start, seen = scene.samples[0].timestamp, {}
    for sample in scene.samples:
        boxes = scene.annotations(sample.token)
        step = round(1e-5 * (sample.timestamp - start))
        for n, instance in enumerate(boxes.instance):
            seen.setdefault(instance, {})[step] = boxes.centre[n, :2]
    assert len(seen) > 20
    checked = absent = expected = 0
    replayed = set()
    for agent, actor in enumerate(drive.scenario.actors, start=1):
        (begin, x, y, _), end = actor.trajectory[0], actor.trajectory[-1][0]
        first = round(10 * begin)
        own = [name for name, told in seen.items() if np.hypot(*(told.get(first, np.zeros(2)) - [x, y])) < 0.002]
        assert len(own) == 1
        replayed.add(own[0])
        logged_places = seen[own[0]]
        expected += sum(step < len(trace.x) and begin - 0.01 <= 0.1 * step <= end + 0.01 for step in logged_places)
        for step in range(0, len(trace.x), 5):
            there = begin - 0.01 <= 0.1 * step <= end + 0.01
            assert trace.active[step, agent] == there, (actor.name, step)
            absent += not there
            if there and step in logged_places:
                away = np.hypot(*(logged_places[step] - [trace.x[step, agent], trace.y[step, agent]]))
                assert away < 0.01, (actor.name, step)
                checked += 1
    # A scene has room for the nearest objects alone.
    assert len(replayed) == len(seen) or len(drive.scenario.actors) == MAX_AGENTS - 1
    assert checked == expected > 100
    assert absent > 10


def test_poses_are_those_of_the_rear_axle_but_in_our_own_recordings(logged: Path, foreign: Path) -> None:
    with NuScenes(logged) as ours, NuScenes(foreign) as others:
        middle = scenario_of_drive(ours, SCENE, town="Logged").scenario.route
        axle = scenario_of_drive(others, SCENE, town="Logged").scenario.route
        frame = next(f for f in ours.scene(SCENE).frames if f.channel == "LIDAR_TOP" and f.key_frame)
    assert np.hypot(middle[0].x - frame.ego_to_world[0, 3], middle[0].y - frame.ego_to_world[1, 3]) < 0.002
    for one, other in ((middle[0], axle[0]), (middle[-1], axle[-1])):
        ahead = np.array([other.x - one.x, other.y - one.y])
        assert ahead == pytest.approx(AXLE_TO_MIDDLE * np.array([np.cos(one.yaw), np.sin(one.yaw)]), abs=0.02)


def test_a_recording_says_its_town_and_older_ones_do_in_words(logged: Path, tmp_path: Path) -> None:
    with NuScenes(logged) as data:
        assert data.scene(SCENE).log.location == "Twinford"
    shutil.copytree(logged / "v1.0-ssad", tmp_path / "v1.0-ssad")
    log = tmp_path / "v1.0-ssad" / "log.json"
    log.write_text(log.read_text().replace('"Twinford"', '"drawn"'))
    with NuScenes(tmp_path) as data:
        assert data.scene(SCENE).log.location == "drawn"
        assert scenario_of_drive(data, SCENE, town="Logged").scenario.town == "Twinford"


Place = Callable[[float], tuple[float, float]]


def east(time: float) -> tuple[float, float]:
    """The way of the ego."""
    return 100.0 + 8.0 * time, 50.0


Thing = tuple[str, tuple[float, float, float], Place, list[int]]
"""Category, size (width, length, height), place at a time, key frames."""


def turned(yaw: float) -> tuple[float, ...]:
    return tuple(yaw_to_quaternion(yaw).tolist())


def write(root: Path, things: list[Thing], ego: Place = east, yaw: float = 0.0) -> Path:
    """A drive of 6 s, the ego always turned by a yaw."""
    with NuScenesWriter(root) as writer:
        scene = writer.add_scene("scene-1")
        writer.add_sensor(scene, "LIDAR_TOP", modality="lidar", translation=(0.0, 0.0, 1.8), rotation=turned(0.0))
        samples = []
        for k in range(13):
            time = 5_000_000 + 500_000 * k
            samples.append(writer.add_sample(scene, time))
            writer.add_sensor_frame(
                scene,
                "LIDAR_TOP",
                timestamp_us=time,
                data=b"",
                ego_translation=(*ego(0.5 * k), 0.0),
                ego_rotation=turned(yaw),
                sample=samples[-1],
            )
        for number, (category, size, place, frames) in enumerate(things):
            instance = writer.add_instance(scene, f"thing-{number}", category=category)
            for k in frames:
                centre = (*place(0.5 * k), 0.8)
                writer.add_annotation(samples[k], instance, translation=centre, size=size, rotation=turned(0.3))
    return root


def opened(root: Path, **more: str):
    with NuScenes(root) as data:
        return scenario_of_drive(data, "scene-1", town="Logged", **more)


CAR = (1.9, 4.6, 1.6)


def still(x: float, y: float) -> Place:
    return lambda time: (x, y)


def test_tracks_begin_end_and_break_off_in_mid_drive(tmp_path: Path) -> None:
    report = ImportReport("log")
    drive = opened(
        write(
            tmp_path,
            [
                ("vehicle.car", CAR, still(120.0, 57.0), list(range(13))),
                ("vehicle.car", CAR, lambda t: (90.0 + 4.0 * t, 46.5), [4, 5, 6]),
                ("human.pedestrian.adult", (0.6, 0.6, 1.7), lambda t: (130.0, 58.0 + t), [0, 1, 2, 6, 7]),
                ("movable_object.trafficcone", (0.4, 0.4, 0.8), still(140.0, 53.0), [3]),
                ("animal", (0.4, 0.8, 0.5), still(150.0, 55.0), [2, 3]),
            ],
        ),
        report=report,
    )
    actors = {actor.name: actor for actor in drive.scenario.actors}
    assert list(actors) == ["car-1", "adult-1", "adult-1-2", "trafficcone-1", "car-2"]
    assert actors["car-1"].trajectory == ((0.0, 120.0, 57.0, 0.3), (6.0, 120.0, 57.0, 0.3))
    assert actors["car-2"].trajectory == ((2.0, 98.0, 46.5, 0.3), (3.0, 102.0, 46.5, 0.3))
    assert actors["adult-1"].trajectory == ((0.0, 130.0, 58.0, 0.3), (1.0, 130.0, 59.0, 0.3))
    assert actors["adult-1-2"].trajectory == ((3.0, 130.0, 61.0, 0.3), (3.5, 130.0, 61.5, 0.3))
    assert actors["trafficcone-1"].trajectory == ((1.5, 140.0, 53.0, 0.3), (1.6, 140.0, 53.0, 0.3))
    assert actors["trafficcone-1"].model == "cone"
    assert len(report.omissions["objects of category animal"]) == 1
    assert report.notes["objects annotated in one key frame exist for 0.1 s"] == ["trafficcone-1"]
    assert not report.doubts
    assert drive.scenario.target_speed == pytest.approx(8.0)
    assert drive.scenario.parameters == {"ego_speed": 8.0}
    first, *_, last = drive.scenario.route
    assert (first.x, first.y) == (100.0, 50.0)
    assert (last.x, last.y) == (148.0, 50.0)
    assert drive.scenario.limits.max_steps == 220


def test_the_ego_starts_where_and_as_fast_as_in_the_log(tmp_path: Path) -> None:
    cone = ("movable_object.trafficcone", (0.4, 0.4, 0.8), still(240.0, -12.0), [3])
    root = write(tmp_path, [cone], lambda t: (217.0 + 6.0 * t, -4.65), yaw=0.1)
    drive = opened(root, map_name="ProvingGround")
    assert drive.is_known_town
    ego = build_episode(drive.scenario, drive.graph, seed=0).agents[0]
    assert (ego.pose.x, ego.pose.y, ego.pose.yaw) == pytest.approx((217.0, -4.65, 0.1), abs=0.01)
    assert ego.speed == pytest.approx(6.0)
    assert ego.route.xy[-1] == pytest.approx([253.0, -5.25], abs=1.01)


def test_the_nearest_are_kept_where_there_are_too_many(tmp_path: Path) -> None:
    far = [("movable_object.barrier", (2.0, 0.5, 1.0), still(104.0 + n, 60.0 + n), [0, 1]) for n in range(70)]
    report = ImportReport("log")
    drive = opened(write(tmp_path, far[::-1]), report=report)
    assert len(drive.scenario.actors) == 62
    assert max(actor.pose.y for actor in drive.scenario.actors) == 121.0
    assert len(report.omissions["objects: a scene has room for 62, the nearest to the ego's path"]) == 8


def test_an_object_that_jumps_is_doubtful_and_refused_by_strict(tmp_path: Path, ssad_home: Path) -> None:
    jumping = ("vehicle.car", CAR, lambda t: (120.0 + 400.0 * t, 57.0), [1, 2])
    root, report = write(tmp_path / "log", [jumping]), ImportReport("log")
    opened(root, report=report)
    assert report.doubts == {"an object moves faster than 70 m/s": ["car-1"]}
    done = ssad("import", "drive", root, "--scene", "scene-1", tmp_path / "a.yaml", "--strict")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "an object moves faster than 70 m/s: car-1; correct the file" in done.stderr
    assert not (tmp_path / "a.yaml").exists()
    assert not (ssad_home / "towns" / "a.npz").exists()


def test_who_appears_later_may_appear_where_the_ego_began(tmp_path: Path) -> None:
    behind = ("vehicle.car", CAR, lambda t: (90.0 + 4.0 * t, 50.0), [5, 6, 7])  # at 100 m after 2.5 s
    assert len(opened(write(tmp_path / "later", [behind])).scenario.actors) == 1
    with pytest.raises(RouteError, match="car-1 stands in the ego at the start"):
        opened(write(tmp_path / "now", [("vehicle.car", CAR, still(101.0, 50.0), [0, 1])]))


@pytest.mark.parametrize(
    ("category", "size", "model"),
    [
        ("vehicle.car", (4.9, 2.0, 1.5), "car"),
        ("vehicle.car", (3.6, 1.8, 1.5), "compact"),
        ("vehicle.car", (5.4, 2.0, 2.4), "van"),
        ("vehicle.truck", (8.0, 2.5, 3.3), "truck"),
        ("vehicle.truck", (5.5, 2.1, 2.2), "van"),
        ("vehicle.bus.rigid", (12.0, 2.9, 3.5), "bus"),
        ("vehicle.trailer", (12.0, 2.9, 3.8), "bus"),
        ("vehicle.emergency.police", (4.8, 1.9, 1.5), "car"),
        ("vehicle.motorcycle", (2.1, 0.8, 1.5), "motorcycle"),
        ("vehicle.bicycle", (1.8, 0.6, 1.3), "bicycle"),
        ("human.pedestrian.wheelchair", (1.0, 0.6, 1.4), "walker"),
        ("movable_object.barrier", (0.5, 2.5, 1.0), "barrier"),
        ("movable_object.debris", (1.0, 1.0, 0.3), None),
        ("static_object.bicycle_rack", (8.0, 2.0, 1.2), None),
        ("animal", (0.8, 0.3, 0.5), None),
    ],
)
def test_objects_get_the_model_most_like_them(category: str, size: tuple[float, ...], model: str | None) -> None:
    assert model_of(category, np.array(size)) == model


def test_rows_on_a_line_are_left_out_and_no_others() -> None:
    times = np.arange(0.0, 8.0, 0.5)
    bend = np.maximum(times - 4.0, 0.0)
    rows = np.stack([times, 5.0 * times, bend**2, 3.0 + 0.1 * bend], 1)
    rows[:, 3] = np.angle(np.exp(1j * rows[:, 3]))  # through a heading of 180 degrees
    kept = np.array(drop_collinear_rows(rows))
    assert kept[:2, 0].tolist() == [0.0, 4.0]
    assert len(kept) == 2 + 7
    for k in range(1, 3):
        assert np.abs(np.interp(times, kept[:, 0], kept[:, k]) - rows[:, k]).max() <= 0.002
    assert np.abs(np.interp(times, kept[:, 0], np.unwrap(kept[:, 3])) - np.unwrap(rows[:, 3])).max() <= 0.001


def test_the_command_writes_a_scenario_that_runs_and_its_town(foreign: Path, tmp_path: Path, ssad_home: Path) -> None:
    out = tmp_path / "queenstown.yaml"
    done = ssad("import", "drive", foreign, "--version", "v1.0-ssad", "--scene", SCENE, out)
    assert done.returncode == 0, done.stderr
    (scenario,) = read_scenarios(out)
    first_line = f"scenario log/{SCENE}: {len(scenario.actors)} actors in queenstown; written to {out}"
    assert " ".join(done.stdout.split()).startswith(first_line)
    assert "not carried over: pictures and point clouds" in (tmp_path / "queenstown.import.txt").read_text()
    with NuScenes(foreign) as data:
        assert scenario == scenario_of_drive(data, SCENE, town="queenstown").scenario
    assert scenario.source == f"nuScenes schema v1.0-ssad, {SCENE} in singapore-queenstown"
    town = load_town("queenstown")
    assert (town.kind == LaneType.DRIVING).all()
    assert build_episode(scenario, town, seed=0).agents[0].route.lane.min() >= 0
    (ssad_home / "towns" / "queenstown.npz").unlink()
    done = ssad("import", "map", tmp_path / "queenstown.npz")  # on another machine
    assert done.returncode == 0, done.stderr
    assert np.array_equal(load_town("queenstown").xy, town.xy)


def test_mistakes_are_one_line(foreign: Path, tmp_path: Path, ssad_home: Path) -> None:
    out = tmp_path / "x.yaml"
    empty = write(tmp_path / "empty", [("animal", (0.4, 0.8, 0.5), still(150.0, 55.0), [2, 3])])
    stands = write(tmp_path / "stands", [("vehicle.car", CAR, still(120.0, 57.0), [0, 1])], ego=still(1.0, 2.0))
    cone = ("movable_object.trafficcone", (0.4, 0.4, 0.8), still(240.0, -12.0), [3])
    aside = write(tmp_path / "aside", [cone], lambda t: (217.0 + 5.0 * t, -5.25 - 8.0 * np.sin(t * np.pi / 6.0)))
    far = write(tmp_path / "far", [cone], lambda t: (5000.0 + 8.0 * t, 50.0))
    for words, message in (
        ((foreign, "--scene", "scene-0", out), "no scene 'scene-0'; closest: scene-twinford-000"),
        ((foreign, "--scene", SCENE, "--version", "v1.0-mini", out), "no version 'v1.0-mini' (found: v1.0-ssad)"),
        ((tmp_path / "none", "--scene", SCENE, out), "no such file or folder"),
        ((empty, "--scene", "scene-1", out), "nothing is annotated that could be an actor; choose another scene"),
        ((stands, "--scene", "scene-1", out), "the ego drives less than 10 m; choose another scene"),
        ((foreign, "--scene", SCENE, tmp_path / "x.json"), "a scenario file ends in .yaml"),
        ((foreign, "--scene", SCENE, "--map", "Atlantis", out), "Atlantis"),
        ((far, "--scene", "scene-1", "--map", "Crossgate", out), "the way of the ego: town 'Crossgate': "),
        ((aside, "--scene", "scene-1", "--map", "ProvingGround", out), "the way of the ego is up to 8.0 m from the"),
        ((foreign, "--scene", SCENE, tmp_path / "Larkhill.yaml"), "'Larkhill' is a built-in town"),
    ):
        done = ssad("import", "drive", *words)
        assert done.returncode == 2, words
        assert message in done.stderr, done.stderr
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert not list(tmp_path.glob("*.yaml"))
    assert not list(tmp_path.glob("*.npz"))
    with pytest.raises(ConfigError):
        opened(empty)

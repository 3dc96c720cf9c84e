"""Cameras and LiDARs in the closed loop: what drivers are shown is what is rendered from the trace afterwards."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import AgentKind, Body, Controller, Episode, EpisodeLimits, EpisodeTrace, Pose, SignalState
from ssad.rendering import onboard as loop_sensors
from ssad.rendering.agent_edit import AgentEdit
from ssad.rendering.camera.effects import select_effects
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.render import SceneWeather, render
from ssad.rendering.camera.rig import rig_camera
from ssad.rendering.camera.scene import LampSignal
from ssad.rendering.camera.scene_edit import SceneEdit, ShadowCard
from ssad.rendering.episode_scene import AgentPoses, agent_poses
from ssad.rendering.lidar import Lidar
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.onboard import Onboard
from ssad.rendering.scene_objects import PHASES
from ssad.rendering.signal_heads import LENSES
from ssad.rendering.target import TargetCar
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.scenarios.static.physical import Camouflage
from ssad.scenarios.static.physical.textures.perturbation import Texture
from ssad.world.check import check_driver
from ssad.world.roads import load_town
from ssad.world.rollout import Loop, rollout
from ssad.world.world import World

FRONT = Camera.typical(96, 64, channel="FRONT")
BEAMS = Lidar(np.deg2rad(np.linspace(-20.0, 5.0, 6)), 90)
STEPS = 8


@cache
def town() -> LaneGraph:
    return load_town("ProvingGround")


@cache
def episodes() -> tuple[Episode, ...]:
    """A walker beside the road, a bicycle, a car at a crossing with signals; of different lengths."""
    names = ("StraightObstacle/00", "TurningObstacle/00", "RedlightRunning/00")
    by_name = {s.name: s for s in load_scenarios("precrash")}
    built = [build_episode(by_name[name], town(), seed=0) for name in names]
    return tuple(replace(e, limits=EpisodeLimits(max_steps=STEPS - 2 * n)) for n, e in enumerate(built))


def world(*numbers: int) -> World:
    return World([episodes()[n] for n in numbers], {town().name: town()})


class Watcher:
    """Drives straight on and keeps what it is shown, by scene, agent and step."""

    name, controller = "watcher", Controller.EXTERNAL

    def __init__(self, *sensors: str) -> None:
        self.sensors, self.throttle = sensors, 0.8
        self.shown: dict[tuple[str, int, int, int], np.ndarray] = {}

    def reset(self, episodes) -> None:
        pass

    def act(self, view):
        for name in self.sensors:
            for row, key in enumerate(zip(view.scene.tolist(), view.agent.tolist(), view.time.tolist(), strict=True)):
                if not view.done[row]:
                    scene, agent, time = key
                    self.shown[name, scene, agent, round(time / 0.1)] = view.readings[name][row].copy()
        return np.tile(np.array([self.throttle, 0.0, 0.1], np.float32), (len(view.scene), 1))


def both(onboard: Onboard) -> dict:
    return {"front": onboard.camera(FRONT), "lidar": onboard.lidar(BEAMS)}


def late(state):
    """The first other agent, from step 3 on."""
    mask = np.zeros(state.active.shape, bool)
    mask[:, 1] = state.active[:, 1] & (state.time > 0.25)
    return mask


@pytest.fixture(scope="module")
def driven() -> tuple[Watcher, list[EpisodeTrace]]:
    """All episodes at once, seen by their egos, and from step 3 on by the first other agent as well."""
    watcher = Watcher("front", "lidar")
    return watcher, rollout(world(0, 1, 2), {0: watcher, late: watcher}, sensors=both(Onboard()))


def test_what_was_shown_is_what_is_rendered_from_the_trace(driven) -> None:
    watcher, traces = driven
    again = both(Onboard())
    assert {(name, scene) for name, scene, *_ in watcher.shown} == {(n, s) for n in again for s in range(3)}
    assert {agent for _, _, agent, _ in watcher.shown} == {0, 1}
    assert max(step for _, _, agent, step in watcher.shown if agent == 1) == STEPS - 1
    for name, sensor in again.items():
        for scene, trace in enumerate(traces):
            for agent in (0, 1):
                steps = sorted(k[3] for k in watcher.shown if k[:3] == (name, scene, agent))
                recalled = sensor.of_trace(trace, town(), agent=agent, steps=steps)
                for step, picture in zip(steps, recalled, strict=True):
                    assert np.array_equal(watcher.shown[name, scene, agent, step], picture), (name, scene, agent, step)
    pictures = [watcher.shown["front", scene, agent, 4] for scene in range(2) for agent in (0, 1)]
    assert all(picture.std() > 10 for picture in pictures)
    assert len({picture.tobytes() for picture in pictures}) == 4


def test_stated_sizes_are_rendered_alike_in_the_loop_and_from_the_trace() -> None:
    ego, car = episodes()[2].agents[:2]
    x, y = ego.pose.x + 15.0 * np.cos(ego.pose.yaw), ego.pose.y + 15.0 * np.sin(ego.pose.yaw)
    ahead = replace(car, pose=Pose(float(x), float(y), ego.pose.yaw + 0.5))
    limits = EpisodeLimits(max_steps=1)
    readings = []
    for body in (Body(), Body(length=9.123, height=3.21)):
        episode = replace(episodes()[2], agents=(ego, replace(ahead, body=body)), limits=limits)
        watcher = Watcher("front", "lidar")
        (trace,) = rollout(World([episode], {town().name: town()}), watcher, sensors=both(Onboard()))
        for name, sensor in both(Onboard()).items():
            shown = watcher.shown[name, 0, 0, 0]
            assert np.array_equal(shown, sensor.of_trace(trace, town(), steps=[0])[0])
            readings.append(shown)
    front, points, long_front, long_points = readings
    assert not np.array_equal(front, long_front)
    assert not np.array_equal(points, long_points)


def test_a_reading_does_not_depend_on_who_else_is_in_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    together = Watcher("front", "lidar")
    rollout(world(0, 1, 2), together, sensors=both(Onboard()))
    monkeypatch.setattr(loop_sensors, "AT_ONCE", 64)
    alone = Watcher("front", "lidar")
    rollout(world(1, 0), alone, sensors=both(Onboard()))
    assert len(alone.shown) == 2 * (STEPS + STEPS - 2)
    for (name, scene, agent, step), reading in alone.shown.items():
        assert np.array_equal(reading, together.shown[name, 1 - scene, agent, step]), (name, scene, step)


@pytest.mark.parametrize("resident", [False, True])
def test_cameras_that_are_read_together_are_rendered_at_once_and_show_the_same(
    monkeypatch: pytest.MonkeyPatch, resident: bool
) -> None:
    cameras = {name: rig_camera(name, 96) for name in ("CAM_FRONT", "CAM_FRONT_LEFT")} | {"small": FRONT}
    simulator, agents = world(0, 1, 0), np.array([[0, 0], [2, 0], [1, 0]], np.int32)
    simulator.step(None)
    alone = {name: Onboard().camera(camera)(simulator, agents) for name, camera in cameras.items()}
    calls = []
    monkeypatch.setattr(
        loop_sensors, "render", lambda *args, **more: calls.append(len(args[1])) or render(*args, **more)
    )
    monkeypatch.setattr(loop_sensors, "AT_ONCE", 6)
    onboard = Onboard()
    onboard.resident = resident  # as on a GPU
    sensors = onboard.group_cameras(cameras)
    for _ in range(2):
        for name, sensor in sensors.items():
            shown = sensor(simulator, agents)
            assert isinstance(shown, torch.Tensor) == resident
            np.testing.assert_array_equal(np.asarray(shown), alone[name])
    assert calls == [6, 3, 6, 3]
    simulator.step(None)  # what was rendered of a moment is not shown at the next
    later = sensors["CAM_FRONT_LEFT"](simulator, agents)
    np.testing.assert_array_equal(np.asarray(later), Onboard().camera(cameras["CAM_FRONT_LEFT"])(simulator, agents))


def test_only_what_is_asked_for_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    views, turns = [], []
    monkeypatch.setattr(
        loop_sensors, "render", lambda scene, asked, **more: views.append(len(asked)) or render(scene, asked, **more)
    )
    sweep = loop_sensors.sweep
    monkeypatch.setattr(loop_sensors, "sweep", lambda *a, **more: turns.append(1) or sweep(*a, **more))
    monkeypatch.setattr(loop_sensors, "AT_ONCE", 64)
    onboard = Onboard()
    rollout(world(0, 1), Watcher(), sensors=both(onboard))
    assert (views, turns, onboard._towns) == ([], [], {})
    rollout(world(0, 2), Watcher("front"), sensors=both(onboard))
    # one call a step for all scenes; the second episode is 4 steps shorter
    assert views == [2] * (STEPS - 4) + [1] * 4
    assert turns == []


def test_legs_follow_the_way_that_was_walked_whoever_looks_and_after_a_restore(driven) -> None:
    _, traces = driven
    onboard = Onboard()
    scene = onboard.town(town())
    looks = scene.appearance_of_trace(traces[0])
    scene.add_bodies(looks.bodies())
    walker = next(a for a, model in enumerate(looks.models) if model == "walker")
    moment = agent_poses(traces[0])[0]
    meshes = set()
    for metres in np.arange(8) * 1.45 / 8:
        later = replace(moment, walked=moment.walked + metres)
        (body,) = [t for t in scene.objects(looks, later) if t.tag == walker + 1]
        meshes.add(body.mesh)
    assert len(meshes) == PHASES

    one = world(1)  # its cyclist rides from the start
    watcher = Watcher("front")
    loop = Loop(one, {1: watcher}, sensors={"front": onboard.camera(FRONT)})
    loop.reset()
    for step in range(5):
        if step == 2:
            kept = one.snapshot()
        loop.step()
    first, watcher.shown = watcher.shown, {}
    one.restore(kept)
    watcher.throttle = 0.0  # goes on in another way
    there = []
    for _ in range(4):
        there.append(one.state().pose[0].copy())
        loop.step()
    assert np.array_equal(watcher.shown["front", 0, 1, 2], first["front", 0, 1, 2])
    track = onboard._tracks[0]
    poses = np.array(track.pose, np.float64)[:, 1, :2]
    far = np.hypot(*np.diff(poses, axis=0).T).sum()
    assert len(poses) == 6
    assert np.array_equal(track.pose[2:], there)
    assert track.walked[-1][1] == pytest.approx(far)
    assert far > 0.0

    (trace,) = rollout(world(1), {0: Watcher(), late: watcher}, sensors={"front": onboard.camera(FRONT)})
    for known, moment in zip(onboard._tracks[0].walked, agent_poses(trace), strict=False):
        assert np.array_equal(known, moment.walked)
    assert len(onboard._tracks[0].walked) >= STEPS - 2


@pytest.mark.parametrize("lit", list(LENSES))
def test_lit_signals_are_seen(lit: SignalState) -> None:
    onboard = Onboard()
    scene = onboard.town(town())
    looks = scene.appearance(episodes()[2])
    assert len(looks.signals)
    heads = scene.street.heads.astype(float)
    head = next(n for n, s in enumerate(scene.street.head_signal.tolist()) if s == looks.signals[0])
    x, y, z, yaw = heads[head].tolist()
    camera = Camera.typical(96, 96)
    camera.to_ego[:3, 3] = 0.0, 0.0, z
    agents = len(looks.models)
    pose = np.zeros((agents, 3), np.float32)
    pose[0] = x + 4.0 * np.cos(yaw), y + 4.0 * np.sin(yaw), yaw + np.pi
    off = np.zeros(len(looks.signals), np.uint8)
    dark = AgentPoses(0, pose, np.zeros(agents, bool), np.zeros(agents), off)
    moment = replace(dark, signal=np.full(len(looks.signals), lit, np.uint8))
    pictures = []
    for now in (dark, moment):
        view = onboard.view(loop_sensors.AgentView(0, scene, looks, now, 0), camera)
        pictures.append(render(scene.scene, [view]).image[0].astype(int))
    change = np.abs(pictures[1] - pictures[0]).max(-1)
    rows, columns = np.nonzero(change > 60)
    assert len(rows) >= 9
    height = 48 - (0.79 * 96) * LENSES[lit] / 4.0  # where the lens is in the picture
    assert abs(rows.mean() - height) < 2.0
    assert abs(columns.mean() - 48) < 2.0
    red, green, _ = pictures[1][rows, columns].mean(0)
    assert (red > 150) == (lit != SignalState.GREEN)
    assert (green > 150) == (lit == SignalState.GREEN) or lit == SignalState.YELLOW


def test_weather_goes_by_episode_and_lamps_are_on_by_night(driven) -> None:
    watcher, traces = driven
    night = Onboard(weather=lambda key: SceneWeather(-0.2, 0.0) if key == traces[0].key else loop_sensors.DAY)
    camera = night.camera(FRONT)
    dark = camera.of_trace(traces[0], town(), steps=[0])[0]
    day = camera.of_trace(traces[1], town(), steps=[0])[0]
    assert np.array_equal(day, watcher.shown["front", 1, 0, 0])
    assert not np.array_equal(dark, watcher.shown["front", 0, 0, 0])
    (sight,) = night.trace_views(traces[0], town(), steps=[0])
    (lamp,) = night.view(sight, FRONT).lamps
    nose = np.linalg.inv(sight.pose) @ lamp.pose[:, 3]
    assert nose[:3] == pytest.approx([2.45, 0.0, 0.65])  # the bumper of a car of 4.9 m
    walker = loop_sensors.MODELS["walker"]
    assert walker.kind == AgentKind.WALKER
    on_foot = next(a for a, model in enumerate(traces[0].models) if model == "walker")
    (sight,) = night.trace_views(traces[0], town(), agent=on_foot, steps=[0])
    assert night.view(sight, FRONT).lamps == ()


def test_perturbations_change_the_pictures_and_leave_the_points_alone() -> None:
    class Dark:
        def apply(self, frames, victim, truth, generators):
            return frames // 2

    plain, changed = Watcher("front", "lidar"), Watcher("front", "lidar")
    onboard = Onboard()
    rollout(world(2), plain, sensors=both(onboard))
    rollout(world(2), changed, sensors=both(onboard), perturbation=Dark())
    for key, reading in plain.shown.items():
        expected = reading // 2 if key[0] == "front" else reading
        assert np.array_equal(changed.shown[key], expected), key


def test_points_end_where_their_rings_do(driven) -> None:
    watcher, _ = driven
    points = watcher.shown["lidar", 0, 0, 0]
    assert points.shape == (6 * 90, 5)
    count = int((points[:, 4] >= 0).sum())
    assert 100 < count < 540
    assert (points[:count, 4] >= 0).all()
    assert (points[count:, :4] == 0).all()


def test_a_trace_has_no_further_agents_or_steps(driven) -> None:
    _, traces = driven
    camera = Onboard().camera(FRONT)
    for wrong in ({"agent": 99}, {"steps": [STEPS + 1]}):
        with pytest.raises(ConfigError, match="steps 0 to 8, not agent"):
            camera.of_trace(traces[0], town(), **wrong)
    assert set(Onboard().rig(320)) >= {"CAM_FRONT", "CAM_BACK"}


def test_the_engine_has_the_sensors_of_nuscenes_for_who_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    from ssad.simulators import closed_loop as driving

    watcher = Watcher("CAM_BACK")
    short = replace(episodes()[0], limits=EpisodeLimits(max_steps=2))
    monkeypatch.setattr(driving, "build_requested_episode", lambda cell: short)
    monkeypatch.setattr(driving, "system_of", lambda name: watcher)
    cell = SimpleNamespace(key="a", system="watcher", spec={"scenario": {"type": short.scenario.type}})
    _, (trace,), measured = driving.drive([cell], device="cpu")
    assert not measured  # by sensors of another simulator
    camera = Onboard().rig()["CAM_BACK"]
    assert np.array_equal(watcher.shown["CAM_BACK", 0, 0, 1], camera.of_trace(trace, town(), steps=[1])[0])
    found = driving.onboard_sensors([Watcher("above"), Watcher("LIDAR_TOP")], "cpu")
    assert {"CAM_FRONT", "CAM_BACK_LEFT", "LIDAR_TOP"} <= set(found)
    assert driving.onboard_sensors([Watcher("above"), Watcher()], "cpu") == {}


def test_a_driver_with_a_camera_can_be_checked() -> None:
    onboard = Onboard()

    class Shy(Watcher):
        def act(self, view):
            dark = view.readings["front"].mean((1, 2, 3)) < 60
            return np.stack([~dark, dark, 0.0 * dark], 1).astype(np.float32)

    make = lambda order: world(*order)  # noqa: E731
    check_driver(lambda: Shy("front"), make, episodes=2, steps=3, sensors=both(onboard))


def patched(mesh: Mesh) -> SceneEdit:
    """A loud patch on the roof and both sides, and a lamp that follows."""
    draws = torch.Generator().manual_seed(1)
    surface = Camouflage(texels=16).on(mesh)
    pose = np.array([[0.0, 0, 1, -8], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    lamp = SceneLamp(pose, 2000.0, (0.2, 0.2))
    return SceneEdit(
        (surface.layer,),
        (lamp,),
        cards=(ShadowCard(np.array([[0.0, -1, 0], [0, 1, 0], [0, 0, 2]])),),
        textures={0: torch.rand((3, *surface.size), generator=draws)},
        masks={0: surface.mask},
    )


def test_an_attack_in_the_loop_is_what_is_rendered_from_the_trace() -> None:
    """To the bit, with several episodes at once; LiDAR too."""
    rear = Camera.typical(96, 64, channel="REAR")
    back = np.diag([-1.0, -1.0, 1.0, 1.0])
    cameras = {"front": FRONT, "rear": replace(rear, to_ego=back @ rear.to_ego)}
    attack = AgentEdit(patched, TargetCar("sedan", "red"), agent=1)

    def sensors(onboard: Onboard) -> dict:
        return {name: onboard.camera(camera) for name, camera in cameras.items()} | {"lidar": onboard.lidar(BEAMS)}

    watcher, plain = Watcher("front", "rear", "lidar"), Watcher("front", "rear", "lidar")
    traces = rollout(world(2, 2), watcher, sensors=sensors(Onboard(attack=attack)))
    rollout(world(2, 2), plain, sensors=sensors(Onboard()))
    again = sensors(Onboard(attack=attack))
    differs: dict[str, int] = {}
    for (name, scene, agent, step), shown in watcher.shown.items():
        (recalled,) = again[name].of_trace(traces[scene], town(), agent=agent, steps=[step])
        assert np.array_equal(shown, recalled), (name, scene, step)
        differs[name] = differs.get(name, 0) + int((shown != plain.shown[name, scene, agent, step]).any())
    assert max(differs["front"], differs["rear"]) > 0, "it is seen"


def test_an_attack_that_does_not_fit_ends_in_one_line() -> None:
    for agent, message in ((1, "agent 1 is a walker"), (7, "agent 7 cannot be attacked")):
        onboard = Onboard(attack=AgentEdit(patched, TargetCar(), agent=agent))
        with pytest.raises(ConfigError, match=message):
            rollout(world(0), Watcher("front"), sensors={"front": onboard.camera(FRONT)})


def test_signs_wear_a_texture_in_the_loop() -> None:
    """All stop signs of a way, and nothing else, look otherwise."""
    graph = load_town("Larkhill")
    (scenario, *_) = [s for s in load_scenarios("stop-signs") if s.town == "Larkhill"]
    simulator = World([build_episode(scenario, graph, seed=1)], {"Larkhill": graph})
    camera = rig_camera("CAM_FRONT", 320)
    onboards = [Onboard(), Onboard(attack=Texture("grey-sign").agent_edit(0))]
    plain, grey = (o.camera(camera)(simulator, np.array([[0, 0]], np.int32))[0] for o in onboards)
    changed = (plain != grey).any(0)
    assert 0 < changed.sum() < 0.02 * changed.size
    clearly = np.abs(plain.astype(int) - grey).max(0) > 30
    redness = [(shown[0].astype(int) - shown[1])[clearly].mean() for shown in (plain, grey)]
    assert redness[0] > redness[1] + 20, "a red face turns grey"


class Brakes(Watcher):
    """Drives on for three steps, then brakes."""

    def act(self, view):
        super().act(view)  # looks at its sensors
        braking = (view.time > 0.25)[:, None]
        return np.where(braking, [0.0, 1.0, 0.0], [self.throttle, 0.0, 0.0]).astype(np.float32)


class Follower(Onboard):
    """Keeps the moments that it shows."""

    def __init__(self, **options) -> None:
        super().__init__(**options)
        self.moments: list[AgentPoses] = []

    def agent_views(self, simulator, agents):
        views = super().agent_views(simulator, agents)
        self.moments += [view.moment for view in views]
        return views


def test_stop_lamps_are_those_of_the_trace() -> None:
    onboard = Follower(effects=select_effects("vehicle-signals"))
    episode = replace(episodes()[2], limits=EpisodeLimits(max_steps=STEPS))
    longer_world = World([episode], {town().name: town()})
    (trace,) = rollout(longer_world, Brakes("front"), sensors={"front": onboard.camera(FRONT)})
    recalled = agent_poses(trace)
    assert len(onboard.moments) == STEPS
    for moment in onboard.moments:
        assert np.array_equal(moment.lamps, recalled[moment.step].lamps)
    ego = [int(moment.lamps[0]) for moment in recalled]
    assert not any(ego[:4])
    assert all(bits & LampSignal.BRAKE for bits in ego[6:])

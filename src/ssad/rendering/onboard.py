"""Cameras and LiDARs that agents carry in the closed loop; their readings can be rendered again from a trace.

    onboard = Onboard()
    sensors = {"front": onboard.camera(Camera.typical(640, 384)), "lidar": onboard.lidar()}
    rollout(world, driver, sensors=sensors)

A sensor is rendered only if a driver names it in its `sensors`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import warp as wp

from ssad.core.driving import Simulator, WorldState
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose
from ssad.core.seeding import digest
from ssad.core.types import F32, F64, I32, U8, End, EpisodeTrace
from ssad.rendering.agent_edit import AgentEdit
from ssad.rendering.camera.effects import DEFAULT_EFFECTS
from ssad.rendering.camera.lamps import NOSE, own_lamps
from ssad.rendering.camera.render import Rendering, RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.camera.scene import SceneObject
from ssad.rendering.camera.scene_edit import SceneEdit, render_with
from ssad.rendering.camera.sensor import SENSOR
from ssad.rendering.camera.sensor import SensorModel as Response
from ssad.rendering.episode_scene import (
    AgentPoses,
    Appearance,
    EpisodeScene,
    agent_poses,
    walked_distance,
)
from ssad.rendering.lidar import HDL32E, Lidar, sweep
from ssad.rendering.street_edit import StreetEdit
from ssad.rendering.vehicle_signals import WITH_LAMPS, flashing, vehicle_signals, with_lamps
from ssad.world.models import MODELS, agent_size
from ssad.world.rollout import has_drivers

DAY: Final = SceneWeather(0.9, 2.2, 0.3)
AT_ONCE, AT_ONCE_GPU, AT_LEAST_GPU = 1, 192, 16  # views rendered in one call; on a CPU more do not pay
VIEW_MEMORY: Final = 100 << 20  # bytes that a view of 640 x 360 needs on a GPU, with shadows and textures


@dataclass(slots=True)
class _Track:
    """Poses, speeds and distances of the agents of a scene since its episode began, one entry per step."""

    episode: int
    appearance: Appearance
    pose: list[F32] = field(default_factory=list)
    walked: list[F64] = field(default_factory=list)
    speed: list[F32] = field(default_factory=list)

    def follow(self, step: int, pose: F32, speed: F32) -> None:
        """Append a step; an earlier step discards the entries from there on."""
        if step < len(self.pose):
            if np.array_equal(self.pose[step], pose):
                return
            del self.pose[step:], self.walked[step:], self.speed[step:]
        previous_pose = self.pose[-1] if self.pose else pose
        walked = self.walked[-1] if self.walked else np.zeros(len(pose))
        # steps before the first reading are unknown; they only affect walking cycles and stop lamps
        missing_steps = step + 1 - len(self.pose)
        self.pose += [pose.copy()] * missing_steps
        self.walked += [walked_distance(walked, previous_pose, pose)] * missing_steps
        self.speed += [speed.copy()] * missing_steps


@dataclass(frozen=True, slots=True)
class AgentView:
    """View of an agent at a moment.

    Attributes:
        row: Row of the reading that it belongs to.
        town: Scene of its town.
        appearance: Appearance of the episode.
        moment: Poses of the agents.
        agent: Number of the viewing agent.
    """

    row: int
    town: EpisodeScene
    appearance: Appearance
    moment: AgentPoses
    agent: int

    @property
    def pose(self) -> F64:
        """Pose of the agent, [4, 4]."""
        x, y, yaw = self.moment.pose[self.agent].astype(np.float64).tolist()
        return upright_pose(x, y, yaw)


class Onboard:
    """Sensors of agents for `ssad.world.rollout.rollout`, and the same readings from traces.

    Sensors of one Onboard share their scenes: street and bodies are built once for each town. A reading depends on
    the episode, the step and the agent alone. It is black, or empty, if the episode has ended.

    Args:
        weather: Weather of all episodes, or a function from an episode's key to its weather.
        response: Model between lens and image; by default that of the recorder.
        device: Device that renders: cpu or cuda:0.
        attack: Edit of one of the agents, or of stop signs, that cameras and LiDARs see.
        resident: Whether images stay on a GPU, as torch tensors, for a driver that processes them there.
        effects: Effects of the rendering that cameras show, see `ssad.rendering.camera.effects`.
        street_edit: Edit of the street that cameras and LiDARs see; not together with `attack`.

    Raises:
        ConfigError: There are both an attack and an edit of the street.
    """

    def __init__(
        self,
        *,
        weather: SceneWeather | Callable[[str], SceneWeather] = DAY,
        response: Response = SENSOR,
        device: str = "cpu",
        attack: AgentEdit | None = None,
        resident: bool = False,
        effects: frozenset[str] = DEFAULT_EFFECTS,
        street_edit: StreetEdit | None = None,
    ) -> None:
        self.quality = RenderQuality(effects=effects)
        self.resident = resident and device != "cpu"
        self.at_once = AT_ONCE
        if device != "cpu":
            # other processes may share the device
            self.at_once = max(min(AT_ONCE_GPU, wp.get_device(device).free_memory // 4 // VIEW_MEMORY), AT_LEAST_GPU)
        self.weather, self.response, self.device, self.attack = weather, response, device, attack
        if attack is not None and street_edit is not None:
            raise ConfigError("an agent and the street are edited at once; use one attack at a time")
        self.street_edit = street_edit
        self._towns: dict[str, tuple[LaneGraph, EpisodeScene]] = {}
        self._simulator: Simulator | None = None
        self._tracks: dict[int, _Track] = {}

    def camera(self, camera: Camera) -> OnboardCamera:
        """Return a camera as a sensor: images uint8 [N, 3, height, width], RGB.

        Args:
            camera: Its lens, and its place on the agent: `to_ego` counts from the middle of its base, x forward.
        """
        return OnboardCamera(self, camera)

    def rig(self, width: int = 640) -> dict[str, OnboardCamera]:
        """Return the six cameras of nuScenes by channel, with images of this width in pixels (16:9)."""
        return {channel: self.camera(rig_camera(channel, width)) for channel in RIG}

    def depth_camera(self, camera: Camera) -> OnboardDepthCamera:
        """Return a depth camera as a sensor: metres along the optical axis, float32 [N, height, width]; inf: sky."""
        return OnboardDepthCamera(self, camera)

    def group_cameras(self, cameras: Mapping[str, Camera]) -> dict[str, OnboardCamera]:
        """Return cameras that are always read together: those of one size are rendered in one call.

        Args:
            cameras: Cameras by the names of their sensors.
        """
        groups = {(camera.width, camera.height): Rig() for camera in cameras.values()}
        sensors = {}
        for name, camera in cameras.items():
            group = groups[camera.width, camera.height]
            group.cameras.append(camera)
            sensors[name] = OnboardCamera(self, camera, group)
        return sensors

    def lidar(self, lidar: Lidar = HDL32E) -> OnboardLidar:
        """Return a LiDAR as a sensor: points float32 [N, P, 5]: x, y, z in the sensor's frame, intensity, ring.

        P is the number of its beams times its azimuths; rows after the last point are 0, their ring -1.

        Args:
            lidar: The sensor, and its place on the agent.
        """
        return OnboardLidar(self, lidar)

    def follow(self, simulator: Simulator) -> None:
        """Record the current poses of all agents; the loop calls it at every step.

        Args:
            simulator: The running simulator. The history of another one is discarded.
        """
        self._follow(simulator)

    def _follow(self, simulator: Simulator) -> WorldState:
        """Record the current poses of all agents and return the state of the simulator."""
        if simulator is not self._simulator:
            self._simulator, self._tracks = simulator, {}
            self._add_bodies(simulator)
        state = simulator.state()
        for scene, episode in enumerate(simulator.assigned.tolist()):
            step = _step_of(simulator, state, scene)
            history = self._tracks.get(scene)
            if history is None or history.episode != episode:
                episode_spec = simulator.episodes[episode]
                appearance = self.town(simulator.graphs[episode_spec.town]).appearance(episode_spec)
                history = self._tracks[scene] = _Track(episode, appearance)
            agent_count = len(history.appearance.models)
            history.follow(step, state.pose[scene, :agent_count], state.speed[scene, :agent_count])
        return state

    def town(self, graph: LaneGraph) -> EpisodeScene:
        """Return the scene of a town, with the bodies of all its episodes so far."""
        cached = self._towns.get(graph.name)
        if cached is None or cached[0] is not graph:
            cached = self._towns[graph.name] = (graph, EpisodeScene(graph, device=self.device))
        return cached[1]

    def _add_bodies(self, simulator: Simulator) -> None:
        """Add the bodies of all episodes that a simulator can run."""
        # All at once: a body that is added later would rebuild the scene in the middle of a run.
        for episode in simulator.episodes:
            town = self.town(simulator.graphs[episode.town])
            self._add_episode(town, town.appearance(episode))

    def _add_episode(self, town: EpisodeScene, appearance: Appearance) -> None:
        """Add the bodies of an episode to its town."""
        town.add_bodies(appearance.bodies())
        if self.attack is not None:
            town.add_meshes(self.attack.meshes(*self._attacked(appearance)))
        if self.street_edit is not None:
            town.add_meshes(self.street_edit.meshes())

    def visible_objects(self, sight: AgentView) -> tuple[SceneObject, ...]:
        """The bodies that an agent could see."""
        scene_objects = sight.town.objects(sight.appearance, sight.moment, without=sight.agent)
        if self.street_edit is not None:
            indices = sight.town.indices(self.street_edit.meshes())
            return self.street_edit.objects(scene_objects, sight.appearance.route, indices, sight.town.sign_kinds)
        if self.attack is None:
            return scene_objects
        (target_key, *_) = self.attack.meshes(*self._attacked(sight.appearance))
        return self.attack.replace_attacked(scene_objects, sight.town.index(target_key), sight.town.stop_signs)

    def render(self, sights: Sequence[AgentView], cameras: Sequence[Camera]) -> Rendering:
        """Render sights in one town, all of one edit (see `edit`), camera by camera; arrays stay on the device."""
        object_cache: dict[int, tuple[SceneObject, ...]] = {}
        views = [self.view(agent_view, camera, object_cache) for camera in cameras for agent_view in sights]
        edit, scene = self.edit(sights[0]), sights[0].town.scene
        if edit is None:
            return render(scene, views, quality=self.quality, download=False)
        rendering = render_with(scene, views, edit.textures, edit.masks, quality=self.quality)
        image, tag, depth = (
            wp.array(array, device=self.device) for array in (rendering.image, rendering.tag, rendering.depth)
        )
        return replace(rendering, image=image, tag=tag, depth=depth)

    def edit(self, sight: AgentView) -> SceneEdit | None:
        """Return the edit of an episode, the same for all episodes whose attacked agent is of one model."""
        if self.street_edit is not None:
            return self.street_edit.edit if self.street_edit.edit.textures else None
        return None if self.attack is None else self.attack.body(*self._attacked(sight.appearance))[1]

    def _attacked(self, appearance: Appearance) -> tuple[str, tuple[float, ...]]:
        """Return the model and the size of the attacked agent, as `AgentEdit.body` takes them."""
        assert self.attack is not None
        model = self.attack.attacked_model(appearance.models, appearance.key)
        return model, self.attack.attacked_size(appearance.sizes)

    def agent_views(self, simulator: Simulator, agents: I32) -> list[AgentView]:
        """Return the current views of agents [N, 2] (scene, agent), without those whose episode has ended."""
        state, ended = self._follow(simulator), simulator.ended()
        agent_views, moments = [], {}
        for row, (scene, agent) in enumerate(agents.tolist()):
            if ended[scene] != End.RUNNING:
                continue
            history = self._tracks[scene]
            if scene not in moments:
                step, agent_count = _step_of(simulator, state, scene), len(history.appearance.models)
                signal = state.signal[scene][history.appearance.signals]
                # As in the trace, which keeps turn signals only of episodes with drivers of the population.
                shows_turns = has_drivers(simulator.episodes[history.episode])
                signals = vehicle_signals(
                    history.speed[max(step - 1, 0)],
                    history.speed[step],
                    history.walked[step],
                    state.turn_signal[scene, :agent_count] if shows_turns else np.zeros(agent_count, np.int8),
                    simulator.dt,
                    with_lamps(history.appearance.models),
                )
                lamps = flashing(signals, step * simulator.dt, np.arange(agent_count))
                moments[scene] = AgentPoses(
                    step, history.pose[step], state.active[scene, :agent_count], history.walked[step], signal, lamps
                )
            town = self.town(simulator.graphs[simulator.episodes[history.episode].town])
            agent_views.append(AgentView(row, town, history.appearance, moments[scene], agent))
        return agent_views

    def trace_views(
        self, trace: EpisodeTrace, graph: LaneGraph, *, agent: int = 0, steps: Sequence[int] | None = None
    ) -> list[AgentView]:
        """Return the views of an agent at steps of a trace.

        Args:
            trace: The drive.
            graph: Lane graph of its town.
            agent: Number of the viewing agent.
            steps: Steps to view; None: all T.

        Raises:
            ConfigError: The trace has no such agent or step.
        """
        moments = agent_poses(trace)
        selected_steps = range(len(moments)) if steps is None else steps
        if not 0 <= agent < len(trace.models) or any(not 0 <= step < len(moments) for step in selected_steps):
            raise ConfigError(
                f"{trace.key}: has agents 0 to {len(trace.models) - 1} and steps 0 to {len(moments) - 1}, "
                f"not agent {agent} at steps {list(selected_steps)}"
            )
        town = self.town(graph)
        appearance = town.appearance_of_trace(trace)
        self._add_episode(town, appearance)
        return [AgentView(row, town, appearance, moments[step], agent) for row, step in enumerate(selected_steps)]

    def view(
        self, sight: AgentView, camera: Camera, object_cache: dict[int, tuple[SceneObject, ...]] | None = None
    ) -> View:
        """Return the view through a camera of the agent; `object_cache` holds gathered objects by `id` of a sight."""
        appearance, moment, agent = sight.appearance, sight.moment, sight.agent
        weather = self.weather if isinstance(self.weather, SceneWeather) else self.weather(appearance.key)
        camera_pose = sight.pose @ camera.to_ego
        scene_objects = None if object_cache is None else object_cache.get(id(sight))
        if scene_objects is None:
            scene_objects = self.visible_objects(sight)
            if object_cache is not None:
                object_cache[id(sight)] = scene_objects
        lit_lenses = sight.town.lights(appearance, moment, camera_pose[:2, 3])
        model_entry = MODELS[appearance.models[agent]]
        length, _, _ = agent_size(model_entry.name, appearance.sizes[agent])
        nose_pose = sight.pose @ upright_pose(0.5 * length - NOSE, 0.0, 0.0)
        lamps = own_lamps(nose_pose, weather) if model_entry.kind in WITH_LAMPS else ()
        # The noise depends on nothing else, so a trace reproduces the reading to the bit.
        noise_seed = int(digest("onboard noise", appearance.key, moment.step, agent, camera.channel)[:7], 16)
        view = View(camera, camera_pose, (*scene_objects, *lit_lenses), weather, self.response, noise_seed, lamps)
        if self.street_edit is not None:
            return self.street_edit.on(view, appearance.route, sight.town.heads)
        edit = self.edit(sight)
        if edit is None or self.attack is None:
            return view
        _, *cards = self.attack.meshes(*self._attacked(sight.appearance))
        for tag in self.attack.tags(scene_objects):
            view = edit.on(view, tag, cards=[sight.town.index(key) for key in cards])
        return view


@dataclass(slots=True)
class Rig:
    """Cameras of one size that are rendered together, see `Onboard.group_cameras`.

    Attributes:
        cameras: The cameras.
        moment: When and for whom they were last rendered.
        read: Pictures of that moment that nobody has taken yet, by the camera's number.
    """

    cameras: list[Camera] = field(default_factory=list)
    moment: tuple[object, ...] = ()
    read: dict[int, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class OnboardCamera:
    """Camera that agents carry, see `Onboard.camera`."""

    onboard: Onboard
    camera: Camera
    rig: Rig | None = None

    def follow(self, simulator: Simulator) -> None:
        """Record the poses of this step for the shared scenes."""
        self.onboard.follow(simulator)

    def __call__(self, simulator: Simulator, agents: I32) -> Any:
        """Return images [N, 3, H, W] of agents [N, 2] (scene, agent); black if the episode has ended."""
        if self.rig is None:
            return self._read(self.onboard.agent_views(simulator, agents), len(agents))
        state = simulator.state()
        state_arrays = (state.time, state.pose, state.active, state.signal, agents)
        # The first camera that is read renders the whole group; the state tells a new moment from an old one.
        moment = (id(simulator), *(array.tobytes() for array in state_arrays))
        camera_index = next(index for index, camera in enumerate(self.rig.cameras) if camera is self.camera)
        if moment != self.rig.moment or camera_index not in self.rig.read:
            cameras, agent_views = self.rig.cameras, self.onboard.agent_views(simulator, agents)
            self.rig.moment = moment
            self.rig.read = dict(enumerate(self._read_all(agent_views, len(agents), cameras)))
        return self.rig.read.pop(camera_index)

    def of_trace(
        self, trace: EpisodeTrace, graph: LaneGraph, *, agent: int = 0, steps: Sequence[int] | None = None
    ) -> U8:
        """The pictures [T, 3, H, W] that an agent was shown; arguments and errors as `Onboard.trace_views`."""
        agent_views = self.onboard.trace_views(trace, graph, agent=agent, steps=steps)
        images = self._read(agent_views, len(agent_views))
        host_images: U8 = images.cpu().numpy() if self.onboard.resident else images
        return host_images

    def _read(self, sights: Sequence[AgentView], count: int) -> Any:
        """All pictures in as few calls as possible."""
        return self._read_all(sights, count, [self.camera])[0]

    def _read_all(self, sights: Sequence[AgentView], count: int, cameras: Sequence[Camera]) -> Any:
        """Pictures [C, N, 3, H, W] of cameras of one size; a tensor on the GPU where they stay there."""
        shape = (len(cameras), count, self.camera.height, self.camera.width, 3)
        if self.onboard.resident:
            import torch

            gpu_images = torch.zeros(shape, dtype=torch.uint8, device=self.onboard.device)
            for batch, rendering in self.render_batches(sights, cameras):
                rows = torch.tensor([agent_view.row for agent_view in batch], device=gpu_images.device)
                wp.synchronize_device(self.onboard.device)  # torch has a stream of its own
                gpu_images[:, rows] = wp.to_torch(rendering.image).view(len(cameras), len(batch), *shape[2:])
                if gpu_images.is_cuda:
                    torch.cuda.synchronize(gpu_images.device)
            return gpu_images.movedim(-1, 2)
        host_images = np.zeros(shape, np.uint8)
        for batch, rendering in self.render_batches(sights, cameras):
            images = rendering.image.numpy()  # type: ignore[attr-defined]
            host_images[:, [agent_view.row for agent_view in batch]] = images.reshape(
                len(cameras), len(batch), *shape[2:]
            )
        return np.moveaxis(host_images, -1, 2)

    def render_batches(
        self, sights: Sequence[AgentView], cameras: Sequence[Camera] | None = None
    ) -> Iterator[tuple[list[AgentView], Rendering]]:
        """Render in as few calls as possible.

        Args:
            sights: What is to be seen.
            cameras: Through which cameras of one size; None: this one.

        Yields:
            Some of the sights, and what `ssad.rendering.camera.render.render` gives for them, camera by camera, with
            its arrays left where they are.
        """
        cameras = [self.camera] if cameras is None else cameras
        # One call renders one scene under one edit.
        groups: dict[tuple[int, int], list[AgentView]] = {}
        for agent_view in sights:
            groups.setdefault((id(agent_view.town), id(self.onboard.edit(agent_view))), []).append(agent_view)
        views_per_call = max(self.onboard.at_once // len(cameras), 1)
        for group in groups.values():
            for start in range(0, len(group), views_per_call):
                batch = group[start : start + views_per_call]
                yield batch, self.onboard.render(batch, cameras)


@dataclass(frozen=True, slots=True)
class OnboardDepthCamera:
    """Depth camera that agents carry, see `Onboard.depth_camera`."""

    onboard: Onboard
    camera: Camera

    def follow(self, simulator: Simulator) -> None:
        """Record the poses of this step for the shared scenes."""
        self.onboard.follow(simulator)

    def __call__(self, simulator: Simulator, agents: I32) -> F32:
        """Return depths [N, H, W] of agents [N, 2] (scene, agent); inf if the episode has ended."""
        depths = np.full((len(agents), self.camera.height, self.camera.width), np.inf, np.float32)
        camera = OnboardCamera(self.onboard, self.camera)
        for batch, rendering in camera.render_batches(self.onboard.agent_views(simulator, agents)):
            depths[[agent_view.row for agent_view in batch]] = rendering.depth.numpy()  # type: ignore[attr-defined]
        return depths


@dataclass(frozen=True, slots=True)
class OnboardLidar:
    """LiDAR that agents carry, see `Onboard.lidar`."""

    onboard: Onboard
    lidar: Lidar

    def follow(self, simulator: Simulator) -> None:
        """Record the poses of this step for the shared scenes."""
        self.onboard.follow(simulator)

    def __call__(self, simulator: Simulator, agents: I32) -> F32:
        """Return points [N, P, 5] of agents [N, 2] (scene, agent); none if the episode has ended."""
        return self._read(self.onboard.agent_views(simulator, agents), len(agents))

    def of_trace(
        self, trace: EpisodeTrace, graph: LaneGraph, *, agent: int = 0, steps: Sequence[int] | None = None
    ) -> F32:
        """The points [T, P, 5] that an agent was shown; arguments and errors as `Onboard.trace_views`."""
        agent_views = self.onboard.trace_views(trace, graph, agent=agent, steps=steps)
        return self._read(agent_views, len(agent_views))

    def _read(self, sights: Sequence[AgentView], count: int) -> F32:
        """One turn for each."""
        readings = np.zeros((count, len(self.lidar.beams) * self.lidar.azimuths, 5), np.float32)
        readings[..., 4] = -1.0
        for agent_view in sights:
            appearance, moment, agent = agent_view.appearance, agent_view.moment, agent_view.agent
            scene_objects = self.onboard.visible_objects(agent_view)
            key = ("onboard lidar", appearance.key, moment.step, agent)
            points, _ = sweep(agent_view.town.scene, self.lidar, agent_view.pose, scene_objects, key=key)
            readings[agent_view.row, : len(points)] = points
        return readings


def _step_of(simulator: Simulator, state: WorldState, scene: int) -> int:
    """Return the steps since the episode of a scene began."""
    return round(float(state.time[scene]) / simulator.dt)

"""Cameras and LiDARs that agents carry in the closed loop; what they saw can be rendered again from a trace.

    eyes = Onboard()
    rollout(world, driver, sensors={"front": eyes.camera(Camera.typical(640, 384)), "lidar": eyes.lidar()})

Nothing is rendered unless a driver names the sensor in its `sensors`.
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
from ssad.core.types import F32, F64, I32, U8, AgentKind, End, EpisodeTrace
from ssad.rendering.agent_edit import LiveAttack
from ssad.rendering.camera.lamps import NOSE, own_lamps
from ssad.rendering.camera.render import Picture, View, Weather, render
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.camera.scene import Thing
from ssad.rendering.camera.scene_edit import SceneEdit, render_with
from ssad.rendering.camera.sensor import SENSOR
from ssad.rendering.camera.sensor import Sensor as Response
from ssad.rendering.episode_scene import EpisodeScene, Looks, Moment, moments_of, walked_to
from ssad.rendering.lidar import HDL32E, Lidar, sweep
from ssad.world.models import MODELS

DAY: Final = Weather(0.9, 2.2, 0.3)
AT_ONCE, AT_ONCE_GPU, AT_LEAST_GPU = 1, 192, 16  # views rendered in one call; on a CPU more do not pay
VIEW_MEMORY: Final = 100 << 20  # bytes that a view of 640 x 360 needs on a GPU, with shadows and textures
WITH_LAMPS: Final = (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS, AgentKind.MOTORCYCLE)


@dataclass(slots=True)
class _Track:
    """Where the agents of a scene have been since its episode began: a row a step."""

    episode: int
    looks: Looks
    pose: list[F32] = field(default_factory=list)
    walked: list[F64] = field(default_factory=list)

    def follow(self, step: int, pose: F32) -> None:
        """Another step; an earlier one again goes on from there."""
        if step < len(self.pose):
            if np.array_equal(self.pose[step], pose):
                return
            del self.pose[step:], self.walked[step:]
        before = self.pose[-1] if self.pose else pose
        walked = self.walked[-1] if self.walked else np.zeros(len(pose))
        # what happened before somebody looked is not known; it decides nothing but where feet are
        missing = step + 1 - len(self.pose)
        self.pose += [pose.copy()] * missing
        self.walked += [walked_to(walked, before, pose)] * missing


@dataclass(frozen=True, slots=True)
class Sight:
    """What an agent could see at a moment.

    Attributes:
        row: Which reading it belongs to.
        town: Where it is.
        looks: Of the episode.
        moment: Who is where.
        agent: Who looks.
    """

    row: int
    town: EpisodeScene
    looks: Looks
    moment: Moment
    agent: int

    @property
    def pose(self) -> F64:
        """Where the agent is, [4, 4]."""
        x, y, yaw = self.moment.pose[self.agent].astype(np.float64).tolist()
        return upright_pose(x, y, yaw)


class Onboard:
    """What agents carry: makes sensors for `ssad.world.rollout.rollout`, and the same readings from traces.

    Sensors of one Onboard share their scenes: street and bodies are made once for each town. A reading depends on the
    episode, the step and the agent alone. It is black, or empty, where the episode has ended.

    Args:
        weather: Of all episodes, or a function from an episode's key to its weather.
        response: What stands between lens and picture; as the recorder's.
        device: Where it is rendered: cpu or cuda:0.
        attack: A physical attack on one of the agents, or on stop signs, in what cameras and LiDARs see.
        resident: Whether pictures stay on a GPU, as torch tensors, for a driver that looks at them there.
    """

    def __init__(
        self,
        *,
        weather: Weather | Callable[[str], Weather] = DAY,
        response: Response = SENSOR,
        device: str = "cpu",
        attack: LiveAttack | None = None,
        resident: bool = False,
    ) -> None:
        self.resident = resident and device != "cpu"
        self.at_once = AT_ONCE
        if device != "cpu":
            # other processes may share the device
            self.at_once = max(min(AT_ONCE_GPU, wp.get_device(device).free_memory // 4 // VIEW_MEMORY), AT_LEAST_GPU)
        self.weather, self.response, self.device, self.attack = weather, response, device, attack
        self._towns: dict[str, tuple[LaneGraph, EpisodeScene]] = {}
        self._simulator: Simulator | None = None
        self._tracks: dict[int, _Track] = {}

    def camera(self, camera: Camera) -> OnboardCamera:
        """A camera as a sensor: pictures uint8 [N, 3, height, width], RGB.

        Args:
            camera: Its lens, and its place on the agent: `to_ego` counts from the middle of its base, x forward.
        """
        return OnboardCamera(self, camera)

    def rig(self, width: int = 640) -> dict[str, OnboardCamera]:
        """The six cameras of nuScenes by channel, for pictures so many pixels wide (16:9)."""
        return {channel: self.camera(rig_camera(channel, width)) for channel in RIG}

    def together(self, cameras: Mapping[str, Camera]) -> dict[str, OnboardCamera]:
        """Cameras that are always read together: those of one size are rendered in one call.

        Args:
            cameras: By the names of their sensors.
        """
        sizes = {(camera.width, camera.height): Rig() for camera in cameras.values()}
        found = {}
        for name, camera in cameras.items():
            rig = sizes[camera.width, camera.height]
            rig.cameras.append(camera)
            found[name] = OnboardCamera(self, camera, rig)
        return found

    def lidar(self, lidar: Lidar = HDL32E) -> OnboardLidar:
        """A LiDAR as a sensor: points float32 [N, P, 5]: x, y, z in the sensor's frame, intensity, ring.

        P is the number of its beams times its azimuths; rows after the last point are 0, their ring -1.

        Args:
            lidar: The sensor, and its place on the agent.
        """
        return OnboardLidar(self, lidar)

    def follow(self, simulator: Simulator) -> None:
        """Take note of where everybody is now, whoever looks; the loop calls it at every step.

        Args:
            simulator: The one that runs. What was known of another one is forgotten.
        """
        self._follow(simulator)

    def _follow(self, simulator: Simulator) -> WorldState:
        """See `follow`; the state of the simulator."""
        if simulator is not self._simulator:
            self._simulator, self._tracks = simulator, {}
            self._cast(simulator)
        state = simulator.state()
        for scene, episode in enumerate(simulator.assigned.tolist()):
            step = _step_of(simulator, state, scene)
            track = self._tracks.get(scene)
            if track is None or track.episode != episode:
                one = simulator.episodes[episode]
                looks = self.town(simulator.graphs[one.town]).looks(one)
                track = self._tracks[scene] = _Track(episode, looks)
            track.follow(step, state.pose[scene, : len(track.looks.models)])
        return state

    def town(self, graph: LaneGraph) -> EpisodeScene:
        """The scene of a town, with the bodies of all episodes that were seen there."""
        known = self._towns.get(graph.name)
        if known is None or known[0] is not graph:
            known = self._towns[graph.name] = (graph, EpisodeScene(graph, device=self.device))
        return known[1]

    def _cast(self, simulator: Simulator) -> None:
        """Have bodies for all episodes that a simulator can run."""
        for episode in simulator.episodes:
            town = self.town(simulator.graphs[episode.town])
            self._prepare(town, town.looks(episode))

    def _prepare(self, town: EpisodeScene, looks: Looks) -> None:
        """Have the bodies of an episode."""
        town.cast(looks.bodies())
        if self.attack is not None:
            town.have(self.attack.meshes(self.attack.attacked(looks.models, looks.key)))

    def things(self, sight: Sight) -> tuple[Thing, ...]:
        """The bodies that an agent could see."""
        found = sight.town.things(sight.looks, sight.moment, without=sight.agent)
        if self.attack is None:
            return found
        (own, *_) = self.attack.meshes(self._attacked(sight))
        return self.attack.dressed(found, sight.town.index(own), sight.town.stop_signs)

    def render(self, sights: Sequence[Sight], cameras: Sequence[Camera]) -> Picture:
        """What sights in one town show, all of one edit (see `edit`), camera by camera, with its arrays left there."""
        seen: dict[int, tuple[Thing, ...]] = {}
        views = [self.view(sight, camera, seen) for camera in cameras for sight in sights]
        edit, scene = self.edit(sights[0]), sights[0].town.scene
        if edit is None:
            return render(scene, views, download=False)
        picture = render_with(scene, views, edit.textures, edit.masks)
        image, tag, depth = (wp.array(one, device=self.device) for one in (picture.image, picture.tag, picture.depth))
        return replace(picture, image=image, tag=tag, depth=depth)

    def edit(self, sight: Sight) -> SceneEdit | None:
        """What the attack changes in an episode, the same for all episodes whose attacked agent is of one model."""
        return None if self.attack is None else self.attack.body(self._attacked(sight))[1]

    def _attacked(self, sight: Sight) -> str:
        assert self.attack is not None
        return self.attack.attacked(sight.looks.models, sight.looks.key)

    def sights(self, simulator: Simulator, agents: I32) -> list[Sight]:
        """What agents [N, 2] (scene, agent) could see now; without those whose episode has ended."""
        state, ended = self._follow(simulator), simulator.ended()
        found, moments = [], {}
        for row, (scene, agent) in enumerate(agents.tolist()):
            if ended[scene] != End.RUNNING:
                continue
            track = self._tracks[scene]
            if scene not in moments:
                step, n = _step_of(simulator, state, scene), len(track.looks.models)
                signal = state.signal[scene][track.looks.signals]
                moments[scene] = Moment(step, track.pose[step], state.active[scene, :n], track.walked[step], signal)
            town = self.town(simulator.graphs[simulator.episodes[track.episode].town])
            found.append(Sight(row, town, track.looks, moments[scene], agent))
        return found

    def sights_of_trace(
        self, trace: EpisodeTrace, graph: LaneGraph, *, agent: int = 0, steps: Sequence[int] | None = None
    ) -> list[Sight]:
        """What an agent could see at steps of a trace.

        Args:
            trace: What happened.
            graph: Its town.
            agent: Who looks.
            steps: Which steps; None: all T.

        Raises:
            ConfigError: There is no such agent or step.
        """
        moments = moments_of(trace)
        chosen = range(len(moments)) if steps is None else steps
        if not 0 <= agent < len(trace.models) or any(not 0 <= step < len(moments) for step in chosen):
            raise ConfigError(
                f"{trace.key}: has agents 0 to {len(trace.models) - 1} and steps 0 to {len(moments) - 1}, "
                f"not agent {agent} at steps {list(chosen)}"
            )
        town = self.town(graph)
        looks = town.looks_of_trace(trace)
        self._prepare(town, looks)
        return [Sight(row, town, looks, moments[step], agent) for row, step in enumerate(chosen)]

    def view(self, sight: Sight, camera: Camera, seen: dict[int, tuple[Thing, ...]] | None = None) -> View:
        """A view through a camera that the agent carries; `seen`: things of sights (by `id`) that were gathered."""
        looks, moment, agent = sight.looks, sight.moment, sight.agent
        weather = self.weather if isinstance(self.weather, Weather) else self.weather(looks.key)
        eye = sight.pose @ camera.to_ego
        things = None if seen is None else seen.get(id(sight))
        if things is None:
            things = self.things(sight)
            if seen is not None:
                seen[id(sight)] = things
        lights = sight.town.lights(looks, moment, eye[:2, 3])
        body = MODELS[looks.models[agent]]
        nose = sight.pose @ upright_pose(0.5 * body.length - NOSE, 0.0, 0.0)
        lamps = own_lamps(nose, weather) if body.kind in WITH_LAMPS else ()
        noise = int(digest("onboard noise", looks.key, moment.step, agent, camera.channel)[:7], 16)
        view = View(camera, eye, (*things, *lights), weather, self.response, noise, lamps)
        edit = self.edit(sight)
        if edit is None or self.attack is None:
            return view
        _, *cards = self.attack.meshes(self._attacked(sight))
        for tag in self.attack.tags(things):
            view = edit.on(view, tag, cards=[sight.town.index(key) for key in cards])
        return view


@dataclass(slots=True)
class Rig:
    """Cameras of one size that are rendered together, see `Onboard.together`.

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
    """A camera that agents carry, see `Onboard.camera`."""

    onboard: Onboard
    camera: Camera
    rig: Rig | None = None

    def follow(self, simulator: Simulator) -> None:
        """See `Onboard.follow`."""
        self.onboard.follow(simulator)

    def __call__(self, simulator: Simulator, agents: I32) -> Any:
        """Pictures [N, 3, H, W] of agents [N, 2] (scene, agent); black where the episode has ended."""
        if self.rig is None:
            return self._read(self.onboard.sights(simulator, agents), len(agents))
        state = simulator.state()
        parts = (state.time, state.pose, state.active, state.signal, agents)
        moment = (id(simulator), *(v.tobytes() for v in parts))
        number = next(k for k, camera in enumerate(self.rig.cameras) if camera is self.camera)
        if moment != self.rig.moment or number not in self.rig.read:
            cameras, sights = self.rig.cameras, self.onboard.sights(simulator, agents)
            self.rig.moment = moment
            self.rig.read = dict(enumerate(self._read_all(sights, len(agents), cameras)))
        return self.rig.read.pop(number)

    def of_trace(
        self, trace: EpisodeTrace, graph: LaneGraph, *, agent: int = 0, steps: Sequence[int] | None = None
    ) -> U8:
        """The pictures [T, 3, H, W] that an agent was shown; arguments and errors as `Onboard.sights_of_trace`."""
        sights = self.onboard.sights_of_trace(trace, graph, agent=agent, steps=steps)
        shown = self._read(sights, len(sights))
        found: U8 = shown.cpu().numpy() if self.onboard.resident else shown
        return found

    def _read(self, sights: Sequence[Sight], count: int) -> Any:
        """All pictures in as few calls as possible."""
        return self._read_all(sights, count, [self.camera])[0]

    def _read_all(self, sights: Sequence[Sight], count: int, cameras: Sequence[Camera]) -> Any:
        """Pictures [C, N, 3, H, W] of cameras of one size; a tensor on the GPU where they stay there."""
        shape = (len(cameras), count, self.camera.height, self.camera.width, 3)
        if self.onboard.resident:
            import torch

            kept = torch.zeros(shape, dtype=torch.uint8, device=self.onboard.device)
            for part, picture in self.shots(sights, cameras):
                rows = torch.tensor([sight.row for sight in part], device=kept.device)
                wp.synchronize_device(self.onboard.device)  # torch has a stream of its own
                kept[:, rows] = wp.to_torch(picture.image).view(len(cameras), len(part), *shape[2:])
                if kept.is_cuda:
                    torch.cuda.synchronize(kept.device)
            return kept.movedim(-1, 2)
        found = np.zeros(shape, np.uint8)
        for part, picture in self.shots(sights, cameras):
            images = picture.image.numpy()  # type: ignore[attr-defined]
            found[:, [sight.row for sight in part]] = images.reshape(len(cameras), len(part), *shape[2:])
        return np.moveaxis(found, -1, 2)

    def shots(
        self, sights: Sequence[Sight], cameras: Sequence[Camera] | None = None
    ) -> Iterator[tuple[list[Sight], Picture]]:
        """Render in as few calls as possible.

        Args:
            sights: What is to be seen.
            cameras: Through which cameras of one size; None: this one.

        Yields:
            Some of the sights, and what `ssad.rendering.camera.render.render` gives for them, camera by camera, with
            its arrays left where they are.
        """
        cameras = [self.camera] if cameras is None else cameras
        alike: dict[tuple[int, int], list[Sight]] = {}
        for sight in sights:
            alike.setdefault((id(sight.town), id(self.onboard.edit(sight))), []).append(sight)
        at_once = max(self.onboard.at_once // len(cameras), 1)
        for here in alike.values():
            for k in range(0, len(here), at_once):
                part = here[k : k + at_once]
                yield part, self.onboard.render(part, cameras)


@dataclass(frozen=True, slots=True)
class OnboardLidar:
    """A LiDAR that agents carry, see `Onboard.lidar`."""

    onboard: Onboard
    lidar: Lidar

    def follow(self, simulator: Simulator) -> None:
        """See `Onboard.follow`."""
        self.onboard.follow(simulator)

    def __call__(self, simulator: Simulator, agents: I32) -> F32:
        """Points [N, P, 5] of agents [N, 2] (scene, agent); none where the episode has ended."""
        return self._read(self.onboard.sights(simulator, agents), len(agents))

    def of_trace(
        self, trace: EpisodeTrace, graph: LaneGraph, *, agent: int = 0, steps: Sequence[int] | None = None
    ) -> F32:
        """The points [T, P, 5] that an agent was shown; arguments and errors as `Onboard.sights_of_trace`."""
        sights = self.onboard.sights_of_trace(trace, graph, agent=agent, steps=steps)
        return self._read(sights, len(sights))

    def _read(self, sights: Sequence[Sight], count: int) -> F32:
        """One turn for each."""
        found = np.zeros((count, len(self.lidar.beams) * self.lidar.azimuths, 5), np.float32)
        found[..., 4] = -1.0
        for sight in sights:
            looks, moment, agent = sight.looks, sight.moment, sight.agent
            things = self.onboard.things(sight)
            key = ("onboard lidar", looks.key, moment.step, agent)
            points, _ = sweep(sight.town.scene, self.lidar, sight.pose, things, key=key)
            found[sight.row, : len(points)] = points
        return found


def _step_of(simulator: Simulator, state: WorldState, scene: int) -> int:
    """Steps since the episode of a scene began."""
    return round(float(state.time[scene]) / simulator.dt)

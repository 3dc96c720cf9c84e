"""CARLA as a simulator: a server in synchronous mode at 10 Hz, with SSAD's drivers, scenarios, metrics and reports.

Everybody is spawned in CARLA, which moves them; after each tick they are mirrored in a `World` in which each is placed
where CARLA has it. The mirror knows lanes, routes, signals and contacts, so that all that SSAD has for its own world
works here too: scripts, the Autopilot and the blind follower plan in the mirror and act in CARLA by throttle, brake and
steering. Who follows a trajectory is put where it has them. CARLA's traffic lights show what the mirror's signals say.

A server runs one world, so a batch has one scene. Needs the extra `carla`. CARLA's frame is left-handed: y and yaw
change sign here and nowhere else. Facts of the interface: carla.readthedocs.io, version 0.9.16.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
import numpy.typing as npt

from ssad.core.driving import STEP, Scenes
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.safeio import parse_xml
from ssad.core.types import (
    F32,
    I32,
    U8,
    AgentKind,
    Contact,
    Controller,
    End,
    Episode,
    Pose,
    SignalState,
)
from ssad.simulators.carla.blueprints import BLUEPRINTS
from ssad.simulators.carla.events import Events
from ssad.simulators.carla.sensors import EgoSensors, SensorBlueprint
from ssad.simulators.carla.server import Server, T, call_server, connect
from ssad.simulators.carla.traffic import Traffic
from ssad.simulators.mirrored import MirroredSimulator, check_phases
from ssad.world.kernels.data import Presence
from ssad.world.models import MODELS, WALKER_RATE
from ssad.world.roads import town_signals, town_xodr
from ssad.world.world import World

if TYPE_CHECKING:
    import carla

ABOVE: Final = 0.3  # m above the road at which bodies are spawned, so that none sticks in it; they drop at once
SAME: Final = 0.05  # m, difference of a road's length between two copies of a map
GROUND: Final = ("static.road", "static.sidewalk", "static.ground", "static.terrain", "static.roadline")
_FREE = (Controller.TRAJECTORY, Controller.PLACED, Controller.NONE)  # agents that CARLA's physics do not move


@dataclass(frozen=True)
class _Connection:
    """A connection that outlives a simulator of this process, so that the next one need not load the map again."""

    client: carla.Client
    world: carla.World
    town: str = ""
    lights: dict[int, carla.TrafficLight] = field(default_factory=dict)


_CONNECTIONS: dict[Server, _Connection] = {}


class Carla(MirroredSimulator):
    """A `Simulator` of `ssad.core.driving` in which a CARLA server moves everybody; see the module.

    `mirror` is the `World` that mirrors it. `close` gives the server back as it was found.
    """

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        *,
        server: Server,
        assign: Scenes | None = None,
        blueprints: Mapping[str, SensorBlueprint] | None = None,
        dt: float = STEP,
    ) -> None:
        check_phases(episodes, "CARLA")
        self.mirror = World(episodes, graphs, assign=assign, dt=dt)
        if self.mirror.batch != 1:
            raise ConfigError(f"{server} runs one world: it takes one scene at a time, not {self.mirror.batch}")
        self.dt, self.batch, self.agents = self.mirror.dt, self.mirror.batch, self.mirror.agents
        self.episodes, self.graphs = self.mirror.episodes, self.mirror.graphs
        self.server = server
        connection = _CONNECTIONS.pop(server, None)
        self.client = connect(server) if connection is None else connection.client
        self.world: carla.World = self._call("get its world", self.client.get_world)
        # Another client may have loaded another world since; then our map and lights are outdated.
        if connection is None or self.world.id != connection.world.id:
            connection = _Connection(self.client, self.world)
        self.town, self._lights = connection.town, connection.lights
        self._original_settings: carla.WorldSettings = self._call("get its settings", self.world.get_settings)
        self._bodies: dict[int, carla.Actor] = {}
        self._centre_offsets: dict[int, float] = {}  # m from an actor's origin forward to the centre of its body
        self._events = Events(str(server))
        self._ego_sensors = EgoSensors(dict(blueprints or {}), server.timeout, str(server))
        self._frame = 0
        self._traffic: Traffic | None = None
        if server.traffic == "manager":
            self._traffic = self._call("reach its Traffic Manager", lambda: Traffic(self.client, server.port))
        self._touching: set[int] = set()
        self._light_states: dict[int, int] = {}
        self._controls: F32 = np.zeros((1, self.agents, 4), np.float32)
        try:
            self.reset()
        except BaseException:
            self.close()
            raise

    @property
    def assigned(self) -> I32:
        """[B] number of the episode of each scene."""
        return self.mirror.assigned

    @property
    def _episode(self) -> Episode:
        return self.episodes[int(self.assigned[0])]

    @property
    def measured(self) -> dict[str, Any]:
        """Counts of the ego's own sensors in this episode, as `Events.measured`."""
        return self._events.measured

    def _call(self, action: str, request: Callable[[], T]) -> T:
        return call_server(self.server, action, request)

    # ------------------------------------------------------------ the start

    def reset(self, scenes: Scenes | None = None, *, episodes: Scenes | None = None) -> None:
        """Restart the scene, with another episode if given; the map is loaded only if the town changes."""
        if scenes is not None and not len(scenes):
            return
        self.mirror.reset(scenes, episodes=episodes)
        self._controls[:] = 0.0
        self._clear()
        self._light_states = {}
        episode = self._episode
        if episode.town != self.town:
            self._load_town(episode.town)
        self._call("change its settings", self._synchronise)
        self._call("set the weather", self._set_weather)
        active = self.mirror.array("active")[0]
        for agent_index, agent in enumerate(episode.agents):
            if active[agent_index] != Presence.ABSENT:
                self._spawn(agent_index, agent.pose)
        self._call("attach its collision and lane sensors", lambda: self._events.attach(self.world, self._bodies[0]))
        self._call(
            "attach its sensors", lambda: self._ego_sensors.attach(self.world, self._bodies[0], self._centre_offsets[0])
        )
        if self._traffic is not None:
            self._call("begin with its Traffic Manager", partial(self._traffic.begin, episode))
        self._tick()  # all bodies drop onto the road
        for agent_index, agent in enumerate(episode.agents):
            if agent.speed != 0.0 and agent_index in self._bodies and agent.controller not in _FREE:
                self._call(
                    f"set the speed of {agent.name}", partial(self._set_speed, agent_index, agent.pose, agent.speed)
                )
        self._events.begin(self._frame)

    def _load_town(self, town: str) -> None:
        import carla

        map_text = town_xodr(town)
        self.client.set_timeout(5.0 * self.server.timeout)
        server_maps = [name.rsplit("/", 1)[-1] for name in self._call("list its maps", self.client.get_available_maps)]
        if town in server_maps:
            self.world = self._call(f"load the map {town}", lambda: self.client.load_world(town))
        else:
            generation = carla.OpendriveGenerationParameters(
                vertex_distance=2.0,
                max_road_length=50.0,
                wall_height=0.0,
                additional_width=0.6,
                smooth_junctions=True,
                enable_mesh_visibility=True,
            )
            self.world = self._call(
                f"make a world of the map of {town}", lambda: self.client.generate_opendrive_world(map_text, generation)
            )
        self.client.set_timeout(self.server.timeout)
        server_map_text = self._call("get its map", lambda: self.world.get_map().to_opendrive())
        if not _same_roads(map_text, server_map_text, str(self.server)):
            raise ConfigError(
                f"{self.server}: its map {town} has other roads than the town here; import the server's map under "
                "that name (ssad import map)"
            )
        self._lights = {}
        for signal, name in town_signals(town).items():
            light = self._call("find a traffic light", partial(self.world.get_traffic_light_from_opendrive_id, name))
            if light is not None:
                self._lights[signal] = light
        self.town = town

    def _synchronise(self) -> None:
        settings = self.world.get_settings()
        settings.synchronous_mode = True
        settings.fixed_delta_seconds = self.dt
        settings.substepping = True
        settings.max_substep_delta_time = 0.01
        settings.max_substeps = 10
        settings.no_rendering_mode = not any("camera" in eye.kind for eye in self._ego_sensors.blueprints.values())
        self.world.apply_settings(settings)
        self.world.freeze_all_traffic_lights(True)

    def _set_weather(self) -> None:
        import carla

        self.world.set_weather(getattr(carla.WeatherParameters, self.server.weather))

    def _spawn(self, agent_index: int, pose: Pose) -> None:
        agent = self._episode.agents[agent_index]

        def spawn() -> carla.Actor | None:
            blueprint = self.world.get_blueprint_library().find(BLUEPRINTS.get(agent.model, agent.model))
            if blueprint.has_attribute("role_name"):
                blueprint.set_attribute("role_name", "hero" if agent_index == 0 else f"ssad {agent_index}")
            if blueprint.has_attribute("is_invincible"):
                blueprint.set_attribute("is_invincible", "true")
            return self.world.try_spawn_actor(blueprint, self._transform(pose))

        try:
            body = self._call(f"spawn {agent.name}", spawn)
        except IndexError:  # the library raises this for an unknown blueprint
            raise ConfigError(f"{self.server}: it has no blueprint {BLUEPRINTS.get(agent.model)}") from None
        if body is None:
            raise ConfigError(
                f"{self.server}: cannot put {agent.name} at ({pose.x:.1f}, {pose.y:.1f}): something is in the way"
            )
        self._bodies[agent_index] = body
        kind = MODELS[agent.model].kind
        self._centre_offsets[agent_index] = (
            0.0 if kind in (AgentKind.PROP, AgentKind.WALKER) else float(body.bounding_box.location.x)
        )
        if abs(self._centre_offsets[agent_index]) > 0.01:
            self._call(f"place {agent.name}", lambda: body.set_transform(self._transform(pose, agent_index)))
        if agent.controller in _FREE and agent_index > 0:
            self._call(f"hold {agent.name}", lambda: body.set_simulate_physics(False))

    def _transform(self, pose: Pose, agent_index: int = -1) -> carla.Transform:
        import carla

        centre_offset = self._centre_offsets.get(agent_index, 0.0)
        x, y = pose.x - centre_offset * math.cos(pose.yaw), pose.y - centre_offset * math.sin(pose.yaw)
        return carla.Transform(carla.Location(x, -y, ABOVE), carla.Rotation(yaw=-math.degrees(pose.yaw)))

    def _set_speed(self, agent_index: int, pose: Pose, speed: float) -> None:
        import carla

        velocity = carla.Vector3D(speed * math.cos(pose.yaw), -speed * math.sin(pose.yaw), 0.0)
        self._bodies[agent_index].set_target_velocity(velocity)

    # ------------------------------------------------------------ a step

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance a running scene by 0.1 s: plan in the mirror, act in CARLA, tick, and mirror the result."""
        world = self.mirror
        if controls is not None:
            world.set_controls(controls)
            self._controls[:] = world.array("controls")
        if world.ended()[0] != End.RUNNING:
            return
        world.plan()
        controllers: I32 = world.array("controller").copy()
        control = np.where((controllers == Controller.EXTERNAL)[..., None], self._controls, world.array("control"))
        active = world.array("active").copy()
        time = (int(world.array("step")[0]) + 1) * self.dt
        self._call("show its traffic lights", self._set_signals)
        self._apply_controls(controllers[0], control[0], active[0], time)
        self._tick()
        placements = self._measure_placements(time)
        world.put("control", control.astype(np.float32))
        world.put("active", active)
        world.place(placements)
        # While the mirror advances, all agents are placed where CARLA has them; the controllers are restored below.
        world.put("controller", np.full_like(controllers, Controller.PLACED))
        world.advance()
        touched = (active != Presence.ABSENT) & (world.array("active") == Presence.ABSENT)  # whom the ego has touched
        world.put("controller", np.where(touched, int(Controller.NONE), controllers).astype(controllers.dtype))
        self._remove_departed(controllers[0], active[0])
        self._add_sensor_contacts()

    def _set_signals(self) -> None:
        import carla

        light_state = carla.TrafficLightState
        light_states = {
            SignalState.RED: light_state.Red,
            SignalState.YELLOW: light_state.Yellow,
            SignalState.GREEN: light_state.Green,
            SignalState.OFF: light_state.Off,
        }
        states = self.mirror.state().signal[0]
        for signal, light in self._lights.items():
            state = int(states[signal])
            if self._light_states.get(signal) != state:
                light.set_state(light_states[SignalState(state)])
                self._light_states[signal] = state

    def _apply_controls(self, controllers: I32, control: F32, active: I32, time: float) -> None:
        """Apply the controls of all agents; those on a trajectory are spawned, placed and destroyed by it."""
        poses = self.mirror.array("pose")[0]
        for agent_index, agent in enumerate(self._episode.agents):
            if controllers[agent_index] == Controller.TRAJECTORY:
                pose = _trajectory_pose(agent.trajectory, time)
                active[agent_index] = Presence.ABSENT if pose is None else Presence.AWAKE
                if pose is None:
                    self._destroy(agent_index)
                elif agent_index in self._bodies:
                    self._call(
                        f"place {agent.name}",
                        partial(self._bodies[agent_index].set_transform, self._transform(pose, agent_index)),
                    )
                else:
                    self._spawn(agent_index, pose)
            elif (
                agent_index in self._bodies
                and active[agent_index] != Presence.ABSENT
                and MODELS[agent.model].max_speed > 0.0
            ):
                if controllers[agent_index] in _FREE and agent_index > 0:
                    continue
                is_walker = MODELS[agent.model].kind == AgentKind.WALKER
                if (
                    self._traffic is not None
                    and agent_index > 0
                    and controllers[agent_index] == Controller.AUTOPILOT
                    and not is_walker
                ):
                    if active[agent_index] == Presence.AWAKE and agent_index not in self._traffic.driven_bodies:
                        command = partial(self._traffic.take, agent_index, self._bodies[agent_index], self._episode)
                        self._call(f"hand {agent.name} to its Traffic Manager", command)
                    continue
                apply = self._control_walker if is_walker else self._control_vehicle
                yaw, command, controller = (
                    float(poses[agent_index, 2]),
                    control[agent_index],
                    Controller(int(controllers[agent_index])),
                )
                self._call(f"control {agent.name}", partial(apply, agent_index, command, yaw, controller))

    def _control_vehicle(self, agent_index: int, control: F32, yaw: float, controller: Controller) -> None:
        import carla

        throttle, brake, steer, reverse = (float(value) for value in control)
        cast("carla.Vehicle", self._bodies[agent_index]).apply_control(
            carla.VehicleControl(
                throttle=min(max(throttle, 0.0), 1.0),
                steer=-min(max(steer, -1.0), 1.0),
                brake=min(max(brake, 0.0), 1.0),
                hand_brake=False,
                reverse=reverse > 0.5,
            )
        )

    def _control_walker(self, agent_index: int, control: F32, yaw: float, controller: Controller) -> None:
        import carla

        agent = self._episode.agents[agent_index]
        speed = min(max(float(control[0]), 0.0), 1.0) * MODELS[agent.model].max_speed
        if controller == Controller.EXTERNAL:
            yaw += float(control[2]) * WALKER_RATE * self.dt
        elif controller == Controller.SCRIPT and agent.route is not None and speed > 0.0:
            # its way bends: towards the place where it is to be after the step
            pose, goal = self.mirror.array("pose")[0, agent_index], self.mirror.array("script.goal")[0, agent_index]
            forward, left = float(goal[0] - pose[0]), float(goal[1] - pose[1])
            if 0.0 < math.hypot(forward, left) < 1.0:
                yaw = math.atan2(left, forward)
        direction = carla.Vector3D(math.cos(yaw), -math.sin(yaw), 0.0)
        walker = cast("carla.Walker", self._bodies[agent_index])
        walker.apply_control(carla.WalkerControl(direction=direction, speed=speed, jump=False))

    def _tick(self) -> None:
        self._frame = self._call("advance", lambda: self.world.tick(self.server.timeout))

    def sensor_reading(self, name: str, scene_agent: Sequence[int]) -> F32 | U8:
        """Return the present reading of one of CARLA's own sensors on an agent (scene, number): the ego alone."""
        if scene_agent[1] != 0:
            raise ConfigError(f"{self.server}: only the ego carries its sensors, not agent {scene_agent[1]}")
        if self.mirror.ended()[0] != End.RUNNING:
            return self._ego_sensors.blueprints[name].empty
        return self._ego_sensors.reading(name, self._frame)

    def _measure_placements(self, time: float) -> F32:
        """Return [1, A, 4] x, y, yaw, speed of the bodies' centres after the tick; absent agents keep their place."""
        world = self.mirror
        placements = np.concatenate([world.array("pose"), world.array("speed")[..., None]], -1)
        snapshot = self._call("tell where everybody is", self.world.get_snapshot)
        for agent_index, body in self._bodies.items():
            actor_state = snapshot.find(body.id)
            if actor_state is None:
                name = self._episode.agents[agent_index].name
                raise ConfigError(f"{self.server}: {name} is gone: somebody has destroyed it")
            transform, velocity = actor_state.get_transform(), actor_state.get_velocity()
            yaw = -math.radians(transform.rotation.yaw)
            x = transform.location.x + self._centre_offsets[agent_index] * math.cos(yaw)
            y = -transform.location.y + self._centre_offsets[agent_index] * math.sin(yaw)
            agent = self._episode.agents[agent_index]
            speed = velocity.x * math.cos(yaw) - velocity.y * math.sin(yaw)
            if agent.controller == Controller.TRAJECTORY:  # it is placed, so CARLA knows no speed of it
                speed = _trajectory_speed(agent.trajectory, time, yaw)
            placements[0, agent_index] = x, y, yaw, speed
        if not np.isfinite(placements).all():
            raise ConfigError(f"{self.server}: it tells places that are no numbers")
        return placements.astype(np.float32)

    def _remove_departed(self, controllers: I32, previous_controllers: I32) -> None:
        """Remove background traffic at the end of its route, and from CARLA all agents that left the mirror."""
        world = self.mirror
        is_removed = np.zeros((1, self.agents), bool)
        route = world.state().route[0]
        at_end = world.array("progress")[0] >= route[:, 1] - 3
        is_removed[0] = (
            at_end & (controllers == Controller.AUTOPILOT) & (route[:, 1] > 0) & (np.arange(self.agents) > 0)
        )
        if is_removed.any():
            world.remove(is_removed)
        for agent_index in list(self._bodies):
            if world.array("active")[0, agent_index] == Presence.ABSENT:
                self._destroy(agent_index)

    def _add_sensor_contacts(self) -> None:
        """Add contacts that only the collision sensor reported: other body shapes, objects of the town."""
        self._call("look after its sensors", self._events.check)
        collisions, self._events.collisions = self._events.collisions, []
        agent_by_body = {body.id: agent_index for agent_index, body in self._bodies.items()}
        touching = {
            agent_by_body.get(body_id, -1 - abs(body_id))
            for body_id, body_type in collisions
            if not body_type.startswith(GROUND)
        } - {0}
        new_contacts = touching - self._touching
        self._touching = touching
        world = self.mirror
        touched = int(world.array("touch")[0, 0])
        for agent_index in sorted(new_contacts):
            if agent_index >= 0 and touched >> agent_index & 1:
                continue
            episode = self._episode
            contact = (
                _contact_bit(MODELS[episode.agents[agent_index].model].kind) if agent_index >= 0 else Contact.STATIC
            )
            world.put("ego.contact", world.array("ego.contact") | int(contact))
            if int(world.array("ego.contact_agent")[0]) == -1:
                world.put(
                    "ego.contact_agent",
                    np.full_like(world.array("ego.contact_agent"), agent_index if agent_index >= 0 else -2),
                )
            if episode.limits.contact == "end" and world.ended()[0] in (End.RUNNING, End.COMPLETE):
                world.put("end", np.full_like(world.array("end"), int(End.COLLISION)))

    # ------------------------------------------------------------ the end

    def _destroy(self, agent_index: int) -> None:
        body = self._bodies.pop(agent_index, None)
        if body is not None:
            self._call("take somebody out", body.destroy)

    def _clear(self) -> None:
        """Remove all spawned bodies and sensors."""
        self._touching = set()
        self._call("take its collision and lane sensors out", self._events.detach)
        self._call("take its sensors out", self._ego_sensors.detach)
        for agent_index in list(self._bodies):
            self._destroy(agent_index)

    def close(self) -> None:
        """Remove all that was spawned and restore the settings; a server that does not answer is left alone."""
        with suppress(ConfigError):
            self._clear()
            if self._traffic is not None:
                self._call("leave its Traffic Manager", self._traffic.end)
            self._call("change its settings", lambda: self.world.apply_settings(self._original_settings))
            _CONNECTIONS[self.server] = _Connection(self.client, self.world, self.town, self._lights)


def _same_roads(town_text: str, server_text: str, server_name: str) -> bool:
    """Return True if two OpenDRIVE texts have the same roads, of the same lengths."""

    def roads(text: str, name: str) -> dict[str, float]:
        elements = parse_xml(text.encode(), name).findall("road")
        return {road.get("id", ""): float(road.get("length", "nan")) for road in elements}

    town_roads, server_roads = roads(town_text, "the town here"), roads(server_text, f"the map of {server_name}")
    return town_roads.keys() == server_roads.keys() and all(
        abs(town_roads[name] - server_roads[name]) <= SAME for name in town_roads
    )


def _trajectory_pose(rows: Sequence[tuple[float, float, float, float]], time: float) -> Pose | None:
    """Return the pose of a trajectory at a time; None before its first and after its last row."""
    table = np.array(rows)
    if not table[0, 0] - 1e-6 <= time <= table[-1, 0] + 1e-6:
        return None
    yaw = np.unwrap(table[:, 3])
    return Pose(*(float(np.interp(time, table[:, 0], column)) for column in (table[:, 1], table[:, 2], yaw)))


def _trajectory_speed(rows: Sequence[tuple[float, float, float, float]], time: float, yaw: float) -> float:
    """Return the speed of a trajectory along its heading in the segment that contains a time, m/s."""
    table = np.array(rows)
    segment = int(np.clip(np.searchsorted(table[:, 0], time, side="left") - 1, 0, len(table) - 2))
    dt, dx, dy, _ = (table[segment + 1] - table[segment]).tolist()
    return float((dx * math.cos(yaw) + dy * math.sin(yaw)) / dt)


def _contact_bit(kind: AgentKind) -> Contact:
    contacts = {AgentKind.WALKER: Contact.WALKER, AgentKind.BICYCLE: Contact.CYCLIST, AgentKind.PROP: Contact.STATIC}
    return contacts.get(kind, Contact.VEHICLE)

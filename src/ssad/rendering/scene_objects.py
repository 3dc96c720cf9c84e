"""Bodies of a recorded drive and their poses at any moment.

They are agents, trailers, parked vehicles, walkers, building sites and signs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import overload

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose, wrap_angle
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, U8, Bool, EpisodeTrace, LaneType
from ssad.rendering.bodies import draw_paint, draw_size, draw_style, make_body
from ssad.rendering.bodies.actor_bodies import ACTOR_BODIES, TowingVehicle, plain_body, towing_vehicle
from ssad.rendering.camera.scene import Finish, SceneObject
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.street.model import Street
from ssad.rendering.street_signs import street_signs
from ssad.rendering.vehicle_signals import flashing, trace_signals
from ssad.world.models import SURROGATES, stated_size, trace_sizes

Size = tuple[float, float, float]  # length, width, height
KERB = 0.12  # m, height of sidewalks
BAY = 0.14  # m, height of parking bays
YARD = 0.12  # m, height of yards and drives
BAY_EDGE = 0.2  # m between the road and a vehicle in a bay
PHASES = 8  # meshes of one walking cycle
STRIDE = 1.45  # m walked in one cycle
ASKEW = 0.12  # rad, standard deviation: cones and barriers stand by hand
# styles of walking and standing people of a drive; many bodies appear in more than one place
WALKING = (
    "adult",
    "adult",
    "elderly",
    "adult",
    "adult",
    "child",
    "adult",
    "stroller",
    "adult",
    "adult",
    "elderly",
    "child",
    "adult",
    "adult",
)
WAITING = ("standing",) * 6 + ("worker",)
SLOW = 0.65  # of the speed of others: who walks with a stick
GRIP = 0.457, 0.575  # where who pushes a stroller holds it: ahead of the middle and up, shares of length and height
RACK = {"bicycle": 0.75, "motorcycle": 1.15}  # m from one two-wheeler to the next where they stand side by side
# what stands at the kerb, how often, and how much of the kerb it takes, m
PARKED = {
    "car": (10.0, 6.3),
    "truck": (4.5, 10.5),
    "bus": (2.5, 13.0),
    "trailer": (3.5, 14.5),
    "construction": (2.0, 9.5),
    "motorcycle": (1.4, 3.0),
    "bicycle": (1.6, 2.6),
}
PARKED_GAP = 0.9  # m of that place that the vehicle leaves free
YARD_SHARE = 0.8  # of the places of long vehicles that are taken
SITE_ENDS = 6.0  # m of a building site before and behind its machine, together
AGAINST = {"car": 0.1, "motorcycle": 0.4, "bicycle": 0.4}  # share of those at the kerb that face the traffic
NOTHING = Mesh(
    np.zeros((0, 3), np.float32),
    np.zeros((0, 3), np.int32),
    np.zeros((0, 3, 3), np.float32),
    np.zeros((0, 3, 2), np.float32),
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    (),
)
TRAILER_GAP = 0.9  # m of the kerb that a trailer and the vehicle before it leave free
LONG = 7.0  # m; what takes more is placed first, along streets alone: between others it would hardly find room


CARS = ("car", "suv", "coupe", "compact", "van")
FEWER = 0.4  # times as many cars, against all else, where streets are "any": a detector sees enough of them


def thin_shares(shares: Mapping[str, float], streets: str) -> dict[str, float]:
    """Shares of bodies, of the sum 1; fewer cars for "any" (see `FEWER`)."""
    shares_by_kind = {
        body: share * (FEWER if streets == "any" and body in CARS else 1.0) for body, share in shares.items()
    }
    return {body: share / sum(shares_by_kind.values()) for body, share in shares_by_kind.items()}


@dataclass(frozen=True, slots=True)
class ObjectBody:
    """Body of an agent or object in a drive.

    Attributes:
        tag: Number of the body in masks and boxes, from 1.
        kind: Kind of body; "" for unlabelled ones.
        style: Style of the body; it decides the nuScenes attribute.
        size: Length, width, height, m.
        paint: Linear RGB.
        meshes: Numbers of its meshes: one, or those of a cycle of `STRIDE` m.
        track: [T, 4] x, y, yaw, z at steps of the world, or [1, 4] if it is static.
        active: [T] whether it is present.
        is_driven: [T] distance covered so far, m.
        is_parked: Whether it is a vehicle without a driver.
        signals: [T] `LampSignal` bits of its stop lamps and indicators, or [1] if they never shine.
        finish: Metallic paint, dirt and wear; None for a clean body.
    """

    tag: int
    kind: str
    style: str
    size: Size
    paint: tuple[float, float, float]
    meshes: tuple[int, ...]
    track: F64
    active: Bool
    is_driven: F64
    is_parked: bool = False
    signals: U8 = field(default_factory=lambda: np.zeros(1, np.uint8))
    finish: Finish | None = None


@dataclass(frozen=True, slots=True)
class PlacedObject:
    """Body at a moment: pose [4, 4], speed m/s, and the object to draw."""

    body: ObjectBody
    pose: F64
    speed: float
    scene_object: SceneObject


class LazyMeshes(Sequence[Mesh]):
    """Meshes by number, each built on first access: most bodies of a town are never in view."""

    def __init__(self) -> None:
        self._meshes: list[Mesh | Callable[[], Mesh]] = []

    def add(self, mesh: Mesh | Callable[[], Mesh]) -> int:
        """Add a mesh, or a function that builds it.

        Returns:
            Its number.
        """
        self._meshes.append(mesh)
        return len(self._meshes) - 1

    def select(self, numbers: Collection[int]) -> list[Mesh]:
        """All meshes under their numbers, with one without faces in place of those that are not wanted."""
        return [self[number] if number in numbers else NOTHING for number in range(len(self))]

    def __len__(self) -> int:
        return len(self._meshes)

    @overload
    def __getitem__(self, number: int) -> Mesh: ...

    @overload
    def __getitem__(self, number: slice) -> list[Mesh]: ...

    def __getitem__(self, number: int | slice) -> Mesh | list[Mesh]:
        if isinstance(number, slice):
            return [self[k] for k in range(len(self))[number]]
        mesh = self._meshes[number]
        if not isinstance(mesh, Mesh):
            mesh = self._meshes[number] = mesh()
        return mesh


@dataclass(slots=True)
class SceneObjects:
    """All meshes and bodies of a drive.

    Attributes:
        dt: Step of the tracks, s.
        key: Key of the random draws.
        detail: Detail of the meshes.
        meshes: Meshes of all bodies.
        bodies: The bodies.
    """

    dt: float
    key: tuple[object, ...] = ()
    detail: int = 1
    meshes: LazyMeshes = field(default_factory=LazyMeshes)
    bodies: list[ObjectBody] = field(default_factory=list)

    def at(self, time: float, centre: F64, reach: float) -> list[PlacedObject]:
        """Return the bodies within `reach` (m) of a place [2] at a time (s), interpolated between steps."""
        placed = []
        for body in self.bodies:
            last_step = len(body.track) - 1
            exact_step = min(max(time / self.dt, 0.0), float(last_step))
            lower_step = min(int(exact_step), max(last_step - 1, 0))
            upper_step, fraction = min(lower_step + 1, last_step), exact_step - lower_step
            if not (
                body.active[min(lower_step, len(body.active) - 1)]
                and body.active[min(upper_step, len(body.active) - 1)]
            ):
                continue
            lower_state, upper_state = body.track[lower_step], body.track[upper_step]
            # Wrapped, so that a body turns the short way round between two steps.
            yaw_change = wrap_angle(upper_state[2] - lower_state[2])
            x, y, yaw, z = (
                lower_state[0] + fraction * (upper_state[0] - lower_state[0]),
                lower_state[1] + fraction * (upper_state[1] - lower_state[1]),
                lower_state[2] + fraction * yaw_change,
                lower_state[3],
            )
            if np.hypot(x - centre[0], y - centre[1]) > reach:
                continue
            speed = (
                float(np.hypot(upper_state[0] - lower_state[0], upper_state[1] - lower_state[1])) / self.dt
                if upper_step > lower_step
                else 0.0
            )
            walked = float(
                body.is_driven[lower_step] + fraction * (body.is_driven[upper_step] - body.is_driven[lower_step])
            )
            mesh = body.meshes[int(walked / STRIDE * len(body.meshes)) % len(body.meshes)]
            pose = upright_pose(float(x), float(y), float(yaw), float(z))
            signals = int(flashing(body.signals[min(lower_step, len(body.signals) - 1)], time, body.tag))
            scene_object = SceneObject(
                mesh,
                pose,
                body.paint,
                body.tag,
                is_lit=not body.is_parked,
                signals=signals,
                finish=body.finish,
            )
            placed.append(PlacedObject(body, pose, speed, scene_object))
        return placed

    def add(
        self,
        body_parts: tuple[str, str, Size, tuple[int, ...]],
        track: F64,
        *,
        active: Bool | None = None,
        parked: bool = False,
        signals: U8 | None = None,
    ) -> None:
        """Add a body (kind, style, size, meshes) with its track; its paint is drawn."""
        tag = len(self.bodies) + 1
        step_lengths = np.hypot(*np.diff(track[:, :2], axis=0).T) if len(track) > 1 else np.zeros(0)
        # A random offset: walkers that start together must not step in unison.
        driven = np.concatenate([[0.0], np.cumsum(step_lengths)]) + generator("stride", *self.key, tag).uniform(
            0, STRIDE
        )
        activity = np.ones(len(track), bool) if active is None else active
        paint = draw_paint(generator("paint", *self.key, tag))
        kind, style, size, meshes = body_parts
        shown = np.zeros(1, np.uint8) if signals is None else signals
        self.bodies.append(ObjectBody(tag, kind, style, size, paint, meshes, track, activity, driven, parked, shown))

    def make(
        self,
        kind: str,
        style: str,
        size: Size,
        *,
        name: tuple[object, ...] = (),
        phases: int = 1,
        has_driver: bool = True,
    ) -> tuple[str, str, Size, tuple[int, ...]]:
        """Add the meshes of one body in `phases` phases of its cycle; return its description for `add`."""
        key = (*self.key, *(name or (len(self.meshes),)))

        build = partial(_drawn_mesh, make_body, key, kind, style, size, self.detail, has_driver)
        cycle_phases = [2 * np.pi * index / phases if phases > 1 else None for index in range(phases)]
        return kind, style, size, tuple(self.meshes.add(partial(build, phase)) for phase in cycle_phases)


@lru_cache(maxsize=512)
def _drawn_mesh(  # noqa: PLR0917
    make: Callable[..., Mesh],
    key: tuple[object, ...],
    kind: str,
    style: str,
    size: Size,
    detail: int,
    has_driver: bool,
    phase: float | None,
) -> Mesh:
    # A recording is rendered clean and under each of its perturbations, an episode for each of its drivers.
    random_draws = generator("record mesh", *key)
    options = {"generator": random_draws, "detail": detail, "phase": phase, "has_driver": has_driver}
    return make(kind, style=style, size=size, **options)


class GroundOccupancy:
    """Occupancy of a street's ground: squares of half a metre with a vertex between knee and head height."""

    def __init__(self, street: Street) -> None:
        vertices = street.vertices
        upright = vertices[(vertices[:, 2] > 0.35) & (vertices[:, 2] < 2.4)]
        squares = np.floor(upright[:, :2] * 2).astype(np.int64)
        low, high = squares.min(axis=0, initial=0), squares.max(axis=0, initial=0)
        row_count = high[1] - low[1] + 1
        # Each square is one number: equal rows of a matrix are found far more slowly.
        columns, rows = np.divmod(np.unique((squares[:, 0] - low[0]) * row_count + squares[:, 1] - low[1]), row_count)
        self.occupied_squares = set(zip((columns + low[0]).tolist(), (rows + low[1]).tolist(), strict=True))

    def is_free(self, x: float, y: float, yaw: float, length: float, width: float) -> bool:
        """Return True if a rectangle is free."""
        # 0.45 m is below the side of a square, so that none is skipped.
        along, across = np.meshgrid(
            np.arange(-length / 2, length / 2 + 0.4, 0.45), np.arange(-width / 2, width / 2 + 0.4, 0.45)
        )
        columns = np.floor(2 * (x + along * np.cos(yaw) - across * np.sin(yaw))).astype(int)
        rows = np.floor(2 * (y + along * np.sin(yaw) + across * np.cos(yaw))).astype(int)
        return not any(
            square in self.occupied_squares
            for square in zip(columns.ravel().tolist(), rows.ravel().tolist(), strict=True)
        )

    def occupy(self, x: float, y: float, yaw: float, length: float, width: float) -> None:
        """Mark a rectangle as occupied."""
        for along in np.arange(-length / 2, length / 2 + 0.4, 0.45):
            for across in np.arange(-width / 2, width / 2 + 0.4, 0.45):
                point_x, point_y = (
                    x + along * np.cos(yaw) - across * np.sin(yaw),
                    y + along * np.sin(yaw) + across * np.cos(yaw),
                )
                self.occupied_squares.add((int(np.floor(2 * point_x)), int(np.floor(2 * point_y))))


def place_objects(
    trace: EpisodeTrace,
    graph: LaneGraph,
    street: Street,
    *,
    key: tuple[object, ...],
    detail: int = 1,
    streets: str = "town",
    many_signs: bool = False,
) -> SceneObjects:
    """Bodies of a drive: the agents but the ego, and what stands or walks beside the first 300 m of its way.

    Args:
        trace: The drive.
        graph: The town.
        street: What stands along its roads.
        key: Of all draws.
        detail: Of the meshes, see `make_body`.
        streets: See `ssad.recorders.drives.thinned`.
        many_signs: See `ssad.rendering.street_signs.street_signs`.
    """
    population = SceneObjects(trace.dt, key, detail)
    _add_agents(population, trace)
    route_points = np.stack([trace.x[:, 0], trace.y[:, 0]], -1)[::5].astype(np.float64)
    free_ground = GroundOccupancy(street)
    _add_parked_vehicles(
        population,
        street,
        route_points,
        free_ground,
        thin_shares({body_kind: PARKED[body_kind][0] for body_kind in PARKED}, streets),
    )
    _add_sidewalk_bodies(population, graph, route_points, free_ground, len(trace.x))
    # Signs come last: they evade whatever stands at their place, and nothing evades them.
    _add_signs(population, graph, route_points, free_ground, many=many_signs, limit_signs=street.limit_signs)
    return population


def _add_agents(population: SceneObjects, trace: EpisodeTrace) -> None:
    """The agents of the world as their traces say; some buses are drawn as a tractor with its trailer."""
    sizes = trace_sizes(trace)
    signals = trace_signals(trace)
    for agent in range(1, len(trace.models)):
        rng = generator("record body", *population.key, agent)
        track = np.stack([trace.x[:, agent], trace.y[:, agent], trace.yaw[:, agent], 0 * trace.x[:, agent]], -1).astype(
            np.float64
        )
        active = trace.active[:, agent]
        model_size = sizes[agent]
        is_exact = trace.models[agent] in SURROGATES or (
            bool(trace.heights) and bool(stated_size(trace.models[agent], model_size))
        )
        if trace.models[agent] not in ACTOR_BODIES:
            population.add(("", "", model_size, (population.meshes.add(plain_body(model_size)),)), track, active=active)
            continue
        kind, styles = ACTOR_BODIES[trace.models[agent]]
        style = styles[int(rng.integers(len(styles)))]
        if kind == "bus" and rng.random() < 0.45 and not is_exact:
            _add_tractor(population, track, active, signals[:, agent], rng)
            continue
        if kind == "truck" and rng.random() < 0.3:
            kind, style = "construction", draw_style("construction", generator=rng)
        drawn_size = draw_size(kind, style, generator=rng)
        # A body must not exceed the footprint that the world uses for contacts.
        size = (min(drawn_size[0], model_size[0]), min(drawn_size[1], model_size[1]), drawn_size[2])
        if is_exact:
            size = model_size
        phases = PHASES if kind in ("pedestrian", "bicycle") else 1
        population.add(
            population.make(kind, style, size, phases=phases), track, active=active, signals=signals[:, agent]
        )


def _add_tractor(
    population: SceneObjects, track: F64, active: Bool, signals: U8, random_draws: np.random.Generator
) -> None:
    """A tractor on the front half of the agent, a trailer that follows its hitch."""
    height = float(random_draws.uniform(3.2, 3.8))
    sizes: tuple[Size, Size] = ((5.6, 2.5, height), (7.4, 2.5, float(random_draws.uniform(3.3, 3.9))))
    tractor_track = track.copy()
    tractor_track[:, 0] += 2.3 * np.cos(track[:, 2])
    tractor_track[:, 1] += 2.3 * np.sin(track[:, 2])
    hitch_track = track[:, :2] + 0.7 * np.stack([np.cos(track[:, 2]), np.sin(track[:, 2])], -1)
    trailer_track = track.copy()
    trailer_yaw = float(track[0, 2])
    for step in range(len(track)):
        if step:  # the axle, 5.6 m behind the hitch, rolls along its own heading
            hitch_move = hitch_track[step] - hitch_track[step - 1]
            trailer_yaw += (-np.sin(trailer_yaw) * hitch_move[0] + np.cos(trailer_yaw) * hitch_move[1]) / 5.6
        trailer_track[step, :3] = (
            hitch_track[step, 0] - 3.1 * np.cos(trailer_yaw),
            hitch_track[step, 1] - 3.1 * np.sin(trailer_yaw),
            trailer_yaw,
        )
    style = ("box", "tank", "flatbed")[int(random_draws.integers(3))]
    population.add(population.make("truck", "tractor", sizes[0]), tractor_track, active=active, signals=signals)
    population.add(population.make("trailer", style, sizes[1]), trailer_track, active=active, signals=signals)


def _fixed_track(x: float, y: float, yaw: float, z: float = 0.0) -> F64:
    return np.array([[x, y, yaw, z]])


def _add_parked_vehicles(
    population: SceneObjects,
    street: Street,
    route_points: F64,
    clear: GroundOccupancy,
    shares: Mapping[str, float],
) -> None:
    """Vehicles parked in bays, yards and on parking places; building sites of cones and barriers round machines."""
    rng = generator("record kerb", *population.key)
    occupancy = float(rng.uniform(0.25, 0.75))
    parking_lots = [(float(x), float(y), float(yaw), YARD) for x, y, yaw in np.asarray(street.parking, float)]
    bays = np.concatenate([street.bays, street.yards]).astype(float)
    place_heights = [BAY] * len(street.bays) + [YARD] * len(street.yards)
    kerb_places = [(x, y, yaw, z) for (x, y, yaw), z in zip(bays[:, :3].tolist(), place_heights, strict=True)]
    parking_spots = []
    for spot_index, place in enumerate([*parking_lots, *kerb_places]):
        yard_index = spot_index - len(parking_lots) - len(street.bays)
        occupied_share = YARD_SHARE if yard_index >= 0 else occupancy
        if (
            np.hypot(route_points[:, 0] - place[0], route_points[:, 1] - place[1]).min() > 55.0
            or rng.random() > occupied_share
        ):
            continue
        if yard_index >= 0:
            body_kind = _draw_long_kind(shares, rng, 2.0 * float(street.yards[yard_index, 4]))
        else:
            body_kind = str(rng.choice(list(shares), p=list(shares.values())))
            if spot_index < len(parking_lots) and PARKED[body_kind][1] > LONG:
                body_kind = "car"
        parking_spots.append((PARKED[body_kind][1] <= LONG, spot_index, body_kind, place))
    # Long vehicles come first: between others they would hardly find room.
    for _, spot_index, body_kind, (edge_x, edge_y, yaw, z) in sorted(parking_spots):
        mesh_number = len(population.meshes)
        prop_rng = generator("record prop", *population.key, mesh_number)
        style = "parked" if body_kind in ("motorcycle", "bicycle") else draw_style(body_kind, generator=prop_rng)
        size = draw_size(body_kind, style, generator=prop_rng)
        size = (min(size[0], PARKED[body_kind][1] - PARKED_GAP), min(size[1], 2.55), size[2])
        lateral_offset = 0.0
        towing = towing_vehicle(style, size) if body_kind == "trailer" else None
        if spot_index >= len(parking_lots):
            _, _, _, depth, room = bays[spot_index - len(parking_lots)]
            lateral_offset = size[1] / 2 + BAY_EDGE
            length = size[0] if towing is None else towing.length
            if lateral_offset + size[1] / 2 > depth or length / 2 > room:
                continue  # it would stand on the pavement
        x, y = edge_x + lateral_offset * np.sin(yaw), edge_y - lateral_offset * np.cos(yaw)
        room = PARKED[body_kind][1] if towing is None else towing.length + TRAILER_GAP
        if z == YARD:
            room = (size[0] if towing is None else towing.length) + 0.4  # walls and fences stand close
        if not clear.is_free(x, y, yaw, room, size[1]):
            continue
        has_site_room = clear.is_free(x, y, yaw, size[0] + SITE_ENDS, size[1])
        clear.occupy(x, y, yaw, room, size[1])
        if towing is not None:
            _add_parked_trailer(population, (x, y, yaw, z), style, size, towing)
            continue
        wrong_way_share = 0.5 if spot_index < len(parking_lots) else AGAINST.get(body_kind, 0.0)
        facing = yaw + (np.pi if prop_rng.random() < wrong_way_share else 0.0)
        parked_body = population.make(body_kind, style, size, has_driver=False)
        population.add(parked_body, _fixed_track(x, y, facing, z), parked=True)
        is_site = body_kind == "construction" or (body_kind == "truck" and prop_rng.random() < 0.3)
        if is_site and has_site_room:
            _add_building_site(population, (x, y, yaw, z), size, prop_rng, clear)


def _draw_long_kind(shares: Mapping[str, float], random_draws: np.random.Generator, place_length: float) -> str:
    """Draw the kind of a long vehicle that fits on a place of a yard, with a tractor before a trailer."""
    tractor_length = towing_vehicle("box", (0.0, 0.0, 0.0)).length
    needed_lengths = {
        kind: PARKED[kind][1] - PARKED_GAP + (tractor_length if kind == "trailer" else 0.0) for kind in shares
    }
    fitting_kinds = [kind for kind in shares if PARKED[kind][1] > LONG and needed_lengths[kind] <= place_length]
    # Trucks fit everywhere: a long place is rather that of a trailer.
    kind_weights = np.array([shares[kind] * needed_lengths[kind] for kind in fitting_kinds])
    return str(random_draws.choice(fitting_kinds, p=kind_weights / kind_weights.sum()))


def _add_parked_trailer(
    population: SceneObjects,
    centre: tuple[float, float, float, float],
    style: str,
    size: Size,
    towing: TowingVehicle,
) -> None:
    """Add a trailer with the vehicle before it; both together stand about a place (x, y, yaw, z)."""
    x, y, yaw, z = centre
    trailer_offset = 0.5 * (size[0] - towing.length)
    bodies = (
        (towing.kind, towing.style, towing.size, trailer_offset + towing.ahead),
        ("trailer", style, size, trailer_offset),
    )
    for kind, body_style, body_size, along in bodies:
        track = _fixed_track(x + along * np.cos(yaw), y + along * np.sin(yaw), yaw, z)
        population.add(population.make(kind, body_style, body_size, has_driver=False), track, parked=True)


def _add_building_site(
    population: SceneObjects,
    centre: tuple[float, float, float, float],
    size: Size,
    random_draws: np.random.Generator,
    occupancy: GroundOccupancy,
) -> None:
    """Cones or barriers along the road side of a machine, barriers across both ends, and up to two workers."""
    x, y, yaw, z = centre
    cos, sin = np.cos(yaw), np.sin(yaw)

    def put(kind: str, forward: float, lateral: float, turn: float) -> None:
        style = draw_style(kind, generator=random_draws)
        drawn_size = draw_size(kind, style, generator=random_draws)
        world_x, world_y = x + forward * cos - lateral * sin, y + forward * sin + lateral * cos
        population.add(
            population.make(kind, style, drawn_size),
            _fixed_track(world_x, world_y, yaw + turn + float(random_draws.normal(0.0, ASKEW)), z),
        )

    if random_draws.random() < 0.5:
        for index in range(int(random_draws.integers(3, 7))):
            put("traffic_cone", -size[0] / 2 - 1.0 + index * (size[0] + 2.0) / 5.0, size[1] / 2 + 0.35, 0.0)
    else:
        for index in range(int((size[0] + 2.0) / 2.8) + 1):
            put("barrier", -size[0] / 2 + 0.4 + 2.8 * index, size[1] / 2 + 0.45, np.pi / 2)
    for direction in (-1, 1):
        for index in range(int(random_draws.integers(1, 3))):
            put("barrier", direction * (size[0] / 2 + 1.2 + 1.3 * index), 0.0, 0.0)
    for direction in (-1, 1):  # between the machine and the barriers
        if random_draws.random() < 0.6:
            worker_size = draw_size("pedestrian", "worker", generator=random_draws)
            forward, worker_lateral = direction * (size[0] / 2 + 0.5), float(random_draws.uniform(-0.3, 0.3)) * size[1]
            worker_x, worker_y = x + forward * cos - worker_lateral * sin, y + forward * sin + worker_lateral * cos
            worker_yaw = float(random_draws.uniform(-np.pi, np.pi))
            population.add(
                population.make("pedestrian", "worker", worker_size), _fixed_track(worker_x, worker_y, worker_yaw, z)
            )
    occupancy.occupy(x, y, yaw, size[0] + SITE_ENDS, size[1])


def _add_sidewalk_bodies(
    population: SceneObjects, graph: LaneGraph, route_points: F64, occupancy: GroundOccupancy, steps: int
) -> None:
    """Add the bodies on sidewalks.

    People who walk alone or in pairs, or stand, also at corners; parked two-wheelers side by side, groups of cones,
    rows of barriers.
    """
    rng = generator("record sidewalks", *population.key)
    walkers, bystanders = [], []
    # A few shared bodies: each walker needs the meshes of a whole cycle.
    for index, style in enumerate(WALKING):
        size = draw_size("pedestrian", style, generator=rng)
        walkers.append(population.make("pedestrian", style, size, name=("walker", index), phases=PHASES))
    for style in WAITING:
        bystanders.append(population.make("pedestrian", style, draw_size("pedestrian", style, generator=rng)))
    pushed = {
        index: _stroller(population, walker[2], rng) for index, walker in enumerate(walkers) if walker[1] == "stroller"
    }
    crowd_share = float(rng.uniform(0.15, 0.55))

    def stand(x: float, y: float, yaw: float) -> None:
        bystander = bystanders[int(rng.integers(len(bystanders)))]
        if occupancy.is_free(x, y, 0.0, 0.6, 0.6):
            population.add(bystander, _fixed_track(x, y, yaw, KERB))

    for lane in np.flatnonzero(graph.kind == LaneType.SIDEWALK):
        length = float(graph.length[lane])
        x, y, yaw, width = graph.at(int(lane), max(length - 1.5, 0.0))
        if rng.random() < crowd_share and np.hypot(route_points[:, 0] - x, route_points[:, 1] - y).min() < 45.0:
            for index in range(int(rng.integers(1, 4))):  # at the corner, looking along the walk or across the road
                lateral = float(rng.uniform(-0.3, 0.3)) * width
                spot_x, spot_y = (
                    x - lateral * np.sin(yaw) - 0.8 * index * np.cos(yaw),
                    y + lateral * np.cos(yaw) - 0.8 * index * np.sin(yaw),
                )
                stand(spot_x, spot_y, yaw + float(rng.choice([0.0, 0.5 * np.pi])) + float(rng.normal(0.0, 0.3)))
        for distance in np.arange(3.0, length - 3.0, 8.0):
            x, y, yaw, width = graph.at(int(lane), float(distance))
            if np.hypot(route_points[:, 0] - x, route_points[:, 1] - y).min() > 45.0:
                continue
            choice = rng.random()
            lateral = float(rng.uniform(-0.3, 0.3)) * width
            spot_x, spot_y = x - lateral * np.sin(yaw), y + lateral * np.cos(yaw)
            if choice < crowd_share:
                group = [int(rng.integers(len(walkers)))]
                speed = float(rng.uniform(0.7, 1.6)) * (1 if rng.random() < 0.5 else -1)
                if rng.random() < 0.35 and width > 1.8:  # somebody walks beside
                    group.append(int(rng.integers(len(walkers))))
                if any(WALKING[index] == "elderly" for index in group):
                    speed *= SLOW
                make_track = partial(
                    _sidewalk_track, graph, int(lane), s0=float(distance), speed=speed, steps=steps, dt=population.dt
                )
                for index, walker_lateral in zip(group, (lateral, lateral - 0.8 * np.sign(lateral)), strict=False):
                    track = make_track(lateral=walker_lateral)
                    population.add(walkers[index], track)
                    if index in pushed:
                        population.add(
                            pushed[index],
                            _track_ahead(track, GRIP[0] * walkers[index][2][0] + pushed[index][2][0] / 2 - 0.02),
                        )
            elif choice < crowd_share + 0.08:
                stand(spot_x, spot_y, yaw + float(rng.uniform(-3, 3)))
            elif choice < crowd_share + 0.13:
                kind = "bicycle" if rng.random() < 0.65 else "motorcycle"
                parked_yaw = yaw + float(rng.choice([-0.5, 0.5])) * np.pi + float(rng.normal(0.0, 0.5 * ASKEW))
                for index in range(int(rng.integers(2, 6))):
                    size = draw_size(kind, "parked", generator=rng)
                    row_x, row_y, _, _ = graph.at(int(lane), min(float(distance) + RACK[kind] * index, length))
                    if size[0] < width + 0.4 and occupancy.is_free(row_x, row_y, parked_yaw, size[0], size[1]):
                        population.add(
                            population.make(kind, "parked", size),
                            _fixed_track(row_x, row_y, parked_yaw, KERB),
                            parked=True,
                        )
            elif choice < crowd_share + 0.2:
                kind = "traffic_cone" if rng.random() < 0.5 else "barrier"
                in_one_row = rng.random() < 0.6  # else barriers stand one behind the other, across the walk
                for index in range(int(rng.integers(1, 5))):
                    style = draw_style(kind, generator=rng)
                    size = draw_size(kind, style, generator=rng)
                    row_offset = (1.6 if kind == "traffic_cone" else 2.8) * index
                    row_x, row_y, object_yaw, _ = graph.at(int(lane), min(float(distance) + row_offset, length))
                    if occupancy.is_free(row_x, row_y, 0.0, 0.5, 0.5):
                        object_yaw += (np.pi / 2 if kind == "barrier" and in_one_row else 0.0) + float(
                            rng.normal(0.0, ASKEW)
                        )
                        population.add(population.make(kind, style, size), _fixed_track(row_x, row_y, object_yaw, KERB))


def _stroller(
    population: SceneObjects, walker: Size, draws: np.random.Generator
) -> tuple[str, str, Size, tuple[int, ...]]:
    """A stroller whose handle is where the hands of a walker of a size (m) are.

    nuScenes does not count it to the walker, and the detection task leaves it out.
    """
    style = draw_style("stroller", generator=draws)
    length, width, _ = draw_size("stroller", style, generator=draws)
    return population.make("stroller", style, (length, width, GRIP[1] * walker[2] + 0.03))


def _track_ahead(track: F64, distance: float) -> F64:
    """Return the track [T, 4] of a point at a distance (m) ahead of a track."""
    shifted_track = track.copy()
    shifted_track[:, 0] += distance * np.cos(track[:, 2])
    shifted_track[:, 1] += distance * np.sin(track[:, 2])
    return shifted_track


def occupy_standing(population: SceneObjects, occupancy: GroundOccupancy) -> None:
    """Mark the ground under all standing bodies as occupied."""
    for body in population.bodies:
        if len(body.track) == 1:
            x, y, yaw, _ = body.track[0].tolist()
            occupancy.occupy(x, y, yaw, *body.size[:2])


def _add_signs(
    population: SceneObjects,
    graph: LaneGraph,
    route_points: F64,
    occupancy: GroundOccupancy,
    *,
    many: bool,
    limit_signs: F32 | None = None,
) -> None:
    """Stop, yield and speed-limit signs: the plate is the body with a kind, the post one without."""
    occupy_standing(population, occupancy)
    for sign in street_signs(
        graph,
        route_points,
        occupancy,
        key=population.key,
        many=many,
        detail=population.detail,
        limit_signs=limit_signs,
    ):
        for kind, mesh in ((sign.kind, sign.plate), ("", sign.post)):
            population.add((kind, sign.style, sign.size, (population.meshes.add(mesh),)), _fixed_track(*sign.pose))


def _sidewalk_track(
    graph: LaneGraph, lane: int, *, s0: float, speed: float, lateral: float, steps: int, dt: float
) -> F64:
    """Track of somebody who walks along a sidewalk, back and forth."""
    length = float(graph.length[lane]) - 2.0
    # The distance runs over twice the length; the second half is the way back.
    folded = np.abs((s0 - 1.0 + speed * dt * np.arange(steps)) % (2 * length))
    is_outward = folded <= length
    distances = 1.0 + np.where(is_outward, folded, 2 * length - folded)
    lane_states = graph.along(lane, distances)
    is_reversed = is_outward == (speed < 0)
    return np.stack(
        [
            lane_states[:, 0] - lateral * np.sin(lane_states[:, 2]),
            lane_states[:, 1] + lateral * np.cos(lane_states[:, 2]),
            lane_states[:, 2] + np.pi * is_reversed,
            np.full(steps, KERB),
        ],
        -1,
    )

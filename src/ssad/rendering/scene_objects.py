"""Who is in a recorded drive, and where each is at any moment.

Agents, trailers, parked vehicles, walkers, building sites, signs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import overload

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose, wrap_angle
from ssad.core.seeding import generator
from ssad.core.types import F64, Bool, EpisodeTrace, LaneType
from ssad.rendering.bodies import draw_paint, draw_size, draw_style, make_body
from ssad.rendering.bodies.actor_bodies import ACTOR_BODIES, plain_body
from ssad.rendering.camera.scene import Thing
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.street.model import Street
from ssad.rendering.street_signs import street_signs
from ssad.world.models import MODELS

Size = tuple[float, float, float]  # length, width, height
KERB = 0.12  # m, height of sidewalks
PHASES = 8  # meshes of one walking cycle
STRIDE = 1.45  # m walked in one cycle
ASKEW = 0.12  # rad, standard deviation: cones and barriers stand by hand
# people of a cast who walk and who stand, by style; many are in more than one place
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
LONG = 7.0  # m; what takes more is placed first, along streets alone: between others it would hardly find room


CARS = ("car", "suv", "coupe", "compact", "van")
FEWER = 0.4  # times as many cars, against all else, where streets are "any": a detector sees enough of them


def thinned(shares: Mapping[str, float], streets: str) -> dict[str, float]:
    """Shares of bodies, of the sum 1; fewer cars for "any" (see `FEWER`)."""
    found = {body: share * (FEWER if streets == "any" and body in CARS else 1.0) for body, share in shares.items()}
    return {body: share / sum(found.values()) for body, share in found.items()}


@dataclass(frozen=True, slots=True)
class ObjectBody:
    """Somebody or something in a drive.

    Attributes:
        tag: Number that masks and boxes name it by, 1 and more.
        kind: Of the body; "" for what has no label.
        style: Of the body; it decides the nuScenes attribute.
        size: Length, width, height, m.
        paint: Linear RGB.
        meshes: Numbers of its meshes: one, or those of a cycle of `STRIDE` m.
        track: [T, 4] x, y, yaw, z at steps of the world, or [1, 4] if it stands still.
        active: [T] whether it is there.
        driven: [T] m so far.
        parked: Whether nobody drives it.
    """

    tag: int
    kind: str
    style: str
    size: Size
    paint: tuple[float, float, float]
    meshes: tuple[int, ...]
    track: F64
    active: Bool
    driven: F64
    parked: bool = False


@dataclass(frozen=True, slots=True)
class PlacedObject:
    """A body at a moment: pose [4, 4], speed m/s, the thing to draw."""

    body: ObjectBody
    pose: F64
    speed: float
    thing: Thing


class LazyMeshes(Sequence[Mesh]):
    """Meshes by number, each built when it is first asked for: most bodies of a town are never in view."""

    def __init__(self) -> None:
        self._made: list[Mesh | Callable[[], Mesh]] = []

    def add(self, mesh: Mesh | Callable[[], Mesh]) -> int:
        """Add a mesh, or what builds it.

        Returns:
            Its number.
        """
        self._made.append(mesh)
        return len(self._made) - 1

    def only(self, wanted: Collection[int]) -> list[Mesh]:
        """All meshes under their numbers, with one without faces in place of those that are not wanted."""
        return [self[number] if number in wanted else NOTHING for number in range(len(self))]

    def __len__(self) -> int:
        return len(self._made)

    @overload
    def __getitem__(self, number: int) -> Mesh: ...

    @overload
    def __getitem__(self, number: slice) -> list[Mesh]: ...

    def __getitem__(self, number: int | slice) -> Mesh | list[Mesh]:
        if isinstance(number, slice):
            return [self[k] for k in range(len(self))[number]]
        made = self._made[number]
        if not isinstance(made, Mesh):
            made = self._made[number] = made()
        return made


@dataclass(slots=True)
class SceneObjects:
    """All meshes and bodies of a drive. dt: a step of the tracks, s; key: of what is drawn; detail: of the meshes."""

    dt: float
    key: tuple[object, ...] = ()
    detail: int = 1
    meshes: LazyMeshes = field(default_factory=LazyMeshes)
    bodies: list[ObjectBody] = field(default_factory=list)

    def at(self, time: float, around: F64, reach: float) -> list[PlacedObject]:
        """Who is within reach (m) of a place [2] at a time (s), between steps in between."""
        found = []
        for body in self.bodies:
            last = len(body.track) - 1
            exact = min(max(time / self.dt, 0.0), float(last))
            low = min(int(exact), max(last - 1, 0))
            high, part = min(low + 1, last), exact - low
            if not (body.active[min(low, len(body.active) - 1)] and body.active[min(high, len(body.active) - 1)]):
                continue
            a, b = body.track[low], body.track[high]
            turn = wrap_angle(b[2] - a[2])
            x, y, yaw, z = a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), a[2] + part * turn, a[3]
            if np.hypot(x - around[0], y - around[1]) > reach:
                continue
            speed = float(np.hypot(b[0] - a[0], b[1] - a[1])) / self.dt if high > low else 0.0
            walked = float(body.driven[low] + part * (body.driven[high] - body.driven[low]))
            mesh = body.meshes[int(walked / STRIDE * len(body.meshes)) % len(body.meshes)]
            pose = upright_pose(float(x), float(y), float(yaw), float(z))
            found.append(PlacedObject(body, pose, speed, Thing(mesh, pose, body.paint, body.tag, lit=not body.parked)))
        return found

    def add(
        self,
        who: tuple[str, str, Size, tuple[int, ...]],
        track: F64,
        *,
        active: Bool | None = None,
        parked: bool = False,
    ) -> None:
        """Another body: kind, style, size, meshes, and where it is. Its paint is drawn."""
        tag = len(self.bodies) + 1
        steps = np.hypot(*np.diff(track[:, :2], axis=0).T) if len(track) > 1 else np.zeros(0)
        driven = np.concatenate([[0.0], np.cumsum(steps)]) + generator("stride", *self.key, tag).uniform(0, STRIDE)
        present = np.ones(len(track), bool) if active is None else active
        paint = draw_paint(generator("paint", *self.key, tag))
        kind, style, size, meshes = who
        self.bodies.append(ObjectBody(tag, kind, style, size, paint, meshes, track, present, driven, parked))

    def make(
        self, kind: str, style: str, size: Size, *, name: tuple[object, ...] = (), phases: int = 1
    ) -> tuple[str, str, Size, tuple[int, ...]]:
        """New meshes of one body in `phases` places of its cycle; what `add` wants to know of it."""
        key = (*self.key, *(name or (len(self.meshes),)))

        def build(phase: float | None) -> Mesh:
            draws = generator("record mesh", *key)
            return make_body(kind, style=style, size=size, generator=draws, detail=self.detail, phase=phase)

        cycle = [2 * np.pi * k / phases if phases > 1 else None for k in range(phases)]
        return kind, style, size, tuple(self.meshes.add(partial(build, phase)) for phase in cycle)


class Clear:
    """Where a street has nothing that stands up: squares of half a metre with a vertex from knee to head."""

    def __init__(self, street: Street) -> None:
        vertices = street.vertices
        upright = vertices[(vertices[:, 2] > 0.35) & (vertices[:, 2] < 2.4)]
        self.taken = {(int(x), int(y)) for x, y in np.unique(np.floor(upright[:, :2] * 2).astype(int), axis=0)}

    def footprint(self, x: float, y: float, yaw: float, length: float, width: float) -> bool:
        """Whether a rectangle is free."""
        a, b = np.meshgrid(np.arange(-length / 2, length / 2 + 0.4, 0.45), np.arange(-width / 2, width / 2 + 0.4, 0.45))
        px = np.floor(2 * (x + a * np.cos(yaw) - b * np.sin(yaw))).astype(int)
        py = np.floor(2 * (y + a * np.sin(yaw) + b * np.cos(yaw))).astype(int)
        return not any(q in self.taken for q in zip(px.ravel().tolist(), py.ravel().tolist(), strict=True))

    def take(self, x: float, y: float, yaw: float, length: float, width: float) -> None:
        """Something stands there now."""
        for da in np.arange(-length / 2, length / 2 + 0.4, 0.45):
            for db in np.arange(-width / 2, width / 2 + 0.4, 0.45):
                px, py = x + da * np.cos(yaw) - db * np.sin(yaw), y + da * np.sin(yaw) + db * np.cos(yaw)
                self.taken.add((int(np.floor(2 * px)), int(np.floor(2 * py))))


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
    cast = SceneObjects(trace.dt, key, detail)
    _agents(cast, trace)
    way = np.stack([trace.x[:, 0], trace.y[:, 0]], -1)[::5].astype(np.float64)
    clear = Clear(street)
    _kerb(cast, graph, street, way, clear, thinned({kind: PARKED[kind][0] for kind in PARKED}, streets))
    _sidewalks(cast, graph, way, clear, len(trace.x))
    _signs(cast, graph, way, clear, many=many_signs)
    return cast


def _agents(cast: SceneObjects, trace: EpisodeTrace) -> None:
    """The agents of the world as their traces say; some buses are drawn as a tractor with its trailer."""
    for a in range(1, len(trace.models)):
        own = generator("record body", *cast.key, a)
        model = MODELS[trace.models[a]]
        track = np.stack([trace.x[:, a], trace.y[:, a], trace.yaw[:, a], 0 * trace.x[:, a]], -1).astype(np.float64)
        active = trace.active[:, a]
        full = model.length, model.width, model.height
        if trace.models[a] not in ACTOR_BODIES:
            cast.add(("", "", full, (cast.meshes.add(plain_body(full)),)), track, active=active)
            continue
        kind, styles = ACTOR_BODIES[trace.models[a]]
        style = styles[int(own.integers(len(styles)))]
        if kind == "bus" and own.random() < 0.45:
            _tractor(cast, track, active, own)
            continue
        if kind == "truck" and own.random() < 0.3:
            kind, style = "construction", draw_style("construction", generator=own)
        drawn = draw_size(kind, style, generator=own)
        size = (min(drawn[0], full[0]), min(drawn[1], full[1]), drawn[2])
        phases = PHASES if kind in ("pedestrian", "bicycle") else 1
        cast.add(cast.make(kind, style, size, phases=phases), track, active=active)


def _tractor(cast: SceneObjects, track: F64, active: Bool, own: np.random.Generator) -> None:
    """A tractor on the front half of the agent, a trailer that follows its hitch."""
    height = float(own.uniform(3.2, 3.8))
    sizes: tuple[Size, Size] = ((5.6, 2.5, height), (7.4, 2.5, float(own.uniform(3.3, 3.9))))
    ahead = track.copy()
    ahead[:, 0] += 2.3 * np.cos(track[:, 2])
    ahead[:, 1] += 2.3 * np.sin(track[:, 2])
    hitch = track[:, :2] + 0.7 * np.stack([np.cos(track[:, 2]), np.sin(track[:, 2])], -1)
    trailer = track.copy()
    yaw = float(track[0, 2])
    for t in range(len(track)):
        if t:  # the axle, 5.6 m behind the hitch, rolls along its own heading
            move = hitch[t] - hitch[t - 1]
            yaw += (-np.sin(yaw) * move[0] + np.cos(yaw) * move[1]) / 5.6
        trailer[t, :3] = hitch[t, 0] - 3.1 * np.cos(yaw), hitch[t, 1] - 3.1 * np.sin(yaw), yaw
    style = ("box", "tank", "flatbed")[int(own.integers(3))]
    cast.add(cast.make("truck", "tractor", sizes[0]), ahead, active=active)
    cast.add(cast.make("trailer", style, sizes[1]), trailer, active=active)


def _still(x: float, y: float, yaw: float, z: float = 0.0) -> F64:
    return np.array([[x, y, yaw, z]])


def _kerb(  # noqa: PLR0917
    cast: SceneObjects, graph: LaneGraph, street: Street, way: F64, clear: Clear, shares: Mapping[str, float]
) -> None:
    """Vehicles parked at the kerb and on parking places; building sites of cones and barriers round machines."""
    draws = generator("record kerb", *cast.key)
    busy = float(draws.uniform(0.25, 0.75))
    kinds, share = list(shares), np.array(list(shares.values()))
    lots = [(float(x), float(y), float(yaw), 0.0) for x, y, yaw in np.asarray(street.parking, float)]
    kerbs = []
    for lane in np.flatnonzero(graph.kind == LaneType.SHOULDER):
        walk = int(graph.right[lane])
        if walk < 0 or graph.kind[walk] != LaneType.SIDEWALK or graph.junction[lane] >= 0:
            continue
        if graph.left[lane] >= 0 and graph.divided(int(graph.left[lane])):
            continue  # nobody parks in a roundabout
        s = 9.0 + float(draws.uniform(0, 3))
        while s < float(graph.length[lane]) - 9.0:
            x, y, yaw, width = graph.at(int(lane), s)  # the edge of the driving lane:
            kerbs.append((x - width / 2 * np.sin(yaw), y + width / 2 * np.cos(yaw), yaw, KERB if width < 1 else 0.0))
            s += 6.5
    spots = []
    for spot, at in enumerate([*lots, *kerbs]):
        if np.hypot(way[:, 0] - at[0], way[:, 1] - at[1]).min() > 55.0 or draws.random() > busy:
            continue
        kind = str(draws.choice(kinds, p=share))
        long = PARKED[kind][1] > LONG
        spots.append((not long, spot, "car" if long and spot < len(lots) else kind, at))
    for _, spot, kind, (edge_x, edge_y, yaw, z) in sorted(spots):
        number = len(cast.meshes)
        own = generator("record prop", *cast.key, number)
        style = "parked" if kind in ("motorcycle", "bicycle") else draw_style(kind, generator=own)
        size = draw_size(kind, style, generator=own)
        size = (min(size[0], PARKED[kind][1] - 0.9), min(size[1], 2.55), size[2])
        aside = size[1] / 2 + 0.08 if spot >= len(lots) else 0.0
        x, y = edge_x + aside * np.sin(yaw), edge_y - aside * np.cos(yaw)
        if not clear.footprint(x, y, yaw, PARKED[kind][1], size[1]):
            continue
        clear.take(x, y, yaw, PARKED[kind][1], size[1])
        against = 0.5 if spot < len(lots) else AGAINST.get(kind, 0.0)
        facing = yaw + (np.pi if own.random() < against else 0.0)
        cast.add(cast.make(kind, style, size), _still(x, y, facing, z), parked=True)
        if kind == "construction" or (kind == "truck" and own.random() < 0.3):
            _site(cast, (x, y, yaw, z), size, own, clear)


def _site(
    cast: SceneObjects, at: tuple[float, float, float, float], size: Size, own: np.random.Generator, clear: Clear
) -> None:
    """Cones or barriers along the road side of a machine, barriers across both ends, and up to two workers."""
    x, y, yaw, z = at
    cos, sin = np.cos(yaw), np.sin(yaw)

    def put(kind: str, forward: float, left: float, turn: float) -> None:
        style = draw_style(kind, generator=own)
        drawn = draw_size(kind, style, generator=own)
        px, py = x + forward * cos - left * sin, y + forward * sin + left * cos
        cast.add(cast.make(kind, style, drawn), _still(px, py, yaw + turn + float(own.normal(0.0, ASKEW)), z))

    if own.random() < 0.5:
        for k in range(int(own.integers(3, 7))):
            put("traffic_cone", -size[0] / 2 - 1.0 + k * (size[0] + 2.0) / 5.0, size[1] / 2 + 0.35, 0.0)
    else:
        for k in range(int((size[0] + 2.0) / 2.8) + 1):
            put("barrier", -size[0] / 2 + 0.4 + 2.8 * k, size[1] / 2 + 0.45, np.pi / 2)
    for end in (-1, 1):
        for k in range(int(own.integers(1, 3))):
            put("barrier", end * (size[0] / 2 + 1.2 + 1.3 * k), 0.0, 0.0)
    for end in (-1, 1):  # between the machine and the barriers
        if own.random() < 0.6:
            worker = draw_size("pedestrian", "worker", generator=own)
            forward, left = end * (size[0] / 2 + 0.5), float(own.uniform(-0.3, 0.3)) * size[1]
            px, py = x + forward * cos - left * sin, y + forward * sin + left * cos
            looks = float(own.uniform(-np.pi, np.pi))
            cast.add(cast.make("pedestrian", "worker", worker), _still(px, py, looks, z))
    clear.take(x, y, yaw, size[0] + 6.0, size[1])


def _sidewalks(cast: SceneObjects, graph: LaneGraph, way: F64, clear: Clear, steps: int) -> None:
    """What is on sidewalks.

    People who walk alone or in pairs, or stand, also at corners; parked two-wheelers side by side, groups of cones,
    rows of barriers.
    """
    draws = generator("record sidewalks", *cast.key)
    people, standing = [], []
    for k, style in enumerate(WALKING):
        size = draw_size("pedestrian", style, generator=draws)
        people.append(cast.make("pedestrian", style, size, name=("walker", k), phases=PHASES))
    for style in WAITING:
        standing.append(cast.make("pedestrian", style, draw_size("pedestrian", style, generator=draws)))
    pushed = {k: _stroller(cast, who[2], draws) for k, who in enumerate(people) if who[1] == "stroller"}
    crowd = float(draws.uniform(0.15, 0.55))

    def stand(x: float, y: float, yaw: float) -> None:
        who = standing[int(draws.integers(len(standing)))]
        if clear.footprint(x, y, 0.0, 0.6, 0.6):
            cast.add(who, _still(x, y, yaw, KERB))

    for lane in np.flatnonzero(graph.kind == LaneType.SIDEWALK):
        length = float(graph.length[lane])
        x, y, yaw, width = graph.at(int(lane), max(length - 1.5, 0.0))
        if draws.random() < crowd and np.hypot(way[:, 0] - x, way[:, 1] - y).min() < 45.0:
            for k in range(int(draws.integers(1, 4))):  # at the corner, looking along the walk or across the road
                aside = float(draws.uniform(-0.3, 0.3)) * width
                px, py = (
                    x - aside * np.sin(yaw) - 0.8 * k * np.cos(yaw),
                    y + aside * np.cos(yaw) - 0.8 * k * np.sin(yaw),
                )
                stand(px, py, yaw + float(draws.choice([0.0, 0.5 * np.pi])) + float(draws.normal(0.0, 0.3)))
        for s in np.arange(3.0, length - 3.0, 8.0):
            x, y, yaw, width = graph.at(int(lane), float(s))
            if np.hypot(way[:, 0] - x, way[:, 1] - y).min() > 45.0:
                continue
            pick = draws.random()
            aside = float(draws.uniform(-0.3, 0.3)) * width
            px, py = x - aside * np.sin(yaw), y + aside * np.cos(yaw)
            if pick < crowd:
                group = [int(draws.integers(len(people)))]
                speed = float(draws.uniform(0.7, 1.6)) * (1 if draws.random() < 0.5 else -1)
                if draws.random() < 0.35 and width > 1.8:  # somebody walks beside
                    group.append(int(draws.integers(len(people))))
                if any(WALKING[k] == "elderly" for k in group):
                    speed *= SLOW
                walk = partial(_walk, graph, int(lane), s0=float(s), speed=speed, steps=steps, dt=cast.dt)
                for k, place in zip(group, (aside, aside - 0.8 * np.sign(aside)), strict=False):
                    track = walk(aside=place)
                    cast.add(people[k], track)
                    if k in pushed:
                        cast.add(pushed[k], _ahead(track, GRIP[0] * people[k][2][0] + pushed[k][2][0] / 2 - 0.02))
            elif pick < crowd + 0.08:
                stand(px, py, yaw + float(draws.uniform(-3, 3)))
            elif pick < crowd + 0.13:
                kind = "bicycle" if draws.random() < 0.65 else "motorcycle"
                facing = yaw + float(draws.choice([-0.5, 0.5])) * np.pi + float(draws.normal(0.0, 0.5 * ASKEW))
                for k in range(int(draws.integers(2, 6))):
                    size = draw_size(kind, "parked", generator=draws)
                    qx, qy, _, _ = graph.at(int(lane), min(float(s) + RACK[kind] * k, length))
                    if size[0] < width + 0.4 and clear.footprint(qx, qy, facing, size[0], size[1]):
                        cast.add(cast.make(kind, "parked", size), _still(qx, qy, facing, KERB), parked=True)
            elif pick < crowd + 0.2:
                kind = "traffic_cone" if draws.random() < 0.5 else "barrier"
                along = draws.random() < 0.6  # else barriers stand one behind the other, across the walk
                for k in range(int(draws.integers(1, 5))):
                    style = draw_style(kind, generator=draws)
                    size = draw_size(kind, style, generator=draws)
                    gap = (1.6 if kind == "traffic_cone" else 2.8) * k
                    qx, qy, turn, _ = graph.at(int(lane), min(float(s) + gap, length))
                    if clear.footprint(qx, qy, 0.0, 0.5, 0.5):
                        turn += (np.pi / 2 if kind == "barrier" and along else 0.0) + float(draws.normal(0.0, ASKEW))
                        cast.add(cast.make(kind, style, size), _still(qx, qy, turn, KERB))


def _stroller(cast: SceneObjects, walker: Size, draws: np.random.Generator) -> tuple[str, str, Size, tuple[int, ...]]:
    """A stroller whose handle is where the hands of a walker of a size (m) are.

    nuScenes does not count it to the walker, and the detection task leaves it out.
    """
    style = draw_style("stroller", generator=draws)
    length, width, _ = draw_size("stroller", style, generator=draws)
    return cast.make("stroller", style, (length, width, GRIP[1] * walker[2] + 0.03))


def _ahead(track: F64, distance: float) -> F64:
    """The track [T, 4] of what is a distance (m) ahead of who follows a track."""
    moved = track.copy()
    moved[:, 0] += distance * np.cos(track[:, 2])
    moved[:, 1] += distance * np.sin(track[:, 2])
    return moved


def take_still(cast: SceneObjects, clear: Clear) -> None:
    """Takes the ground of all that stands still."""
    for body in cast.bodies:
        if len(body.track) == 1:
            x, y, yaw, _ = body.track[0].tolist()
            clear.take(x, y, yaw, *body.size[:2])


def _signs(cast: SceneObjects, graph: LaneGraph, way: F64, clear: Clear, *, many: bool) -> None:
    """Stop and yield signs: the plate is the body with a kind, the post one without."""
    take_still(cast, clear)
    for one in street_signs(graph, way, clear, key=cast.key, many=many, detail=cast.detail):
        for kind, mesh in ((one.kind, one.plate), ("", one.post)):
            cast.add((kind, one.style, one.size, (cast.meshes.add(mesh),)), _still(*one.pose))


def _walk(graph: LaneGraph, lane: int, *, s0: float, speed: float, aside: float, steps: int, dt: float) -> F64:
    """Track of somebody who walks along a sidewalk, back and forth."""
    length = float(graph.length[lane]) - 2.0
    along = np.abs((s0 - 1.0 + speed * dt * np.arange(steps)) % (2 * length))
    there = along <= length
    places = 1.0 + np.where(there, along, 2 * length - along)
    rows = graph.along(lane, places)
    back = there == (speed < 0)
    return np.stack(
        [
            rows[:, 0] - aside * np.sin(rows[:, 2]),
            rows[:, 1] + aside * np.cos(rows[:, 2]),
            rows[:, 2] + np.pi * back,
            np.full(steps, KERB),
        ],
        -1,
    )

"""Stop, yield and speed-limit signs: their places, and their bodies in two parts, plate and post."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.lane_graph import LaneGraph, SignKind
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, LaneType
from ssad.rendering.bodies import draw_size, draw_style, make_body
from ssad.rendering.meshes.mesh import Mesh, Point, part_of

if TYPE_CHECKING:
    from ssad.rendering.scene_objects import GroundOccupancy

KINDS: Final = {SignKind.STOP: "stop_sign", SignKind.YIELD: "yield_sign"}
LIMIT_SIGN: Final = "limit_sign"
KERB: Final = 0.12  # m, height of sidewalks
REACH: Final = 120.0  # m from the way of the ego within which signs stand
ROOM: Final = 0.5  # m, side of the square that a post takes
SPACING: Final = 16.0  # m between places along a kerb where a further sign may stand
SHARE: Final = 0.7  # of these places have one
YIELDS: Final = 0.2  # share of yield signs among them
FACING: Final = 0.7  # least cosine between the traffic that a speed-limit sign faces and the route beside it
ASKEW: Final = 0.06  # rad, standard deviation: posts are turned by hand


@dataclass(frozen=True, slots=True)
class StreetSign:
    """Sign of a drive.

    Attributes:
        kind: Kind of its body: stop_sign, yield_sign or limit_sign.
        style: Style of its body; of a speed-limit sign, its figures.
        size: Length, width, height, m.
        pose: x, y, yaw (of the direction that it faces) and z of its foot.
        plate: Mesh of the labelled plate.
        post: Mesh of the post.
    """

    kind: str
    style: str
    size: Point
    pose: tuple[float, float, float, float]
    plate: Mesh
    post: Mesh


def street_signs(
    graph: LaneGraph,
    route_points: F64,
    occupancy: GroundOccupancy,
    *,
    key: tuple[object, ...],
    many: bool,
    detail: int,
    limit_signs: F32 | None = None,
) -> Iterator[StreetSign]:
    """The signs near a way.

    Args:
        graph: The town. Its signs stand where the map has them, or beside that where something else stands there.
        route_points: Places [N, 2] that the ego comes by.
        occupancy: What stands already; each sign takes its ground.
        key: Of what is drawn.
        many: Whether further signs stand along the kerbs, as at crosswalks and driveways.
        detail: Of the meshes, see `make_body`.
        limit_signs: Speed-limit signs of the street [L, 5], see `ssad.rendering.street.model.Street`; None: none.

    Yields:
        One sign after another.
    """
    map_signs = list(_map_signs(graph))
    candidates = [*map_signs, *(_along_kerbs(graph, route_points, key) if many else ())]
    # Speed-limit signs come last: they change none of the others.
    figures = {len(candidates) + row: str(round(limit)) for row, limit in enumerate(_limits(limit_signs)[:, 4])}
    candidates += [(LIMIT_SIGN, x, y, yaw, z) for x, y, yaw, z, _ in _limits(limit_signs).tolist()]
    for index, (kind, x, y, yaw, z) in enumerate(candidates):
        if np.hypot(route_points[:, 0] - x, route_points[:, 1] - y).min() > REACH:
            continue
        spot = _free_place(x, y, yaw, occupancy)
        if spot is None:
            continue
        # A generator per place: a sign that has no room changes none of the others.
        rng = generator("street sign", *key, index)
        style = figures[index] if index in figures else draw_style(kind, generator=rng)
        if style == "all_way" and index < len(map_signs):
            style = "standard"  # the main road of a T-junction does not stop
        size = draw_size(kind, style, generator=rng)
        facing_yaw = yaw + np.pi + float(rng.normal(0.0, ASKEW))
        mesh = make_body(kind, style=style, size=size, generator=rng, detail=detail)
        yield StreetSign(kind, style, size, (*spot, facing_yaw, z), *plate_and_post(mesh))


def free_places(
    graph: LaneGraph, route_points: F64, occupancy: GroundOccupancy, *, key: tuple[object, ...]
) -> Iterator[tuple[float, float, float, float]]:
    """x, y, yaw (of the way it faces) and z of places along the kerbs near a way where one more sign could stand."""
    for _, x, y, yaw, z in _along_kerbs(graph, route_points, key):
        spot = _free_place(x, y, yaw, occupancy)
        if spot is not None:
            yield (*spot, yaw + np.pi, z)


def limit_signs_of_route(limit_signs: F32, route: F64, *, within: float) -> F64:
    """Return the speed-limit signs that face the traffic of a route, in its order.

    Args:
        limit_signs: Speed-limit signs of a street [L, 5], see `ssad.rendering.street.model.Street`.
        route: Points [N, 2], m.
        within: Greatest distance from the route, m.

    Returns:
        Distance along the route, m, and limit, km/h, of each sign [M, 2].
    """
    rows, steps = limit_signs.astype(np.float64), np.diff(route, axis=0)
    if not len(rows) or not len(steps):
        return np.zeros((0, 2))
    arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    distances = np.hypot(*np.moveaxis(rows[:, None, :2] - route[None, :-1], -1, 0))
    nearest = distances.argmin(1)
    headings = steps[nearest] / np.maximum(np.hypot(*steps[nearest].T), 1e-9)[:, None]
    facing = np.cos(rows[:, 2]) * headings[:, 0] + np.sin(rows[:, 2]) * headings[:, 1] > FACING
    chosen = np.flatnonzero(facing & (distances.min(1) < within))
    signs = np.stack([arc_lengths[nearest[chosen]], rows[chosen, 4]], 1)
    return np.asarray(signs[np.argsort(signs[:, 0], kind="stable")])


def plate_and_post(mesh: Mesh) -> tuple[Mesh, Mesh]:
    """Split the body of a sign into the plate, which labels outline as a stop sign, and the rest."""
    plate = np.isin(mesh.panel, [mesh.panels.index(name) for name in ("face", "back")])
    return part_of(mesh, plate), part_of(mesh, ~plate)


def _map_signs(graph: LaneGraph) -> Iterator[tuple[str, float, float, float, float]]:
    """Yield kind, x, y, yaw of the traffic and height of the ground of each sign of the map."""
    # Reversed, so that the first lane of a sign with several rules wins.
    lane_of = dict(zip(graph.rule_sign.tolist()[::-1], graph.rule_lane.tolist()[::-1], strict=True))
    for sign_index, (x, y) in enumerate(graph.sign_xy.astype(float).tolist()):
        z = KERB if sign_index in lane_of and _sidewalk(graph, lane_of[sign_index]) else 0.0
        yield KINDS[SignKind(int(graph.sign_kind[sign_index]))], x, y, float(graph.sign_yaw[sign_index]), z


def _limits(limit_signs: F32 | None) -> F64:
    return np.zeros((0, 5)) if limit_signs is None else limit_signs.astype(np.float64)


def _sidewalk(graph: LaneGraph, lane: int) -> bool:
    """Return True if a sidewalk lies to the right of a lane."""
    while lane >= 0 and graph.kind[lane] != LaneType.SIDEWALK:
        lane = int(graph.right[lane])
    return lane >= 0


def _along_kerbs(
    graph: LaneGraph, route_points: F64, key: tuple[object, ...]
) -> Iterator[tuple[str, float, float, float, float]]:
    """As `_map_signs`, of signs along the streets near the way, on the right of the traffic."""
    rng = generator("record signs", *key)
    for lane in np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0)).tolist():
        right_lane = int(graph.right[lane])
        if right_lane >= 0 and graph.kind[right_lane] == LaneType.DRIVING:
            continue
        for distance in np.arange(float(rng.uniform(5.0, SPACING)), float(graph.length[lane]) - 3.0, SPACING).tolist():
            # Every place draws all its numbers, used or not, so that places stay independent of the route.
            has_sign, kind = rng.random() < SHARE, "yield_sign" if rng.random() < YIELDS else "stop_sign"
            kerb_offset = float(rng.uniform(0.55, 1.1))
            x, y, yaw, width = graph.at(lane, distance)
            if not has_sign or np.hypot(route_points[:, 0] - x, route_points[:, 1] - y).min() > REACH:
                continue
            shoulder_width = (
                graph.at(right_lane, distance)[3]
                if right_lane >= 0 and graph.kind[right_lane] == LaneType.SHOULDER
                else 0.0
            )
            lateral_offset = 0.5 * width + shoulder_width + kerb_offset
            z = KERB if _sidewalk(graph, lane) else 0.0
            yield kind, x + lateral_offset * float(np.sin(yaw)), y - lateral_offset * float(np.cos(yaw)), yaw, z


def _free_place(x: float, y: float, yaw: float, occupancy: GroundOccupancy) -> tuple[float, float] | None:
    """The place, or the first one near it, before it and further from the road, where nothing stands; taken now."""
    for outward in (0.0, 0.3, 0.6):
        for backward in (0.0, 0.6, 1.2):
            spot_x = x + outward * float(np.sin(yaw)) - backward * float(np.cos(yaw))
            spot_y = y - outward * float(np.cos(yaw)) - backward * float(np.sin(yaw))
            if occupancy.is_free(spot_x, spot_y, yaw, ROOM, ROOM):
                occupancy.occupy(spot_x, spot_y, yaw, ROOM, ROOM)
                return spot_x, spot_y
    return None

"""Stop and yield signs of recorded drives: which stand where, and their bodies in two parts, plate and post."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.lane_graph import LaneGraph, SignKind
from ssad.core.seeding import generator
from ssad.core.types import F64, LaneType
from ssad.rendering.bodies import draw_size, draw_style, make_body
from ssad.rendering.meshes.mesh import Mesh, Point, part_of

if TYPE_CHECKING:
    from ssad.rendering.scene_objects import Clear

KINDS: Final = {SignKind.STOP: "stop_sign", SignKind.YIELD: "yield_sign"}
KERB: Final = 0.12  # m, height of sidewalks
REACH: Final = 120.0  # m from the way of the ego within which signs stand
ROOM: Final = 0.5  # m, side of the square that a post takes
SPACING: Final = 16.0  # m between places along a kerb where a further sign may stand
SHARE: Final = 0.7  # of these places have one
YIELDS: Final = 0.2  # share of yield signs among them
ASKEW: Final = 0.06  # rad, standard deviation: posts are turned by hand


@dataclass(frozen=True, slots=True)
class StreetSign:
    """A sign of a drive.

    Attributes:
        kind: Of its body: stop_sign or yield_sign.
        style: Of its body.
        size: Length, width, height, m.
        pose: x, y, yaw (of the way it faces) and z of its foot.
        plate: What is read and labelled.
        post: What carries it.
    """

    kind: str
    style: str
    size: Point
    pose: tuple[float, float, float, float]
    plate: Mesh
    post: Mesh


def street_signs(
    graph: LaneGraph, way: F64, clear: Clear, *, key: tuple[object, ...], many: bool, detail: int
) -> Iterator[StreetSign]:
    """The signs near a way.

    Args:
        graph: The town. Its signs stand where the map has them, or beside that where something else stands there.
        way: Places [N, 2] that the ego comes by.
        clear: What stands already; each sign takes its ground.
        key: Of what is drawn.
        many: Whether further signs stand along the kerbs, as at crosswalks and driveways.
        detail: Of the meshes, see `make_body`.

    Yields:
        One sign after another.
    """
    of_map = list(_of_the_map(graph))
    places = [*of_map, *(_along_kerbs(graph, way, key) if many else ())]
    for number, (kind, x, y, yaw, z) in enumerate(places):
        if np.hypot(way[:, 0] - x, way[:, 1] - y).min() > REACH:
            continue
        spot = _free(x, y, yaw, clear)
        if spot is None:
            continue
        own = generator("street sign", *key, number)
        style = draw_style(kind, generator=own)
        if style == "all_way" and number < len(of_map):
            style = "standard"  # the main road of a T-junction does not stop
        size = draw_size(kind, style, generator=own)
        facing = yaw + np.pi + float(own.normal(0.0, ASKEW))
        mesh = make_body(kind, style=style, size=size, generator=own, detail=detail)
        yield StreetSign(kind, style, size, (*spot, facing, z), *plate_and_post(mesh))


def free_places(
    graph: LaneGraph, way: F64, clear: Clear, *, key: tuple[object, ...]
) -> Iterator[tuple[float, float, float, float]]:
    """x, y, yaw (of the way it faces) and z of places along the kerbs near a way where one more sign could stand."""
    for _, x, y, yaw, z in _along_kerbs(graph, way, key):
        spot = _free(x, y, yaw, clear)
        if spot is not None:
            yield (*spot, yaw + np.pi, z)


def plate_and_post(mesh: Mesh) -> tuple[Mesh, Mesh]:
    """The body of a sign in two: the plate, which is what people outline as a stop sign, and all else."""
    plate = np.isin(mesh.panel, [mesh.panels.index(name) for name in ("face", "back")])
    return part_of(mesh, plate), part_of(mesh, ~plate)


def _of_the_map(graph: LaneGraph) -> Iterator[tuple[str, float, float, float, float]]:
    """Kind, x, y, yaw of the traffic and height of the ground of each sign of the map."""
    lane_of = dict(zip(graph.rule_sign.tolist()[::-1], graph.rule_lane.tolist()[::-1], strict=True))
    for k, (x, y) in enumerate(graph.sign_xy.astype(float).tolist()):
        z = KERB if k in lane_of and _sidewalk(graph, lane_of[k]) else 0.0
        yield KINDS[SignKind(int(graph.sign_kind[k]))], x, y, float(graph.sign_yaw[k]), z


def _sidewalk(graph: LaneGraph, lane: int) -> bool:
    """Whether a sidewalk lies to the right of a lane."""
    while lane >= 0 and graph.kind[lane] != LaneType.SIDEWALK:
        lane = int(graph.right[lane])
    return lane >= 0


def _along_kerbs(
    graph: LaneGraph, way: F64, key: tuple[object, ...]
) -> Iterator[tuple[str, float, float, float, float]]:
    """As `_of_the_map`, of signs along the streets near the way, on the right of the traffic."""
    draws = generator("record signs", *key)
    for lane in np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0)).tolist():
        beside = int(graph.right[lane])
        if beside >= 0 and graph.kind[beside] == LaneType.DRIVING:
            continue
        for s in np.arange(float(draws.uniform(5.0, SPACING)), float(graph.length[lane]) - 3.0, SPACING).tolist():
            chosen, kind = draws.random() < SHARE, "yield_sign" if draws.random() < YIELDS else "stop_sign"
            beyond = float(draws.uniform(0.55, 1.1))
            x, y, yaw, width = graph.at(lane, s)
            if not chosen or np.hypot(way[:, 0] - x, way[:, 1] - y).min() > REACH:
                continue
            verge = graph.at(beside, s)[3] if beside >= 0 and graph.kind[beside] == LaneType.SHOULDER else 0.0
            aside = 0.5 * width + verge + beyond
            z = KERB if _sidewalk(graph, lane) else 0.0
            yield kind, x + aside * float(np.sin(yaw)), y - aside * float(np.cos(yaw)), yaw, z


def _free(x: float, y: float, yaw: float, clear: Clear) -> tuple[float, float] | None:
    """The place, or the first one near it, before it and further from the road, where nothing stands; taken now."""
    for away in (0.0, 0.3, 0.6):
        for back in (0.0, 0.6, 1.2):
            px = x + away * float(np.sin(yaw)) - back * float(np.cos(yaw))
            py = y - away * float(np.cos(yaw)) - back * float(np.sin(yaw))
            if clear.footprint(px, py, yaw, ROOM, ROOM):
                clear.take(px, py, yaw, ROOM, ROOM)
                return px, py
    return None

"""Trajectories of OpenSCENARIO as points: polylines, clothoids, splines of clothoids, and NURBS."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.types import F64, Pose
from ssad.interchange.openscenario_document import AttributeReader
from ssad.world.roads.reference_line import clothoid

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

STEP: Final = 0.5  # m between samples of a curve
MAX_LENGTH: Final = 1.0e5  # m
MAX_ORDER: Final = 16
PoseReader = Callable[["Element | None", "Element"], Pose]


@dataclass(frozen=True)
class SampledTrajectory:
    """Points of a trajectory.

    Attributes:
        xy: [n, 2], m.
        yaw: Heading of the body at each point [n], rad.
        s: Distance along the trajectory [n], m.
        times: Time at each point [n], s; None if the file states none.
    """

    xy: F64
    yaw: F64
    s: F64
    times: F64 | None

    def at(self, s: float, t: float = 0.0) -> Pose:
        """Return the pose at a distance along the trajectory, t metres to its left."""
        distance = min(max(s, 0.0), float(self.s[-1]))
        index = min(max(int(np.searchsorted(self.s, distance, side="right")) - 1, 0), len(self.s) - 2)
        length = float(self.s[index + 1] - self.s[index])
        share = (distance - float(self.s[index])) / length if length else 0.0
        x, y = ((1.0 - share) * self.xy[index] + share * self.xy[index + 1]).tolist()
        turn = math.remainder(float(self.yaw[index + 1] - self.yaw[index]), math.tau)
        yaw = float(self.yaw[index]) + share * turn
        return Pose(x - t * math.sin(yaw), y + t * math.cos(yaw), yaw)

    def before(self, pose: Pose, distance: float) -> Pose:
        """Return the pose that lies a distance before the place nearest to a pose."""
        nearest = int(np.argmin(np.hypot(self.xy[:, 0] - pose.x, self.xy[:, 1] - pose.y)))
        direction = float(self.yaw[nearest])
        x, y = self.xy[nearest].tolist()
        ahead = math.cos(direction) * (pose.x - x) + math.sin(direction) * (pose.y - y)
        return self.at(float(self.s[nearest]) + ahead - distance)


def sample_trajectory(trajectory: Element, values: AttributeReader, pose: PoseReader) -> SampledTrajectory:
    """Sample a trajectory.

    Args:
        trajectory: The element.
        values: Reads the attributes of elements.
        pose: Reads a Position that an element has; None: the place of the entity that follows the trajectory.

    Raises:
        FormatError: It has no shape that is read, or fewer than two points.
    """
    shape = trajectory.find("Shape")
    content = None if shape is None else next(iter(shape), None)
    samplers = {"Polyline": _polyline, "Clothoid": _clothoid, "ClothoidSpline": _spline, "Nurbs": _nurbs}
    if content is None or content.tag not in samplers:
        raise values.error(trajectory, f"a shape that is not read; known: {', '.join(samplers)}")
    xy, yaw, times = samplers[content.tag](content, values, pose)
    if len(xy) < 2:
        raise values.error(content, "a trajectory needs at least two points")
    steps = np.hypot(*np.diff(xy, axis=0).T)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    if not s[-1] <= MAX_LENGTH:
        raise values.error(content, f"a trajectory longer than {MAX_LENGTH:g} m")
    timed = times is not None and bool(np.isfinite(times).all()) and bool((np.diff(times) > 0.0).all())
    return SampledTrajectory(xy, yaw, s, times if timed else None)


def _times(elements: list[Element], values: AttributeReader) -> F64 | None:
    if any(element.get("time") in (None, "") for element in elements):
        return None
    return np.array([values.number(element, "time") for element in elements])


def _polyline(content: Element, values: AttributeReader, pose: PoseReader) -> tuple[F64, F64, F64 | None]:
    vertices = content.findall("Vertex")
    positions = [vertex.find("Position") for vertex in vertices]
    poses = [pose(position, vertex) for position, vertex in zip(positions, vertices, strict=True)]
    xy = np.array([(point.x, point.y) for point in poses], np.float64).reshape(-1, 2)
    yaw = np.array([point.yaw for point in poses])
    # A world position without a heading faces the next one.
    for index, position in enumerate(positions):
        world = None if position is None else position.find("WorldPosition")
        if world is None or world.get("h") is not None or len(poses) < 2:
            continue
        first = min(index, len(poses) - 2)
        dx, dy = xy[first + 1] - xy[first]
        yaw[index] = math.atan2(dy, dx) if dx or dy else yaw[max(index - 1, 0)]
    return xy, yaw, _times(vertices, values)


def _curve(start: Pose, length: float, curvature: float, rate: float) -> tuple[F64, F64, F64]:
    """Return distances, points and headings of a clothoid that begins at a pose."""
    distance = np.linspace(0.0, length, max(math.ceil(length / STEP), 1) + 1)
    u, v, turn = clothoid(np.full(len(distance), curvature), np.full(len(distance), rate), distance)
    cos, sin = math.cos(start.yaw), math.sin(start.yaw)
    xy = np.stack([start.x + cos * u - sin * v, start.y + sin * u + cos * v], 1)
    return distance, xy, start.yaw + turn


def _length(element: Element, values: AttributeReader) -> float:
    length = values.number(element, "length")
    if not 0.0 < length <= MAX_LENGTH:
        raise values.error(element, f"length is {length:g}, outside 0 to {MAX_LENGTH:g} m")
    return length


def _clothoid(content: Element, values: AttributeReader, pose: PoseReader) -> tuple[F64, F64, F64 | None]:
    rate = "curvaturePrime" if content.get("curvaturePrime") is not None else "curvatureDot"
    start = pose(content.find("Position"), content)
    length = _length(content, values)
    distance, xy, yaw = _curve(start, length, values.number(content, "curvature"), values.number(content, rate, 0.0))
    if content.get("startTime") in (None, "") or content.get("stopTime") in (None, ""):
        return xy, yaw, None
    begin, end = values.number(content, "startTime"), values.number(content, "stopTime")
    return xy, yaw, begin + (end - begin) * distance / length


def _spline(content: Element, values: AttributeReader, pose: PoseReader) -> tuple[F64, F64, F64 | None]:
    segments = [item for item in content if item.tag in ("ClothoidSplineSegment", "Segment")]
    timed = bool(segments) and content.get("timeEnd") is not None
    timed &= all(segment.get("timeStart") is not None for segment in segments)
    ends = [values.number(segment, "timeStart") for segment in segments[1:]] if timed else []
    ends += [values.number(content, "timeEnd")] if timed else []
    points: list[F64] = []
    headings: list[F64] = []
    times: list[F64] = []
    end: Pose | None = None
    for index, segment in enumerate(segments):
        position = segment.find("PositionStart")
        start = pose(position, segment) if end is None or position is not None else end
        start = Pose(start.x, start.y, start.yaw + values.number(segment, "hOffset", 0.0))
        length = _length(segment, values)
        first, last = values.number(segment, "curvatureStart"), values.number(segment, "curvatureEnd")
        distance, xy, yaw = _curve(start, length, first, (last - first) / length)
        end = Pose(float(xy[-1, 0]), float(xy[-1, 1]), float(yaw[-1]))
        skip = 1 if points and np.hypot(*(xy[0] - points[-1][-1])) < 1e-6 else 0
        points.append(xy[skip:])
        headings.append(yaw[skip:])
        if timed:
            begin = values.number(segment, "timeStart")
            times.append((begin + (ends[index] - begin) * distance / length)[skip:])
    if not points:
        raise values.error(content, "ClothoidSplineSegment is missing")
    return np.concatenate(points), np.concatenate(headings), np.concatenate(times) if timed else None


def _nurbs(content: Element, values: AttributeReader, pose: PoseReader) -> tuple[F64, F64, F64 | None]:
    controls = content.findall("ControlPoint")
    knots = np.array([values.number(knot, "value") for knot in content.iterfind("Knot")])
    order = int(values.number(content, "order"))
    if not 2 <= order <= MAX_ORDER or len(controls) < order or len(knots) != len(controls) + order:
        raise values.error(
            content, f"order {order}, {len(controls)} control points and {len(knots)} knots do not make a curve"
        )
    if (np.diff(knots) < 0.0).any() or not knots[order - 1] < knots[len(controls)]:
        raise values.error(content, "knots must not decrease")
    places = [pose(control.find("Position"), control) for control in controls]
    weights = np.array([values.number(control, "weight", 1.0) for control in controls])
    if not (weights > 0.0).all():
        raise values.error(content, "weights must be above 0")
    times = _times(controls, values)
    columns = [np.array([point.x for point in places]), np.array([point.y for point in places])]
    columns += [] if times is None else [times]
    table = np.stack([*columns, np.ones(len(places))], 1) * weights[:, None]
    chord = float(np.hypot(*np.diff(table[:, :2] / weights[:, None], axis=0).T).sum())
    count = min(max(math.ceil(chord / STEP) * 4, 64), 20_000)
    parameter = np.linspace(knots[order - 1], knots[len(controls)], count + 1)
    curve = _basis(knots, order, len(controls), parameter) @ table
    curve = curve[:, :-1] / curve[:, -1:]
    xy = curve[:, :2]
    tangent = np.gradient(xy, axis=0)
    return xy, np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])), None if times is None else curve[:, 2]


def _basis(knots: F64, order: int, count: int, parameter: F64) -> F64:
    """Return the B-spline basis functions [n, count] of an order at parameters [n] (recursion of Cox and de Boor)."""
    inside = np.minimum(parameter, np.nextafter(knots[count], -np.inf))[:, None]
    basis = ((knots[:-1] <= inside) & (inside < knots[1:])).astype(np.float64)
    for degree in range(1, order):
        spans = len(knots) - 1 - degree
        rising, falling = knots[degree : degree + spans] - knots[:spans], knots[degree + 1 :] - knots[1 : spans + 1]
        left = np.where(rising > 0.0, (inside - knots[:spans]) / np.where(rising > 0.0, rising, 1.0), 0.0)
        right = np.where(falling > 0.0, (knots[degree + 1 :] - inside) / np.where(falling > 0.0, falling, 1.0), 0.0)
        basis = left * basis[:, :spans] + right * basis[:, 1 : spans + 1]
    result: F64 = basis
    return result

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

    def at(self, arc_length: float, t: float = 0.0) -> Pose:
        """Return the pose at a distance along the trajectory, t metres to its left."""
        distance = min(max(arc_length, 0.0), float(self.s[-1]))
        index = min(max(int(np.searchsorted(self.s, distance, side="right")) - 1, 0), len(self.s) - 2)
        length = float(self.s[index + 1] - self.s[index])
        share = (distance - float(self.s[index])) / length if length else 0.0
        x_coordinate, y_coordinate = ((1.0 - share) * self.xy[index] + share * self.xy[index + 1]).tolist()
        turn = math.remainder(float(self.yaw[index + 1] - self.yaw[index]), math.tau)
        headings = float(self.yaw[index]) + share * turn
        return Pose(x_coordinate - t * math.sin(headings), y_coordinate + t * math.cos(headings), headings)

    def before(self, pose: Pose, distance: float) -> Pose:
        """Return the pose that lies a distance before the place nearest to a pose."""
        nearest = int(np.argmin(np.hypot(self.xy[:, 0] - pose.x, self.xy[:, 1] - pose.y)))
        direction = float(self.yaw[nearest])
        x_coordinate, y_coordinate = self.xy[nearest].tolist()
        ahead = math.cos(direction) * (pose.x - x_coordinate) + math.sin(direction) * (pose.y - y_coordinate)
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
    points_xy, headings, times = samplers[content.tag](content, values, pose)
    if len(points_xy) < 2:
        raise values.error(content, "a trajectory needs at least two points")
    steps = np.hypot(*np.diff(points_xy, axis=0).T)
    arc_length = np.concatenate([[0.0], np.cumsum(steps)])
    if not arc_length[-1] <= MAX_LENGTH:
        raise values.error(content, f"a trajectory longer than {MAX_LENGTH:g} m")
    has_times = times is not None and bool(np.isfinite(times).all()) and bool((np.diff(times) > 0.0).all())
    return SampledTrajectory(points_xy, headings, arc_length, times if has_times else None)


def _times(elements: list[Element], values: AttributeReader) -> F64 | None:
    if any(element.get("time") in (None, "") for element in elements):
        return None
    return np.array([values.number(element, "time") for element in elements])


def _polyline(content: Element, values: AttributeReader, pose: PoseReader) -> tuple[F64, F64, F64 | None]:
    vertices = content.findall("Vertex")
    positions = [vertex.find("Position") for vertex in vertices]
    poses = [pose(position, vertex) for position, vertex in zip(positions, vertices, strict=True)]
    points_xy = np.array([(point.x, point.y) for point in poses], np.float64).reshape(-1, 2)
    headings = np.array([point.yaw for point in poses])
    # A world position without a heading faces the next one.
    for index, position in enumerate(positions):
        world = None if position is None else position.find("WorldPosition")
        if world is None or world.get("h") is not None or len(poses) < 2:
            continue
        first = min(index, len(poses) - 2)
        dx, dy = points_xy[first + 1] - points_xy[first]
        headings[index] = math.atan2(dy, dx) if dx or dy else headings[max(index - 1, 0)]
    return points_xy, headings, _times(vertices, values)


def _curve(start_pose: Pose, length: float, curvature: float, curvature_rate: float) -> tuple[F64, F64, F64]:
    """Return distances, points and headings of a clothoid that begins at a pose."""
    distance = np.linspace(0.0, length, max(math.ceil(length / STEP), 1) + 1)
    u, v, turn = clothoid(np.full(len(distance), curvature), np.full(len(distance), curvature_rate), distance)
    cos, sin = math.cos(start_pose.yaw), math.sin(start_pose.yaw)
    points_xy = np.stack([start_pose.x + cos * u - sin * v, start_pose.y + sin * u + cos * v], 1)
    return distance, points_xy, start_pose.yaw + turn


def _length(element: Element, values: AttributeReader) -> float:
    length = values.number(element, "length")
    if not 0.0 < length <= MAX_LENGTH:
        raise values.error(element, f"length is {length:g}, outside 0 to {MAX_LENGTH:g} m")
    return length


def _clothoid(content: Element, values: AttributeReader, pose: PoseReader) -> tuple[F64, F64, F64 | None]:
    curvature_rate = "curvaturePrime" if content.get("curvaturePrime") is not None else "curvatureDot"
    start_pose = pose(content.find("Position"), content)
    length = _length(content, values)
    distance, points_xy, headings = _curve(
        start_pose, length, values.number(content, "curvature"), values.number(content, curvature_rate, 0.0)
    )
    if content.get("startTime") in (None, "") or content.get("stopTime") in (None, ""):
        return points_xy, headings, None
    begin_time, end_time = values.number(content, "startTime"), values.number(content, "stopTime")
    return points_xy, headings, begin_time + (end_time - begin_time) * distance / length


def _spline(content: Element, values: AttributeReader, pose: PoseReader) -> tuple[F64, F64, F64 | None]:
    segments = [item for item in content if item.tag in ("ClothoidSplineSegment", "Segment")]
    has_times = bool(segments) and content.get("timeEnd") is not None
    has_times &= all(segment.get("timeStart") is not None for segment in segments)
    end_times = [values.number(segment, "timeStart") for segment in segments[1:]] if has_times else []
    end_times += [values.number(content, "timeEnd")] if has_times else []
    segment_points: list[F64] = []
    segment_headings: list[F64] = []
    times: list[F64] = []
    end_pose: Pose | None = None
    for index, segment in enumerate(segments):
        position = segment.find("PositionStart")
        start_pose = pose(position, segment) if end_pose is None or position is not None else end_pose
        start_pose = Pose(start_pose.x, start_pose.y, start_pose.yaw + values.number(segment, "hOffset", 0.0))
        length = _length(segment, values)
        first, last = values.number(segment, "curvatureStart"), values.number(segment, "curvatureEnd")
        distance, points_xy, headings = _curve(start_pose, length, first, (last - first) / length)
        end_pose = Pose(float(points_xy[-1, 0]), float(points_xy[-1, 1]), float(headings[-1]))
        skip = 1 if segment_points and np.hypot(*(points_xy[0] - segment_points[-1][-1])) < 1e-6 else 0
        segment_points.append(points_xy[skip:])
        segment_headings.append(headings[skip:])
        if has_times:
            begin = values.number(segment, "timeStart")
            times.append((begin + (end_times[index] - begin) * distance / length)[skip:])
    if not segment_points:
        raise values.error(content, "ClothoidSplineSegment is missing")
    sampled_times = np.concatenate(times) if has_times else None
    return np.concatenate(segment_points), np.concatenate(segment_headings), sampled_times


def _nurbs(content: Element, values: AttributeReader, pose: PoseReader) -> tuple[F64, F64, F64 | None]:
    controls = content.findall("ControlPoint")
    knot_values = np.array([values.number(knot, "value") for knot in content.iterfind("Knot")])
    curve_order = int(values.number(content, "order"))
    if (
        not 2 <= curve_order <= MAX_ORDER
        or len(controls) < curve_order
        or len(knot_values) != len(controls) + curve_order
    ):
        raise values.error(
            content,
            f"order {curve_order}, {len(controls)} control points and {len(knot_values)} knots do not make a curve",
        )
    if (np.diff(knot_values) < 0.0).any() or not knot_values[curve_order - 1] < knot_values[len(controls)]:
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
    parameter = np.linspace(knot_values[curve_order - 1], knot_values[len(controls)], count + 1)
    curve = _basis(knot_values, curve_order, len(controls), parameter) @ table
    curve = curve[:, :-1] / curve[:, -1:]
    points_xy = curve[:, :2]
    tangent = np.gradient(points_xy, axis=0)
    return points_xy, np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])), None if times is None else curve[:, 2]


def _basis(knot_values: F64, curve_order: int, count: int, parameter: F64) -> F64:
    """Return the B-spline basis functions [n, count] of an order at parameters [n] (recursion of Cox and de Boor)."""
    inside = np.minimum(parameter, np.nextafter(knot_values[count], -np.inf))[:, None]
    basis = ((knot_values[:-1] <= inside) & (inside < knot_values[1:])).astype(np.float64)
    for degree in range(1, curve_order):
        spans = len(knot_values) - 1 - degree
        rising, falling = (
            knot_values[degree : degree + spans] - knot_values[:spans],
            knot_values[degree + 1 :] - knot_values[1 : spans + 1],
        )
        left = np.where(rising > 0.0, (inside - knot_values[:spans]) / np.where(rising > 0.0, rising, 1.0), 0.0)
        right = np.where(
            falling > 0.0, (knot_values[degree + 1 :] - inside) / np.where(falling > 0.0, falling, 1.0), 0.0
        )
        basis = left * basis[:, :spans] + right * basis[:, 1 : spans + 1]
    result: F64 = basis
    return result

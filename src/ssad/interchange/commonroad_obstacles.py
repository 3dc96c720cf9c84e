"""Obstacles of CommonRoad as actors: a trajectory is replayed, whatever happens around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.rotations import wrap_angle
from ssad.core.types import Actor, AgentKind, EpisodeLimits, Pose
from ssad.interchange.commonroad_xml import KINDS_OF, STEP, TextReader, element_name
from ssad.world.episode_arrays import MAX_AGENTS
from ssad.world.models import MODELS, SURROGATES

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

OWN: Final = 1.5  # m from the ego's start within which an obstacle is the ego's own recording
_VEHICLES = (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS, AgentKind.MOTORCYCLE, AgentKind.BICYCLE)


class ObstacleReader:
    """The obstacles of a document whose steps last `dt` s; inexact conversions go into a report."""

    def __init__(self, texts: TextReader, report: ImportReport, dt: float) -> None:
        self.texts, self.report, self.dt = texts, report, dt

    def read(self, root: Element, start: Pose, limits: EpisodeLimits) -> tuple[Actor, ...]:
        """Return the actors in the order of their ids.

        Args:
            root: The document.
            start: Start of the ego; an obstacle that starts there too is the ego's own recording.
            limits: Limits of the episode.

        Raises:
            FormatError: An obstacle is broken.
        """
        end_time = min(limits.max_steps * STEP, limits.max_time)
        actors: dict[int, tuple[float, Actor]] = {}
        known_ids: set[int] = set()
        for tag, convert in (("staticObstacle", self._static_actor), ("dynamicObstacle", self._dynamic_actor)):
            for element in root.iterfind(tag):
                obstacle_id = self.texts.whole(element.get("id"), element, "id")
                if obstacle_id in known_ids:
                    raise self.texts.error(element, "there are two of this id")
                known_ids.add(obstacle_id)
                actor = convert(element, end_time)
                if actor is not None and self._is_ego(actor, start):
                    self.report.omit(
                        "an obstacle that is the ego's own recording: it starts where the ego does",
                        element_name(element),
                    )
                elif actor is not None:
                    rows = np.array(actor.trajectory or [(0.0, actor.pose.x, actor.pose.y, 0.0)])
                    distance = float(np.hypot(rows[:, 1] - start.x, rows[:, 2] - start.y).min())
                    actors[obstacle_id] = distance, actor
        nearest_ids = sorted(actors, key=lambda obstacle_id: actors[obstacle_id][0])[: MAX_AGENTS - 1]
        if excess := len(actors) - len(nearest_ids):
            self.report.omit(
                f"obstacles: a scene has room for {MAX_AGENTS - 1}, the nearest to the ego's start", count=excess
            )
        self.report.contents.append(f"{len(nearest_ids)} obstacles")
        return tuple(actors[obstacle_id][1] for obstacle_id in sorted(nearest_ids))

    @staticmethod
    def _is_ego(actor: Actor, start: Pose) -> bool:
        """Return whether a moving actor starts exactly where the ego does."""
        if not actor.trajectory or actor.trajectory[0][0] > 0.0:
            return False
        _, x, y, yaw = actor.trajectory[0]
        return math.hypot(x - start.x, y - start.y) < OWN and abs(float(wrap_angle(yaw - start.yaw))) < 0.2

    def _body(self, element: Element) -> tuple[str, str]:
        """Return the type of an obstacle, and the model that represents it."""
        type_name = (element.findtext("type") or "").strip()
        is_static = element.tag == "staticObstacle"
        kinds: Sequence[AgentKind] = KINDS_OF.get(type_name, ())
        if is_static:
            kinds = _VEHICLES if type_name == "parkedVehicle" else (AgentKind.PROP,)
        if not kinds:
            raise self.texts.error(element, f"'{type_name[:40]}' is no type of obstacle; known: {', '.join(KINDS_OF)}")
        size = self._size(element)
        candidates = [
            candidate for name, candidate in MODELS.items() if candidate.kind in kinds and name not in SURROGATES
        ]
        model = min(candidates, key=lambda candidate: abs(candidate.length - size[0]) + abs(candidate.width - size[1]))
        if max(abs(model.length - size[0]), abs(model.width - size[1])) > 0.01:
            self.report.omit(
                f"the body of a {type_name} ({size[0]:.3g} x {size[1]:.3g} m) becomes '{model.name}'",
                element_name(element),
            )
        return type_name, model.name

    def _size(self, element: Element) -> tuple[float, float]:
        """Return length and width, m."""
        shape = element.find("shape")
        if shape is None or not len(shape):
            raise self.texts.error(element, "shape is missing")
        outline = shape[0]
        if outline.tag == "rectangle":
            length, width = (
                self.texts.number(outline.findtext(extent), element, extent) for extent in ("length", "width")
            )
        elif outline.tag == "circle":
            length = width = 2.0 * self.texts.number(outline.findtext("radius"), element, "radius")
        elif outline.tag == "polygon":
            corners = self.texts.points(outline, element, "polygon")
            if len(corners) < 3:
                raise self.texts.error(element, "its shape is a polygon of fewer than 3 points")
            length, width = np.ptp(corners[:, :2], axis=0).tolist()
        else:
            raise self.texts.error(element, f"its shape is a {outline.tag[:40]}, which is not read")
        if not (0.0 < length < 1e4 and 0.0 < width < 1e4):
            raise self.texts.error(element, f"its body is {length:g} x {width:g} m")
        if outline.tag != "rectangle" or outline.find("center") is not None or len(shape) > 1:
            self.report.omit("bodies that are no rectangle about their middle", element_name(element))
        return length, width

    def _static_actor(self, element: Element, until: float) -> Actor | None:
        type_name, model = self._body(element)
        state = element.find("initialState")
        if state is None:
            raise self.texts.error(element, "initialState is missing")
        return Actor(f"{type_name}-{element.get('id')}", model, self.pose(state, element))

    def _dynamic_actor(self, element: Element, until: float) -> Actor | None:
        type_name, model = self._body(element)
        start = element.find("initialState")
        if start is None:
            raise self.texts.error(element, "initialState is missing")
        name = f"{type_name}-{element.get('id')}"
        for tag in ("initialSignalState", "signalSeries"):
            if element.find(tag) is not None:
                self.report.omit(f"{tag}: the lamps of obstacles", element_name(element))
        regions = element.findall("occupancySet/occupancy")
        if regions:
            self.report.omit("occupancy sets: their middles are taken as a trajectory", element_name(element))
        pose_by_time: dict[float, tuple[float, float, float]] = {}
        pose = self.pose(start, element)
        for state in (start, *element.findall("trajectory/state"), *regions):
            time = self.middle(state, "time", element, None) * self.dt
            last_time = max(pose_by_time, default=-1.0)
            if time < last_time:
                raise self.texts.error(element, f"time {time / self.dt:g} does not come after the one before it")
            if time == last_time:
                self.report.doubt("states of a step that has one already are left out", element_name(element))
                continue
            pose = self._middle_of(state, element, pose) if state.tag == "occupancy" else self.pose(state, element)
            pose_by_time[time] = pose.x, pose.y, pose.yaw
        if len(pose_by_time) < 2:
            return Actor(name, model, pose)
        table = [(round(time, 6), *row) for time, row in pose_by_time.items()]
        if until - 1e-6 <= table[-1][0] <= until + 1e-6:  # it exists in the last step, so it must not disappear there
            table.append((until + 1.0, *table[-1][1:]))
        return Actor(name, model, Pose(*table[0][1:]), trajectory=tuple(table))

    def pose(self, state: Element, within: Element) -> Pose:
        """Return the pose of a state; of a region the middle."""
        position = state.find("position")
        if position is None or not len(position):
            raise self.texts.error(within, "position is missing")
        if position[0].tag == "point":
            x, y = self.texts.points(position, within, "position")[0, :2].tolist()
        else:
            centre = position[0].find("center")
            if centre is None:
                raise self.texts.error(within, f"a position that is a {position[0].tag[:40]} is not read")
            x, y = (self.texts.number(centre.findtext(axis), within, f"position: {axis}") for axis in "xy")
            self.report.omit("positions that are regions: their middle is taken", element_name(within))
        return Pose(x, y, float(wrap_angle(self.middle(state, "orientation", within, None))))

    def _middle_of(self, occupancy: Element, within: Element, previous_pose: Pose) -> Pose:
        """The middle of an occupancy; without an orientation of its own it heads as the one before it."""
        shape = occupancy.find("shape")
        if shape is None or not len(shape):
            raise self.texts.error(within, "an occupancy without a shape")
        if shape[0].tag == "polygon":
            corners = self.texts.points(shape[0], within, "occupancy")[:, :2]
            if len(corners) < 3:
                raise self.texts.error(within, "an occupancy is a polygon of fewer than 3 points")
            return Pose(float(corners[:, 0].mean()), float(corners[:, 1].mean()), previous_pose.yaw)
        coordinates = [shape[0].findtext(f"center/{axis}", "0") for axis in "xy"]
        x, y = (self.texts.number(text, within, "occupancy: center") for text in coordinates)
        yaw = self.texts.number(
            shape[0].findtext("orientation", repr(previous_pose.yaw)), within, "occupancy: orientation"
        )
        return Pose(x, y, float(wrap_angle(yaw)))

    def middle(self, state: Element, tag: str, within: Element, default: float | None) -> float:
        """Return a value of a state; of an interval the middle."""
        element = state.find(tag)
        if element is None and default is not None:
            return default
        low, high = self.texts.value(element, within, tag)
        if low != high:
            self.report.omit(f"intervals of {tag}: their middle is taken", element_name(within))
        return 0.5 * (low + high)

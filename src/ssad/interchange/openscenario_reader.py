"""OpenSCENARIO XML 1.0 to 1.3 as scenarios: files of SSAD are restored completely, others as far as they map.

An event that changes a speed becomes a phase, one that changes a lane a lateral phase, with the event's trigger; a
trajectory with times becomes an actor's own; one without times, or a route, becomes its path. The ego is left to the
system under test. Features without a counterpart are listed: as doubts if they change how an actor moves, when it
starts, its size, or when the episode ends, else as omissions.

CARLA's ScenarioRunner writes world positions in CARLA's left-handed frame, which a description that begins with
"CARLA:" indicates, and gives positions of bodies' centres (srunner/tools/openscenario_parser.py of ScenarioRunner).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.errors import FormatError, RouteError, SSADError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import (
    F64,
    Actor,
    EpisodeLimits,
    LateralPhase,
    Phase,
    Pose,
    Route,
    Scenario,
    SignalPlan,
    SignalState,
)
from ssad.core.wording import counted
from ssad.interchange.ego_start import start_parameters
from ssad.interchange.openscenario_distributions import check_names, parameter_sets, scenario_file
from ssad.interchange.openscenario_document import AttributeReader, ConstraintError, read_document, resolve
from ssad.interchange.openscenario_entities import Entity, read_entities
from ssad.interchange.openscenario_maps import DocumentMap, find_map
from ssad.interchange.openscenario_places import PositionReader
from ssad.interchange.openscenario_storyboard import StoryboardReader
from ssad.interchange.openscenario_triggers import earliest_time
from ssad.interchange.scenario_parts import plan_of, scenario_name
from ssad.scenarios.dynamic import CUSTOM, build_episode, parameter_box
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, lane_path, move_pose
from ssad.scenarios.dynamic.schema import MAX_SPEED
from ssad.world.models import MODELS
from ssad.world.roads import load_town, route_along, town_signals

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

STEP: Final = 0.1  # s of the world
WAY: Final = 200.0  # m, shortest path along its lane of an agent without a route
LONGEST_WAY: Final = 3000.0  # m
DEFAULT_TIME: Final = 60.0  # s of a scenario that states no time
FAR_OFF: Final = 5.0  # m from the ego's route of a point that it does not pass
MAX_MINOR: Final = 3  # minor version of the latest OpenSCENARIO XML that is known
MAX_EGO_LONGITUDINAL: Final = parameter_box(CUSTOM)["ego_longitudinal"].high  # m


@dataclass(frozen=True)
class ImportedScenario:
    """A scenario from another format.

    Attributes:
        scenario: The scenario.
        omissions: Features of the file that are not carried over and leave all motions as they are.
        doubts: What an actor does, when it starts, its size or the end of the episode, where it differs from the file,
            and what is likely to be wrong in the file.
    """

    scenario: Scenario
    omissions: tuple[str, ...]
    doubts: tuple[str, ...]


@dataclass(frozen=True)
class ImportedSet:
    """Scenarios of a document, or of a distribution of its parameters.

    Attributes:
        scenarios: The scenarios.
        report: Account of what came in, what was left out, and what is doubtful.
    """

    scenarios: tuple[Scenario, ...]
    report: ImportReport


def read_openscenario(path: Path, *, map_name: str | None = None) -> ImportedScenario:
    """Read the scenario of a file; see `read_openscenario_set`.

    Raises:
        FormatError: The file is broken, is not OpenSCENARIO XML, or holds a distribution of several scenarios.
        MapError, UnknownNameError: The town does not exist.
        RouteError: The ego's route does not lie on the town's roads.
    """
    imported = read_openscenario_set(path, map_name=map_name)
    if len(imported.scenarios) != 1:
        raise FormatError(f"{path}: a distribution of {len(imported.scenarios)} scenarios, not one")
    report = imported.report
    return ImportedScenario(imported.scenarios[0], tuple(report.omissions), tuple(report.doubts))


def read_openscenario_set(
    path: Path,
    *,
    map_name: str | None = None,
    assigned: Mapping[str, str] | None = None,
    count: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportedSet:
    """Read the scenarios of a file: one, or those of a distribution of parameters.

    The map beside the file is imported if no town has it yet.

    Args:
        path: The file.
        map_name: Its town, or a file of that town; None: that of the file's LogicFile.
        assigned: Values of parameters that take the place of the declared ones.
        count: Draw so many scenarios of a distribution; None: all.
        progress: Called with the number of scenarios read so far, and of all.

    Raises:
        FormatError: The file is broken, or is not OpenSCENARIO XML.
        MapError, UnknownNameError: The town does not exist.
        RouteError: The ego's route does not lie on the town's roads.
    """
    root = read_document(path)
    report = ImportReport(str(path))
    sets, total = parameter_sets(root, path, count=count)
    source = scenario_file(root, path) or path
    document = root if source is path else read_document(source)
    check_names(root, path, document)
    _note_newer_version(document, report)
    scenarios: list[Scenario] = []
    maps: dict[str, DocumentMap] = {}
    excluded = 0
    is_set = root.find("ParameterValueDistribution") is not None and total > 1
    for index, values in enumerate(sets):
        try:
            resolved, parameters = resolve(document, source, {**values, **(assigned or {})})
        except ConstraintError:
            if not is_set:
                raise
            excluded += 1
            continue
        logic = resolved.find("RoadNetwork/LogicFile")
        key = "" if logic is None else logic.get("filepath", "")
        if key not in maps:
            maps[key] = find_map(resolved, source, report) if map_name is None else DocumentMap(map_name)
        reader = _Reader(source, resolved, parameters, maps[key], report)
        try:
            scenario = reader.read(source.stem, f"/{index + 1:04d}" if is_set else "")
        except RecursionError:
            raise FormatError(
                f"{source}: its conditions are nested too deeply; split them into several events"
            ) from None
        scenarios.append(scenario)
        if progress is not None:
            progress(index + 1, len(sets))
    if excluded:
        report.note(f"{excluded} of {len(sets)} sets of values are excluded by constraints of parameters")
    if not scenarios:
        raise FormatError(f"{path}: all {len(sets)} sets of values are excluded by constraints of parameters")
    return ImportedSet(tuple(scenarios), report)


def _note_newer_version(document: Element, report: ImportReport) -> None:
    """Note a minor version beyond `MAX_MINOR`: elements that only it has are not known here."""
    header = document.find("FileHeader")
    minor = "" if header is None else header.get("revMinor", "").strip()
    if minor.isdecimal() and int(minor) > MAX_MINOR:
        report.note(
            f"version 1.{minor[:9]} is newer than 1.{MAX_MINOR}, the latest one known: the file is read as that"
        )


class _Reader:
    """Reader of one resolved document."""

    def __init__(
        self, path: Path, root: Element, parameters: Mapping[str, str], map_: DocumentMap, report: ImportReport
    ) -> None:
        self.root, self.town, self.report, self.parameters = root, map_.town, report, parameters
        self.graph: LaneGraph = load_town(map_.town)
        self.values = AttributeReader(str(path))
        self.omissions: Counter[str] = Counter()  # what leaves all motions as they are
        self.doubts: Counter[str] = Counter()
        header = root.find("FileHeader")
        if header is None:
            raise self.values.error("OpenSCENARIO", "FileHeader is missing")
        if self.values.text(header, "revMajor") != "1":
            raise self.values.error(header, f"revision {header.get('revMajor')} is not read, only 1")
        self.description = self.values.text(header, "description", "")
        self.own_properties = {
            property_element.get("name", "")[5:]: property_element.get("value", "")
            for property_element in header.iter("Property")
        }
        is_carla = self.description.startswith("CARLA:")
        self.entities = read_entities(root, self.values, self.doubts, centred=is_carla)
        self.places = PositionReader(
            self.values,
            self.graph,
            town=map_.town,
            shift=map_.shift,
            mirrored=is_carla,
            doubts=self.doubts,
            starts=self._starts(),
        )
        self.ego = next(entity for entity in self.entities.values() if entity.ego)

    def _starts(self) -> dict[str, Element]:
        """Return the position at the start of each entity that has one."""
        starts: dict[str, Element] = {}
        for private in self.root.iterfind("Storyboard/Init/Actions/Private"):
            position = private.find("PrivateAction/TeleportAction/Position")
            if position is not None:
                starts[private.get("entityRef", "")] = position
        for action in self.root.iter("EntityAction"):
            position = action.find("AddEntityAction/Position")
            if position is not None:
                starts.setdefault(action.get("entityRef", ""), position)
        return starts

    def _place(self) -> None:
        """Find the start of each entity: its position, or that of the trajectory that it begins with."""
        storyboard = StoryboardReader(
            self.root,
            self.places,
            self.entities,
            parameters=self.parameters,
            omissions=self.omissions,
            doubts=self.doubts,
            report=self.report,
        )
        self.storyboard = storyboard
        for private in self.root.iterfind("Storyboard/Init/Actions/Private"):
            name = private.get("entityRef", "")
            follow = private.find("PrivateAction/RoutingAction/FollowTrajectoryAction")
            if follow is None or name in self.places.starts or name not in self.entities:
                continue
            way = storyboard.find_trajectory(follow, replace(self.entities[name], placed=False))
            if way is not None:
                self.places.moved[name] = way.at(0.0)
        for entity in sorted(self.entities.values(), key=lambda entity: not entity.ego):
            entity.placed = entity.name in self.places.starts or entity.name in self.places.moved
            if not entity.placed and not entity.ego:
                self.doubts[f"'{entity.name}': it has no position at the start"] += 1
            if entity.placed:
                pose = self.places.start(entity.name, within=entity.element)
                element = self.places.starts.get(entity.name, entity.element)
                self.places.check_inside(entity.name, pose, within=element)
            if entity.ego and entity.placed and not self._has_way(entity):
                self._start_lane(pose)

    def _has_way(self, entity: Entity) -> bool:
        """Return whether an action at the start gives an entity a route or a trajectory."""
        privates = self.root.iterfind("Storyboard/Init/Actions/Private")
        return any(
            private.get("entityRef") == entity.name and private.find("PrivateAction/RoutingAction") is not None
            for private in privates
        )

    def _start_lane(self, start: Pose) -> LanePosition:
        """Return the lane on which the ego starts. RouteError if there is none."""
        place = self.places.lane_under(start)
        if place is None:
            source, line = getattr(self.ego.element, "source", ""), getattr(self.ego.element, "line", 0)
            raise RouteError(
                f"{source}:{line}: the ego '{self.ego.name}' does not stand on a road of '{self.town}' in the direction"
                " of its traffic"
            )
        return place

    def read(self, stem: str, suffix: str) -> Scenario:
        """Return the scenario, checked."""
        self._place()
        # As conditions count, only agents that are placed become actors.
        self.storyboard = StoryboardReader(
            self.root,
            self.places,
            self.entities,
            parameters=self.parameters,
            omissions=self.omissions,
            doubts=self.doubts,
            report=self.report,
        )
        forced_signals = self._signals()
        self.storyboard.read()
        limits = self._limits()
        if self.own_properties.get("contact") in ("end", "count", "remove"):
            limits = replace(limits, contact=self.own_properties["contact"])  # type: ignore[arg-type]
        speed = self.ego.target_speed or self.ego.speed or Scenario.target_speed
        key_points = self._ego_route(limits)
        ego_route = route_along(self.graph, key_points)
        start_pose = self._centre(self.ego, self.places.start(self.ego.name, within=self.ego.element))
        name = scenario_name(self.description.removeprefix("CARLA:")) or scenario_name(stem) or "imported"
        scenario = Scenario(
            name=name[: 120 - len(suffix)] + suffix,
            type="Custom",
            town=self.town,
            route=key_points,
            parameters=start_parameters(ego_route, start_pose, self.ego.speed, digits=6, report=self.report),
            limits=limits,
            target_speed=min(speed, MAX_SPEED),
            group=self.own_properties.get("group", ""),
            source=f"OpenSCENARIO {Path(self.values.location).name}",
            ego_model=self.ego.model,
            ego_body=self.ego.body,
            friction=self._friction(),
        )
        for entity in self.entities.values():
            entity.phases = self._with_meetings(entity, ego_route)
            self._name_late_phases(entity, min(limits.max_steps * STEP, limits.max_time))
        scenario = replace(scenario, actors=tuple(self._actors(limits)), signals=self._plan(ego_route, forced_signals))
        try:
            build_episode(scenario, self.graph, seed=0)
        except SSADError as error:
            raise type(error)(f"{self.values.location}: {error}") from None
        for message, times in self.omissions.items():
            self.report.omit(message, count=times)
        for message, times in self.doubts.items():
            self.report.doubt(message, count=times)
        return scenario

    def _name_late_phases(self, entity: Entity, end_time: float) -> None:
        """Add a doubt for each phase of an actor that begins after the end of the episode."""
        phases: list[Phase | LateralPhase] = [*entity.phases, *entity.lateral]
        for phase in phases:
            begin_time = earliest_time(phase.when)
            if begin_time > end_time and not entity.ego:
                event = f"event '{phase.name}'" if phase.name else "an event"
                self.doubts[
                    f"{event} of '{entity.name}' waits for {begin_time:g} s; the episode ends at {end_time:g} s"
                ] += 1

    def _centre(self, entity: Entity, pose: Pose) -> Pose:
        return move_pose(pose, *entity.centre) if any(entity.centre) else pose

    # ------------------------------------------------------------ the start

    def _signals(self) -> dict[str, str]:
        """Return the states of signals at the start by id, and by number for those that are not in the map."""
        assignments = (element.partition("=") for element in self.own_properties.get("signals", "").split())
        forced_signals = {f"ssad:{signal}": state for signal, _, state in assignments}
        for action in self.root.iterfind("Storyboard/Init/Actions/GlobalAction"):
            element = action.find("InfrastructureAction/TrafficSignalAction/TrafficSignalStateAction")
            if element is not None:
                forced_signals[self.values.text(element, "name")] = self.values.text(element, "state")
            elif (entity_action := action.find("EntityAction")) is not None:
                if entity_action.find("DeleteEntityAction") is not None:
                    self.storyboard.triggers.referenced_entity(entity_action).leaves = 0.0
            elif action.find(".//RoadCondition") is None or len(list(action.iter())) > 8:
                self.storyboard.record_action("at the start", action)
        for action in self.root.iterfind("Storyboard/Init/Actions/UserDefinedAction"):
            self.storyboard.record_action("at the start", action)
        return forced_signals

    def _friction(self) -> float:
        """Return the friction of the road: 0.9 times the scale that an environment at the start states."""
        friction = Scenario.friction
        for action in self.root.iterfind("Storyboard/Init/Actions/GlobalAction/EnvironmentAction"):
            condition = action.find(".//RoadCondition")
            if condition is not None and condition.get("frictionScaleFactor") is not None:
                scale = self.values.number(condition, "frictionScaleFactor")
                friction = min(max(Scenario.friction * scale, 0.05), 1.5)
        return friction

    # ------------------------------------------------------------ parts of the scenario

    def _limits(self) -> EpisodeLimits:
        limits = EpisodeLimits()
        groups = self.root.findall("Storyboard/StopTrigger/ConditionGroup")
        conditions = [condition for group in groups for condition in group]
        # A condition that must hold together with others says nothing of its own.
        alone = [group[0] for group in groups if len(group) == 1]
        times: list[float] = []
        for condition in conditions:
            name = condition.get("name", "")
            time_condition = condition.find("ByValueCondition/SimulationTimeCondition")
            distance_condition = condition.find("ByEntityCondition/EntityCondition/TraveledDistanceCondition")
            if time_condition is not None and condition in alone:
                value = self.values.number(time_condition, "value") + self.values.number(condition, "delay", 0.0)
                if name == "max_steps":
                    limits = replace(limits, max_steps=round(value / STEP))
                elif name == "max_time":
                    limits = replace(limits, max_time=value)
                else:
                    times.append(value)
            elif distance_condition is not None and condition in alone:
                limits = replace(limits, max_distance=max(self.values.number(distance_condition, "value"), 1.0))
            elif name != "end of the route" and condition.find(".//CollisionCondition") is None:
                condition_tags = [element.tag for element in condition.iter() if element.tag.endswith("Condition")]
                tag = condition_tags[-1] if condition_tags else "a condition"
                self.doubts[f"{tag} of the stop trigger is not carried over"] += 1
        if times:
            time = max(min(times), STEP)
            limits = replace(limits, max_time=time, max_steps=math.ceil(time / STEP))
        elif not any(condition.get("name") == "max_steps" for condition in conditions):
            limits = replace(limits, max_steps=round(DEFAULT_TIME / STEP))
        return limits

    def _way(self, speed: float, limits: EpisodeLimits) -> float:
        """Return the length of the path of an agent without a route, m."""
        time = min(limits.max_steps * STEP, limits.max_time)
        return min(max(1.1 * speed * time, WAY), LONGEST_WAY)

    def _ego_route(self, limits: EpisodeLimits) -> tuple[Pose, ...]:
        if not self.ego.placed:
            raise self.values.error(self.ego.element, f"entity '{self.ego.name}' has no position at the start")
        start = self.places.start(self.ego.name, within=self.ego.element)
        points = self.ego.route
        if not points and self.ego.path:
            first, trajectory = self.ego.path[0], self.ego.path
            begins_here = math.dist((first.x, first.y), (start.x, start.y)) < FAR_OFF
            points = self._along_trajectory(trajectory if begins_here else (start, *trajectory))
        if len(points) > 1:
            return self._from_start(points, start)
        start_lane = self._start_lane(start)
        if points:
            return (start, *points)
        way = self._way(max(self.ego.speed, self.ego.target_speed), limits)
        path = lane_path(self.graph, start_lane, way)
        if len(path) < 3:
            raise RouteError(f"{self.values.location}: the road ends before the ego '{self.ego.name}'")
        length = float(np.hypot(*np.diff(path, axis=0).T).sum())
        self.report.note("the ego has no route: it follows its lane", f"{length:.0f} m")
        count = max(9, int(len(path) * 9 / WAY))
        indices = np.unique(np.linspace(0, len(path) - 2, count).astype(int))
        key_points = path[indices]
        headings = np.arctan2(*(path[indices + 1] - key_points).T[::-1])
        return tuple(
            Pose(x, y, heading) for (x, y), heading in zip(key_points.tolist(), headings.tolist(), strict=True)
        )

    def _from_start(self, points: tuple[Pose, ...], start: Pose) -> tuple[Pose, ...]:
        """Return the key points of a route from where it passes the ego's start, which may lie far along it."""
        route = route_along(self.graph, points)
        distance = np.hypot(route.xy[:, 0] - start.x, route.xy[:, 1] - start.y)
        first = int(np.argmin(distance))
        if first * route.spacing <= MAX_EGO_LONGITUDINAL or distance[first] > FAR_OFF:
            return points
        nearest = [int(np.argmin(np.hypot(*(route.xy - (point.x, point.y)).T))) for point in points]
        later = [point for point, index in zip(points, nearest, strict=True) if index > first + 1]
        x, y = route.xy[first].tolist()
        return (Pose(x, y, float(route.yaw[first])), *(later or points[-1:]))

    def _along_trajectory(self, path: tuple[Pose, ...]) -> tuple[Pose, ...]:
        """Return key points of a route along the trajectory of the ego; () if the lanes do not allow it."""
        for count in (9, 5, 3, 2):
            indices = np.unique(np.linspace(0, len(path) - 1, count).astype(int))
            points = tuple(path[index] for index in indices.tolist())
            try:
                route = route_along(self.graph, points)
            except RouteError:
                continue
            if route.length < 1.5 * _length(path) + 20.0:
                return points
        self.doubts[f"the trajectory of the ego '{self.ego.name}', which the town's lanes do not allow"] += 1
        return ()

    def _with_meetings(self, entity: Entity, route: Route) -> list[Phase]:
        """Return the phases of an entity without meetings at points that the ego's route does not pass."""
        line = route.xy.astype(np.float64)
        phases = []
        for phase in entity.phases:
            arrival, carried_phase = phase.arrival, phase
            is_of_ego = arrival is not None and arrival.reference == "ego"
            if arrival is not None and is_of_ego and _distance(line, arrival.reference_point) > FAR_OFF:
                self.doubts[f"'{entity.name}' meets the ego at a point that its route does not pass"] += 1
                carried_phase = replace(phase, arrival=None, speed=phase.speed or entity.speed)
            phases.append(carried_phase)
        return phases

    def _actors(self, limits: EpisodeLimits) -> list[Actor]:
        end_time = min(limits.max_steps * STEP, limits.max_time)
        actors = [entity for entity in self.entities.values() if entity.placed and not entity.ego]
        actors = [entity for entity in actors if entity.leaves > 0.0]
        return [replace(self._actor(entity, end_time, limits), body=entity.body) for entity in actors]

    def _actor(self, entity: Entity, until: float, limits: EpisodeLimits) -> Actor:
        pose = self._centre(entity, self.places.start(entity.name, within=entity.element))
        if entity.rows:
            return self._on_trajectory(entity, pose, until)
        moves = bool(entity.speed or entity.phases or entity.lateral or entity.policy)
        if not moves and (entity.appears > 0.0 or math.isfinite(entity.leaves)):
            entity.rows = ((entity.appears, pose.x, pose.y, pose.yaw), (until + 1.0, pose.x, pose.y, pose.yaw))
            return self._on_trajectory(entity, pose, until)
        if math.isfinite(entity.leaves):
            self.doubts[f"DeleteEntityAction of '{entity.name}': it stays"] += 1
        if entity.appears > 0.0:
            self.doubts[f"AddEntityAction of '{entity.name}': it is there from the start"] += 1
        model = MODELS[entity.model]
        if model.max_speed == 0.0:
            if moves or entity.path:
                self.doubts[f"what '{entity.name}' does: a {entity.model} stands still"] += 1
            return Actor(entity.name, entity.model, pose)
        if entity.policy:
            path = tuple((point.x, point.y) for point in entity.route) if len(entity.route) > 1 else ()
            speed = min(max(entity.target_speed, 0.1), entity.max_speed)
            return Actor(entity.name, entity.model, pose, path=path, policy=entity.policy, target_speed=speed)
        path = self._path(entity, pose, limits) if moves else ()
        return Actor(
            entity.name,
            entity.model,
            pose,
            phases=self._with_own_meetings(entity, pose, path),
            lateral=tuple(entity.lateral),
            path=path,
            speed=min(entity.speed, entity.max_speed),
        )

    def _with_own_meetings(
        self, entity: Entity, pose: Pose, path: tuple[tuple[float, float], ...]
    ) -> tuple[Phase, ...]:
        """Return the phases of an entity without meetings at points that its own path does not pass."""
        ahead = move_pose(pose, LONGEST_WAY, 0.0)
        line = np.array(path if len(path) > 1 else ((pose.x, pose.y), (ahead.x, ahead.y)))
        phases = []
        for phase in entity.phases:
            carried_phase = phase
            if phase.arrival is not None and _distance(line, phase.arrival.point) > FAR_OFF:
                self.doubts[f"'{entity.name}' meets another at a point that its path does not pass"] += 1
                carried_phase = replace(phase, arrival=None, speed=phase.speed or entity.speed)
            phases.append(carried_phase)
        return tuple(phases)

    def _on_trajectory(self, entity: Entity, pose: Pose, until: float) -> Actor:
        """Return an actor that follows the trajectory of an entity."""
        rows = [row for row in entity.rows if entity.appears - 1e-9 <= row[0] <= entity.leaves] or list(entity.rows)
        if rows[0][0] > 0.0 and entity.appears == 0.0 and entity.name in self.places.starts:
            rows.insert(0, (0.0, pose.x, pose.y, pose.yaw))  # it waits where it was placed, or drives from there
        if math.isfinite(entity.leaves) and rows[-1][0] < entity.leaves < until:
            rows.append((entity.leaves, *rows[-1][1:]))
        elif rows[-1][0] < min(until, entity.leaves):
            rows.append((until + 1.0, *rows[-1][1:]))  # it stays at the end of its trajectory
        if entity.phases or entity.lateral:
            self.doubts[f"speeds and lanes of '{entity.name}': its trajectory has times"] += 1
        rows = [row for index, row in enumerate(rows) if index == 0 or row[0] > rows[index - 1][0]]
        if len(rows) < 2:
            rows.append((rows[0][0] + STEP, *rows[0][1:]))
        return Actor(entity.name, entity.model, Pose(*rows[0][1:]), trajectory=tuple(rows))

    def _path(self, entity: Entity, pose: Pose, limits: EpisodeLimits) -> tuple[tuple[float, float], ...]:
        """Return the path of an actor: from the file, else its lane; () is straight on."""
        if entity.path:
            if _is_straight(entity.path) and not entity.lateral:
                return ()
            points = list(entity.path)
            if math.dist((pose.x, pose.y), (points[0].x, points[0].y)) > 1.0:
                points.insert(0, pose)
            return tuple((point.x, point.y) for point in points)
        if entity.model == "walker" or MODELS[entity.model].wheelbase == 0.0:
            points = [pose, *entity.route] if len(entity.route) == 1 else list(entity.route)
            return tuple((point.x, point.y) for point in points)
        if entity.route:
            points = [pose, *entity.route] if len(entity.route) == 1 else list(entity.route)
            try:
                return tuple((x, y) for x, y in route_along(self.graph, points).xy.tolist())
            except RouteError:
                self.doubts[f"the route of '{entity.name}', which the town's lanes do not allow"] += 1
        place = self.places.lane_under(pose)
        if place is None:
            return ()
        fastest = max([entity.speed, *(phase.speed or 0.0 for phase in entity.phases)])
        if any(phase.reference or phase.arrival or phase.gap for phase in entity.phases):
            fastest = max(fastest, self.ego.speed + 10.0)
        lane_points = lane_path(self.graph, place, self._way(fastest, limits))
        start_offset = -math.sin(pose.yaw) * (pose.x - lane_points[0, 0]) + math.cos(pose.yaw) * (
            pose.y - lane_points[0, 1]
        )
        arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane_points, axis=0).T))])
        distances = np.arange(0.0, arc_lengths[-1], 1.0)
        if len(distances) < 2:
            return ()
        resampled = np.stack([np.interp(distances, arc_lengths, lane_points[:, axis]) for axis in range(2)], 1)
        tangents = np.gradient(resampled, axis=0)
        normals = np.stack([-tangents[:, 1], tangents[:, 0]], 1) / np.hypot(*tangents.T)[:, None]
        return tuple((x, y) for x, y in (resampled + start_offset * normals).tolist())

    def _plan(self, line: Route, forced: dict[str, str]) -> SignalPlan:
        """Return the plan that forces just these signals; what no plan does is lost."""
        if not forced:
            return SignalPlan()
        signal_numbers = {name: signal for signal, name in town_signals(self.town).items()}
        signal_numbers |= {f"ssad:{signal}": signal for signal in np.flatnonzero(self.graph.signal_virtual).tolist()}
        forced_states: dict[int, SignalState] = {}
        for name, state_name in forced.items():
            state = next(
                (candidate for candidate in SignalState if candidate.name.lower() == state_name.strip().lower()), None
            )
            if state is None or name not in signal_numbers:
                self.doubts[f"state '{state_name[:40]}' of signal '{name[:40]}'"] += 1
            else:
                forced_states[signal_numbers[name]] = state
        end_time = 60.0
        if "signals_until" in self.own_properties:
            try:
                end_time = float(self.own_properties["signals_until"])
            except ValueError:
                raise self.values.error("Property", "ssad.signals_until is not a number") from None
        plan = plan_of(self.graph, line, forced_states, end_time)
        if plan is None:
            self.doubts[f"the states of {counted(len(forced_states), 'signal')}, which no signal plan here gives"] += 1
        return plan or SignalPlan()


def _distance(line: F64, point: tuple[float, float]) -> float:
    """Return the distance of a point from a polyline [n, 2], m."""
    start, step = line[:-1], np.diff(line, axis=0)
    share = np.clip(((point - start) * step).sum(1) / np.maximum((step**2).sum(1), 1e-9), 0.0, 1.0)
    return float(np.hypot(*(start + share[:, None] * step - point).T).min())


def _length(points: tuple[Pose, ...]) -> float:
    """Return the length of a polyline, m."""
    return float(np.hypot(*np.diff([(point.x, point.y) for point in points], axis=0).T).sum())


def _is_straight(points: tuple[Pose, ...]) -> bool:
    """Return whether a path is two points, the second straight ahead of the first, which needs no path."""
    if len(points) != 2:
        return False
    start, end = points
    length = math.dist((start.x, start.y), (end.x, end.y))
    forward_distance = math.cos(start.yaw) * (end.x - start.x) + math.sin(start.yaw) * (end.y - start.y)
    return length > 0.0 and length - forward_distance < 1e-6

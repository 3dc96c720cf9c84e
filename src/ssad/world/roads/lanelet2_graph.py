"""Lane graph of a Lanelet2 map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import F32, LaneType
from ssad.world.roads import lanelet2_tags as tagging
from ssad.world.roads.graph_report import describe
from ssad.world.roads.lanelet2 import Lanelet2Options, LaneletMap, read_lanelet_map
from ssad.world.roads.lanelet2_lanes import LaneletLanes
from ssad.world.roads.lanelet2_signals import RuleReader


def bake_lanelet2(
    path: Path,
    name: str | None = None,
    *,
    options: Lanelet2Options | None = None,
    report: ImportReport | None = None,
) -> LaneGraph:
    """Return the lane graph of a Lanelet2 map.

    Args:
        path: The file, OSM XML.
        name: Name of the town; None: that of the file.
        options: Origin, projection and rule of the road.
        report: Filled with what came in, what was left out, and what is doubtful.

    Raises:
        MapError: The file is invalid.
    """
    account = ImportReport(str(path)) if report is None else report
    options = options or Lanelet2Options()
    # Numbers of a damaged file overflow; lanelets without a finite shape are left out.
    with np.errstate(all="ignore"):
        content = read_lanelet_map(path, options, account)
        lanes = LaneletLanes(path, content, options, account)
        return _graph(name or Path(path).stem, content, lanes, account)


def _graph(name: str, content: LaneletMap, lanes: LaneletLanes, report: ImportReport) -> LaneGraph:
    lanelets, count = lanes.lanelets, len(lanes.lanelets)
    allowed = not lanes.left_hand and lanes.country in tagging.RED_TURN_COUNTRIES
    report.contents.append(f"turns to the near side on red: {'' if allowed else 'not '}allowed")
    points = np.concatenate(lanes.lines).astype(np.float32)
    graph = LaneGraph(
        name=name,
        xy=points[:, :2],
        z=points[:, 2],
        yaw=np.asarray(wrap_angle(points[:, 4])),
        width=points[:, 3],
        s=points[:, 5],
        offset=np.cumsum([0, *map(len, lanes.lines)]),
        kind=np.array(lanes.kinds),
        road=lanes.road + 1,
        section=np.zeros(count, np.int32),
        lane_id=lanes.lane_id,
        junction=lanes.junction,
        speed_limit=_limits(content, lanes, report),
        left=lanes.left,
        right=lanes.right,
        left_marking=np.array([tagging.marking(lanelet.left, is_left=True) for lanelet in lanelets]),
        right_marking=np.array([tagging.marking(lanelet.right, is_left=False) for lanelet in lanelets]),
        succ_offset=np.cumsum([0, *map(len, lanes.successors)]),
        succ=np.array([row for followers in lanes.successors for row in followers], np.int32),
        crosswalk_offset=np.cumsum([0, *map(len, lanes.crosswalks)]),
        crosswalk_xy=np.concatenate([np.zeros((0, 2)), *lanes.crosswalks]),
        **RuleReader(content, lanes, report).arrays(),
        forward=lanes.forward,
        origin=np.array(content.origin),
        left_hand=np.array([lanes.left_hand]),
        turn_on_red=np.array([allowed]),
    )
    junctions = len(set(lanes.junction.tolist()) - {-1})
    describe(graph, f"{count + len(lanes.crosswalks)} lanelets, {junctions} junctions", report, lanes.place)
    return graph


def _limits(content: LaneletMap, lanes: LaneletLanes, report: ImportReport) -> F32:
    """Return the speed limit of each lane, m/s."""
    limits = np.zeros(len(lanes.lanelets), np.float32)
    without_limit = 0
    for row, lanelet in enumerate(lanes.lanelets):
        speed, unread = tagging.speed_limit(lanelet, content.rules, content.ways, lanes.country)
        for text in unread:
            report.doubt("a speed limit cannot be read", text)
        without_limit += speed is None and lanes.kinds[row] == LaneType.DRIVING
        limits[row] = tagging.statutory_speed(lanelet.tags, lanes.country) if speed is None else speed
    if without_limit:
        country = f"'{lanes.country}'" if lanes.country in tagging.TOWN_SPEEDS and lanes.country else "most of Europe"
        report.note(
            f"lanelets without a speed limit have that of their subtype and location in {country}",
            count=without_limit,
        )
    return limits

"""Contents and doubts of an imported lane graph."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import LaneType

BESIDE = 0.5  # m between the end of a lane and an unlinked start that is worth a word
SAME_WAY = 0.7  # cosine between two lanes of the same direction


def describe(graph: LaneGraph, roads: str, report: ImportReport, place: Callable[[int], str]) -> None:
    """Add to a report what a graph holds, and the lanes that end beside an unlinked start.

    Args:
        graph: The town.
        roads: Line on its roads.
        report: Takes the lines.
        place: Name of a lane in the file.
    """
    driving = graph.kind == LaneType.DRIVING
    others = [
        f"{count} {kind.name.lower()}"
        for kind in LaneType
        if kind not in (LaneType.DRIVING, LaneType.NONE) and (count := int((graph.kind == kind).sum()))
    ]
    kilometres = float(graph.length[driving].sum()) / 1000.0
    report.contents += [
        roads,
        f"{int(driving.sum())} drivable lanes of {kilometres:.2f} km{', ' if others else ''}{', '.join(others)}",
        f"{int((~graph.signal_virtual).sum())} traffic lights, {len(graph.sign_kind)} signs,"
        f" {len(graph.crosswalk_offset) - 1} crosswalks",
    ]
    lanes = np.flatnonzero(driving)
    starts = lanes[np.diff(graph.pred_offset)[lanes] == 0]
    if not len(starts):
        return
    start_points, end_points = graph.offset[:-1], graph.offset[1:] - 1
    from scipy.spatial import cKDTree  # every process loads towns, few import maps

    beside = cKDTree(graph.xy[start_points[starts]]).query_ball_point(graph.xy[end_points[lanes]], BESIDE)
    for lane, rows in zip(lanes.tolist(), beside, strict=True):
        for start in starts[rows].tolist():
            turn = float(graph.yaw[start_points[start]] - graph.yaw[end_points[lane]])
            if np.cos(turn) > SAME_WAY and start != lane:
                report.doubt("a lane ends beside an unlinked start", f"{place(lane)} beside {place(start)}")

"""The page of an imported map: its report, and a picture from above."""

from __future__ import annotations

import html
from pathlib import Path

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, LaneType

COLOURS = {
    LaneType.SHOULDER: "#c9c5bd",
    LaneType.SIDEWALK: "#dcd2c0",
    LaneType.PARKING: "#9fb4c7",
    LaneType.BIKING: "#b98f86",
    LaneType.MEDIAN: "#a9bfa0",
    LaneType.DRIVING: "#5d636b",
}
WIDTH = 1200  # pixels
MARGIN = 10.0  # m


def import_page_path(home: Path, town: str) -> Path:
    """Return the path of the page on the import of a town."""
    return Path(home) / "imports" / f"{town}.html"


def import_page(graph: LaneGraph, report: ImportReport) -> str:
    """Return an HTML page on an imported map."""
    lines = "\n".join(f"<li>{html.escape(line)}</li>" for line in report.lines(examples=None))
    key = ", ".join(
        f'<span style="background:{colour}">&emsp;</span> {kind.name.lower()}' for kind, colour in COLOURS.items()
    )
    title = html.escape(f"Import of {graph.name}")
    return (
        f'<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8"><title>{title}</title>'
        "<style>body{font-family:sans-serif;max-width:1240px;margin:2em auto}</style></head>\n"
        f"<body>\n<h1>{title}</h1>\n<ul>\n{lines}\n</ul>\n<p>{key}; wedges point with the traffic, red dots are"
        f" ends and blue dots starts of drivable lanes without a link.</p>\n{picture(graph)}\n</body>\n</html>\n"
    )


def picture(graph: LaneGraph) -> str:
    """Return an SVG of a town from above: lanes by kind, the direction of traffic, and unlinked ends and starts."""
    xy = graph.xy.astype(np.float64)
    low, high = xy.min(axis=0) - MARGIN, xy.max(axis=0) + MARGIN
    size, corner = high - low, np.array([low[0], high[1]])
    pixel = float(size.max()) / WIDTH
    parts = []
    for kind, colour in COLOURS.items():
        data = " ".join(_path(_outline(graph, lane) - corner) for lane in np.flatnonzero(graph.kind == kind).tolist())
        if data:
            parts.append(f'<path fill="{colour}" stroke="#fff" stroke-width="{0.3 * pixel:.3f}" d="{data}"/>')
    driving = np.flatnonzero(graph.kind == LaneType.DRIVING)
    wedge = max(0.8, 3.0 * pixel)
    wedges = [_wedge(graph, lane, wedge) for lane in driving.tolist()]
    parts.append(f'<path fill="#fff" d="{" ".join(_path(shape - corner) for shape in wedges)}"/>')
    ends = driving[np.diff(graph.succ_offset)[driving] == 0]
    starts = driving[np.diff(graph.pred_offset)[driving] == 0]
    for lanes, points, colour in ((ends, graph.offset[1:] - 1, "#d22"), (starts, graph.offset[:-1], "#26c")):
        radius = max(0.8, 2.0 * pixel)
        for x, y in xy[points[lanes]].tolist():
            place = f'cx="{x - low[0]:.2f}" cy="{high[1] - y:.2f}" r="{radius:.2f}"'
            parts.append(f'<circle {place} fill="{colour}"/>')
    content = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{size[0] / pixel:.0f}" height="{size[1] / pixel:.0f}"'
        f' viewBox="0 0 {size[0]:.2f} {size[1]:.2f}">\n{content}\n</svg>'
    )


def _outline(graph: LaneGraph, lane: int) -> F64:
    """Return the corners [., 2] of the area of a lane."""
    part = graph.points(lane)
    yaw = graph.yaw[part].astype(np.float64)
    across = 0.5 * graph.width[part].astype(np.float64)[:, None] * np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    return np.concatenate([graph.xy[part] + across, (graph.xy[part] - across)[::-1]])


def _wedge(graph: LaneGraph, lane: int, size: float) -> F64:
    """Return a triangle [3, 2] in the middle of a lane that points with its traffic."""
    x, y, yaw, _ = graph.at(lane, 0.5 * float(graph.length[lane]))
    forward = size * np.array([np.cos(yaw), np.sin(yaw)])
    left = 0.5 * np.array([-forward[1], forward[0]])
    middle = np.array([x, y])
    return np.stack([middle + forward, middle - forward + left, middle - forward - left])


def _path(outline: F64) -> str:
    """Return the SVG path of a polygon [., 2] from the upper left corner; y points down in an SVG."""
    numbers = (outline * [1.0, -1.0]).ravel().tolist()
    return f"M{('%.2f,%.2f ' * len(outline) % tuple(numbers)).rstrip()}Z"

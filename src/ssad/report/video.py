"""Top-view videos of an episode: mp4 or GIF, in the colours of the page's replay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.safeio import atomic_path
from ssad.core.types import AgentKind, EpisodeTrace, LaneType
from ssad.report.lanes import LAYERS, junction_areas, strips

Frame = npt.NDArray[np.uint8]
GROUND, ROAD, WALK, EDGE = (231, 236, 226), (82, 86, 96), (196, 198, 194), (236, 236, 236)
EGO, CRASH, ROUTE = (37, 99, 235), (220, 38, 38), (96, 165, 250)
BODY = {
    AgentKind.WALKER: (219, 39, 119),
    AgentKind.BICYCLE: (5, 150, 105),
    AgentKind.MOTORCYCLE: (5, 150, 105),
    AgentKind.PROP: (120, 113, 108),
}
OTHER = (234, 138, 30)
LAMP = {1: (220, 38, 38), 2: (234, 179, 8), 3: (34, 197, 94)}
_SHIFT = 4  # OpenCV draws at 1/16 pixel


class _Canvas:
    """World metres to pixels around a moving centre; colours are RGB."""

    def __init__(self, size: tuple[int, int], scale: float, centre: tuple[float, float]) -> None:
        self.image: Frame = np.full((size[1], size[0], 3), GROUND, np.uint8)
        self.size, self.scale, self.centre = size, scale, centre

    def points(self, xy: npt.ArrayLike) -> npt.NDArray[np.int32]:
        p = (np.asarray(xy, np.float64) - self.centre) * (self.scale, -self.scale)
        p += (self.size[0] / 2, self.size[1] / 2)
        return np.round(p * (1 << _SHIFT)).astype(np.int32)

    def fill(self, xy: npt.ArrayLike, colour: tuple[int, int, int]) -> None:
        cv2.fillPoly(self.image, [self.points(xy)], colour, cv2.LINE_AA, _SHIFT)

    def line(self, xy: npt.ArrayLike, colour: tuple[int, int, int], width: int, closed: bool = False) -> None:
        cv2.polylines(self.image, [self.points(xy)], closed, colour, width, cv2.LINE_AA, _SHIFT)

    def disc(self, x: float, y: float, radius: float, colour: tuple[int, int, int], width: int = -1) -> None:
        px, py = self.points([[x, y]])[0]
        cv2.circle(
            self.image,
            (int(px), int(py)),
            round(radius * self.scale * (1 << _SHIFT)),
            colour,
            width,
            cv2.LINE_AA,
            _SHIFT,
        )

    def text(self, place: tuple[int, int], words: str, size: float = 0.5) -> None:
        for colour, width in (((255, 255, 255), 4), ((30, 41, 59), 1)):
            cv2.putText(self.image, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, width, cv2.LINE_AA)


def box_corners(x: float, y: float, yaw: float, length: float, width: float) -> npt.NDArray[np.float64]:
    """Corners [4, 2] of an oriented box."""
    c, s = np.cos(yaw), np.sin(yaw)
    local = 0.5 * np.array([[length, width], [length, -width], [-length, -width], [-length, width]])
    out: npt.NDArray[np.float64] = local @ np.array([[c, s], [-s, c]]) + (x, y)
    return out


def frames(trace: EpisodeTrace, graph: LaneGraph, *, size: tuple[int, int] = (960, 540)) -> Iterator[Frame]:
    """RGB frames [H, W, 3], one a step, the camera following the ego from above."""
    lanes = strips(graph)
    areas = junction_areas(graph, lanes)
    scale = size[0] / 90.0
    reach = 0.6 * max(size) / scale
    first_hit = next(iter(np.flatnonzero(trace.contact)), None)
    for t in range(len(trace.accel)):
        centre = (float(trace.x[t, 0]), float(trace.y[t, 0]))
        canvas = _Canvas(size, scale, centre)
        for area in areas:
            canvas.fill(area, ROAD)
        for lane in lanes:
            ring = lane.ring
            low, high = ring.min(axis=0), ring.max(axis=0)
            if (low > np.add(centre, reach)).any() or (high < np.subtract(centre, reach)).any():
                continue
            canvas.fill(ring, WALK if lane.layer == 0 else ROAD)
            if lane.layer == LAYERS[LaneType.DRIVING] and not lane.junction:
                canvas.line(lane.left, EDGE, 1)
                canvas.line(lane.right, EDGE, 1)
        canvas.line(trace.route, ROUTE, 2)
        _signals(canvas, trace, graph, t)
        for a in range(len(trace.names) - 1, -1, -1):
            if trace.active[t, a]:
                _agent(canvas, trace, t, a)
        if first_hit is not None and t >= first_hit:
            canvas.disc(centre[0], centre[1], 4.0 + 0.3 * min(t - int(first_hit), 6), CRASH, 3)
        words = f"{t * trace.dt:5.1f} s   {trace.speed[t, 0]:5.1f} m/s   route {trace.route_complete[t]:3.0f} %"
        canvas.text((14, 28), words, 0.6)
        if t == len(trace.accel) - 1:
            canvas.text((14, 56), trace.end.replace("_", " "), 0.6)
        yield canvas.image


def _signals(canvas: _Canvas, trace: EpisodeTrace, graph: LaneGraph, t: int) -> None:
    for s, index in enumerate(trace.signal_ids):
        colour = LAMP.get(int(trace.signal[t, s]))
        if colour is not None:
            x, y = (float(v) for v in graph.signal_xy[index])
            canvas.disc(x, y, 0.9, (30, 30, 30))
            canvas.disc(x, y, 0.65, colour)


def _agent(canvas: _Canvas, trace: EpisodeTrace, t: int, a: int) -> None:
    kind = AgentKind(int(trace.kind[a]))
    colour = EGO if a == 0 else BODY.get(kind, OTHER)
    x, y, yaw = float(trace.x[t, a]), float(trace.y[t, a]), float(trace.yaw[t, a])
    length, width = float(trace.length[a]), float(trace.width[a])
    if a == 0:
        past = np.stack([trace.x[max(t - 30, 0) : t + 1, 0], trace.y[max(t - 30, 0) : t + 1, 0]], 1)
        if len(past) > 1:
            canvas.line(past, EGO, 3)
    body = box_corners(x, y, yaw, length, width)
    canvas.fill(body, colour)
    canvas.line(body, (255, 255, 255), 1, closed=True)
    if kind not in (AgentKind.WALKER, AgentKind.PROP):
        tip = box_corners(
            x + 0.28 * length * np.cos(yaw), y + 0.28 * length * np.sin(yaw), yaw, 0.12 * length, 0.8 * width
        )
        canvas.fill(tip, (226, 232, 240))


def write_video(trace: EpisodeTrace, graph: LaneGraph, path: Path | str) -> Path:
    """Write the episode as .mp4 (10 frames a second) or .gif (every second frame), whole or not at all.

    ConfigError for another suffix or when no encoder answers; StoreError for a folder that cannot be written.
    """
    path = Path(path)
    if path.suffix == ".gif":
        return save_frames(frames(trace, graph, size=(640, 360)), path, dt=trace.dt)
    return save_frames(frames(trace, graph), path, dt=trace.dt)


def save_frames(shown: Iterable[Frame], path: Path, *, dt: float) -> Path:
    """Write frames as .mp4 or .gif (every second frame), whole or not at all.

    Args:
        shown: RGB, uint8 [H, W, 3], one size.
        path: Where to.
        dt: From one frame to the next, s.

    Raises:
        ConfigError: Another suffix, no frames, or no encoder answers.
        StoreError: The folder cannot be written.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ConfigError(f"{path}: a video is .mp4 or .gif")
    with atomic_path(path) as temporary:
        (_mp4 if path.suffix == ".mp4" else _gif)(iter(shown), temporary, dt)
    return path


def _mp4(shown: Iterator[Frame], path: Path, dt: float) -> None:
    first = next(shown, None)
    if first is None:
        raise ConfigError(f"{path}: a video without frames")
    size = first.shape[1], first.shape[0]
    code: Any = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), code, round(1.0 / dt), size)
    if not writer.isOpened():
        raise ConfigError(f"{path}: OpenCV has no mp4 encoder here; write a .gif")
    try:
        for frame in chain([first], shown):
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    finally:
        writer.release()


def _gif(shown: Iterator[Frame], path: Path, dt: float) -> None:
    pictures = [Image.fromarray(f).quantize(64) for k, f in enumerate(shown) if k % 2 == 0]
    if not pictures:
        raise ConfigError(f"{path}: a video without frames")
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(2000 * dt), loop=0, optimize=False)

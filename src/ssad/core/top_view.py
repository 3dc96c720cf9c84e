"""Top view of an episode, step by step, for videos, environments and windows, in the colours of the replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ssad.core.geometry import corners
from ssad.core.lane_graph import LaneGraph
from ssad.core.lane_strips import LAYERS, junction_areas, make_lane_strips
from ssad.core.types import AgentKind, Bool, LaneType

Frame = npt.NDArray[np.uint8]
GROUND, ROAD, SIDEWALK, EDGE = (231, 236, 226), (82, 86, 96), (196, 198, 194), (236, 236, 236)
EGO, CONTACT, ROUTE = (37, 99, 235), (220, 38, 38), (96, 165, 250)
BODY = {
    AgentKind.WALKER: (219, 39, 119),
    AgentKind.BICYCLE: (5, 150, 105),
    AgentKind.MOTORCYCLE: (5, 150, 105),
    AgentKind.PROP: (120, 113, 108),
}
VEHICLE = (234, 138, 30)
LAMP = {1: (220, 38, 38), 2: (234, 179, 8), 3: (34, 197, 94)}
INDICATOR = (251, 191, 36)
FLASHES = 1.5  # flashes of turn signals a second: 90 +- 30 a minute (Swiss VTS, article 79; UN Regulation 48)
_SHIFT = 4  # OpenCV draws at 1/16 pixel


class _Canvas:
    """Maps world metres to pixels around a moving centre; colours are RGB."""

    def __init__(self, size: tuple[int, int], scale: float, centre: tuple[float, float]) -> None:
        self.image: Frame = np.full((size[1], size[0], 3), GROUND, np.uint8)
        self.size, self.scale, self.centre = size, scale, centre

    def points(self, xy: npt.ArrayLike) -> npt.NDArray[np.int32]:
        # y is flipped: image rows grow downwards, north is up.
        pixels = (np.asarray(xy, np.float64) - self.centre) * (self.scale, -self.scale)
        pixels += (self.size[0] / 2, self.size[1] / 2)
        return np.round(pixels * (1 << _SHIFT)).astype(np.int32)

    def fill(self, xy: npt.ArrayLike, colour: tuple[int, int, int]) -> None:
        cv2.fillPoly(self.image, [self.points(xy)], colour, cv2.LINE_AA, _SHIFT)

    def line(self, xy: npt.ArrayLike, colour: tuple[int, int, int], width: int, closed: bool = False) -> None:
        cv2.polylines(self.image, [self.points(xy)], closed, colour, width, cv2.LINE_AA, _SHIFT)

    def disc(self, x: float, y: float, radius: float, colour: tuple[int, int, int], width: int = -1) -> None:
        pixel_x, pixel_y = self.points([[x, y]])[0]
        cv2.circle(
            self.image,
            (int(pixel_x), int(pixel_y)),
            round(radius * self.scale * (1 << _SHIFT)),
            colour,
            width,
            cv2.LINE_AA,
            _SHIFT,
        )

    def text(self, position: tuple[int, int], caption: str, size: float = 0.5) -> None:
        (width, height), baseline = cv2.getTextSize(caption, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
        corner, opposite = (
            (position[0] - 5, position[1] - height - 5),
            (position[0] + width + 5, position[1] + baseline + 3),
        )
        cv2.rectangle(self.image, corner, opposite, (255, 255, 255), -1)
        cv2.putText(self.image, caption, position, cv2.FONT_HERSHEY_SIMPLEX, size, (30, 41, 59), 1, cv2.LINE_AA)


@dataclass(frozen=True, slots=True)
class TopViewScene:
    """Content of one top view; agent 0 is the ego.

    Attributes:
        pose: [A, 3] x, y (m) and yaw (rad) of the centres of the bodies.
        size: [A, 2] length and width, m.
        kind: [A] `ssad.core.types.AgentKind`.
        active: [A] whether the agent is present.
        route: The ego's route [N, 2], m.
        past: Recent positions of the ego [N, 2], m.
        lamps: x, y (m) and `ssad.core.types.SignalState` of traffic lights.
        hit: Steps since the ego's first contact; None without one.
        words: Lines in the upper left corner.
        turn_signal: `ssad.core.types.TurnSignal` of the agents whose lamp is lit at this moment [A]; None: no lamps.
    """

    pose: npt.NDArray[np.floating]
    size: npt.NDArray[np.floating]
    kind: npt.NDArray[np.integer]
    active: Bool
    route: npt.NDArray[np.floating]
    past: npt.NDArray[np.floating]
    lamps: Sequence[tuple[float, float, int]] = ()
    hit: int | None = None
    words: Sequence[str] = ()
    turn_signal: npt.NDArray[np.integer] | None = None


def lit_turn_signals(turn_signal: npt.NDArray[np.integer], time: float) -> npt.NDArray[np.integer]:
    """Return the turn signals [A] at a time (s): dark in the second half of each flash."""
    is_lit = int(2.0 * FLASHES * time + 1e-6) % 2 == 0
    return turn_signal if is_lit else np.zeros_like(turn_signal)


class TopView:
    """Draws top views of a town; the roads are prepared once.

    Args:
        graph: The town.
        size: Width and height of a frame, pixels.
        visible_width: Width of the visible area, m.
    """

    def __init__(self, graph: LaneGraph, *, size: tuple[int, int] = (960, 540), visible_width: float = 90.0) -> None:
        self.lanes = make_lane_strips(graph)
        self.areas = junction_areas(graph, self.lanes)
        self.size, self.scale = size, size[0] / visible_width

    def draw(self, scene: TopViewScene) -> Frame:
        """Return an RGB image [H, W, 3] around the ego, north up."""
        centre = (float(scene.pose[0, 0]), float(scene.pose[0, 1]))
        canvas = _Canvas(self.size, self.scale, centre)
        view_radius = 0.6 * max(self.size) / self.scale
        for area in self.areas:
            canvas.fill(area, ROAD)
        for lane in self.lanes:
            ring = lane.outline
            lower, upper = ring.min(axis=0), ring.max(axis=0)
            if (lower > np.add(centre, view_radius)).any() or (upper < np.subtract(centre, view_radius)).any():
                continue
            canvas.fill(ring, SIDEWALK if lane.layer == 0 else ROAD)
            if lane.layer == LAYERS[LaneType.DRIVING] and not lane.junction:
                canvas.line(lane.left, EDGE, 1)
                canvas.line(lane.right, EDGE, 1)
        if len(scene.route) > 1:
            canvas.line(scene.route, ROUTE, 2)
        for x, y, state in scene.lamps:
            if state in LAMP:
                canvas.disc(x, y, 0.9, (30, 30, 30))
                canvas.disc(x, y, 0.65, LAMP[state])
        # In reverse, so that the ego is drawn last, above all others.
        for agent in reversed(range(len(scene.kind))):
            if scene.active[agent]:
                _agent(canvas, scene, agent)
        if scene.hit is not None:
            canvas.disc(*centre, 4.0 + 0.3 * min(scene.hit, 6), CONTACT, 3)
        for line, caption in enumerate(scene.words):
            canvas.text((14, 28 + 28 * line), caption, 0.6)
        return canvas.image


def _agent(canvas: _Canvas, scene: TopViewScene, agent: int) -> None:
    kind = AgentKind(int(scene.kind[agent]))
    x, y, yaw = (float(coordinate) for coordinate in scene.pose[agent])
    length, width = (float(coordinate) for coordinate in scene.size[agent])
    if agent == 0 and len(scene.past) > 1:
        canvas.line(scene.past, EGO, 3)
    body = corners(x, y, yaw, length, width)
    canvas.fill(body, EGO if agent == 0 else BODY.get(kind, VEHICLE))
    canvas.line(body, (255, 255, 255), 1, closed=True)
    if kind not in (AgentKind.WALKER, AgentKind.PROP):
        nose_offset = 0.28 * length
        nose = corners(x + nose_offset * np.cos(yaw), y + nose_offset * np.sin(yaw), yaw, 0.12 * length, 0.8 * width)
        canvas.fill(nose, (226, 232, 240))
    side = 0 if scene.turn_signal is None else int(scene.turn_signal[agent])
    if side:
        left = 0.5 * side * width
        for ahead in (0.5 * length, -0.5 * length):
            lamp_x, lamp_y = ahead * np.cos(yaw) - left * np.sin(yaw), ahead * np.sin(yaw) + left * np.cos(yaw)
            canvas.disc(x + lamp_x, y + lamp_y, 0.35, INDICATOR)

"""Cabins of cars behind their panes: seats, dashboard, steering wheel, the driver, and the light from beyond.

A pane is opaque to the visibility pass. So the cabin is drawn on it, a few millimetres in front, with the gloss of
glass: reflections continue over it, and it costs some dozens of triangles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssad.rendering.bodies.drape import Outline, Surface, ellipse, patches, rectangle, trapezoid
from ssad.rendering.bodies.parts import GLASS, both_sides
from ssad.rendering.bodies.shell import U1, U2, Shell, axle_x, sections
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point, part_of

BEYOND = replace(GLASS, colour=(0.085, 0.094, 0.102))  # the surroundings, through two panes
SEAT = replace(GLASS, colour=(0.010, 0.010, 0.011))
CLOTH = replace(GLASS, colour=(0.034, 0.034, 0.036))  # front of a seat, in the light of the windscreen
BOARD = replace(GLASS, colour=(0.007, 0.007, 0.008))
SKIN_TINTS = ((0.105, 0.072, 0.055), (0.080, 0.052, 0.038), (0.045, 0.028, 0.020))
SHIRT_TINTS = (
    (0.10, 0.10, 0.11),
    (0.02, 0.026, 0.05),
    (0.06, 0.014, 0.014),
    (0.010, 0.010, 0.011),
    (0.035, 0.05, 0.07),
)
SEAT_Y = 0.37  # m from the middle of the car to the middle of a front seat
LAYER = 0.003  # m between two layers on a pane


@dataclass(frozen=True, slots=True)
class DriverColours:
    """Colours of a driver as they look through a pane."""

    skin: Material
    shirt: Material

    @classmethod
    def from_share(cls, share: float) -> DriverColours:
        """Return the colours for a random share in [0, 1)."""
        skin = SKIN_TINTS[int(share * 1e3) % len(SKIN_TINTS)]
        shirt = SHIRT_TINTS[int(share * 1e4) % len(SHIRT_TINTS)]
        return cls(replace(GLASS, colour=skin), replace(GLASS, colour=shirt))


@dataclass(frozen=True, slots=True)
class Pane:
    """Pane ahead or behind: its lower and upper edge, and half its width at both, m."""

    low: float
    high: float
    low_width: float
    high_width: float

    def up(self, share: float) -> float:
        """Return the height at a share of the way from the lower to the upper edge, m."""
        return self.low + share * (self.high - self.low)

    def half_width(self, share: float) -> float:
        """Return half the width there, m."""
        return self.low_width + share * (self.high_width - self.low_width)

    def band(self, low: float, high: float, width: float) -> list[Outline]:
        """Return a strip across the pane; heights and width are shares of the pane's."""
        base, top = width * self.half_width(low), width * self.half_width(high)
        return trapezoid((-base, self.up(low)), (base, self.up(high)), (-top, top))


def cabin(shell: Shell, size: Point, body: Mesh, *, detail: int, driver: DriverColours | None) -> list[Mesh]:
    """Return the meshes on the panes of a car that show its cabin.

    Args:
        shell: Its shell.
        size: Length, width, height, m.
        body: The mesh of the shell.
        detail: 1 or 2.
        driver: Colours of the driver; None for a parked car.
    """
    is_glass = np.array([material == GLASS for material in body.materials])[body.material]
    panes = part_of(body, is_glass)
    return [
        *_behind(Surface(panes, "rear"), detail, driver),
        *_ahead(Surface(panes, "front"), detail, driver),
        *(both_sides(mesh) for mesh in _sides(shell, size, Surface(panes, "left"), detail, driver)),
    ]


def pane_of(surface: Surface) -> Pane | None:
    """Return the bounds of the panes of a surface ahead or behind; None without one."""
    pane_points = surface.corners.reshape(-1, 3)
    if not len(pane_points):
        return None
    heights, half_widths = pane_points[:, 2], np.abs(pane_points[:, 1])
    low, high = float(heights.min()), float(heights.max())
    is_low, is_high = heights < low + 0.2 * (high - low), heights > high - 0.2 * (high - low)
    return Pane(low, high, float(half_widths[is_low].max()), float(half_widths[is_high].max()))


def _behind(surface: Surface, detail: int, driver: DriverColours | None) -> list[Mesh]:
    """Rear window: headrests before the light of the windscreen."""
    window_pane = pane_of(surface)
    if window_pane is None:
        return []
    corner_count = 8 if detail == 2 else 6
    height = window_pane.high - window_pane.low
    head_size = min(0.10, 0.3 * height)
    rear_rests: list[Outline] = [
        ellipse((y, window_pane.up(0.36)), (0.13, head_size), corner_count) for y in (0.35, -0.35)
    ]
    front_rests: list[Outline] = [
        ellipse((y, window_pane.up(0.62)), (0.10, head_size), corner_count) for y in (SEAT_Y, -SEAT_Y)
    ]
    draped_pieces = [
        (window_pane.band(0.34, 0.93, 0.84), BEYOND, LAYER),
        (front_rests, SEAT, 2 * LAYER),
        ([*window_pane.band(0.04, 0.36, 0.90), *rear_rests], SEAT, 4 * LAYER),
    ]
    if detail == 2:
        draped_pieces.append((rectangle((-0.11, window_pane.up(0.84)), (0.11, window_pane.up(0.93))), SEAT, 2 * LAYER))
    if driver is not None:
        draped_pieces.append(
            ([ellipse((SEAT_Y, window_pane.up(0.66)), (0.075, 1.15 * head_size), corner_count)], driver.skin, 3 * LAYER)
        )
    return patches(surface, draped_pieces)


def _ahead(surface: Surface, detail: int, driver: DriverColours | None) -> list[Mesh]:
    """Windscreen: dashboard, seats and steering wheel before the light of the rear window."""
    window_pane = pane_of(surface)
    if window_pane is None:
        return []
    corner_count = 8 if detail == 2 else 6
    height = window_pane.high - window_pane.low
    seat_outlines: list[Outline] = []
    for y in (SEAT_Y, -SEAT_Y):
        seat_outlines += trapezoid(
            (y - 0.24, window_pane.up(0.10)), (y + 0.24, window_pane.up(0.50)), (y - 0.19, y + 0.19)
        )
        seat_outlines.append(ellipse((y, window_pane.up(0.62)), (0.12, min(0.09, 0.2 * height)), corner_count))
    draped_pieces = [
        (window_pane.band(0.46, 0.88, 0.66), BEYOND, LAYER),
        (seat_outlines, CLOTH, 2 * LAYER),
        (window_pane.band(0.02, 0.15, 0.92), BOARD, 4 * LAYER),
        (rectangle((-0.12, window_pane.up(0.84)), (0.12, window_pane.up(0.92))), BOARD, 4 * LAYER),
    ]
    if driver is not None:
        torso_outlines = trapezoid(
            (SEAT_Y - 0.23, window_pane.up(0.10)), (SEAT_Y + 0.23, window_pane.up(0.48)), (SEAT_Y - 0.15, SEAT_Y + 0.15)
        )
        face_outline = ellipse((SEAT_Y, window_pane.up(0.64)), (0.078, min(0.11, 0.25 * height)), corner_count)
        draped_pieces += [(torso_outlines, driver.shirt, 3 * LAYER), ([face_outline], driver.skin, 3 * LAYER)]
    if detail == 2:
        draped_pieces.append((_arc((SEAT_Y, window_pane.up(0.10)), (0.19, 0.32 * height), 0.026), BOARD, 5 * LAYER))
    return patches(surface, draped_pieces)


def _arc(middle: tuple[float, float], half: tuple[float, float], thickness: float) -> list[Outline]:
    """The upper half of a ring, as five quadrilaterals."""
    angles = np.linspace(0.0, np.pi, 6)
    outer = np.stack([middle[0] + half[0] * np.cos(angles), middle[1] + half[1] * np.sin(angles)], axis=1)
    inner_half = half[0] - thickness, half[1] - thickness
    inner = np.stack([middle[0] + inner_half[0] * np.cos(angles), middle[1] + inner_half[1] * np.sin(angles)], axis=1)
    return [
        [(float(x), float(z)) for x, z in (inner[index], outer[index], outer[index + 1], inner[index + 1])]
        for index in range(5)
    ]


def _sides(shell: Shell, size: Point, surface: Surface, detail: int, driver: DriverColours | None) -> list[Mesh]:
    """Side windows on the left: front seat and driver, rear seat, before the light of the windows opposite."""
    if not len(surface.corners):
        return []
    corner_count = 8 if detail == 2 else 6
    beyond_outlines: list[Outline] = []
    seat_outlines: list[Outline] = []
    head_outlines: list[Outline] = []
    torso_outlines: list[Outline] = []
    for index, (start, end) in enumerate(shell.windows):
        edges = window_edges(shell, size, start, end)
        if edges is None:
            continue
        front, rear = edges  # lower and upper point (x, z) of both edges

        def point(along: float, up: float, front: F64 = front, rear: F64 = rear) -> tuple[float, float]:
            """Return the point at shares of the way from the rear edge to the front edge, and from below."""
            lower, upper = rear[0] + along * (front[0] - rear[0]), rear[1] + along * (front[1] - rear[1])
            x, z = lower + up * (upper - lower)
            return float(x), float(z)

        window_length = float(front[0, 0] - rear[0, 0])
        if window_length < 0.15:
            continue
        beyond_outlines += [[point(0.05, 0.26), point(0.5, 0.26), point(0.5, 0.92), point(0.05, 0.92)]]
        beyond_outlines += [[point(0.5, 0.26), point(0.92, 0.26), point(0.92, 0.92), point(0.5, 0.92)]]
        if index > 1 or window_length < 0.5:
            continue
        # A seat back leans; its headrest lies 0.2 m ahead of the window's rear edge.
        seat_x = rear[0, 0] + 0.20
        seat_share = min(0.20 / window_length, 0.4)
        _, base = point(seat_share, 0.05)
        _, middle = point(seat_share, 0.46)
        _, top = point(seat_share, 0.62)
        seat_outlines.append(
            [(seat_x - 0.06, base), (seat_x + 0.16, base), (seat_x + 0.06, middle), (seat_x - 0.14, middle)]
        )
        seat_outlines.append(ellipse((seat_x - 0.05, top), (0.085, min(0.10, 0.35 * (middle - base))), corner_count))
        if index == 0 and driver is not None:
            _, head_middle = point(seat_share, 0.64)
            head_outlines.append(
                ellipse((seat_x + 0.10, head_middle), (0.095, min(0.12, 0.4 * (middle - base))), corner_count)
            )
            torso_outlines.append(
                [(seat_x - 0.04, base), (seat_x + 0.30, base), (seat_x + 0.18, middle), (seat_x + 0.02, middle)]
            )
    draped_pieces = [(beyond_outlines, BEYOND, LAYER), (seat_outlines, SEAT, 2 * LAYER)]
    if driver is not None:
        draped_pieces += [(torso_outlines, driver.shirt, 3 * LAYER), (head_outlines, driver.skin, 4 * LAYER)]
    return patches(surface, draped_pieces)


def window_edges(shell: Shell, size: Point, start: float, end: float) -> tuple[F64, F64] | None:
    """Return lower and upper end (x, z) of the front and the rear edge of a side window [2, 2], m; None without one."""
    half_sections = sections(shell, size, np.array([start, end]), detail=2)
    edges = half_sections[:, [U1, U2]][..., [0, 2]]
    edges[:, :, 0] = [[axle_x(shell, size, start)] * 2, [axle_x(shell, size, end)] * 2]
    if float((edges[:, 1, 1] - edges[:, 0, 1]).max()) < 0.05:
        return None
    return edges[0], edges[1]

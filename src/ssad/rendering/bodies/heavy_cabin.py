"""Cabs of trucks and interiors of buses behind their panes: drivers, passengers, seats, and the light from beyond.

They are drawn on the panes, as those of cars are (`ssad.rendering.bodies.cabin`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssad.core.seeding import generator
from ssad.rendering.bodies.cabin import (
    BEYOND,
    BOARD,
    CLOTH,
    LAYER,
    SEAT,
    DriverColours,
    pane_of,
    window_edges,
)
from ssad.rendering.bodies.drape import Outline, Piece, Surface, ellipse, patches, rectangle, trapezoid
from ssad.rendering.bodies.parts import GLASS
from ssad.rendering.bodies.shell import Shell, axle_x
from ssad.rendering.meshes.mesh import Mesh, Point, part_of

FAR_SIDE = replace(GLASS, colour=(0.060, 0.066, 0.072))  # windows of the other side, through a bus
HEAD = (0.085, 0.118)  # m, half width and half height of a head
SHOULDER = 0.23  # m, half width of the shoulders
SHOULDER_DROP = 0.145  # m from the middle of a head down to the shoulders
CAB_EYES = 0.56  # share of the height of a truck's windscreen: middle of the driver's head
BUS_EYES = 0.55  # share of a bus's height: middle of the driver's head
SEATED = {"city": 0.535, "bendy": 0.54, "coach": 0.655}  # share of a bus's height: heads of seated passengers
STANDING = 0.605  # share of a bus's height: heads of those who stand in a city bus
SEAT_PITCH = 0.80  # m between two rows of seats
OCCUPANCY = (0.15, 0.8)  # share of the seats with a passenger
STANDING_SHARE = 0.3  # of the places beside seats of a full city bus at which somebody stands


def truck_cab(shell: Shell, size: Point, body: Mesh, *, detail: int, share: float, has_driver: bool) -> list[Mesh]:
    """Return the meshes on the panes of a truck's cab: driver, seats, dashboard, and the window opposite.

    Args:
        shell: Shell of the cab.
        size: Length, width, height of the cab, m.
        body: The mesh of the shell.
        detail: 1 or 2.
        share: Random share in [0, 1) that picks the driver's colours.
        has_driver: Whether somebody drives.
    """
    driver = DriverColours.from_share(share) if has_driver else None
    panes = _panes(body)
    pieces: list[Piece] = []
    meshes: list[Mesh] = []
    front = Surface(panes, "front")
    windscreen = pane_of(front)
    corner_count = 8 if detail == 2 else 6
    if windscreen is not None:
        seat_y, eye_height = 0.56 * windscreen.half_width(0.5), windscreen.up(CAB_EYES)
        seats: list[Outline] = []
        for y in (seat_y, -seat_y):
            seats += _torso(y, eye_height, windscreen.up(0.06), width=SHOULDER + 0.02)
            seats.append(ellipse((y, eye_height + 0.02), (0.14, 0.15), corner_count))
        pieces += [
            (seats, CLOTH, LAYER),
            (windscreen.band(0.02, 0.13, 0.94), BOARD, 4 * LAYER),
        ]
        if driver is not None:
            pieces += _person(seat_y, eye_height, windscreen.up(0.06), driver, corner_count, lift=2 * LAYER)
        meshes += patches(front, pieces)
    edges = window_edges(shell, size, *shell.windows[0])
    if edges is None:
        return meshes
    front_edge, rear_edge = edges
    lower_edge, upper_edge = float(rear_edge[0, 1]), float(rear_edge[1, 1])
    seat_x = float(rear_edge[0, 0]) + 0.30
    eye_height = lower_edge + CAB_EYES * (upper_edge - lower_edge)
    beyond = rectangle(
        (float(rear_edge[0, 0]) + 0.08, lower_edge + 0.32 * (upper_edge - lower_edge)),
        (float(front_edge[0, 0]) - 0.12, lower_edge + 0.90 * (upper_edge - lower_edge)),
    )
    seat = _torso(seat_x - 0.10, eye_height, lower_edge, width=0.14)
    for view in ("left", "right"):
        side_pieces: list[Piece] = [(beyond, BEYOND, LAYER), (seat, SEAT, 2 * LAYER)]
        if driver is not None:
            side_pieces += _person(
                seat_x + 0.08, eye_height, lower_edge, driver, corner_count, lift=3 * LAYER, width=0.17
            )
        meshes += patches(Surface(panes, view), side_pieces)
    return meshes


def bus_interior(
    shell: Shell,
    size: Point,
    body: Mesh,
    style: str,
    share: float,
    *,
    detail: int,
    is_first: bool = True,
    has_driver: bool,
) -> list[Mesh]:
    """Return the meshes on the panes of a bus: driver, passengers, seats, and the windows of the other side.

    Args:
        shell: Its shell, or that of a section.
        size: Length, width, height of the section, m.
        body: The mesh of the shell.
        style: city, coach or bendy.
        share: Random share in [0, 1) that picks the people.
        detail: 1 or 2.
        is_first: Whether the section has the driver's place.
        has_driver: Whether there are people on the bus.
    """
    draws = generator("passengers", style, is_first, share)
    occupancy = float(draws.uniform(*OCCUPANCY)) if has_driver else 0.0
    panes = _panes(body)
    corner_count = 8 if detail == 2 else 6
    seated_height = SEATED[style] * size[2]
    meshes: list[Mesh] = []
    for view in ("left", "right"):
        # Doors have panes of their own on the right.
        doors = [(start, end) for _, start, end in shell.doors] if view == "right" else []
        pieces: list[Piece] = []
        for index, (start, end) in enumerate(shell.windows):
            edges = window_edges(shell, size, start, end)
            if edges is None or any(start < door_end and door_start < end for door_start, door_end in doors):
                continue
            front_edge, rear_edge = edges
            lower_edge, upper_edge = (
                float(max(front_edge[0, 1], rear_edge[0, 1])),
                float(min(front_edge[1, 1], rear_edge[1, 1])),
            )
            rear_x, front_x = axle_x(shell, size, end) + 0.05, axle_x(shell, size, start) - 0.05
            if upper_edge - lower_edge < 0.3 or front_x - rear_x < 0.3:
                continue
            pieces.append(
                (
                    rectangle(
                        (rear_x, lower_edge + 0.22 * (upper_edge - lower_edge)),
                        (front_x, lower_edge + 0.86 * (upper_edge - lower_edge)),
                    ),
                    FAR_SIDE,
                    LAYER,
                )
            )
            if is_first and index == 0:
                if has_driver:
                    driver = DriverColours.from_share(float(draws.random()))
                    middle = 0.5 * (rear_x + front_x)
                    pieces += _person(
                        middle, BUS_EYES * size[2], lower_edge, driver, corner_count, lift=4 * LAYER, width=0.17
                    )
                continue
            row_count = max(int((front_x - rear_x) / SEAT_PITCH), 1)
            for row in range(row_count):
                x = rear_x + (row + 0.5) * (front_x - rear_x) / row_count
                pieces.append((_torso(x - 0.22, seated_height - 0.06, lower_edge, width=0.06), SEAT, 3 * LAYER))
                standing_draw, sitting_draw, colour, offset = draws.random(4).tolist()
                people = DriverColours.from_share(colour)
                if style != "coach" and standing_draw < STANDING_SHARE * occupancy:
                    height = (STANDING + 0.03 * (offset - 0.5)) * size[2]
                    pieces += _person(x + 0.25, height, lower_edge, people, corner_count, lift=2 * LAYER)
                elif sitting_draw < occupancy:
                    height = seated_height + 0.10 * (offset - 0.5)
                    pieces += _person(x + 0.02, height, lower_edge, people, corner_count, lift=4 * LAYER, width=0.17)
        meshes += patches(Surface(panes, view), pieces)
    if is_first:
        meshes += _bus_front(panes, size, draws, occupancy=occupancy, corner_count=corner_count, has_driver=has_driver)
    return meshes


def _bus_front(
    panes: Mesh, size: Point, draws: np.random.Generator, *, occupancy: float, corner_count: int, has_driver: bool
) -> list[Mesh]:
    """Windscreen of a bus: dashboard and driver, passengers behind, before the light of the rear window."""
    surface = Surface(panes, "front")
    windscreen = pane_of(surface)
    if windscreen is None:
        return []
    seat_y, eye_height, base = 0.58 * windscreen.half_width(0.5), BUS_EYES * size[2], windscreen.up(0.05)
    pieces: list[Piece] = [
        (rectangle((-0.42, eye_height - 0.05), (0.42, eye_height + 0.38)), FAR_SIDE, LAYER),
        (windscreen.band(0.01, 0.10, 0.94), BOARD, 5 * LAYER),
    ]
    seats = [
        *_torso(seat_y, eye_height, base, width=SHOULDER + 0.02),
        ellipse((seat_y, eye_height + 0.02), (0.13, 0.15), corner_count),
    ]
    pieces.append((seats, CLOTH, 3 * LAYER))
    # Further back, passengers look smaller.
    for y in (-0.75, -0.42, 0.40):
        sitting_draw, colour, offset = draws.random(3).tolist()
        if sitting_draw < occupancy:
            people = DriverColours.from_share(colour)
            pieces += _person(
                y + 0.1 * (offset - 0.5),
                eye_height - 0.05,
                eye_height - 0.45,
                people,
                corner_count,
                lift=2 * LAYER,
                scale=0.7,
            )
    if has_driver:
        driver = DriverColours.from_share(float(draws.random()))
        pieces += _person(seat_y, eye_height, base, driver, corner_count, lift=4 * LAYER)
    return patches(surface, pieces)


def _panes(body: Mesh) -> Mesh:
    is_glass = np.array([material == GLASS for material in body.materials])[body.material]
    return part_of(body, is_glass)


def _torso(across: float, eye_height: float, lower_edge: float, *, width: float) -> list[Outline]:
    """Return shoulders and chest below a head, down to a height; nothing if they lie below it."""
    top = eye_height - SHOULDER_DROP
    if top < lower_edge + 0.02:
        return []
    return trapezoid(
        (across - width, lower_edge), (across + width, top), (across - 0.72 * width, across + 0.72 * width)
    )


def _person(
    across: float,
    eye_height: float,
    lower_edge: float,
    colours: DriverColours,
    corner_count: int,
    *,
    lift: float,
    width: float = SHOULDER,
    scale: float = 1.0,
) -> list[Piece]:
    """Return the pieces of a person: chest and head."""
    head = ellipse((across, eye_height), (scale * HEAD[0], scale * HEAD[1]), corner_count)
    return [
        (_torso(across, eye_height, lower_edge, width=scale * width), colours.shirt, lift),
        ([head], colours.skin, lift + 0.5 * LAYER),
    ]

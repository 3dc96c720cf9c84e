"""Trucks (box, flatbed, tractor, tipper), buses (city, coach, bendy) and trailers (box, flatbed, tank, utility)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssad.rendering.bodies.heavy_cabin import bus_interior, truck_cab
from ssad.rendering.bodies.parts import (
    BLINKER,
    CARGO,
    CHROME,
    DARK,
    FRAME,
    GLASS,
    HEAD,
    PAINT,
    PLATE,
    SOIL,
    STEEL,
    TAIL,
    TRIM,
    WOOD,
    Chart,
    assign_side_panels,
    both_sides,
    crate,
    crates,
    finish,
    shift_chart,
    side_charts,
    tubes,
    wheels,
)
from ssad.rendering.bodies.shell import S1, S2, S3, S4, Shell, axle_x, charts, shell_mesh
from ssad.rendering.meshes.mesh import Material, Mesh, Point, box, loft, merge, prism

_BLUNT = ((0.0, 0.93), (0.03, 0.985), (0.08, 1.0), (0.95, 1.0), (1.0, 0.98))
CAB = Shell(
    top=((0.0, 0.93), (0.06, 0.985), (0.25, 1.0), (1.0, 1.0)),
    belt=((0.0, 0.44), (0.3, 0.46), (1.0, 0.50)),
    plan=_BLUNT,
    cowl=0.0,
    screen=0.0,
    roof=1.0,
    deck=1.0,
    windows=((0.06, 0.62),),
    doors=(("front_door", 0.05, 0.72),),
    axles=(0.55, 0.55),
    radius=0.178,
    sill=0.19,
    tumble=0.06,
    body=1.0,
    nose=0.05,
    tail=0.01,
    lamps=(S1, S2),
    lamp_from=0.62,
    grille=(S3, S4),
    tail_lamps=(S4, S4),
    glass_gap=0.04,
    rear_window=False,
    wheel_width=0.3,
)
BUS = Shell(
    top=((0.0, 0.955), (0.012, 0.985), (0.04, 1.0), (0.97, 1.0), (1.0, 0.98)),
    belt=((0.0, 0.33), (0.04, 0.36), (0.09, 0.40), (1.0, 0.40)),
    plan=((0.0, 0.93), (0.01, 0.98), (0.03, 1.0), (0.97, 1.0), (1.0, 0.97)),
    cowl=0.0,
    screen=0.0,
    roof=1.0,
    deck=1.0,
    windows=(
        (0.012, 0.085),
        (0.095, 0.205),
        (0.213, 0.325),
        (0.333, 0.445),
        (0.453, 0.565),
        (0.573, 0.685),
        (0.693, 0.805),
        (0.813, 0.94),
    ),
    doors=(("front_door", 0.012, 0.090), ("rear_door", 0.452, 0.566)),
    axles=(0.225, 0.735),
    radius=0.146,
    sill=0.095,
    tumble=0.035,
    body=0.90,
    nose=0.018,
    tail=0.008,
    lamps=(S1, S3),
    lamp_from=0.62,
    tail_lamps=(S1, S4),
    tail_from=0.82,
    grille=(S4, S4),
    glass_gap=0.03,
    wheel_width=0.3,
)


def truck(style: str, size: Point, *, generator: np.random.Generator, detail: int, has_driver: bool = True) -> Mesh:
    """Return a truck of a style that fills its size, m: cab over the front axle, frame, and body or load.

    Its cab shows behind the panes; with `has_driver`, the driver does, too.
    """
    length, width, height = size
    cab_share, load_share = generator.random(2)
    cab_height = height * {"box": 0.78, "flatbed": 0.97, "tractor": 0.97, "tipper": 0.90}[style] - 0.08 * cab_share
    cab_length = min(2.35, 0.32 * length) * (1.0 + 0.1 * (cab_share - 0.5))
    cab_width = 0.92 * width
    cab_size = (cab_length, cab_width, cab_height)
    shell = replace(CAB, radius=min(0.50, 0.19 * cab_height) / cab_height)
    radius = shell.radius * cab_height
    cab_shift = 0.5 * (length - cab_length)
    cab_body = shell_mesh(shell, cab_size, detail=detail)
    cab_parts = [cab_body]
    if detail > 0:
        # The share of the cab also picks the driver: a truck takes the same number of draws with and without.
        cab_parts += truck_cab(shell, cab_size, cab_body, detail=detail, share=cab_share, has_driver=has_driver)
    parts = [part.moved(cab_shift) for part in cab_parts]
    panels = [shift_chart(chart, cab_shift) for chart in charts(shell, cab_size)]
    rear_x, cargo_front, deck_height = -0.5 * length, 0.5 * length - cab_length - 0.08, 2.05 * radius
    parts.append(crate((rear_x + 0.05, -0.42, 0.75 * radius), (cargo_front + 0.4, 0.42, deck_height), FRAME))
    front_axle = axle_x(shell, cab_size, 0.55) + cab_shift
    rear_axles = (
        [rear_x + 0.20 * length] if length < 8.0 and style != "tractor" else [rear_x + 1.0, rear_x + 1.0 + 2.3 * radius]
    )
    parts.append(wheels([(front_axle, 0.5 * cab_width - 0.01)], radius, 0.30, detail=detail, spokes=10, steel=STEEL))
    parts.append(
        wheels(
            [(position, 0.5 * cab_width - 0.03) for position in rear_axles],
            radius,
            0.55,
            detail=detail,
            spokes=10,
            steel=STEEL,
        )
    )
    parts += _cab_fittings(0.5 * length, size, cab_size, detail)
    half_width = 0.5 * width
    if style == "box":
        parts.append(_cargo((rear_x, -half_width, deck_height), (cargo_front, half_width, height)))
        panels += side_charts("cargo", (rear_x, -half_width, deck_height), (cargo_front, half_width, height))
        if detail > 0:
            parts.append(_doors(rear_x, half_width, deck_height, height))
        if detail == 2:
            parts.append(_ribs((rear_x, -half_width, deck_height), (cargo_front, half_width, height)))
    elif style == "flatbed":
        parts.append(
            crate((rear_x, -half_width, deck_height - 0.02), (cargo_front, half_width, deck_height + 0.14), WOOD)
        )
        parts.append(
            crate((cargo_front - 0.08, -half_width, deck_height), (cargo_front, half_width, deck_height + 0.9), STEEL)
        )
        if detail > 0:
            stakes = [
                crate(
                    (position, half_width - 0.05, deck_height), (position + 0.07, half_width, deck_height + 0.55), STEEL
                )
                for position in np.linspace(rear_x, cargo_front - 1.0, 5)
            ]
            parts.append(both_sides(merge(stakes)))
        if load_share > 0.4:
            upper_corner = (cargo_front - 0.5, 0.8 * half_width, min(height, deck_height + 1.4))
            parts += _load((rear_x + 0.4, -0.8 * half_width, deck_height + 0.14), upper_corner, generator=generator)
    elif style == "tractor":
        plate = prism(
            [(-0.55, -0.5), (0.55, -0.5), (0.55, 0.5), (-0.55, 0.5)], (deck_height, deck_height + 0.12), material=FRAME
        )
        parts.append(plate.moved(rear_axles[0] + 0.5))
        tanks = [(cargo_front - 0.9, half_width - 0.35, 0.62), (cargo_front - 2.1, half_width - 0.35, 0.62)]
        parts.append(tubes(tanks, 0.3, CHROME, 12))
        mudguard = (
            (rear_x, half_width - 0.62, 2.0 * radius + 0.03),
            (rear_axles[-1] + radius, half_width - 0.06, 2.0 * radius + 0.07),
        )
        parts.append(crates(*mudguard, TRIM))
        shield = [
            (cargo_front + 0.2, cab_height - 0.05),
            (0.5 * length - 0.35, cab_height - 0.05),
            (cargo_front + 0.2, height),
        ]
        parts.append(prism(shield, (-0.42 * cab_width, 0.42 * cab_width), axis=1, material=PAINT).with_panel("roof"))
    else:
        tub_height = min(height, deck_height + 1.35)
        lower_edge = [
            (rear_x, deck_height + 0.35),
            (rear_x + 0.5, deck_height + 0.05),
            (cargo_front, deck_height + 0.05),
        ]
        outline = [*lower_edge, (cargo_front, height), (cargo_front - 0.12, tub_height), (rear_x, tub_height)]
        tub = prism(outline, (-half_width, half_width), axis=1, material=PAINT)
        parts.append(assign_side_panels(tub, "cargo"))
        panels += side_charts("cargo", (rear_x, -half_width, deck_height), (cargo_front, half_width, height))
        parts.append(
            crate(
                (rear_x + 0.1, 0.1 - half_width, tub_height - 0.1),
                (cargo_front - 0.25, half_width - 0.1, tub_height + 0.02),
                SOIL,
            )
        )
        parts.append(
            crate(
                (cargo_front, -0.9 * half_width, height - 0.06), (cargo_front + 0.75, 0.9 * half_width, height), STEEL
            )
        )
        side_ribs = [
            crate(
                (position, half_width - 0.02, deck_height + 0.3),
                (position + 0.1, half_width + 0.03, tub_height - 0.02),
                STEEL,
            )
            for position in np.linspace(rear_x + 0.5, cargo_front - 0.5, 5)
        ]
        parts.append(both_sides(merge(side_ribs)))
    parts += _rear_fittings(rear_x, half_width, 0.95 * radius, detail)
    return finish(parts, panels, size)


def _cab_fittings(front: float, size: Point, cab: Point, detail: int) -> list[Mesh]:
    """Return mirrors, plate and indicators of a cab-over front."""
    half_width, half_cab_width = 0.5 * size[1], 0.5 * cab[1]
    mirror = crate(
        (front - 0.30, half_cab_width - 0.02, 0.56 * cab[2]), (front - 0.16, half_width, 0.80 * cab[2]), TRIM
    )
    parts = [both_sides(mirror)]
    if detail > 0:
        parts.append(_plate(front - 0.005, 0.29 * cab[2]))
        blinker = (front - 0.1, 0.43 * cab[1], 0.40 * cab[2]), (front - 0.05, 0.47 * cab[1], 0.44 * cab[2])
        parts.append(crates(*blinker, BLINKER))
        grille = (front - 0.1, -0.26 * cab[1], 0.25 * cab[2]), (front - 0.008, 0.26 * cab[1], 0.27 * cab[2])
        parts.append(crate(*grille, TRIM))
        surround = (front - 0.12, 0.29 * cab[1], 0.205 * cab[2]), (front - 0.012, 0.465 * cab[1], 0.305 * cab[2])
        parts.append(crates(*surround, TRIM))
    lamp = (front - 0.1, 0.31 * cab[1], 0.22 * cab[2]), (front - 0.005, 0.45 * cab[1], 0.29 * cab[2])
    parts.append(crates(*lamp, HEAD))
    return parts


def _rear_fittings(rear: float, half: float, z: float, detail: int) -> list[Mesh]:
    """Tail lamps, under-run bar, plate and mud flaps (which hide the lamps from the front)."""
    parts = [crates((rear, 0.62 * half, z), (rear + 0.06, 0.95 * half, z + 0.14), TAIL)]
    if detail > 0:
        parts.append(crate((rear + 0.03, -0.95 * half, z - 0.25), (rear + 0.12, 0.95 * half, z - 0.12), STEEL))
        parts.append(_plate(rear + 0.01, z + 0.07))
        mud_flap = (rear + 0.06, 0.60 * half, z - 0.35), (rear + 0.08, 0.97 * half, z + 0.15)
        parts.append(crates(*mud_flap, TRIM))
    return parts


def _doors(rear: float, half: float, low: float, high: float) -> Mesh:
    """Rear doors of a cargo box: the gap between them, their bars and hinges, marker lamps over them."""
    door_gap = crate((rear - 0.002, -0.012, low + 0.06), (rear + 0.01, 0.012, high - 0.06), TRIM)
    lock_rods = [
        crate((rear - 0.004, y * half, low + 0.05), (rear + 0.01, y * half + 0.03, high - 0.05), STEEL)
        for y in (0.16, 0.52)
    ]
    hinges = [
        crate((rear - 0.004, 0.86 * half, z), (rear + 0.01, 0.97 * half, z + 0.05), STEEL)
        for z in np.linspace(low + 0.2, high - 0.3, 3)
    ]
    marker = crate((rear - 0.004, 0.84 * half, high - 0.10), (rear + 0.01, 0.96 * half, high - 0.04), TAIL)
    return merge([door_gap, both_sides(merge([*lock_rods, *hinges, marker]))])


def _plate(x: float, z: float) -> Mesh:
    """Return a number plate."""
    return box((0.02, 0.52, 0.12), material=PLATE, centre=(x, 0.0, z))


def _cargo(low: Point, high: Point, material: Material = CARGO) -> Mesh:
    """Return a closed cargo box with panels on five sides."""
    return crate(low, high, material, {side: f"cargo_{side}" for side in ("front", "rear", "left", "right", "top")})


def _ribs(low: Point, high: Point) -> Mesh:
    """Return the metal edges of a cargo box, flush with its sides."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    edge_width = 0.07
    posts = [(x0, y1 - edge_width, z0, x0 + edge_width, y1, z1), (x1 - edge_width, y1 - edge_width, z0, x1, y1, z1)]
    rails = [(x0, y1 - edge_width, z, x1, y1, z + edge_width) for z in (z0, z1 - edge_width)]
    # m, keeps the ribs from coinciding with the sides
    overlap = 0.004
    edge_bars = [
        crate((x_start, y_start, z_start), (x_end, y_end + overlap, z_end), STEEL)
        for x_start, y_start, z_start, x_end, y_end, z_end in posts + rails
    ]
    cross_bars = [
        crate((x0 - overlap, y0, z), (x0 + edge_width, y1, z + edge_width), STEEL) for z in (z0, z1 - edge_width)
    ]
    return merge([both_sides(merge(edge_bars)), *cross_bars])


def _load(low: Point, high: Point, *, generator: np.random.Generator) -> list[Mesh]:
    """Return three loads on an open deck."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    shades = generator.uniform(0.06, 0.4, (3, 1)) * np.array([1.0, 0.85, 0.68]) ** generator.uniform(-0.6, 1.6, (3, 1))
    boundaries = np.linspace(x0, x1, 4)
    heights = z0 + (z1 - z0) * generator.uniform(0.5, 1.0, 3)
    return [
        crate(
            (start, y0, z0),
            (end - 0.15, y1, float(top)),
            Material(f"load_{index}", (float(rgb[0]), float(rgb[1]), float(rgb[2]))),
        )
        for index, (start, end, top, rgb) in enumerate(
            zip(boundaries[:-1], boundaries[1:], heights, shades, strict=True)
        )
    ]


def bus(style: str, size: Point, *, generator: np.random.Generator, detail: int, has_driver: bool = True) -> Mesh:
    """Return a bus of a style (city, coach, bendy) that fills its size, m. Passenger doors are on the right.

    Seats show behind the panes; with `has_driver`, the driver and passengers do, too.
    """
    length, width, height = size
    stripe_share = float(generator.random())
    if style == "bendy":
        return _bendy(size, detail, stripe_share, has_driver=has_driver)
    shell = (
        BUS
        if style == "city"
        else replace(
            BUS,
            belt=((0.0, 0.36), (0.05, 0.40), (0.10, 0.50), (1.0, 0.50)),
            sill=0.105,
            tail_from=0.8,
            top=((0.0, 0.93), (0.02, 0.985), (0.06, 1.0), (0.97, 1.0), (1.0, 0.97)),
        )
    )
    roof_share = 0.955 if style == "city" else 1.0
    body_size = (length, width, height * roof_share)
    parts = [shell_mesh(shell, body_size, detail=detail)]
    if detail > 0:
        parts += bus_interior(shell, body_size, parts[0], style, stripe_share, detail=detail, has_driver=has_driver)
    parts += _bus_fittings(shell, body_size, detail, rear=True)
    if style == "city":
        parts.append(crate((-0.12 * length, -0.3 * width, 0.94 * height), (0.16 * length, 0.3 * width, height), CARGO))
    if stripe_share > 0.5 and detail > 0:
        side_y = 0.5 * width * shell.body + 0.003
        band = (-0.44 * length, side_y - 0.02, 0.30 * height), (0.43 * length, side_y, 0.325 * height)
        parts.append(crates(*band, TRIM))
    return finish(parts, charts(shell, body_size), size)


def _bus_fittings(shell: Shell, size: Point, detail: int, *, rear: bool, front: bool = True) -> list[Mesh]:
    """Return wheels, doors, mirrors, destination sign and plate."""
    length, width, height = size
    radius, side_y = shell.radius * height, 0.5 * width * shell.body
    axles = dict.fromkeys(shell.axles)
    places = [(axle_x(shell, size, share), side_y - 0.02) for share in axles]
    parts = [wheels(places, radius, 0.30, detail=detail, spokes=10, steel=STEEL)]
    if detail > 0:
        for _, share, end_share in shell.doors:
            x1, x0 = axle_x(shell, size, share), axle_x(shell, size, end_share)
            door_middle = 0.5 * (x0 + x1)
            for leaf_start, leaf_end in ((x0 + 0.03, door_middle - 0.02), (door_middle + 0.02, x1 - 0.03)):
                parts.append(
                    crate(
                        (leaf_start, -side_y - 0.006, 0.11 * height), (leaf_end, -side_y + 0.15, 0.78 * height), GLASS
                    )
                )
    if front:
        x = 0.5 * length
        parts.append(crates((x - 0.15, side_y - 0.05, 0.56 * height), (x - 0.02, 0.5 * width, 0.72 * height), TRIM))
        if detail > 0:
            sign_board = crate(
                (x - 0.10, -0.62 * side_y, 0.875 * height), (x - 0.012, 0.62 * side_y, 0.945 * height), TRIM
            )
            amber = Material("sign_lamp", (0.55, 0.30, 0.03), emission=0.6)
            sign_text = crate(
                (x - 0.05, -0.45 * side_y, 0.895 * height), (x - 0.006, 0.35 * side_y, 0.925 * height), amber
            )
            parts += [sign_board, sign_text, _plate(x - 0.004, 0.16 * height)]
    if rear:
        x = -0.5 * length
        if detail > 0:
            parts.append(crate((x, -0.6 * side_y, 0.15 * height), (x + 0.08, 0.6 * side_y, 0.30 * height), TRIM))
        else:
            parts.append(crates((x, 0.75 * side_y, 0.2 * height), (x + 0.05, 0.97 * side_y, 0.3 * height), TAIL))
    if front and detail == 0:
        x = 0.5 * length
        parts.append(crates((x - 0.06, 0.62 * side_y, 0.15 * height), (x, 0.93 * side_y, 0.22 * height), HEAD))
    return parts


def _bendy(size: Point, detail: int, people_share: float, *, has_driver: bool) -> Mesh:
    """Return an articulated bus: two sections with bellows between them."""
    length, width, height = size
    front_length, rear_length, joint_length = 0.55 * length, 0.40 * length, 0.05 * length
    front_section = replace(BUS, axles=(0.25, 0.80), rear_window=False, tail_lamps=(S4, S4))
    rear_section = replace(
        BUS,
        windows=BUS.windows[1:],
        axles=(0.60, 0.60),
        lamps=(S4, S4),
        screen=0.03,
        cowl=0.0,
        plan=((0.0, 1.0), (0.97, 1.0), (1.0, 0.97)),
        top=((0.0, 1.0), (0.97, 1.0), (1.0, 0.98)),
        nose=0.002,
        belt=((0.0, 0.40), (1.0, 0.40)),
        doors=(("rear_door", 0.20, 0.37),),
    )
    parts: list[Mesh] = []
    panels: list[Chart] = []
    sections = (
        (front_section, front_length, 0.5 * (length - front_length), True),
        (rear_section, rear_length, -0.5 * (length - rear_length), False),
    )
    for shell, section_length, section_x, is_first in sections:
        section_size = (section_length, width, height)
        fittings = _bus_fittings(shell, section_size, detail, rear=not is_first, front=is_first)
        body = shell_mesh(shell, section_size, detail=detail)
        if detail > 0:
            fittings += bus_interior(
                shell,
                section_size,
                body,
                "bendy",
                people_share,
                detail=detail,
                is_first=is_first,
                has_driver=has_driver,
            )
        parts += [part.moved(section_x) for part in (body, *fittings)]
        for chart in charts(shell, section_size):
            panel_name, *part_names = chart.name.split("/")
            if not is_first and panel_name == "front":
                continue
            name = "/".join([panel_name if is_first or panel_name == "rear" else f"rear_{panel_name}", *part_names])
            panels.append(replace(shift_chart(chart, section_x), name=name))
    # The rear of the front section and the front of the rear section lie inside the joint.
    panels = [panel for panel in panels if panel.name != "rear" or panel.low[0] < -0.4 * length]
    front_mesh = parts[0]
    parts[0] = replace(front_mesh, panels=tuple("front" if panel == "rear" else panel for panel in front_mesh.panels))
    roof_index = next(
        part_index for part_index, part_mesh in enumerate(parts) if part_index > 0 and "roof" in part_mesh.panels
    )
    rear_mesh = parts[roof_index]
    names = tuple("rear" if panel in ("front", "rear") else f"rear_{panel}" for panel in rear_mesh.panels)
    parts[roof_index] = replace(rear_mesh, panels=names)
    x0, half_width = 0.5 * length - front_length - joint_length - 0.05, 0.5 * width * 0.86
    fold_count = 7 if detail == 2 else 3
    for fold_index in range(fold_count):
        fold_start = x0 + (joint_length + 0.1) * fold_index / fold_count
        parts.append(
            crate(
                (fold_start, -half_width, 0.12 * height),
                (fold_start + 0.7 * (joint_length + 0.1) / fold_count, half_width, 0.965 * height),
                TRIM,
            )
        )
    parts.append(
        crate(
            (x0, -0.97 * half_width, 0.14 * height), (x0 + joint_length + 0.1, 0.97 * half_width, 0.95 * height), DARK
        )
    )
    return finish(parts, panels, size)


def trailer(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a trailer of a style that fills its size, m. Its front is the end that couples to the tractor."""
    length, width, height = size
    half_width, front_x, rear_x = 0.5 * width, 0.5 * length, -0.5 * length
    load_share, cover_share = generator.random(2)
    is_utility = style == "utility"
    radius = 0.32 if is_utility else 0.5
    deck_height = 0.55 if is_utility else min(1.2, 0.36 * height)
    parts: list[Mesh] = []
    panels: list[Chart] = []
    if is_utility:
        box_top = 0.72 * height if cover_share < 0.5 else height
        box_front = front_x - 0.22 * length
        lower_corner, upper_corner = (rear_x, -half_width + 0.18, deck_height), (box_front, half_width - 0.18, box_top)
        parts.append(_cargo(lower_corner, upper_corner, PAINT))
        panels += side_charts("cargo", lower_corner, upper_corner)
        if cover_share < 0.5:
            interior = (
                (rear_x + 0.05, -half_width + 0.23, box_top - 0.02),
                (box_front - 0.05, half_width - 0.23, box_top + 0.005),
            )
            parts.append(crate(*interior, DARK))
            parts.append(
                crate((box_front - 0.05, -half_width + 0.2, box_top), (box_front, half_width - 0.2, height), STEEL)
            )
        drawbar = [(box_front - 0.2, 0.5 * half_width, deck_height - 0.05), (front_x - 0.05, 0.03, deck_height - 0.08)]
        parts.append(tubes(drawbar, 0.04, STEEL, 6))
        parts.append(crate((front_x - 0.12, -0.05, deck_height - 0.14), (front_x, 0.05, deck_height), STEEL))
        parts.append(crate((front_x - 0.35, -0.04, 0.0), (front_x - 0.28, 0.04, deck_height), STEEL))
        axle = rear_x + 0.42 * (box_front - rear_x)
        parts.append(wheels([(axle, half_width - 0.02)], radius, 0.16, detail=detail, steel=STEEL))
        mudguard = (axle - 0.40, half_width - 0.2, 2 * radius + 0.02), (axle + 0.40, half_width, 2 * radius + 0.06)
        parts.append(crates(*mudguard, TRIM))
        parts.append(
            crates(
                (rear_x - 0.006, 0.62 * half_width, deck_height + 0.02),
                (rear_x + 0.01, 0.80 * half_width, deck_height + 0.12),
                TAIL,
            )
        )
        if detail > 0:
            parts.append(_plate(rear_x + 0.004, deck_height + 0.09))
        return finish(parts, panels, size)
    axles = [rear_x + 0.12 * length + axle_index * 1.31 for axle_index in range(3 if length > 10.0 else 2)]
    parts.append(crate((rear_x + 0.1, -0.5, deck_height - 0.32), (front_x - 0.3, 0.5, deck_height), FRAME))
    places = [(position, half_width - 0.06) for position in axles]
    parts.append(wheels(places, radius, 0.40, detail=detail, spokes=10, rim=0.55, steel=STEEL))
    legs = (front_x - 0.27 * length, 0.5, 0.0), (front_x - 0.27 * length + 0.14, 0.65, deck_height - 0.05)
    parts.append(crates(*legs, STEEL))
    if detail > 0:
        guard_low, guard_high = (
            (axles[-1] + 0.9, half_width - 0.10, 0.45),
            (front_x - 0.30 * length, half_width - 0.06, 0.62 * deck_height + 0.3),
        )
        parts.append(crates(guard_low, guard_high, STEEL))
    if style == "box":
        lower_corner, upper_corner = (rear_x, -half_width, deck_height), (front_x, half_width, height)
        parts.append(_cargo(lower_corner, upper_corner))
        panels += side_charts("cargo", lower_corner, upper_corner)
        if detail > 0:
            parts.append(_doors(rear_x, half_width, deck_height, height))
        if detail == 2:
            parts.append(_ribs(lower_corner, upper_corner))
    elif style == "flatbed":
        parts.append(crate((rear_x, -half_width, deck_height), (front_x, half_width, deck_height + 0.16), WOOD))
        parts.append(crate((front_x - 0.08, -half_width, deck_height), (front_x, half_width, height), STEEL))
        upper_corner = (front_x - 0.8, 0.85 * half_width, height - 0.2 * load_share)
        parts += _load((rear_x + 0.5, -0.85 * half_width, deck_height + 0.16), upper_corner, generator=generator)
    else:
        tank_centre = 0.5 * (deck_height - 0.1 + height)
        angles = np.linspace(0.0, 2.0 * np.pi, 24 if detail == 2 else 10, endpoint=False) - np.pi / 2
        tank_section = np.stack(
            [np.zeros_like(angles), half_width * np.cos(angles), (height - tank_centre) * np.sin(angles)], 1
        )
        tank_sections = [(rear_x, 0.78), (rear_x + 0.12, 0.95), (rear_x + 0.4, 1.0)]
        tank_sections += [(front_x - 0.4, 1.0), (front_x - 0.12, 0.95), (front_x, 0.78)]
        tank = loft(
            np.stack([tank_section * scale + [position, 0.0, tank_centre] for position, scale in tank_sections]),
            material=PAINT,
        )
        parts.append(assign_side_panels(tank, "cargo"))
        panels += side_charts("cargo", (rear_x, -half_width, deck_height - 0.1), (front_x, half_width, height))
        parts.append(crate((rear_x + 1.0, -0.28, height - 0.12), (front_x - 1.0, 0.28, height), STEEL))
    parts += _rear_fittings(rear_x, half_width, deck_height - 0.25, detail)
    return finish(parts, panels, size)

"""Cars in six body styles: sedan, hatchback, estate, SUV, van and pickup."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssad.rendering.bodies.cabin import DriverColours, cabin
from ssad.rendering.bodies.car_details import front_details, plain_side, rear_details
from ssad.rendering.bodies.parts import (
    CHROME,
    DARK,
    GLASS,
    HEAD,
    RIM,
    STEEL,
    TAIL,
    TRIM,
    as_point,
    both_sides,
    finish,
    wheels,
)
from ssad.rendering.bodies.shell import B3, S3, S4, S5, U0, U2, Shell, axle_x, charts, sections, shell_mesh
from ssad.rendering.meshes.mesh import Material, Mesh, Point, box, build, sphere

_PLAN = ((0.0, 0.83), (0.02, 0.90), (0.06, 0.955), (0.18, 1.0), (0.80, 1.0), (0.94, 0.955), (0.98, 0.91), (1.0, 0.86))
_BOXY = ((0.0, 0.88), (0.02, 0.95), (0.06, 0.98), (0.15, 1.0), (0.90, 1.0), (0.98, 0.97), (1.0, 0.93))

SEDAN = Shell(
    top=(
        (0.0, 0.50),
        (0.03, 0.545),
        (0.12, 0.59),
        (0.27, 0.655),
        (0.43, 0.965),
        (0.53, 1.0),
        (0.62, 0.99),
        (0.71, 0.945),
        (0.87, 0.715),
        (0.93, 0.705),
        (1.0, 0.68),
    ),
    belt=((0.0, 0.47), (0.05, 0.525), (0.27, 0.615), (0.60, 0.645), (0.87, 0.675), (1.0, 0.65)),
    plan=_PLAN,
    cowl=0.27,
    screen=0.43,
    roof=0.71,
    deck=0.87,
    windows=((0.335, 0.512), (0.532, 0.690), (0.700, 0.765)),
    doors=(("front_door", 0.300, 0.520), ("rear_door", 0.520, 0.700)),
    axles=(0.165, 0.785),
    radius=0.226,
)
HATCHBACK = replace(
    SEDAN,
    top=(
        (0.0, 0.48),
        (0.03, 0.53),
        (0.12, 0.575),
        (0.27, 0.65),
        (0.45, 0.965),
        (0.56, 1.0),
        (0.75, 0.985),
        (0.93, 0.93),
        (1.0, 0.91),
    ),
    belt=((0.0, 0.45), (0.05, 0.51), (0.27, 0.60), (0.60, 0.635), (0.93, 0.675), (1.0, 0.68)),
    screen=0.45,
    roof=1.0,
    deck=1.0,
    lean=0.085,
    windows=((0.345, 0.555), (0.578, 0.765), (0.790, 0.870)),
    doors=(("front_door", 0.310, 0.565), ("rear_door", 0.565, 0.775)),
    axles=(0.175, 0.835),
    radius=0.215,
    tail_from=0.62,
    tail_lamps=(S4, U0),
)
ESTATE = replace(
    SEDAN,
    top=(
        (0.0, 0.50),
        (0.03, 0.545),
        (0.12, 0.59),
        (0.26, 0.655),
        (0.42, 0.965),
        (0.52, 1.0),
        (0.75, 0.99),
        (1.0, 0.93),
    ),
    belt=((0.0, 0.47), (0.05, 0.525), (0.26, 0.61), (0.60, 0.64), (1.0, 0.67)),
    cowl=0.26,
    screen=0.42,
    roof=1.0,
    deck=1.0,
    lean=0.055,
    windows=((0.325, 0.500), (0.520, 0.680), (0.695, 0.900)),
    doors=(("front_door", 0.290, 0.508), ("rear_door", 0.508, 0.690)),
    axles=(0.165, 0.790),
    tail_from=0.60,
    tail_lamps=(S4, U0),
)
SUV = replace(
    SEDAN,
    top=(
        (0.0, 0.52),
        (0.03, 0.575),
        (0.12, 0.605),
        (0.26, 0.645),
        (0.40, 0.965),
        (0.50, 1.0),
        (0.78, 0.99),
        (1.0, 0.955),
    ),
    belt=((0.0, 0.49), (0.04, 0.555), (0.26, 0.615), (0.60, 0.635), (1.0, 0.66)),
    plan=_BOXY,
    cowl=0.26,
    screen=0.40,
    roof=1.0,
    deck=1.0,
    lean=0.035,
    sill=0.155,
    tumble=0.16,
    clad=True,
    windows=((0.318, 0.495), (0.515, 0.690), (0.705, 0.915)),
    doors=(("front_door", 0.288, 0.503), ("rear_door", 0.503, 0.700)),
    axles=(0.160, 0.800),
    radius=0.222,
    tail_from=0.66,
    tail_lamps=(S4, U0),
    wheel_width=0.25,
)
VAN = replace(
    SEDAN,
    top=(
        (0.0, 0.40),
        (0.03, 0.455),
        (0.08, 0.49),
        (0.15, 0.545),
        (0.30, 0.955),
        (0.38, 1.0),
        (0.90, 1.0),
        (1.0, 0.985),
    ),
    belt=((0.0, 0.37), (0.04, 0.44), (0.15, 0.52), (0.32, 0.535), (1.0, 0.545)),
    plan=_BOXY,
    cowl=0.15,
    screen=0.30,
    roof=1.0,
    deck=1.0,
    lean=0.015,
    sill=0.11,
    tumble=0.11,
    windows=((0.205, 0.395), (0.430, 0.640), (0.665, 0.930)),
    doors=(("front_door", 0.175, 0.410), ("rear_door", 0.410, 0.650)),
    axles=(0.135, 0.795),
    radius=0.172,
    tail_from=0.80,
    tail_lamps=(S3, U0),
    lamp_from=0.6,
)
PICKUP = replace(
    SEDAN,
    top=(
        (0.0, 0.54),
        (0.03, 0.595),
        (0.10, 0.62),
        (0.245, 0.65),
        (0.35, 0.965),
        (0.43, 1.0),
        (0.54, 0.99),
        (0.585, 0.965),
        (0.615, 0.655),
        (0.70, 0.65),
        (1.0, 0.65),
    ),
    belt=((0.0, 0.51), (0.04, 0.575), (0.245, 0.615), (0.60, 0.625), (1.0, 0.625)),
    plan=_BOXY,
    cowl=0.245,
    screen=0.35,
    roof=0.585,
    deck=0.615,
    sill=0.19,
    tumble=0.15,
    clad=False,
    windows=((0.285, 0.430), (0.447, 0.572)),
    doors=(("front_door", 0.262, 0.438), ("rear_door", 0.438, 0.590)),
    axles=(0.150, 0.770),
    radius=0.215,
    tail_from=0.80,
    tail_lamps=(S3, U0),
    bed=(0.635, 0.975),
    trunk="tailgate",
    tail=0.012,
    wheel_width=0.26,
)

# A car of foam under printed covers: the shape of a small hatchback, without mirrors that stand out.
GLOBAL_VEHICLE_TARGET = replace(HATCHBACK, body=0.985, wheel_width=0.16, sill=0.10)
COVER = Material("cover", (0.70, 0.70, 0.69), specular=0.03, gloss=0.15)
PRINT_GLOSS = 0.15  # of everything that is printed on its covers

STYLES: dict[str, Shell] = {
    "sedan": SEDAN,
    "hatchback": HATCHBACK,
    "estate": ESTATE,
    "suv": SUV,
    "van": VAN,
    "pickup": PICKUP,
    "global_vehicle_target": GLOBAL_VEHICLE_TARGET,
}


def car(style: str, size: Point, *, generator: np.random.Generator, detail: int, has_driver: bool = True) -> Mesh:
    """Return a car of a style that fills its size (length, width with mirrors, height), m.

    Its interior shows behind the panes; with `has_driver`, the driver does, too. The global vehicle target is a car
    of foam: nobody drives it, its covers keep their colour, and nothing on them shines.
    """
    style_shell, is_target = STYLES[style], style == "global_vehicle_target"
    variation = generator.normal(0.0, 1.0, 4).clip(-2.0, 2.0)
    chrome, roof_rails = (float(share) for share in generator.random(2))
    spokes = int(generator.integers(5, 8))
    if is_target:  # one of them is like the other
        variation, chrome, roof_rails, spokes = np.zeros(4), 0.5, 0.0, 5
    shell = replace(
        style_shell,
        radius=style_shell.radius * (1.0 + 0.02 * variation[0]),
        sill=style_shell.sill * (1.0 + 0.04 * variation[1]),
        tumble=style_shell.tumble * (1.0 + 0.06 * variation[2]),
        lamp_from=float(np.clip(style_shell.lamp_from + 0.05 * variation[3], 0.45, 0.75)),
    )
    body = shell_mesh(shell, size, detail=detail)
    parts = [body]
    radius = shell.radius * size[2]
    wheel_y = 0.5 * size[1] * shell.body - 0.012
    places = [(axle_x(shell, size, axle_share), wheel_y) for axle_share in shell.axles]
    rim_share = 0.60 if style in ("suv", "pickup", "van") else 0.66
    rim_material = STEEL if style == "van" else RIM
    wheel_options: dict[str, object] = {"rim": rim_share, "spokes": spokes, "steel": rim_material, "top": False}
    parts.append(wheels(places, radius, shell.wheel_width, detail=detail, **wheel_options))
    has_rails = roof_rails > 0.4 and style in ("suv", "estate")
    parts += fittings(shell, size, body, detail=detail, chrome=chrome > 0.6, rails=has_rails)
    if detail > 0:
        parts += rear_details(shell, size, body, detail=detail, chrome=chrome)
        parts += front_details(shell, size, body, detail=detail)
        # The share of the roof rails also picks the driver: a car takes the same number of draws with and without.
        driver = DriverColours.from_share(roof_rails) if has_driver and not is_target else None
        parts += cabin(shell, size, body, detail=detail, driver=driver)
    mesh = finish(parts, charts(shell, size), size)
    return _printed(mesh) if is_target else mesh


def _printed(mesh: Mesh) -> Mesh:
    """Return the mesh of a car as printed covers over foam."""
    materials = tuple(
        COVER if material.paint else replace(material, gloss=min(material.gloss, PRINT_GLOSS), emission=0.0)
        for material in mesh.materials
    )
    return replace(mesh, materials=materials)


def fittings(shell: Shell, size: Point, body: Mesh, *, detail: int, chrome: bool, rails: bool) -> list[Mesh]:
    """Return mirrors, handles, roof rails and exhaust; at detail 0 mirrors and lamps only."""
    _, width, height = size
    positions = np.array([shell.windows[0][0] + 0.012, 0.0, 1.0, shell.doors[0][2] - 0.02, shell.doors[-1][2] - 0.02])
    half_sections = sections(shell, size, positions, detail=2)
    window_base = half_sections[0, U0]
    mirror_reach = 0.5 * width - window_base[1]
    bright_material: Material = CHROME if chrome else TRIM
    mirror_centre = (window_base[0], 0.5 * width - 0.5 * mirror_reach, window_base[2] + 0.075)
    if detail == 2:
        mirror = sphere((0.075, 0.5 * mirror_reach, 0.085), material=TRIM, centre=mirror_centre, segments=8)
    elif detail == 1:
        mirror = box((0.12, mirror_reach, 0.15), material=TRIM, centre=mirror_centre)
    else:
        mirror = _plate_x(mirror_centre, (mirror_reach, 0.14), TRIM)
    parts = [both_sides(mirror)]
    lamps = (
        (half_sections[1], shell.lamps, HEAD, 1.0, shell.lamp_from),
        (half_sections[2], shell.tail_lamps, TAIL, -1.0, shell.tail_from),
    )
    if detail == 0:
        for section, lamp_rows, material, direction, lamp_start in lamps:
            lower, upper = section[lamp_rows[0]], section[min(lamp_rows[1], S5)]
            y = 0.5 * (1.0 + lamp_start) * lower[1]
            centre = (lower[0] + direction * 0.012, y, 0.5 * (lower[2] + upper[2]))
            parts.append(
                both_sides(_plate_x(centre, ((1.0 - lamp_start) * lower[1], upper[2] - lower[2]), material, direction))
            )
        return parts
    mirror_glass = (mirror_centre[0] - 0.077, mirror_centre[1], mirror_centre[2])
    parts.append(both_sides(_plate_x(mirror_glass, (0.84 * mirror_reach, 0.115), GLASS, -1.0)))
    handles = half_sections[3:][:, S5] - [0.0, 0.0, 0.03]
    if detail == 1:
        return parts + plain_side(shell, size, body, handles[:, [0, 2]], bright_material)
    parts += [both_sides(box((0.17, 0.03, 0.028), material=bright_material, centre=as_point(h))) for h in handles]
    outlet = (float(half_sections[2, B3][0]) + 0.02, 0.3 * width, 0.8 * shell.sill * height)
    parts.append(box((0.09, 0.10, 0.07), material=DARK, centre=outlet))
    if rails:
        rail_ends = sections(shell, size, np.array([shell.screen + 0.05, 0.90]), detail=2)[:, U2 + 1]
        mirror_centre = tuple(0.5 * (rail_ends[0] + rail_ends[1]) + [0.0, -0.05, 0.05])
        rail_size = (float(rail_ends[0, 0] - rail_ends[1, 0]), 0.035, 0.04)
        parts.append(both_sides(box(rail_size, material=bright_material, centre=mirror_centre)))
    return parts


def _plate_x(centre: Point, size: tuple[float, float], material: Material, sign: float = 0.0) -> Mesh:
    """Return a flat rectangle (width, height) across the vehicle.

    `sign`: seen from the front (1), the rear (-1) or both (0).
    """
    x, y, z = centre
    half_width, half_height = 0.5 * size[0], 0.5 * size[1]
    points = [
        (x, y - half_width, z - half_height),
        (x, y + half_width, z - half_height),
        (x, y + half_width, z + half_height),
        (x, y - half_width, z + half_height),
    ]
    faces = [(0, 1, 2), (0, 2, 3)] if sign >= 0.0 else []
    faces += [(0, 2, 1), (0, 3, 2)] if sign <= 0.0 else []
    return build(points, faces, materials=material, smooth=0.0)

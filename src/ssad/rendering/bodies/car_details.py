"""Fittings that lie flat on a car's ends and sides: lamp clusters, number plates, badges, gaps, bumpers, handles."""

from __future__ import annotations

import numpy as np

from ssad.rendering.bodies.drape import Outline, Surface, ellipse, mirrored, patches, rectangle, trapezoid
from ssad.rendering.bodies.parts import CHROME, HEAD, HOUSING, PLATE, SEAM, TAIL, TRIM, both_sides
from ssad.rendering.bodies.shell import B3, S2, S3, S4, S5, U0, Shell, axle_x, sections
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point

GUIDE = Material("tail_lamp", (0.62, 0.030, 0.025), specular=0.09, gloss=0.9, emission=0.12)
DARK_LENS = Material("dark_lens", (0.055, 0.004, 0.005), specular=0.09, gloss=0.9)
GRILLE_BAR = Material("grille_bar", (0.11, 0.11, 0.115), specular=0.2, gloss=0.6)
AMBER = Material("indicator", (0.34, 0.12, 0.015), specular=0.09, gloss=0.9)
CLEAR = Material("clear_lens", (0.34, 0.33, 0.33), specular=0.09, gloss=0.9)
BRAKE = Material("brake_lamp", (0.12, 0.006, 0.008), specular=0.06, gloss=0.8)
REFLECTOR = Material("reflector", (0.16, 0.008, 0.010), specular=0.06, gloss=0.7)
INK = Material("plate_letters", (0.012, 0.012, 0.014), specular=0.03, gloss=0.4)
BLUE = Material("plate_band", (0.012, 0.035, 0.22), specular=0.03, gloss=0.4)
PLATE_HALF = (0.26, 0.056)  # m
# letters of a number plate: middle and half width, m, seen from outside from left to right
LETTERS = (
    (-0.165, 0.018),
    (-0.115, 0.018),
    (-0.035, 0.020),
    (0.020, 0.018),
    (0.075, 0.020),
    (0.130, 0.018),
    (0.185, 0.018),
)
LIFT = 0.004  # m of the lowest layer over the shell
BAR_SHARE = 0.35  # of cars whose tail lamps are joined by a bar

Pieces = list[tuple[list[Outline], Material, float]]


def number_plate(height: float, *, front: bool, detail: int, recess: bool) -> Pieces:
    """Return a number plate at a height (m) in the middle of the front or the rear, on its recess."""
    half_width, half_height = PLATE_HALF
    draped_pieces: Pieces = []
    if recess:
        frame = 0.035, 0.022
        draped_pieces.append(
            (
                rectangle(
                    (-half_width - frame[0], height - half_height - frame[1]),
                    (half_width + frame[0], height + half_height + frame[1]),
                ),
                TRIM,
                LIFT,
            )
        )
    draped_pieces.append(
        (rectangle((-half_width, height - half_height), (half_width, height + half_height)), PLATE, 3 * LIFT)
    )
    side = 1.0 if front else -1.0  # y of the right edge of the plate, seen from outside, has this sign
    letters = LETTERS if detail == 2 else LETTERS[::3]
    wide = 1.0 if detail == 2 else 2.4
    for middle, half in letters:
        lower_point, upper_point = sorted((side * (middle - wide * half), side * (middle + wide * half)))
        draped_pieces.append((rectangle((lower_point, height - 0.036), (upper_point, height + 0.036)), INK, 4 * LIFT))
    if detail == 2:
        lower_point, upper_point = sorted((-side * half_width, -side * (half_width - 0.042)))
        draped_pieces.append(
            (rectangle((lower_point, height - half_height), (upper_point, height + half_height)), BLUE, 4 * LIFT)
        )
    return draped_pieces


def rear_details(shell: Shell, size: Point, body: Mesh, *, detail: int, chrome: float) -> list[Mesh]:
    """Return the fittings of the rear.

    Args:
        shell: Shell of the car.
        size: Length, width, height, m.
        body: The mesh of the shell.
        detail: 1 or 2.
        chrome: Random share of the car in [0, 1); it decides between lamps with and without a bar between them.
    """
    section = sections(shell, size, np.array([1.0]), detail=2)[0]
    half_width = float(section[S3, 1])
    has_lid = shell.deck < 0.97  # a boot lid or tailgate that ends at the belt line
    draped_pieces = _tail_lamps(shell, section, has_bar=chrome < BAR_SHARE and not has_lid)
    plate_height = plate_heights(section, section, shell)[1]
    draped_pieces += number_plate(plate_height, front=False, detail=detail, recess=True)
    bumper, ledge = float(section[B3, 2]) + 0.01, float(section[S2, 2])
    if not shell.clad:
        draped_pieces.append(
            (
                trapezoid(
                    (-0.80 * half_width, bumper),
                    (0.80 * half_width, bumper + 0.55 * (ledge - bumper)),
                    (-0.70 * half_width, 0.70 * half_width),
                ),
                TRIM,
                LIFT,
            )
        )
    reflector_low = ledge - 0.055
    draped_pieces.append(
        (
            mirrored(rectangle((0.66 * half_width, reflector_low), (0.86 * half_width, reflector_low + 0.032))),
            REFLECTOR,
            2 * LIFT,
        )
    )
    gap = 0.010 if detail == 2 else 0.014
    lamp_edge = shell.tail_from * half_width
    draped_pieces.append((rectangle((-0.84 * half_width, ledge), (0.84 * half_width, ledge + gap)), SEAM, LIFT))
    lid_top = float(section[S5 if has_lid else U0, 2])
    if detail == 2:
        draped_pieces.append((mirrored(rectangle((lamp_edge - 0.03, ledge), (lamp_edge - 0.02, lid_top))), SEAM, LIFT))
    badge_height = 0.5 * (plate_height + PLATE_HALF[1] + 0.022 + lid_top)
    if lid_top - plate_height > 0.14:
        draped_pieces.append(
            ([ellipse((0.0, badge_height), (0.050, 0.036), 8 if detail == 2 else 6)], CHROME, 2 * LIFT)
        )
        if detail == 2:
            script = rectangle(
                (-0.74 * lamp_edge, badge_height - 0.012), (-0.74 * lamp_edge + 0.17, badge_height + 0.012)
            )
            draped_pieces.append((script, CHROME, 2 * LIFT))
    return patches(Surface(body, "rear"), draped_pieces)


def plate_heights(front: F64, rear: F64, shell: Shell) -> tuple[float, float]:
    """Return the heights of the number plates ahead and behind, m, on the half sections [16, 3] of both ends."""
    behind = rear[S4, 2] - 0.02 if shell.deck < 0.97 else rear[S3, 2] + 0.04
    return float(front[S3, 2]) - 0.10, float(behind)


def _tail_lamps(shell: Shell, section: F64, *, has_bar: bool) -> Pieces:
    """Clusters: reversing lamp and indicator below, a light guide above; the lens is that of the shell."""
    lower_point, upper_point = section[shell.tail_lamps[0]], section[min(shell.tail_lamps[1], U0)]
    inner, outer = shell.tail_from * float(lower_point[1]) + 0.01, 0.985 * float(lower_point[1])
    base, height, width = float(lower_point[2]), float(upper_point[2] - lower_point[2]), outer - inner

    def cell(left: float, right: float, bottom: float, top: float) -> list[Outline]:
        return mirrored(
            rectangle(
                (inner + left * width, base + bottom * height),
                (inner + right * width, base + top * height),
            )
        )

    # At lower detail the shell has fewer rows, and its lens is lower than the cluster.
    draped_pieces: Pieces = [
        (cell(0.0, 1.0, 0.46, 1.0), TAIL, 0.5 * LIFT),
        (cell(0.0, 1.0, 0.0, 0.46), DARK_LENS, LIFT),
        (cell(0.08, 0.36, 0.08, 0.34), CLEAR, 2 * LIFT),
        (cell(0.42, 0.90, 0.08, 0.34), AMBER, 2 * LIFT),
        (cell(0.06, 0.94, 0.66, 0.84), GUIDE, LIFT),
    ]
    if has_bar:
        strip = rectangle((-inner, base + 0.58 * height), (inner, base + 0.92 * height))
        draped_pieces.append((strip, TAIL, LIFT))
    return draped_pieces


def front_details(shell: Shell, size: Point, body: Mesh, *, detail: int) -> list[Mesh]:
    """Return the fittings of the front: lamps in their housings, grille, badge, plate (see `rear_details`)."""
    section = sections(shell, size, np.array([0.0]), detail=2)[0]
    lower_point, upper_point = section[shell.lamps[0]], section[min(shell.lamps[1], S5)]
    inner, outer = shell.lamp_from * float(lower_point[1]) + 0.008, 0.985 * float(lower_point[1])
    base, height, width = float(lower_point[2]), float(upper_point[2] - lower_point[2]), outer - inner
    corners = 8 if detail == 2 else 6
    lens_half = 0.24 * height, 0.20 * height
    lenses = [ellipse((inner + share * width, base + 0.40 * height), lens_half, corners) for share in (0.30, 0.68)]
    draped_pieces: Pieces = [
        (mirrored(rectangle((inner, base + 0.80 * height), (outer, base + height))), HEAD, LIFT),
        (mirrored(rectangle((inner, base), (outer, base + 0.80 * height))), HOUSING, LIFT),
        (mirrored(lenses if detail == 2 else lenses[:1]), HEAD, 2 * LIFT),
    ]
    grille_low, grille_high = float(section[shell.grille[0], 2]), float(section[shell.grille[1], 2])
    half = 0.84 * shell.lamp_from * float(section[S3, 1])
    for share in (0.2, 0.5, 0.8) if detail == 2 else ():
        bar_height = grille_low + share * (grille_high - grille_low)
        draped_pieces.append((rectangle((-half, bar_height - 0.007), (half, bar_height + 0.007)), GRILLE_BAR, LIFT))
    badge_height = 0.5 * (grille_low + grille_high)
    draped_pieces.append(([ellipse((0.0, badge_height), (0.058, 0.050), corners)], CHROME, 2 * LIFT))
    draped_pieces += number_plate(plate_heights(section, section, shell)[0], front=True, detail=detail, recess=False)
    bumper, ledge = float(section[B3, 2]), float(section[S2, 2])
    outer_edge = float(lower_point[1])
    if detail == 1:  # the shell of higher detail has rows for it
        air_intake = trapezoid(
            (-0.72 * outer_edge, bumper), (0.72 * outer_edge, ledge - 0.03), (-0.66 * outer_edge, 0.66 * outer_edge)
        )
        draped_pieces.append((air_intake, TRIM, 0.5 * LIFT))
    else:
        corner_insets = trapezoid(
            (0.72 * outer_edge, bumper + 0.45 * (ledge - bumper)),
            (0.93 * outer_edge, ledge),
            (0.80 * outer_edge, 0.93 * outer_edge),
        )
        draped_pieces.append((mirrored(corner_insets), TRIM, LIFT))
    return patches(Surface(body, "front"), draped_pieces)


def plain_side(shell: Shell, size: Point, body: Mesh, handles: F64, material: Material) -> list[Mesh]:
    """Return door handles, door gaps and sills of both sides for lower detail, whose shell has too few rows for them.

    Args:
        shell: Shell of the car.
        size: Length, width, height, m.
        body: The mesh of the shell.
        handles: Middles of the door handles (x, z), m.
        material: That of the handles.
    """
    edges = np.unique([outer_edge for _, start, end in shell.doors for outer_edge in (start, end)])
    half_sections = sections(shell, size, np.array([*edges, sum(shell.axles) / 2.0]), detail=2)
    *door_sections, middle = half_sections
    floor, sill = float(middle[B3, 2]), float(middle[B3, 2] + 0.35 * (middle[S2, 2] - middle[B3, 2]))
    reach = shell.arch * shell.radius * size[2]
    axle_places = [axle_x(shell, size, axle) for axle in shell.axles]
    gap_outlines: list[Outline] = []
    for section in door_sections:
        x = float(section[S4, 0])
        gap_outlines += rectangle((x - 0.007, max(sill, float(section[B3, 2]))), (x + 0.007, float(section[U0, 2])))
    draped_pieces: Pieces = [
        (rectangle((axle_places[1] + reach, floor), (axle_places[0] - reach, sill)), TRIM, LIFT),
        (gap_outlines, SEAM, LIFT),
        ([rectangle((x - 0.09, z - 0.016), (x + 0.09, z + 0.016))[0] for x, z in handles.tolist()], material, 2 * LIFT),
    ]
    return [both_sides(mesh) for mesh in patches(Surface(body, "left"), draped_pieces)]

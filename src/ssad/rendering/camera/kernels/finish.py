"""Finish of bodies: effect pigments in paint, dirt and wear, as changes of the albedo that `shade` has lit."""

import warp as wp

from ssad.rendering.camera.kernels.matter import Surface
from ssad.rendering.camera.kernels.sky import speck

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

DUST = wp.constant(wp.vec3(0.21, 0.18, 0.14))  # linear albedo of dry road dust
RUST = wp.constant(wp.vec3(0.10, 0.035, 0.012))


@wp.struct
class Finish:
    """Finish of an object in a view.

    Attributes:
        to_object: Camera to object.
        eye: Position of the camera in the object's frame, m.
        height: Of the object, m.
        metallic: Strength of the effect pigments, 0 to 1.
        dirt: 0 to 1.
        wear: 0 to 1.
        seed: Of its pattern.
        tag: Of the object.
    """

    to_object: wp.mat44
    eye: wp.vec3
    height: float
    metallic: float
    dirt: float
    wear: float
    seed: int
    tag: int


@wp.func
def lattice(column: int, row: int, layer: int, seed: int) -> float:
    """Return a fixed random number in [0, 1) for a cell in space."""
    return speck(column + 131 * layer + 7919 * seed, row + 57 * layer - 3571 * seed)


@wp.func
def eased(share: float) -> float:
    """Return the Hermite step of a share."""
    return share * share * (3.0 - 2.0 * share)


@wp.func
def noise(point: wp.vec3, seed: int) -> float:
    """Return smooth noise in [0, 1] with unit cells in space."""
    column = wp.floor(point[0])
    row = wp.floor(point[1])
    layer = wp.floor(point[2])
    column_share = eased(point[0] - column)
    row_share = eased(point[1] - row)
    layer_share = eased(point[2] - layer)
    total = float(0.0)
    for corner in range(8):
        column_offset = corner % 2
        row_offset = (corner / 2) % 2
        layer_offset = corner / 4
        weight = wp.where(column_offset == 1, column_share, 1.0 - column_share)
        weight *= wp.where(row_offset == 1, row_share, 1.0 - row_share)
        weight *= wp.where(layer_offset == 1, layer_share, 1.0 - layer_share)
        total += weight * lattice(int(column) + column_offset, int(row) + row_offset, int(layer) + layer_offset, seed)
    return total


@wp.func
def dirt_share(finish: Finish, point: wp.vec3, normal: wp.vec3) -> float:
    """Return the share of a surface that dirt covers, at a point with a normal, both in the object's frame.

    Wheels throw dirt at the lower sides, the wake draws it to the rear, and dust settles on what is level.
    """
    splash = wp.clamp(1.1 - 2.0 * point[2] / finish.height, 0.0, 1.0)
    rear = 0.35 * wp.max(-normal[0], 0.0)
    settled = 0.25 * wp.max(normal[2], 0.0)
    patches = 0.5 * noise(point * 1.7, finish.seed) + 0.3 * noise(point * 6.0, finish.seed + 1)
    # Rain washes dirt down in streaks.
    streaks = 0.2 * noise(wp.vec3(point[0] * 22.0, point[1] * 22.0, point[2] * 1.5), finish.seed + 2)
    return wp.min(finish.dirt * (0.15 + splash + rear + settled) * (0.3 + 1.2 * (patches + streaks)), 0.92)


@wp.func
def worn(finish: Finish, albedo: wp.vec3, point: wp.vec3) -> wp.vec3:
    """Return the albedo of worn paint: chalked, scratched, with rust on its lower parts."""
    grey = 0.3333 * (albedo[0] + albedo[1] + albedo[2])
    chalk = 0.3 * finish.wear * (0.5 + noise(point * 2.3, finish.seed + 3))
    pale = wp.vec3(grey, grey, grey) * 0.9 + wp.vec3(0.05, 0.05, 0.05)
    result = albedo * (1.0 - chalk) + pale * chalk
    scratch = noise(wp.vec3(point[0] * 2.0, point[1] * 40.0, point[2] * 55.0), finish.seed + 4)
    scratch_share = wp.clamp((scratch - 0.82) * 8.0, 0.0, 1.0) * 0.6 * finish.wear
    result = result * (1.0 - scratch_share) + wp.vec3(0.3, 0.3, 0.3) * scratch_share
    rust = noise(point * 9.0, finish.seed + 5) + 0.25 * wp.clamp(1.0 - 2.0 * point[2] / finish.height, 0.0, 1.0)
    rust_share = wp.clamp((rust - 1.15 + 0.25 * finish.wear) * 8.0, 0.0, 1.0) * finish.wear
    return result * (1.0 - rust_share) + RUST * rust_share


@wp.func
def rotation_of(pose: wp.mat44) -> wp.mat33:
    """Return the rotation of a pose."""
    return wp.mat33(
        pose[0, 0], pose[0, 1], pose[0, 2], pose[1, 0], pose[1, 1], pose[1, 2], pose[2, 0], pose[2, 1], pose[2, 2]
    )


@wp.kernel
def apply_finish(
    finishes: wp.array(dtype=Finish),
    rows: wp.array2d(dtype=int),
    lens: wp.array(dtype=wp.vec4),
    to_world: wp.array(dtype=wp.mat44),
    surfaces: wp.array(dtype=Surface),
    material: wp.array3d(dtype=int),
    tag: wp.array3d(dtype=int),
    depth: wp.array3d(dtype=float),
    albedo: wp.array3d(dtype=wp.vec3),
    normal: wp.array3d(dtype=wp.vec3),
    gain: wp.array3d(dtype=wp.vec3),
    radiance: wp.array3d(dtype=wp.vec3),
):
    """Change the radiance of objects with a finish; rows [B, T]: row of the finish of a tag modulo T, -1 for none."""
    view, y = wp.tid()
    focal = lens[view]
    for x in range(radiance.shape[2]):
        object_tag = tag[view, y, x]
        row = int(-1)
        if object_tag > 0:
            row = rows[view, object_tag % rows.shape[1]]
        if row >= 0 and finishes[row].tag == object_tag:
            finish = finishes[row]
            ray = wp.vec3((float(x) - focal[2]) / focal[0], (float(y) - focal[3]) / focal[1], 1.0)
            point = wp.transform_point(finish.to_object, ray * depth[view, y, x])
            # The normal is in the world frame; the matrix leads from the camera.
            local_normal = wp.transform_vector(
                finish.to_object, wp.transpose(rotation_of(to_world[view])) * normal[view, y, x]
            )
            clean = albedo[view, y, x]
            changed = clean
            is_paint = surfaces[material[view, y, x]].paint
            if is_paint == 1:
                if finish.metallic > 0.0:
                    facing = wp.abs(wp.dot(local_normal, wp.normalize(finish.eye - point)))
                    # The mean of the factor over the hemisphere, weighted by its cosine, is 1.
                    changed = changed * (1.0 + finish.metallic * (0.9 * facing * facing - 0.45))
                if finish.wear > 0.0:
                    changed = worn(finish, changed, point)
            if finish.dirt > 0.0:
                share = dirt_share(finish, point, local_normal)
                if is_paint == 0:
                    # Glass, lamps and tyres are wiped or rub themselves clean.
                    share = 0.35 * share
                changed = changed * (1.0 - share) + DUST * share
            lit = radiance[view, y, x] + wp.cw_mul(gain[view, y, x], changed - clean)
            radiance[view, y, x] = wp.max(lit, wp.vec3(0.0, 0.0, 0.0))

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
def lattice(x: int, y: int, z: int, seed: int) -> float:
    """Return a fixed random number in [0, 1) for a cell in space."""
    return speck(x + 131 * z + 7919 * seed, y + 57 * z - 3571 * seed)


@wp.func
def noise(p: wp.vec3, seed: int) -> float:
    """Return smooth noise in [0, 1] with unit cells in space."""
    i = wp.floor(p[0])
    j = wp.floor(p[1])
    k = wp.floor(p[2])
    u = p[0] - i
    v = p[1] - j
    w = p[2] - k
    u = u * u * (3.0 - 2.0 * u)
    v = v * v * (3.0 - 2.0 * v)
    w = w * w * (3.0 - 2.0 * w)
    x = int(i)
    y = int(j)
    z = int(k)
    total = float(0.0)
    for corner in range(8):
        dx = corner % 2
        dy = (corner / 2) % 2
        dz = corner / 4
        weight = wp.where(dx == 1, u, 1.0 - u) * wp.where(dy == 1, v, 1.0 - v) * wp.where(dz == 1, w, 1.0 - w)
        total += weight * lattice(x + dx, y + dy, z + dz, seed)
    return total


@wp.func
def dirt_share(finish: Finish, p: wp.vec3, n: wp.vec3) -> float:
    """Return the share of a surface that dirt covers, at a point with a normal, both in the object's frame.

    Wheels throw dirt at the lower sides, the wake draws it to the rear, and dust settles on what is level.
    """
    splash = wp.clamp(1.1 - 2.0 * p[2] / finish.height, 0.0, 1.0)
    rear = 0.35 * wp.max(-n[0], 0.0)
    settled = 0.25 * wp.max(n[2], 0.0)
    patches = 0.5 * noise(p * 1.7, finish.seed) + 0.3 * noise(p * 6.0, finish.seed + 1)
    # Rain washes dirt down in streaks.
    streaks = 0.2 * noise(wp.vec3(p[0] * 22.0, p[1] * 22.0, p[2] * 1.5), finish.seed + 2)
    return wp.min(finish.dirt * (0.15 + splash + rear + settled) * (0.3 + 1.2 * (patches + streaks)), 0.92)


@wp.func
def worn(finish: Finish, albedo: wp.vec3, p: wp.vec3) -> wp.vec3:
    """Return the albedo of worn paint: chalked, scratched, with rust on its lower parts."""
    grey = 0.3333 * (albedo[0] + albedo[1] + albedo[2])
    chalk = 0.3 * finish.wear * (0.5 + noise(p * 2.3, finish.seed + 3))
    pale = wp.vec3(grey, grey, grey) * 0.9 + wp.vec3(0.05, 0.05, 0.05)
    result = albedo * (1.0 - chalk) + pale * chalk
    scratch = noise(wp.vec3(p[0] * 2.0, p[1] * 40.0, p[2] * 55.0), finish.seed + 4)
    scratch_share = wp.clamp((scratch - 0.82) * 8.0, 0.0, 1.0) * 0.6 * finish.wear
    result = result * (1.0 - scratch_share) + wp.vec3(0.3, 0.3, 0.3) * scratch_share
    rust = noise(p * 9.0, finish.seed + 5) + 0.25 * wp.clamp(1.0 - 2.0 * p[2] / finish.height, 0.0, 1.0)
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
            p = wp.transform_point(finish.to_object, ray * depth[view, y, x])
            # The normal is in the world frame; the matrix leads from the camera.
            n = wp.transform_vector(finish.to_object, wp.transpose(rotation_of(to_world[view])) * normal[view, y, x])
            own = albedo[view, y, x]
            changed = own
            is_paint = surfaces[material[view, y, x]].paint
            if is_paint == 1:
                if finish.metallic > 0.0:
                    facing = wp.abs(wp.dot(n, wp.normalize(finish.eye - p)))
                    # The mean of the factor over the hemisphere, weighted by its cosine, is 1.
                    changed = changed * (1.0 + finish.metallic * (0.9 * facing * facing - 0.45))
                if finish.wear > 0.0:
                    changed = worn(finish, changed, p)
            if finish.dirt > 0.0:
                share = dirt_share(finish, p, n)
                if is_paint == 0:
                    # Glass, lamps and tyres are wiped or rub themselves clean.
                    share = 0.35 * share
                changed = changed * (1.0 - share) + DUST * share
            lit = radiance[view, y, x] + wp.cw_mul(gain[view, y, x], changed - own)
            radiance[view, y, x] = wp.max(lit, wp.vec3(0.0, 0.0, 0.0))

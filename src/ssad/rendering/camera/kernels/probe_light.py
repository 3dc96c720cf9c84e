"""Light of an environment probe: the surfaces around a point, lit as in a picture, and the sky."""

import warp as wp

from ssad.rendering.camera.kernels.light import Near, cell_of, lamp_emission
from ssad.rendering.camera.kernels.matter import textured
from ssad.rendering.camera.kernels.probe import direction_of
from ssad.rendering.camera.kernels.raster import LAST
from ssad.rendering.camera.kernels.shade import DrawRanges, Geometry, SunShadows, hit_of, light_at
from ssad.rendering.camera.kernels.sky import Light, air_transmission, sky

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PARTS = wp.constant(2)  # directions of a texel, along its diagonal


@wp.func
def arriving_light(
    geometry: Geometry,
    draw_samples: DrawRanges,
    poses: wp.array(dtype=wp.mat44),
    light: Light,
    shadows: SunShadows,
    near: Near,
    direction: wp.vec3,
) -> wp.vec4:
    """Return the light from a direction at the eye of the faces' cameras, and one over the distance."""
    ahead = direction
    level = wp.max(wp.abs(ahead[0]), wp.abs(ahead[1]))
    # There is no view downwards: the ground below is like that at the lower edge of the views to the sides.
    if ahead[2] < -0.98 * level:
        ahead = wp.vec3(ahead[0], ahead[1], -0.98 * level)
    face = int(4)
    if ahead[2] <= level:
        face = 0
        if wp.abs(ahead[0]) >= wp.abs(ahead[1]):
            if ahead[0] < 0.0:
                face = 2
        else:
            face = 1
            if ahead[1] < 0.0:
                face = 3
    pose = poses[face]
    across = wp.vec3(pose[0, 0], pose[1, 0], pose[2, 0])
    down = wp.vec3(pose[0, 1], pose[1, 1], pose[2, 1])
    axis = wp.vec3(pose[0, 2], pose[1, 2], pose[2, 2])
    eye = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
    depth = wp.dot(ahead, axis)
    ray = wp.vec3(wp.dot(ahead, across) / depth, wp.dot(ahead, down) / depth, 1.0)
    side = draw_samples.samples.shape[1]
    column = wp.clamp(int((ray[0] * 0.5 + 0.5) * float(side)), 0, side - 1)
    row = wp.clamp(int((ray[1] * 0.5 + 0.5) * float(side)), 0, side - 1)
    key = draw_samples.samples[face, row, column] & LAST
    if key == wp.uint64(0):
        colour = sky(light, direction, 2)
        return wp.vec4(colour[0], colour[1], colour[2], 0.0)
    hit = hit_of(geometry, draw_samples, int(LAST - key), ray, pose)
    surface = geometry.surfaces[geometry.material[hit.face]]
    albedo = surface.colour
    if surface.paint == 1:
        albedo = draw_samples.paints[hit.draw]
    albedo = textured(surface, albedo, hit.uv, hit.distance * 2.0 / (float(side) * hit.slant))
    cell = cell_of(hit.place, eye)
    lit = light_at(light, shadows, near, 0, cell, hit.place, hit.normal, 1.0)
    emission = lamp_emission(surface, draw_samples.lit[hit.draw], 0.0, draw_samples.split[hit.draw], light.lamps)
    colour = wp.cw_mul(albedo, lit.light) + emission
    transmission = air_transmission(light, hit.distance)
    colour = wp.cw_mul(colour, transmission) + wp.cw_mul(light.horizon, wp.vec3(1.0, 1.0, 1.0) - transmission)
    return wp.vec4(colour[0], colour[1], colour[2], 1.0 / wp.max(hit.distance, 0.1))


@wp.kernel
def light_probe(
    geometry: Geometry,
    draw_samples: DrawRanges,
    poses: wp.array(dtype=wp.mat44),
    light: wp.array(dtype=Light),
    shadows: SunShadows,
    near: Near,
    size: int,
    lanes: int,
    texels: wp.array2d(dtype=wp.vec4),
):
    """Compute level 0 of a probe: the mean light over each texel.

    Each row has `lanes` threads, as in `shade`. Cameras, in the order of `poses`: along x, y, -x, -y, and up.
    """
    row, lane = wp.tid()
    for column in range(lane, 4 * size, lanes):
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for part in range(PARTS):
            share = (float(part) + 0.5) / float(PARTS)
            u = float(column) + share
            v = float(row) + share
            total += arriving_light(
                geometry, draw_samples, poses, light[0], shadows, near, direction_of(u, v, float(size))
            )
        texels[0, row * 4 * size + column] = total / float(PARTS)


@wp.kernel
def halve_probe(start: int, size: int, texels: wp.array2d(dtype=wp.vec4)):
    """Compute a level of a probe from the level of `size` that begins at a texel: the means of squares of four."""
    row, column = wp.tid()
    upper = start + 2 * row * 4 * size + 2 * column
    lower = upper + 4 * size
    texels[0, start + 8 * size * size + row * 2 * size + column] = (
        texels[0, upper] + texels[0, upper + 1] + texels[0, lower] + texels[0, lower + 1]
    ) * 0.25

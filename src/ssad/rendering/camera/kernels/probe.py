"""Environment probes: the light that arrives at a point from all directions, with distances, at several roughnesses.

A texel belongs to a direction (x, y, z). Its column follows the azimuth, by the position of (x, y) on the square
|x| + |y| = 1; its row follows z / (|z| + sqrt(x^2 + y^2)). Neither needs a trigonometric function. Level l has
4 n by 2 n texels with n = `size` / 2^l, each the mean of four texels of the level before.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

LEVELS = wp.constant(6)
STEPS = wp.constant(3)  # of the search for the point that a mirror shows
ROUGH = wp.constant(0.65)  # roughness from which no such point is sought


@wp.struct
class Probes:
    """Environment probes of all views.

    Attributes:
        is_on: 1 where surfaces mirror them.
        size: Texels along an eighth of the horizon's square, at level 0; a power of two.
        texels: RGB, and one over the distance (1/m, 0 for the sky), of all levels of each probe, one after the other.
        row: Probe of each view.
        centre: Position of each probe, m.
    """

    is_on: int
    size: int
    texels: wp.array2d(dtype=wp.vec4)
    row: wp.array(dtype=int)
    centre: wp.array(dtype=wp.vec3)


@wp.func
def direction_of(column: float, row: float, size: float) -> wp.vec3:
    """Return the direction (unit vector, world) of a position on a level of `size`, texels."""
    azimuth = column / size
    quadrant = wp.floor(azimuth)
    share = azimuth - quadrant
    x = 1.0 - share
    y = share
    if quadrant == 1.0:
        x = -share
        y = 1.0 - share
    elif quadrant == 2.0:
        x = share - 1.0
        y = -share
    elif quadrant == 3.0:
        x = share
        y = share - 1.0
    height = wp.clamp(1.0 - row / size, -0.9999, 0.9999)
    z = height / (1.0 - wp.abs(height)) * wp.sqrt(x * x + y * y)
    return wp.normalize(wp.vec3(x, y, z))


@wp.func(inline=True)
def position_of(direction: wp.vec3, size: float) -> wp.vec2:
    """Return the position of a direction, of any length, on a level of `size`: column and row, texels."""
    x = direction[0]
    y = direction[1]
    square = wp.max(wp.abs(x) + wp.abs(y), 1.0e-9)
    azimuth = y / square
    if y >= 0.0 and x < 0.0:
        azimuth = 1.0 - x / square
    elif x < 0.0:
        azimuth = 2.0 - y / square
    elif y < 0.0:
        azimuth = 3.0 + x / square
    height = direction[2] / (wp.abs(direction[2]) + wp.sqrt(x * x + y * y) + 1.0e-9)
    return wp.vec2(azimuth * size, (1.0 - height) * size)


@wp.func(inline=True)
def probe_texel(probes: Probes, probe: int, direction: wp.vec3, level: int) -> wp.vec4:
    """Return the light from a direction and one over its distance, between four texels of a level."""
    size = probes.size >> level
    # the texels of all levels before this one
    start = 32 * (probes.size * probes.size - size * size) / 3
    position = position_of(direction, float(size))
    width = 4 * size
    u = position[0] - 0.5
    v = wp.clamp(position[1] - 0.5, 0.0, float(2 * size - 1))
    column = int(wp.floor(u))
    row = wp.min(int(v), 2 * size - 2)
    u = u - float(column)
    v = v - float(row)
    # The columns go around the horizon; their number is a power of two.
    left = column & (width - 1)
    right = (column + 1) & (width - 1)
    upper = start + row * width
    lower = upper + width
    return (probes.texels[probe, upper + left] * (1.0 - u) + probes.texels[probe, upper + right] * u) * (1.0 - v) + (
        probes.texels[probe, lower + left] * (1.0 - u) + probes.texels[probe, lower + right] * u
    ) * v


@wp.func(inline=True)
def mirrored_light(probes: Probes, view: int, ray: wp.vec3, p: wp.vec3, roughness: float) -> wp.vec3:
    """Return the light that a mirror at a point shows along a reflected ray (unit vector, world).

    The point where the ray meets the surroundings is found by its distance from the probe (Szirmay-Kalos et al.,
    Approximate ray-tracing on the GPU with distance impostors, Eurographics 2005).

    roughness: 0 for a sharp image, 1 for the mean of a large part of the surroundings.
    """
    probe = probes.row[view]
    level = wp.clamp(roughness, 0.0, 1.0) * float(LEVELS - 1)
    lower = wp.min(int(level), LEVELS - 2)
    direction = ray
    # Parallax hardly shows in a mirror image that is blurred this much.
    if roughness < ROUGH:
        offset = p - probes.centre[probe]
        along = wp.dot(offset, ray)
        beside = wp.dot(offset, offset) - along * along
        travel = float(0.0)
        for step in range(STEPS):
            # Without anything near along the ray, further steps would find the same.
            if step == 0 or travel > 0.0:
                inverse = probe_texel(probes, probe, direction, lower)[3]
                # What is 1 km away or further shows no parallax.
                if inverse > 1.0e-3:
                    distance = 1.0 / inverse
                    # the point of the ray at this distance from the probe, or the nearest to it
                    reach = wp.max(wp.sqrt(wp.max(distance * distance - beside, 0.0)) - along, 0.01)
                    if step > 0:
                        # Short steps do not jump to and fro between a surface and what is behind its edge.
                        reach = 0.5 * (wp.min(reach, 2.0 * travel) + travel)
                    travel = reach
                elif travel > 0.0:
                    travel = 1.5 * travel
                if travel > 0.0:
                    direction = offset + ray * travel
    share = level - float(lower)
    texel = probe_texel(probes, probe, direction, lower)
    if share > 0.02:
        texel = texel * (1.0 - share) + probe_texel(probes, probe, direction, lower + 1) * share
    return wp.vec3(texel[0], texel[1], texel[2])

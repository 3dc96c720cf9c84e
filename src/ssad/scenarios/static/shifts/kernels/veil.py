"""Effects between the camera and the scene: extinction and airlight, particles, glare, gain."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.light import PARTS, coded_pixel, light_of, linear_pixel
from ssad.scenarios.static.shifts.kernels.shared import (
    FIELDS,
    HALF,
    ONES,
    TENS,
    cell,
    fields_of,
    gather,
    pixel_of,
    put_four,
    spread,
    value_noise,
)

wp.set_module_options({"enable_backward": False})  # see `exposure`


@wp.kernel
def patchiness(
    keys: wp.array(dtype=wp.uint64),
    to_world: wp.array(dtype=wp.mat44),
    lens: wp.array(dtype=wp.vec4),
    depth: wp.array3d(dtype=float),
    drift: wp.array(dtype=wp.vec3),
    strength: wp.array(dtype=float),
    cells: float,
    out: wp.array3d(dtype=float),
):
    """Density of the fog along each viewing ray, 1 in the mean: smooth noise fixed to the air of the world.

    to_world: camera poses; lens: (fx, fy, cx, cy) in pixels; depth: quarter grid (every fourth node is looked at);
    drift: how far the wind has carried the air, m; strength: amplitude; cells: pixels an output node.
    """
    b, y, x = wp.tid()
    focal = lens[b]
    u = (float(x) + 0.5) * cells
    v = (float(y) + 0.5) * cells
    row = wp.min(int(v * 0.25), depth.shape[1] - 1)
    column = wp.min(int(u * 0.25), depth.shape[2] - 1)
    distance = wp.clamp(depth[b, row, column], 2.0, 120.0)
    pose = to_world[b]
    ray = wp.vec3((u - focal[2]) / focal[0], (v - focal[3]) / focal[1], 1.0)
    total = float(0.0)
    for sample_index in range(3):
        sample_depth = distance * (float(sample_index) + 0.5) / 3.0
        point = wp.transform_point(pose, ray * sample_depth) - drift[b]
        total += value_noise(keys[b], point / 30.0) * 0.65 + value_noise(keys[b] + wp.uint64(1), point / 11.0) * 0.35
    out[b, y, x] = 1.0 + strength[b] * (total / 3.0 - 0.5) * 2.0


@wp.kernel
def transmittance(
    depth: wp.array3d(dtype=float),
    slant: wp.array(dtype=wp.vec4),
    density: wp.array3d(dtype=float),
    beta: wp.array(dtype=float),
    farthest: float,
    out: wp.array3d(dtype=float),
):
    """Compute exp(-beta * range) at each node (Koschmieder); range is depth times the slant of the ray."""
    b, y = wp.tid()
    focal = slant[b]
    v = ((float(y) + 0.5) * 4.0 - focal[3]) / focal[1]
    grid_y = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(grid_y))
    for x in range(depth.shape[2]):
        u = ((float(x) + 0.5) * 4.0 - focal[2]) / focal[0]
        grid_x = (float(x) + 0.5) * 0.25 - 0.5
        column = int(wp.floor(grid_x))
        left = cell(density, b, row, grid_y - float(row), column)
        right = cell(density, b, row, grid_y - float(row), column + 1)
        mean_density = left + (right - left) * (grid_x - float(column))
        ray_length = wp.min(depth[b, y, x] * wp.sqrt(1.0 + u * u + v * v), farthest)
        out[b, y, x] = wp.exp(-beta[b] * mean_density * ray_length)


@wp.func
def veiled_light(pixel: wp.uint32, haze: wp.vec3i, clear: int, linear: wp.array(dtype=int)) -> wp.vec3i:
    """Return the light of a pixel behind a veil that transmits `clear` of 1024 parts, in as many parts."""
    return linear_pixel(linear, pixel) * clear + haze * (PARTS - clear)


@wp.kernel
def blend_air(
    image: wp.array(dtype=wp.uint32),
    grid: wp.array3d(dtype=float),
    air: wp.array(dtype=wp.vec3),
    linear: wp.array(dtype=int),
    codes: wp.array(dtype=wp.uint8),
    width: int,
    words: int,
    out: wp.array(dtype=wp.uint32),
):
    """Blend airlight in linear light: image * t + air * (1 - t), with the transmittance t from a quarter grid.

    Four pixels are three words. air: 1 is white; linear, codes: the tables of `light.tables`.
    """
    b, y = wp.tid()
    grid_y = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(grid_y))
    fraction = grid_y - float(row)
    i = b * words + y * width * 3 / 4
    haze = light_of(air[b])
    previous = cell(grid, b, row, fraction, -1) * 1024.0
    current = cell(grid, b, row, fraction, 0) * 1024.0
    for quad in range(width / 4):
        following = cell(grid, b, row, fraction, quad + 1) * 1024.0
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        p0 = coded_pixel(
            codes, veiled_light(pixel_of(w0, w1, w2, 0), haze, int(previous + (current - previous) * 0.625), linear)
        )
        p1 = coded_pixel(
            codes, veiled_light(pixel_of(w0, w1, w2, 1), haze, int(previous + (current - previous) * 0.875), linear)
        )
        p2 = coded_pixel(
            codes, veiled_light(pixel_of(w0, w1, w2, 2), haze, int(current + (following - current) * 0.125), linear)
        )
        p3 = coded_pixel(
            codes, veiled_light(pixel_of(w0, w1, w2, 3), haze, int(current + (following - current) * 0.375), linear)
        )
        put_four(out, i, p0, p1, p2, p3)
        i += 3
        previous = current
        current = following


@wp.func
def opacity(layer: wp.array3d(dtype=int), b: int, near_row: int, far_row: int, column: int) -> int:
    """Return the opacity (of 65536, times 4) of a column of the half-resolution layer, between two of its rows."""
    x = wp.clamp(column, 0, layer.shape[2] - 1)
    return 3 * layer[b, near_row, x] + layer[b, far_row, x]


@wp.func
def light_behind_particles(
    pixel: wp.uint32, haze: wp.vec3i, clear: float, white: wp.vec3i, cover: int, linear: wp.array(dtype=int)
) -> wp.vec3i:
    """Return the light of a pixel through the veil and under particles, in 1024 parts.

    The particles hide cover / 1,048,576 of it.
    """
    mixed = veiled_light(pixel, haze, int(clear), linear)
    if cover > 0:
        hidden_parts = wp.min(cover >> 10, PARTS)
        visible_parts = PARTS - hidden_parts
        mixed = (
            wp.vec3i(
                (mixed[0] >> 10) * visible_parts, (mixed[1] >> 10) * visible_parts, (mixed[2] >> 10) * visible_parts
            )
            + white * hidden_parts
        )
    return mixed


@wp.kernel
def blend_particles(
    image: wp.array(dtype=wp.uint32),
    grid: wp.array3d(dtype=float),
    air: wp.array(dtype=wp.vec3),
    layer: wp.array3d(dtype=int),
    white: wp.array(dtype=wp.vec3),
    linear: wp.array(dtype=int),
    codes: wp.array(dtype=wp.uint8),
    width: int,
    words: int,
    out: wp.array(dtype=wp.uint32),
):
    """Blend the veil of `blend_air`, then particles: layer is their opacity (of 65536) at half resolution."""
    b, y = wp.tid()
    grid_y = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(grid_y))
    fraction = grid_y - float(row)
    i = b * words + y * width * 3 / 4
    haze = light_of(air[b])
    light = light_of(white[b])
    # rows of the half-resolution layer around this row: weights 3/4 and 1/4
    near_row = y / 2
    other_row = wp.clamp(near_row + (y & 1) * 2 - 1, 0, layer.shape[1] - 1)
    previous = cell(grid, b, row, fraction, -1) * 1024.0
    current = cell(grid, b, row, fraction, 0) * 1024.0
    o0 = opacity(layer, b, near_row, other_row, -1)
    o1 = opacity(layer, b, near_row, other_row, 0)
    for quad in range(width / 4):
        following = cell(grid, b, row, fraction, quad + 1) * 1024.0
        # pixels 4q to 4q+3 lie in the half-resolution columns 2q and 2q+1
        o2 = opacity(layer, b, near_row, other_row, 2 * quad + 1)
        o3 = opacity(layer, b, near_row, other_row, 2 * quad + 2)
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        p0 = coded_pixel(
            codes,
            light_behind_particles(
                pixel_of(w0, w1, w2, 0), haze, previous + (current - previous) * 0.625, light, 3 * o1 + o0, linear
            ),
        )
        p1 = coded_pixel(
            codes,
            light_behind_particles(
                pixel_of(w0, w1, w2, 1), haze, previous + (current - previous) * 0.875, light, 3 * o1 + o2, linear
            ),
        )
        p2 = coded_pixel(
            codes,
            light_behind_particles(
                pixel_of(w0, w1, w2, 2), haze, current + (following - current) * 0.125, light, 3 * o2 + o1, linear
            ),
        )
        p3 = coded_pixel(
            codes,
            light_behind_particles(
                pixel_of(w0, w1, w2, 3), haze, current + (following - current) * 0.375, light, 3 * o2 + o3, linear
            ),
        )
        put_four(out, i, p0, p1, p2, p3)
        i += 3
        previous = current
        current = following
        o0 = o2
        o1 = o3


STAR = wp.constant(1400.0)  # grey levels one degree from the sun, beyond which star and ghosts grow no more


@wp.kernel
def glare(
    toward: wp.array(dtype=wp.vec3),
    place: wp.array(dtype=wp.vec3),
    lens: wp.array(dtype=wp.vec4),
    strength: wp.array(dtype=float),
    rays: wp.array(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Compute the light that the sun adds in the lens, in grey levels, on the quarter grid.

    toward: unit direction of the sun in the camera frame; place: its pixel (x, y), and 1 if in front of the camera;
    strength: grey levels at one degree from the sun. Veiling glare falls with the square of the angle (CIE disability
    glare: 10 / theta^2), with a bright aureole; the lens adds a six-pointed diffraction star (`rays`: its angle) that
    ends at 14 degrees and two ghosts on the line through the image centre, which do not grow with the dirt on the
    screen before it.
    """
    b, y = wp.tid()
    focal = lens[b]
    sun = toward[b]
    v = ((float(y) + 0.5) * 4.0 - focal[3]) / focal[1]
    sun_pixel = place[b]
    lens_light = wp.min(strength[b], STAR)
    for x in range(out.shape[2]):
        u = ((float(x) + 0.5) * 4.0 - focal[2]) / focal[0]
        ray = wp.normalize(wp.vec3(u, v, 1.0))
        chord = wp.length(ray - sun)
        degrees = chord * 57.29578
        light = strength[b] * (1.0 / (degrees * degrees + 0.04) + 0.06 / (degrees + 1.0))
        if sun_pixel[2] > 0.5:
            dx = (float(x) + 0.5) * 4.0 - sun_pixel[0]
            dy = (float(y) + 0.5) * 4.0 - sun_pixel[1]
            if degrees < 14.0:
                angle = wp.atan2(dy, dx) + rays[b]
                star = wp.cos(angle * 3.0)
                star = star * star
                star = star * star
                star = star * star
                fade = 1.0 - degrees / 14.0
                light += lens_light * star * star * fade * 0.5 / (degrees * degrees * 0.35 + 1.0)
            for ghost in range(2):
                ghost_position = -0.45 - 0.6 * float(ghost)
                ghost_dx = (float(x) + 0.5) * 4.0 - (focal[2] + (sun_pixel[0] - focal[2]) * ghost_position)
                ghost_dy = (float(y) + 0.5) * 4.0 - (focal[3] + (sun_pixel[1] - focal[3]) * ghost_position)
                size = (0.03 + 0.03 * float(ghost)) * focal[0]
                ghost_radius = wp.sqrt(ghost_dx * ghost_dx + ghost_dy * ghost_dy) / size
                if ghost_radius < 1.1:
                    light += (
                        0.035
                        * lens_light
                        * wp.clamp((1.1 - ghost_radius) * 8.0, 0.0, 1.0)
                        * (0.5 + 0.5 * ghost_radius * ghost_radius)
                    )
        out[b, y, x] = light


@wp.func
def lit(pixel: wp.uint32, gain: wp.uint64, tint: wp.uint64, light: float) -> wp.uint32:
    """Return pixel * gain + tint * light (both of 1024), clipped: a field that overflows becomes white."""
    added = wp.uint64(wp.clamp(int(light + 0.5), 0, 320))
    total = ((spread(pixel) * gain + tint * added + HALF) >> wp.uint64(10)) & TENS
    overflow = ((total >> wp.uint64(8)) | (total >> wp.uint64(9))) & ONES
    return gather((total | (overflow * wp.uint64(255))) & FIELDS)


@wp.kernel
def blend_glare(
    image: wp.array(dtype=wp.uint32),
    grid: wp.array3d(dtype=float),
    tint: wp.array(dtype=wp.vec3),
    gain: wp.array(dtype=float),
    width: int,
    words: int,
    out: wp.array(dtype=wp.uint32),
):
    """Blend glare at a lower exposure: image * gain + tint * grid, clipped. tint, gain: 0 to 1."""
    b, y = wp.tid()
    grid_y = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(grid_y))
    fraction = grid_y - float(row)
    i = b * words + y * width * 3 / 4
    factor = wp.uint64(wp.clamp(int(gain[b] * 1024.0), 0, 1024))
    tint_fields = fields_of(tint[b] * 1023.0)
    previous = cell(grid, b, row, fraction, -1)
    current = cell(grid, b, row, fraction, 0)
    for quad in range(width / 4):
        following = cell(grid, b, row, fraction, quad + 1)
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        p0 = lit(pixel_of(w0, w1, w2, 0), factor, tint_fields, previous + (current - previous) * 0.625)
        p1 = lit(pixel_of(w0, w1, w2, 1), factor, tint_fields, previous + (current - previous) * 0.875)
        p2 = lit(pixel_of(w0, w1, w2, 2), factor, tint_fields, current + (following - current) * 0.125)
        p3 = lit(pixel_of(w0, w1, w2, 3), factor, tint_fields, current + (following - current) * 0.375)
        put_four(out, i, p0, p1, p2, p3)
        i += 3
        previous = current
        current = following

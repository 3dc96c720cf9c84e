"""Wet ground: its extent, its reflection, and the image with both."""

from typing import Any

import warp as wp

from ssad.scenarios.static.shifts.kernels.light import CODES, WHITE
from ssad.scenarios.static.shifts.kernels.shared import pixel_of, put_four, value_noise

wp.set_module_options({"enable_backward": False})  # see `exposure`

FARTHEST_GROUND = wp.constant(120.0)  # m: beyond it, ground and house fronts share a cell
FARTHEST_PLANE = wp.constant(60.0)  # where depth is not given
STEPS = wp.constant(30)  # along the mirrored ray, each `RATIO` times as far away as the one before
RATIO = wp.constant(1.11)
BEHIND = wp.constant(0.85)  # a surface is met if it lies at this share of the ray's depth or deeper
HIGHEST = wp.constant(int(CODES - 1))
PARTS_OF_LIGHT = wp.constant(float(CODES))


@wp.struct
class Footprint:
    """Ground rectangle of a box in the ego's frame, m.

    Attributes:
        x: Centre along x.
        y: Centre along y.
        cos: Cosine of the direction of its length.
        sin: Sine of that direction.
        half_length: Half its length.
        half_width: Half its width.
        base: Height of its base.
    """

    x: float
    y: float
    cos: float
    sin: float
    half_length: float
    half_width: float
    base: float


@wp.func
def place_of(focal: wp.vec4, x: int, y: int, depth: float) -> wp.vec3:
    """Return the point in the camera frame at the centre of a cell of the quarter grid."""
    u = ((float(x) + 0.5) * 4.0 - focal[2]) / focal[0]
    v = ((float(y) + 0.5) * 4.0 - focal[3]) / focal[1]
    return wp.vec3(u, v, 1.0) * depth


@wp.func
def nearer(depth: wp.array3d(dtype=float), b: int, y: int, x: int, dy: int, dx: int) -> int:
    """Return the side, 1 or -1, of the neighbouring cell with the more similar depth, which continues the surface."""
    cell_depth = depth[b, y, x]
    forward_step = float(1.0e9)
    backward_step = float(1.0e9)
    if y + dy < depth.shape[1] and x + dx < depth.shape[2]:
        forward_step = wp.abs(depth[b, y + dy, x + dx] - cell_depth)
    if y - dy >= 0 and x - dx >= 0:
        backward_step = wp.abs(depth[b, y - dy, x - dx] - cell_depth)
    return wp.where(forward_step <= backward_step, 1, -1)


@wp.func
def level(depth: wp.array3d(dtype=float), b: int, y: int, x: int, focal: wp.vec4, pose: wp.mat44) -> float:
    """Return 1 where the surface at a cell is level, 0 where it is steep."""
    origin = place_of(focal, x, y, depth[b, y, x])
    side = nearer(depth, b, y, x, 0, 1)
    down = nearer(depth, b, y, x, 1, 0)
    across = place_of(focal, x + side, y, depth[b, y, x + side]) - origin
    along = place_of(focal, x, y + down, depth[b, y + down, x]) - origin
    normal = wp.transform_vector(pose, wp.normalize(wp.cross(across, along)))
    return wp.clamp(wp.abs(normal[2]) * 5.0 - 3.5, 0.0, 1.0)


@wp.kernel
def find_ground(
    lens: wp.array(dtype=wp.vec4),
    to_ego: wp.array(dtype=wp.mat44),
    is_depth_given: wp.array(dtype=int),
    boxes: wp.array(dtype=Footprint),
    first: wp.array(dtype=int),
    depth: wp.array3d(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Compute the share of each cell of the quarter grid that is ground.

    With given depth: level surface near the height of the road; inside the outline of a box only its very base. With
    filled-in depth (given: 0): the plane of the road beside boxes, up to the first nearer surface; depth is set to
    the plane there.
    """
    b, y = wp.tid()
    focal = lens[b]
    pose = to_ego[b]
    for x in range(depth.shape[2]):
        cell_depth = depth[b, y, x]
        share = float(0.0)
        if is_depth_given[b] == 0:
            ray_slope = wp.transform_vector(pose, place_of(focal, x, y, 1.0))[2]
            if ray_slope < 0.0:
                plane_depth = -pose[2, 3] / ray_slope
                if plane_depth < FARTHEST_PLANE:
                    share = wp.clamp((cell_depth / plane_depth - 0.7) * 10.0, 0.0, 1.0)
                    if share > 0.0:
                        cell_depth = plane_depth
                        depth[b, y, x] = plane_depth
        point = wp.transform_point(pose, place_of(focal, x, y, cell_depth))
        if is_depth_given[b] == 1 and cell_depth < FARTHEST_GROUND:
            share = wp.clamp(2.0 - 2.0 * wp.abs(point[2]) / (0.4 + 0.012 * cell_depth), 0.0, 1.0)
            if share > 0.0:
                share *= level(depth, b, y, x, focal, pose)
        if share > 0.0:
            for box_index in range(first[b], first[b + 1]):
                box = boxes[box_index]
                offset_x = point[0] - box.x
                offset_y = point[1] - box.y
                lateral = wp.abs(offset_y * box.cos - offset_x * box.sin)
                if wp.abs(offset_x * box.cos + offset_y * box.sin) < box.half_length and lateral < box.half_width:
                    share *= float(is_depth_given[b]) * wp.clamp(2.0 - wp.abs(point[2] - box.base) * 20.0, 0.0, 1.0)
        out[b, y, x] = share


@wp.kernel
def shrink(
    image: wp.array(dtype=wp.uint8),
    linear: wp.array(dtype=int),
    width: int,
    height: int,
    out: wp.array3d(dtype=wp.vec3),
):
    """Compute the mean light of each cell of the quarter grid, 1 for white."""
    b, y = wp.tid()
    for x in range(out.shape[2]):
        total = wp.vec3(0.0, 0.0, 0.0)
        for row in range(2):
            image_row = wp.min(4 * y + 1 + row, height - 1)
            for column in range(2):
                pixel = ((b * height + image_row) * width + wp.min(4 * x + 1 + column, width - 1)) * 3
                total += wp.vec3(
                    float(linear[int(image[pixel])]),
                    float(linear[int(image[pixel + 1])]),
                    float(linear[int(image[pixel + 2])]),
                )
        out[b, y, x] = total / (4.0 * WHITE)


@wp.kernel
def typical_light(ground: wp.array3d(dtype=float), light: wp.array3d(dtype=wp.vec3), out: wp.array3d(dtype=float)):
    """Compute the geometric mean light of the ground around each eighth cell, 24 x 24 cells, robust to paint."""
    b, block_row, block_column = wp.tid()
    total = float(0.0)
    weight = float(1.0e-6)
    for sample_row in range(8):
        y = 8 * block_row - 8 + 3 * sample_row
        if y >= 0 and y < ground.shape[1]:
            for sample_column in range(8):
                x = 8 * block_column - 8 + 3 * sample_column
                if x >= 0 and x < ground.shape[2]:
                    colour = light[b, y, x]
                    total += ground[b, y, x] * wp.log(0.3 * colour[0] + 0.6 * colour[1] + 0.1 * colour[2] + 0.002)
                    weight += ground[b, y, x]
    out[b, block_row, block_column] = wp.exp(total / weight)


@wp.func
def on_grid(focal: wp.vec4, p: wp.vec3) -> wp.vec2:
    """Return column and row on the quarter grid, whose first cell spans 0 to 1, of a point in the camera frame."""
    return wp.vec2((p[0] / p[2] * focal[0] + focal[2]) * 0.25, (p[1] / p[2] * focal[1] + focal[3]) * 0.25)


@wp.func
def light_at_position(light: wp.array3d(dtype=wp.vec3), b: int, x: float, y: float) -> wp.vec3:
    """Return the light at a position of the quarter grid, interpolated between columns, clamped at the border."""
    row = wp.clamp(int(wp.floor(y)), 0, light.shape[1] - 1)
    left = wp.floor(x - 0.5)
    share = x - 0.5 - left
    first = light[b, row, wp.clamp(int(left), 0, light.shape[2] - 1)]
    return first * (1.0 - share) + light[b, row, wp.clamp(int(left) + 1, 0, light.shape[2] - 1)] * share


@wp.func
def mirror_point(ray: wp.vec3, up: wp.vec3, rise: float, d: float, s: float) -> wp.vec3:
    """Return the point at depth s of a ray (camera frame, depth 1), mirrored at its ground hit at depth d."""
    return ray * s - up * (2.0 * rise * (s - d))


@wp.func
def is_on_surface(
    depth: wp.array3d(dtype=float), ground: wp.array3d(dtype=float), b: int, focal: wp.vec4, p: wp.vec3
) -> bool:
    """Check that a point lies on, or slightly behind, a visible surface that is not ground."""
    if p[2] < 0.5:
        return False
    position = on_grid(focal, p)
    row = int(wp.floor(position[1]))
    column = int(wp.floor(position[0]))
    if row < 0 or row >= depth.shape[1] or column < 0 or column >= depth.shape[2]:
        return False
    surface_depth = depth[b, row, column]
    return surface_depth <= p[2] * 1.01 and surface_depth >= p[2] * BEHIND and ground[b, row, column] < 0.5


@wp.kernel
def mirror(
    depth: wp.array3d(dtype=float),
    ground: wp.array3d(dtype=float),
    light: wp.array3d(dtype=wp.vec3),
    lens: wp.array(dtype=wp.vec4),
    to_ego: wp.array(dtype=wp.mat44),
    to_world: wp.array(dtype=wp.mat44),
    keys: wp.array(dtype=wp.uint64),
    film: wp.array(dtype=float),
    rough: wp.array(dtype=float),
    out: wp.array3d(dtype=wp.vec4),
):
    """Compute the reflection of the water film in each cell.

    out: reflected light times the reflectance (red, green, blue), and the reflectance.

    The reflected ray sees the mirror image of the ray continued below the ground: its points are mirrored up, and the
    first on a visible surface is reflected, or else the sky in the direction of the ray. rough: tangent of the angle
    over which waves blur it vertically. Water lies in hollows (noise fixed to the world, about a mean of `film`) and
    reflects by Fresnel's law for n = 1.33 (Schlick 1994).
    """
    b, y = wp.tid()
    focal = lens[b]
    pose = to_ego[b]
    up = wp.vec3(pose[2, 0], pose[2, 1], pose[2, 2])  # in the camera frame
    for x in range(depth.shape[2]):
        result = wp.vec4(0.0, 0.0, 0.0, 0.0)
        ground_depth = depth[b, y, x]
        if ground[b, y, x] > 0.0:
            ray = place_of(focal, x, y, 1.0)
            rise = wp.dot(up, ray)  # below 0
            hit_depth = float(0.0)
            step_depth = ground_depth
            for _step in range(STEPS):
                if hit_depth == 0.0:
                    step_depth *= RATIO
                    if is_on_surface(depth, ground, b, focal, mirror_point(ray, up, rise, ground_depth, step_depth)):
                        hit_depth = step_depth
            target = ray - up * (2.0 * rise)  # point at infinity: direction of the mirrored ray
            blur = rough[b] * focal[1] * 0.25
            if hit_depth > 0.0:
                # Bisection between the last two steps refines the hit.
                near_depth = hit_depth / RATIO
                for _step in range(4):
                    mid_depth = 0.5 * (near_depth + hit_depth)
                    if is_on_surface(depth, ground, b, focal, mirror_point(ray, up, rise, ground_depth, mid_depth)):
                        hit_depth = mid_depth
                    else:
                        near_depth = mid_depth
                target = mirror_point(ray, up, rise, ground_depth, hit_depth)
                blur *= 1.0 - ground_depth / hit_depth
            reflection = wp.vec3(0.0, 0.0, 0.0)
            if target[2] > 0.01:
                position = on_grid(focal, target)
                weight = float(0.0)
                for tap_index in range(9):
                    tap_offset = float(tap_index - 4) * 0.25
                    share = 1.0 - tap_offset * tap_offset * 0.8
                    reflection += light_at_position(light, b, position[0], position[1] + blur * tap_offset) * share
                    weight += share
                reflection = reflection / weight
            world_point = wp.transform_point(to_world[b], ray * ground_depth)
            ground_point = wp.vec3(world_point[0], world_point[1], 0.0)
            hollow = 0.6 * value_noise(keys[b], ground_point / 3.1) + 0.4 * value_noise(
                keys[b] + wp.uint64(1), ground_point / 0.9
            )
            water = wp.clamp(film[b] + 1.1 * (hollow - 0.5) * (1.0 - film[b] * 0.5), 0.0, 1.0)
            one_minus_cosine = 1.0 + wp.clamp(rise / wp.length(ray), -1.0, 0.0)
            squared = one_minus_cosine * one_minus_cosine
            reflectance = water * (0.02 + 0.98 * squared * squared * one_minus_cosine)
            result = wp.vec4(
                reflection[0] * reflectance, reflection[1] * reflectance, reflection[2] * reflectance, reflectance
            )
        out[b, y, x] = result


@wp.kernel
def soften(shine: wp.array3d(dtype=wp.vec4), ground: wp.array3d(dtype=float), out: wp.array3d(dtype=wp.vec4)):
    """Blur the reflection over 3 x 5 cells of ground, as waves do, so that its outlines have no steps of a cell."""
    b, y = wp.tid()
    for x in range(shine.shape[2]):
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        weight = float(0.0)
        if ground[b, y, x] > 0.0:
            for row_offset in range(-2, 3):
                row = y + row_offset
                if row >= 0 and row < shine.shape[1]:
                    for column_offset in range(-1, 2):
                        column = x + column_offset
                        if column >= 0 and column < shine.shape[2]:
                            # Binomial weights; what is no ground reflects nothing and has none.
                            share = ground[b, row, column] * (2.0 - wp.abs(float(column_offset)))
                            share *= 3.0 - wp.abs(float(row_offset))
                            total += shine[b, row, column] * share
                            weight += share
            total = total / wp.max(weight, 1.0e-6)
        out[b, y, x] = total


@wp.func
def between(grid: wp.array3d(dtype=Any), b: int, row: int, fraction: float, column: int):
    """Return the value of a grid, of numbers or vectors, between two of its rows; columns are clamped."""
    clamped = wp.clamp(column, 0, grid.shape[2] - 1)
    low = wp.clamp(row, 0, grid.shape[1] - 1)
    high = wp.clamp(row + 1, 0, grid.shape[1] - 1)
    return grid[b, low, clamped] * (1.0 - fraction) + grid[b, high, clamped] * fraction


@wp.func
def wet_pixel(
    pixel: wp.uint32,
    covered: float,
    shine: wp.vec4,
    usual: float,
    dark: float,
    linear: wp.array(dtype=int),
    codes: wp.array(dtype=wp.uint8),
) -> wp.uint32:
    """Return a pixel of which `covered` (from a half on) is wet ground."""
    wetness = 2.0 * covered - 1.0
    if wetness <= 0.0:
        return pixel
    r_light = float(linear[int(pixel & wp.uint32(255))]) / WHITE
    g_light = float(linear[int((pixel >> wp.uint32(8)) & wp.uint32(255))]) / WHITE
    b_light = float(linear[int((pixel >> wp.uint32(16)) & wp.uint32(255))]) / WHITE
    # paint keeps more of its light than asphalt, whose pores fill
    paint = wp.clamp((0.3 * r_light + 0.6 * g_light + 0.1 * b_light) / usual - 1.5, 0.0, 1.0)
    keep = (1.0 - wetness * dark * (1.0 - 0.7 * paint)) * (1.0 - wetness * shine[3])
    red = wp.uint32(codes[wp.min(int((r_light * keep + shine[0] * wetness) * PARTS_OF_LIGHT), HIGHEST)])
    green = wp.uint32(codes[wp.min(int((g_light * keep + shine[1] * wetness) * PARTS_OF_LIGHT), HIGHEST)])
    blue = wp.uint32(codes[wp.min(int((b_light * keep + shine[2] * wetness) * PARTS_OF_LIGHT), HIGHEST)])
    return red | (green << wp.uint32(8)) | (blue << wp.uint32(16))


@wp.kernel
def blend_wet(
    image: wp.array(dtype=wp.uint32),
    ground: wp.array3d(dtype=float),
    shine: wp.array3d(dtype=wp.vec4),
    typical: wp.array3d(dtype=float),
    dark: wp.array(dtype=float),
    linear: wp.array(dtype=int),
    codes: wp.array(dtype=wp.uint8),
    width: int,
    words: int,
    out: wp.array(dtype=wp.uint32),
):
    """Blend dark, reflecting ground into the image in linear light; dark: share of light that wet asphalt loses."""
    b, y = wp.tid()
    grid_y = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(grid_y))
    fraction = grid_y - float(row)
    i = b * words + y * width * 3 / 4
    row_max = float(0.0)
    for x in range(ground.shape[2]):
        row_max = wp.max(row_max, between(ground, b, row, fraction, x))
    # Rows without wet ground are copied; `wet_pixel` acts from a half on.
    if row_max <= 0.5:
        for word_index in range(width * 3 / 4):
            out[i + word_index] = image[i + word_index]
        return
    g0 = between(ground, b, row, fraction, -1)
    g1 = between(ground, b, row, fraction, 0)
    s0 = between(shine, b, row, fraction, -1)
    s1 = between(shine, b, row, fraction, 0)
    for quad in range(width / 4):
        g2 = between(ground, b, row, fraction, quad + 1)
        s2 = between(shine, b, row, fraction, quad + 1)
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        if g0 + g1 + g2 > 0.0:
            mean_light = typical[b, y / 32, wp.min(quad / 8, typical.shape[2] - 1)]
            darkening = dark[b]
            p0 = wet_pixel(
                pixel_of(w0, w1, w2, 0),
                g0 + (g1 - g0) * 0.625,
                s0 + (s1 - s0) * 0.625,
                mean_light,
                darkening,
                linear,
                codes,
            )
            p1 = wet_pixel(
                pixel_of(w0, w1, w2, 1),
                g0 + (g1 - g0) * 0.875,
                s0 + (s1 - s0) * 0.875,
                mean_light,
                darkening,
                linear,
                codes,
            )
            p2 = wet_pixel(
                pixel_of(w0, w1, w2, 2),
                g1 + (g2 - g1) * 0.125,
                s1 + (s2 - s1) * 0.125,
                mean_light,
                darkening,
                linear,
                codes,
            )
            p3 = wet_pixel(
                pixel_of(w0, w1, w2, 3),
                g1 + (g2 - g1) * 0.375,
                s1 + (s2 - s1) * 0.375,
                mean_light,
                darkening,
                linear,
                codes,
            )
            put_four(out, i, p0, p1, p2, p3)
        else:
            out[i] = w0
            out[i + 1] = w1
            out[i + 2] = w2
        i += 3
        g0 = g1
        g1 = g2
        s0 = s1
        s1 = s2

"""Wet ground: where it is, what it mirrors, and the picture with it."""

from typing import Any

import warp as wp

from ssad.scenarios.static.shifts.kernels.light import CODES, WHITE
from ssad.scenarios.static.shifts.kernels.shared import pixel_of, put_four, value_noise

FARTHEST_GROUND = wp.constant(120.0)  # m: beyond it, ground and house fronts share a cell
FARTHEST_PLANE = wp.constant(60.0)  # where depth is not given
STEPS = wp.constant(30)  # along the mirrored ray, each `RATIO` times as far away as the one before
RATIO = wp.constant(1.11)
BEHIND = wp.constant(0.85)  # a surface is met if it lies at this share of the ray's depth or deeper
HIGHEST = wp.constant(int(CODES - 1))
PARTS_OF_LIGHT = wp.constant(float(CODES))


@wp.struct
class Footprint:
    """Where a box stands, in the ego's frame, m.

    Attributes:
        x: Of the middle.
        y: Of the middle.
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
    """The point in the camera frame at the middle of a cell of the quarter grid."""
    u = ((float(x) + 0.5) * 4.0 - focal[2]) / focal[0]
    v = ((float(y) + 0.5) * 4.0 - focal[3]) / focal[1]
    return wp.vec3(u, v, 1.0) * depth


@wp.func
def nearer(depth: wp.array3d(dtype=float), b: int, y: int, x: int, dy: int, dx: int) -> int:
    """On which side, 1 or -1, the neighbouring cell is more alike: the surface goes on there."""
    here = depth[b, y, x]
    ahead = float(1.0e9)
    back = float(1.0e9)
    if y + dy < depth.shape[1] and x + dx < depth.shape[2]:
        ahead = wp.abs(depth[b, y + dy, x + dx] - here)
    if y - dy >= 0 and x - dx >= 0:
        back = wp.abs(depth[b, y - dy, x - dx] - here)
    return wp.where(ahead <= back, 1, -1)


@wp.func
def level(depth: wp.array3d(dtype=float), b: int, y: int, x: int, focal: wp.vec4, pose: wp.mat44) -> float:
    """1 where the surface at a cell lies level, 0 where it is steep."""
    here = place_of(focal, x, y, depth[b, y, x])
    side = nearer(depth, b, y, x, 0, 1)
    down = nearer(depth, b, y, x, 1, 0)
    across = place_of(focal, x + side, y, depth[b, y, x + side]) - here
    along = place_of(focal, x, y + down, depth[b, y + down, x]) - here
    normal = wp.transform_vector(pose, wp.normalize(wp.cross(across, along)))
    return wp.clamp(wp.abs(normal[2]) * 5.0 - 3.5, 0.0, 1.0)


@wp.kernel
def find_ground(
    lens: wp.array(dtype=wp.vec4),
    to_ego: wp.array(dtype=wp.mat44),
    given: wp.array(dtype=int),
    boxes: wp.array(dtype=Footprint),
    first: wp.array(dtype=int),
    depth: wp.array3d(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Share of each cell of the quarter grid that is ground.

    Where depth is given: what is level near the height of the road, and of the outline of a box its very base. Where it
    is filled in (given: 0): the plane of the road beside boxes, as far as nothing nearer is known; depth becomes the
    plane's there.
    """
    b, y = wp.tid()
    focal = lens[b]
    pose = to_ego[b]
    for x in range(depth.shape[2]):
        d = depth[b, y, x]
        share = float(0.0)
        if given[b] == 0:
            fall = wp.transform_vector(pose, place_of(focal, x, y, 1.0))[2]
            if fall < 0.0:
                plane = -pose[2, 3] / fall
                if plane < FARTHEST_PLANE:
                    share = wp.clamp((d / plane - 0.7) * 10.0, 0.0, 1.0)
                    if share > 0.0:
                        d = plane
                        depth[b, y, x] = plane
        p = wp.transform_point(pose, place_of(focal, x, y, d))
        if given[b] == 1 and d < FARTHEST_GROUND:
            share = wp.clamp(2.0 - 2.0 * wp.abs(p[2]) / (0.4 + 0.012 * d), 0.0, 1.0)
            if share > 0.0:
                share *= level(depth, b, y, x, focal, pose)
        if share > 0.0:
            for k in range(first[b], first[b + 1]):
                box = boxes[k]
                ex = p[0] - box.x
                ey = p[1] - box.y
                aside = wp.abs(ey * box.cos - ex * box.sin)
                if wp.abs(ex * box.cos + ey * box.sin) < box.half_length and aside < box.half_width:
                    share *= float(given[b]) * wp.clamp(2.0 - wp.abs(p[2] - box.base) * 20.0, 0.0, 1.0)
        out[b, y, x] = share


@wp.kernel
def shrink(
    image: wp.array(dtype=wp.uint8),
    linear: wp.array(dtype=int),
    width: int,
    height: int,
    out: wp.array3d(dtype=wp.vec3),
):
    """Mean light of the pixels of each cell of the quarter grid, 1 for white."""
    b, y = wp.tid()
    for x in range(out.shape[2]):
        total = wp.vec3(0.0, 0.0, 0.0)
        for row in range(2):
            line = wp.min(4 * y + 1 + row, height - 1)
            for column in range(2):
                i = ((b * height + line) * width + wp.min(4 * x + 1 + column, width - 1)) * 3
                total += wp.vec3(
                    float(linear[int(image[i])]), float(linear[int(image[i + 1])]), float(linear[int(image[i + 2])])
                )
        out[b, y, x] = total / (4.0 * WHITE)


@wp.kernel
def usual_light(ground: wp.array3d(dtype=float), light: wp.array3d(dtype=wp.vec3), out: wp.array3d(dtype=float)):
    """Light of the ground around each eighth cell: geometric mean over 24 x 24 cells, which paint moves little."""
    b, j, i = wp.tid()
    total = float(0.0)
    weight = float(1.0e-6)
    for q in range(8):
        y = 8 * j - 8 + 3 * q
        if y >= 0 and y < ground.shape[1]:
            for p in range(8):
                x = 8 * i - 8 + 3 * p
                if x >= 0 and x < ground.shape[2]:
                    colour = light[b, y, x]
                    total += ground[b, y, x] * wp.log(0.3 * colour[0] + 0.6 * colour[1] + 0.1 * colour[2] + 0.002)
                    weight += ground[b, y, x]
    out[b, j, i] = wp.exp(total / weight)


@wp.func
def on_grid(focal: wp.vec4, p: wp.vec3) -> wp.vec2:
    """Column and row on the quarter grid, whose first cell spans 0 to 1, of a point in the camera frame."""
    return wp.vec2((p[0] / p[2] * focal[0] + focal[2]) * 0.25, (p[1] / p[2] * focal[1] + focal[3]) * 0.25)


@wp.func
def seen_at(light: wp.array3d(dtype=wp.vec3), b: int, x: float, y: float) -> wp.vec3:
    """Light at a place of the quarter grid, between its columns, held at the border."""
    row = wp.clamp(int(wp.floor(y)), 0, light.shape[1] - 1)
    left = wp.floor(x - 0.5)
    share = x - 0.5 - left
    first = light[b, row, wp.clamp(int(left), 0, light.shape[2] - 1)]
    return first * (1.0 - share) + light[b, row, wp.clamp(int(left) + 1, 0, light.shape[2] - 1)] * share


@wp.func
def mirrored(ray: wp.vec3, up: wp.vec3, rise: float, d: float, s: float) -> wp.vec3:
    """The point at depth s of a ray (camera frame, depth 1) that meets the ground at depth d, mirrored there."""
    return ray * s - up * (2.0 * rise * (s - d))


@wp.func
def meets(depth: wp.array3d(dtype=float), ground: wp.array3d(dtype=float), b: int, focal: wp.vec4, p: wp.vec3) -> bool:
    """Whether a point lies on, or not far behind, a surface of the picture that is not ground."""
    if p[2] < 0.5:
        return False
    at = on_grid(focal, p)
    row = int(wp.floor(at[1]))
    column = int(wp.floor(at[0]))
    if row < 0 or row >= depth.shape[1] or column < 0 or column >= depth.shape[2]:
        return False
    there = depth[b, row, column]
    return there <= p[2] * 1.01 and there >= p[2] * BEHIND and ground[b, row, column] < 0.5


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
    """What the film of water mirrors in each cell, times how much of it (red, green, blue), and how much.

    The ray that leaves the ground upwards sees what the ray that goes on below it sees in the mirrored scene: its
    points are mirrored up, and the first that lies on a surface of the picture is seen; if none does, the sky where the
    ray points. rough: tangent of the angle over which waves blur it upright. Water lies in hollows (noise fixed to the
    world, about a mean of `film`) and mirrors by Fresnel's law for n = 1.33 (Schlick 1994).
    """
    b, y = wp.tid()
    focal = lens[b]
    pose = to_ego[b]
    up = wp.vec3(pose[2, 0], pose[2, 1], pose[2, 2])  # in the camera frame
    for x in range(depth.shape[2]):
        result = wp.vec4(0.0, 0.0, 0.0, 0.0)
        d = depth[b, y, x]
        if ground[b, y, x] > 0.0:
            ray = place_of(focal, x, y, 1.0)
            rise = wp.dot(up, ray)  # below 0
            met = float(0.0)
            s = d
            for _k in range(STEPS):
                if met == 0.0:
                    s *= RATIO
                    if meets(depth, ground, b, focal, mirrored(ray, up, rise, d, s)):
                        met = s
            q = ray - up * (2.0 * rise)  # without end: where the mirrored ray points
            blur = rough[b] * focal[1] * 0.25
            if met > 0.0:
                least = met / RATIO
                for _k in range(4):
                    middle = 0.5 * (least + met)
                    if meets(depth, ground, b, focal, mirrored(ray, up, rise, d, middle)):
                        met = middle
                    else:
                        least = middle
                q = mirrored(ray, up, rise, d, met)
                blur *= 1.0 - d / met
            seen = wp.vec3(0.0, 0.0, 0.0)
            if q[2] > 0.01:
                at = on_grid(focal, q)
                weight = float(0.0)
                for k in range(9):
                    away = float(k - 4) * 0.25
                    share = 1.0 - away * away * 0.8
                    seen += seen_at(light, b, at[0], at[1] + blur * away) * share
                    weight += share
                seen = seen / weight
            place = wp.transform_point(to_world[b], ray * d)
            flat = wp.vec3(place[0], place[1], 0.0)
            hollow = 0.6 * value_noise(keys[b], flat / 3.1) + 0.4 * value_noise(keys[b] + wp.uint64(1), flat / 0.9)
            water = wp.clamp(film[b] + 1.1 * (hollow - 0.5) * (1.0 - film[b] * 0.5), 0.0, 1.0)
            grazing = 1.0 + wp.clamp(rise / wp.length(ray), -1.0, 0.0)
            twice = grazing * grazing
            part = water * (0.02 + 0.98 * twice * twice * grazing)
            result = wp.vec4(seen[0] * part, seen[1] * part, seen[2] * part, part)
        out[b, y, x] = result


@wp.func
def between(grid: wp.array3d(dtype=Any), b: int, row: int, fraction: float, column: int):
    """Value of a grid, of numbers or of vectors, between two of its rows, columns held at the border."""
    x = wp.clamp(column, 0, grid.shape[2] - 1)
    low = wp.clamp(row, 0, grid.shape[1] - 1)
    high = wp.clamp(row + 1, 0, grid.shape[1] - 1)
    return grid[b, low, x] * (1.0 - fraction) + grid[b, high, x] * fraction


@wp.func
def wetted(
    pixel: wp.uint32,
    covered: float,
    shine: wp.vec4,
    usual: float,
    dark: float,
    linear: wp.array(dtype=int),
    codes: wp.array(dtype=wp.uint8),
) -> wp.uint32:
    """A pixel of which `covered` (from a half on) is wet ground."""
    wet = 2.0 * covered - 1.0
    if wet <= 0.0:
        return pixel
    r = float(linear[int(pixel & wp.uint32(255))]) / WHITE
    g = float(linear[int((pixel >> wp.uint32(8)) & wp.uint32(255))]) / WHITE
    k = float(linear[int((pixel >> wp.uint32(16)) & wp.uint32(255))]) / WHITE
    # paint keeps more of its light than asphalt, whose pores fill
    paint = wp.clamp((0.3 * r + 0.6 * g + 0.1 * k) / usual - 1.5, 0.0, 1.0)
    keep = (1.0 - wet * dark * (1.0 - 0.7 * paint)) * (1.0 - wet * shine[3])
    red = wp.uint32(codes[wp.min(int((r * keep + shine[0] * wet) * PARTS_OF_LIGHT), HIGHEST)])
    green = wp.uint32(codes[wp.min(int((g * keep + shine[1] * wet) * PARTS_OF_LIGHT), HIGHEST)])
    blue = wp.uint32(codes[wp.min(int((k * keep + shine[2] * wet) * PARTS_OF_LIGHT), HIGHEST)])
    return red | (green << wp.uint32(8)) | (blue << wp.uint32(16))


@wp.kernel
def blend_wet(
    image: wp.array(dtype=wp.uint32),
    ground: wp.array3d(dtype=float),
    shine: wp.array3d(dtype=wp.vec4),
    usual: wp.array3d(dtype=float),
    dark: wp.array(dtype=float),
    linear: wp.array(dtype=int),
    codes: wp.array(dtype=wp.uint8),
    width: int,
    words: int,
    out: wp.array(dtype=wp.uint32),
):
    """The picture with dark, mirroring ground; in linear light. dark: share of its light that wet asphalt loses."""
    b, y = wp.tid()
    fy = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(fy))
    fraction = fy - float(row)
    i = b * words + y * width * 3 / 4
    most = float(0.0)
    for x in range(ground.shape[2]):
        most = wp.max(most, between(ground, b, row, fraction, x))
    if most <= 0.5:
        for k in range(width * 3 / 4):
            out[i + k] = image[i + k]
        return
    g0 = between(ground, b, row, fraction, -1)
    g1 = between(ground, b, row, fraction, 0)
    s0 = between(shine, b, row, fraction, -1)
    s1 = between(shine, b, row, fraction, 0)
    for q in range(width / 4):
        g2 = between(ground, b, row, fraction, q + 1)
        s2 = between(shine, b, row, fraction, q + 1)
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        if g0 + g1 + g2 > 0.0:
            level = usual[b, y / 32, wp.min(q / 8, usual.shape[2] - 1)]
            loss = dark[b]
            p0 = wetted(
                pixel_of(w0, w1, w2, 0), g0 + (g1 - g0) * 0.625, s0 + (s1 - s0) * 0.625, level, loss, linear, codes
            )
            p1 = wetted(
                pixel_of(w0, w1, w2, 1), g0 + (g1 - g0) * 0.875, s0 + (s1 - s0) * 0.875, level, loss, linear, codes
            )
            p2 = wetted(
                pixel_of(w0, w1, w2, 2), g1 + (g2 - g1) * 0.125, s1 + (s2 - s1) * 0.125, level, loss, linear, codes
            )
            p3 = wetted(
                pixel_of(w0, w1, w2, 3), g1 + (g2 - g1) * 0.375, s1 + (s2 - s1) * 0.375, level, loss, linear, codes
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

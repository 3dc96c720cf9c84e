"""What lies between the camera and the scene: extinction and airlight, particles, glare, gain."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import byte, cell, value_noise


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
    u = (float(x) + 0.5) * cells - 0.5
    v = (float(y) + 0.5) * cells - 0.5
    row = wp.min(int(v * 0.25), depth.shape[1] - 1)
    column = wp.min(int(u * 0.25), depth.shape[2] - 1)
    far = wp.clamp(depth[b, row, column], 2.0, 120.0)
    pose = to_world[b]
    ray = wp.vec3((u - focal[2]) / focal[0], (v - focal[3]) / focal[1], 1.0)
    total = float(0.0)
    for k in range(3):
        s = far * (float(k) + 0.5) / 3.0
        p = wp.transform_point(pose, ray * s) - drift[b]
        total += value_noise(keys[b], p / 30.0) * 0.65 + value_noise(keys[b] + wp.uint64(1), p / 11.0) * 0.35
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
    """Koschmieder: exp(-beta * range) at each node; range is depth times the slant of the ray."""
    b, y = wp.tid()
    focal = slant[b]
    v = ((float(y) + 0.5) * 4.0 - 0.5 - focal[3]) / focal[1]
    fy = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(fy))
    for x in range(depth.shape[2]):
        u = ((float(x) + 0.5) * 4.0 - 0.5 - focal[2]) / focal[0]
        fx = (float(x) + 0.5) * 0.25 - 0.5
        column = int(wp.floor(fx))
        left = cell(density, b, row, fy - float(row), column)
        right = cell(density, b, row, fy - float(row), column + 1)
        thick = left + (right - left) * (fx - float(column))
        away = wp.min(depth[b, y, x] * wp.sqrt(1.0 + u * u + v * v), farthest)
        out[b, y, x] = wp.exp(-beta[b] * thick * away)


@wp.kernel
def blend_air(
    image: wp.array(dtype=wp.uint8),
    grid: wp.array3d(dtype=float),
    air: wp.array(dtype=wp.vec3),
    height: int,
    width: int,
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """image * t + air * (1 - t), with t from a quarter grid; `air` in grey levels."""
    b, y = wp.tid()
    fy = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(fy))
    fraction = fy - float(row)
    start = b * stride + y * width * 3
    red = int(air[b][0] * 1024.0)
    green = int(air[b][1] * 1024.0)
    blue = int(air[b][2] * 1024.0)
    left = cell(grid, b, row, fraction, -1)
    for q in range(-1, grid.shape[2]):
        right = cell(grid, b, row, fraction, q + 1)
        for k in range(4):
            x = q * 4 + 2 + k
            if x >= 0 and x < width:
                t = int((left + (right - left) * (float(k) + 0.5) * 0.25) * 1024.0)
                i = start + x * 3
                rest = 1024 - t
                out[i] = wp.uint8((int(image[i]) * t * 1024 + red * rest + 524288) >> 20)
                out[i + 1] = wp.uint8((int(image[i + 1]) * t * 1024 + green * rest + 524288) >> 20)
                out[i + 2] = wp.uint8((int(image[i + 2]) * t * 1024 + blue * rest + 524288) >> 20)
        left = right


@wp.func
def opacity(layer: wp.array3d(dtype=int), b: int, near: int, other: int, column: int) -> int:
    """Opacity (of 65536, times 4) of a column of the half-resolution layer, between two of its rows."""
    x = wp.clamp(column, 0, layer.shape[2] - 1)
    return 3 * layer[b, near, x] + layer[b, other, x]


@wp.kernel
def blend_particles(
    image: wp.array(dtype=wp.uint8),
    grid: wp.array3d(dtype=float),
    air: wp.array(dtype=wp.vec3),
    layer: wp.array3d(dtype=int),
    white: wp.array(dtype=wp.vec3),
    height: int,
    width: int,
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """The veil of `blend_air`, then particles over it: layer is their opacity (of 65536) at half resolution."""
    b, y = wp.tid()
    fy = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(fy))
    fraction = fy - float(row)
    start = b * stride + y * width * 3
    red = int(air[b][0] * 1024.0)
    green = int(air[b][1] * 1024.0)
    blue = int(air[b][2] * 1024.0)
    r = int(white[b][0] * 1024.0)
    g = int(white[b][1] * 1024.0)
    w = int(white[b][2] * 1024.0)
    # rows of the half-resolution layer around this row: weights 3/4 and 1/4
    near = y / 2
    other = wp.clamp(near + (y & 1) * 2 - 1, 0, layer.shape[1] - 1)
    left = cell(grid, b, row, fraction, -1)
    o0 = opacity(layer, b, near, other, -2)
    o1 = opacity(layer, b, near, other, -1)
    for q in range(-1, grid.shape[2]):
        right = cell(grid, b, row, fraction, q + 1)
        # pixels 4q+2 to 4q+5 lie in the half-resolution columns 2q+1 and 2q+2
        o2 = opacity(layer, b, near, other, 2 * q + 2)
        o3 = opacity(layer, b, near, other, 2 * q + 3)
        any_drop = o0 + o1 + o2 + o3
        for k in range(4):
            x = q * 4 + 2 + k
            if x >= 0 and x < width:
                t = int((left + (right - left) * (float(k) + 0.5) * 0.25) * 1024.0)
                i = start + x * 3
                rest = 1024 - t
                c0 = (int(image[i]) * t * 1024 + red * rest) >> 10
                c1 = (int(image[i + 1]) * t * 1024 + green * rest) >> 10
                c2 = (int(image[i + 2]) * t * 1024 + blue * rest) >> 10
                if any_drop > 0:
                    a = 3 * o1 + o0
                    if k == 1:
                        a = 3 * o1 + o2
                    elif k == 2:
                        a = 3 * o2 + o1
                    elif k == 3:
                        a = 3 * o2 + o3
                    a = wp.min(a >> 10, 1024)
                    c0 = c0 + (((r - c0) * a) >> 10)
                    c1 = c1 + (((g - c1) * a) >> 10)
                    c2 = c2 + (((w - c2) * a) >> 10)
                out[i] = wp.uint8((c0 + 512) >> 10)
                out[i + 1] = wp.uint8((c1 + 512) >> 10)
                out[i + 2] = wp.uint8((c2 + 512) >> 10)
        left = right
        o0 = o2
        o1 = o3


@wp.kernel
def glare(
    toward: wp.array(dtype=wp.vec3),
    place: wp.array(dtype=wp.vec3),
    lens: wp.array(dtype=wp.vec4),
    strength: wp.array(dtype=float),
    rays: wp.array(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Light that the sun adds in the lens, in grey levels, on the quarter grid.

    toward: unit direction of the sun in the camera frame; place: its pixel (x, y), and 1 if in front of the camera;
    strength: grey levels at one degree from the sun. Veiling glare falls with the square of the angle (CIE disability
    glare: 10 / theta^2), with a bright aureole, a six-pointed diffraction star (`rays`: its angle) and two ghosts on
    the line through the image centre.
    """
    b, y = wp.tid()
    focal = lens[b]
    sun = toward[b]
    v = ((float(y) + 0.5) * 4.0 - 0.5 - focal[3]) / focal[1]
    spot = place[b]
    for x in range(out.shape[2]):
        u = ((float(x) + 0.5) * 4.0 - 0.5 - focal[2]) / focal[0]
        ray = wp.normalize(wp.vec3(u, v, 1.0))
        chord = wp.length(ray - sun)
        degrees = chord * 57.29578
        light = 1.0 / (degrees * degrees + 0.04) + 0.06 / (degrees + 1.0)
        if spot[2] > 0.5:
            dx = (float(x) + 0.5) * 4.0 - spot[0]
            dy = (float(y) + 0.5) * 4.0 - spot[1]
            if degrees < 14.0:
                angle = wp.atan2(dy, dx) + rays[b]
                star = wp.cos(angle * 3.0)
                star = star * star
                star = star * star
                star = star * star
                light += star * star * 0.5 / (degrees * degrees * 0.35 + 1.0)
            for g in range(2):
                reach = -0.45 - 0.6 * float(g)
                gx = (float(x) + 0.5) * 4.0 - (focal[2] + (spot[0] - focal[2]) * reach)
                gy = (float(y) + 0.5) * 4.0 - (focal[3] + (spot[1] - focal[3]) * reach)
                size = (0.03 + 0.03 * float(g)) * focal[0]
                r = wp.sqrt(gx * gx + gy * gy) / size
                if r < 1.1:
                    light += 0.035 * wp.clamp((1.1 - r) * 8.0, 0.0, 1.0) * (0.5 + 0.5 * r * r)
        out[b, y, x] = strength[b] * light


@wp.kernel
def blend_glare(
    image: wp.array(dtype=wp.uint8),
    grid: wp.array3d(dtype=float),
    tint: wp.array(dtype=wp.vec3),
    gain: wp.array(dtype=float),
    height: int,
    width: int,
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """image * gain + tint * grid, clipped: the exposure goes down, the glare comes on top."""
    b, y = wp.tid()
    fy = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(fy))
    fraction = fy - float(row)
    start = b * stride + y * width * 3
    factor = gain[b]
    colour = tint[b]
    left = cell(grid, b, row, fraction, -1)
    for q in range(-1, grid.shape[2]):
        right = cell(grid, b, row, fraction, q + 1)
        for k in range(4):
            x = q * 4 + 2 + k
            if x >= 0 and x < width:
                light = left + (right - left) * (float(k) + 0.5) * 0.25
                i = start + x * 3
                out[i] = byte(float(image[i]) * factor + colour[0] * light)
                out[i + 1] = byte(float(image[i + 1]) * factor + colour[1] * light)
                out[i + 2] = byte(float(image[i + 2]) * factor + colour[2] * light)
        left = right

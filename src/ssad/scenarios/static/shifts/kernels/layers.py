"""The paper's calibration of fog, sun and motion blur: drawn over the picture, without a world behind it."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import byte, colour, draw, put_colour, unit


@wp.kernel
def brightest(image: wp.array(dtype=wp.uint32), row: int, words: int, highest: wp.array2d(dtype=int)):
    """The largest byte of each row of `row` words."""
    b, y = wp.tid()
    most = int(0)
    pairs = wp.uint32(16711935)
    start = b * words + y * row
    for i in range(start, start + row):
        word = image[i]
        room = wp.uint32((255 - most) * 65537)
        over = ((word & pairs) + room) | (((word >> wp.uint32(8)) & pairs) + room)
        if (over & wp.uint32(16777472)) != wp.uint32(0):
            for k in range(4):
                most = wp.max(most, int((word >> wp.uint32(8 * k)) & wp.uint32(255)))
    highest[b, y] = most


@wp.kernel
def squares(keys: wp.array(dtype=wp.uint64), wibble: wp.array2d(dtype=float), level: int, out: wp.array3d(dtype=float)):
    """Diamond-square (Fournier, Fussell and Carpenter 1982) on a torus: the middle of each square of corners."""
    b, i, j = wp.tid()
    size = out.shape[1]
    step = size >> level
    half = step / 2
    y = i * step
    x = j * step
    down = (y + step) % size
    right = (x + step) % size
    mean = (out[b, y, x] + out[b, down, x] + out[b, y, right] + out[b, down, right]) * 0.25
    noise = 2.0 * unit(draw(keys[b] + wp.uint64(3 * level), i * 8192 + j), 0) - 1.0
    out[b, y + half, x + half] = mean + wibble[b, level] * noise


@wp.kernel
def diamonds(
    keys: wp.array(dtype=wp.uint64), wibble: wp.array2d(dtype=float), level: int, out: wp.array3d(dtype=float)
):
    """Diamond-square: the middles of the edges, between two corners and two middles of squares."""
    b, i, j = wp.tid()
    size = out.shape[1]
    step = size >> level
    half = step / 2
    y = i * step
    x = j * step
    up = (y + size - half) % size
    left = (x + size - half) % size
    corner = out[b, y, x]
    middle = out[b, y + half, x + half]
    mean = (corner + out[b, y, (x + step) % size] + middle + out[b, up, x + half]) * 0.25
    noise = 2.0 * unit(draw(keys[b] + wp.uint64(3 * level + 1), i * 8192 + j), 0) - 1.0
    out[b, y, x + half] = mean + wibble[b, level] * noise
    mean = (corner + out[b, (y + step) % size, x] + middle + out[b, y + half, left]) * 0.25
    noise = 2.0 * unit(draw(keys[b] + wp.uint64(3 * level + 2), i * 8192 + j), 0) - 1.0
    out[b, y + half, x] = mean + wibble[b, level] * noise


@wp.kernel
def extremes(grid: wp.array3d(dtype=float), low: wp.array2d(dtype=float), high: wp.array2d(dtype=float)):
    """The least and the largest value of each row."""
    b, y = wp.tid()
    least = grid[b, y, 0]
    most = least
    for x in range(1, grid.shape[2]):
        least = wp.min(least, grid[b, y, x])
        most = wp.max(most, grid[b, y, x])
    low[b, y] = least
    high[b, y] = most


@wp.kernel
def blend_clouds(
    image: wp.array(dtype=wp.uint8),
    grid: wp.array3d(dtype=float),
    low: wp.array(dtype=float),
    span: wp.array(dtype=float),
    amount: wp.array(dtype=float),
    most: wp.array(dtype=float),
    grey: wp.array(dtype=float),
    step: float,
    width: int,
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """(image + amount * clouds) * most / (most + amount), then blended with grey (ImageNet-C's fog, 3DC's end).

    grid: clouds on a torus, from low to low + span; step: cells a pixel.
    """
    b, y = wp.tid()
    size = grid.shape[1]
    fy = float(y) * step
    row = int(fy)
    part = fy - float(row)
    above = row % size
    below = (row + 1) % size
    start = b * stride + y * width * 3
    scale = most[b] / (most[b] + amount[b]) * (1.0 - grey[b])
    add = amount[b] * 255.0 * scale / span[b]
    base = 128.0 * grey[b] - low[b] * add
    column = int(-1)
    left = float(0.0)
    right = float(0.0)
    for x in range(width):
        fx = float(x) * step
        here = int(fx)
        if here != column:
            column = here
            q = here % size
            left = grid[b, above, q] * (1.0 - part) + grid[b, below, q] * part
            q = (here + 1) % size
            right = grid[b, above, q] * (1.0 - part) + grid[b, below, q] * part
        veil = (left + (right - left) * (fx - float(here))) * add + base
        i = start + x * 3
        for k in range(3):
            out[i + k] = byte(float(image[i + k]) * scale + veil)


@wp.func
def brighter(pixel: wp.vec3, shade: wp.vec3, part: float) -> wp.vec3:
    """A colour over a pixel by a share, unless that makes it darker (HLS lightness, whole grey levels)."""
    over = pixel * (1.0 - part) + shade * part
    lighter = int(wp.max(over)) + int(wp.min(over)) > int(wp.max(pixel)) + int(wp.min(pixel))
    return wp.where(lighter, over, pixel)


@wp.kernel
def blend_sun(
    image: wp.array(dtype=wp.uint8),
    sun: wp.array(dtype=wp.vec3),
    flare: wp.array(dtype=wp.vec3),
    tint: wp.array(dtype=wp.vec3),
    strength: wp.array(dtype=float),
    width: int,
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """In place (out holds the image): a faint disc of a colour, then the white sun, both with gaussian edges.

    sun, flare: x, y, deviation in pixels, 0 for none; tint: colour of the disc; strength: its share there.
    """
    b, y = wp.tid()
    start = b * stride + y * width * 3
    reach = wp.max(4.0 * sun[b][2], 4.5 * flare[b][2])
    dy = float(y) - sun[b][1]
    ey = float(y) - flare[b][1]
    if wp.abs(dy) > reach and wp.abs(ey) > reach:
        return
    for x in range(width):
        dx = float(x) - sun[b][0]
        ex = float(x) - flare[b][0]
        near = (dx * dx + dy * dy) / (sun[b][2] * sun[b][2])
        far = float(100.0)
        if flare[b][2] > 0.0:
            far = (ex * ex + ey * ey) / (flare[b][2] * flare[b][2])
        if near < 16.0 or far < 20.0:
            i = start + x * 3
            part = wp.min(4.0 * wp.exp(-0.5 * far), 1.0) * strength[b]
            mixed = brighter(wp.vec3(colour(image, i)), tint[b], part)
            part = wp.min(1.5 * wp.exp(-0.5 * near), 1.0)
            mixed = brighter(mixed, wp.vec3(255.0, 255.0, 255.0), part)
            for k in range(3):
                out[i + k] = wp.uint8(wp.clamp(int(mixed[k]), 0, 255))


@wp.kernel
def smear_rows(
    image: wp.array(dtype=wp.uint8),
    owner: wp.array3d(dtype=wp.int16),
    length: wp.array(dtype=int),
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """Horizontal box blur of the whole row, put in where there is an object; length 0: leave it."""
    b, y = wp.tid()
    width = owner.shape[2]
    half = length[b] / 2
    if half < 1:
        return
    start = b * stride + y * width * 3
    total = wp.vec3i(0, 0, 0)
    for k in range(-half, half + 1):
        total += colour(image, start + wp.clamp(k, 0, width - 1) * 3)
    taps = 2 * half + 1
    for x in range(width):
        if owner[b, y, x] > wp.int16(0):
            put_colour(out, start + x * 3, total / taps)
        enter = start + wp.min(x + half + 1, width - 1) * 3
        leave = start + wp.max(x - half, 0) * 3
        total += colour(image, enter) - colour(image, leave)


@wp.kernel
def zoom_blur(
    image: wp.array(dtype=wp.uint8),
    owner: wp.array3d(dtype=wp.int16),
    zoom: wp.array(dtype=float),
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """Mean over 12 zooms about the image centre, put in where there is an object; zoom 0: leave it."""
    b, y = wp.tid()
    if zoom[b] <= 0.0:
        return
    width = owner.shape[2]
    height = owner.shape[1]
    cx = float(width - 1) * 0.5
    cy = float(height - 1) * 0.5
    start = b * stride
    for x in range(width):
        if owner[b, y, x] > wp.int16(0):
            total = wp.vec3i(0, 0, 0)
            for k in range(12):
                shrink = 1.0 / (1.0 + zoom[b] * float(k) / 11.0)
                sx = int((float(x) - cx) * shrink + cx + 0.5)
                sy = int((float(y) - cy) * shrink + cy + 0.5)
                total += colour(image, start + (sy * width + sx) * 3)
            put_colour(out, start + (y * width + x) * 3, total / 12)

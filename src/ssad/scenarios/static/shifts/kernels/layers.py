"""The paper's calibration: layers drawn over the picture, without a world behind it."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import byte, cell, draw, unit


@wp.kernel
def specks(
    keys: wp.array(dtype=wp.uint64),
    mean: wp.array(dtype=float),
    deviation: wp.array(dtype=float),
    normal: wp.array(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Normal noise in [0, 1]: flakes or drops before they are enlarged, cut off and blurred.

    normal: inverse distribution function at 65,536 midpoints; four cells a hash.
    """
    b, y = wp.tid()
    columns = out.shape[2]
    for q in range((columns + 3) / 4):
        bits = draw(keys[b], y * 4096 + q)
        for k in range(4):
            x = 4 * q + k
            if x < columns:
                u = int((bits >> wp.uint64(16 * k)) & wp.uint64(65535))
                out[b, y, x] = wp.clamp(mean[b] + deviation[b] * normal[u], 0.0, 1.0)


@wp.func
def sample(grid: wp.array3d(dtype=float), b: int, y: float, x: float) -> float:
    """Bilinear value, held at the border."""
    row = int(wp.floor(y))
    column = int(wp.floor(x))
    left = cell(grid, b, row, y - float(row), column)
    right = cell(grid, b, row, y - float(row), column + 1)
    return left + (right - left) * (x - float(column))


@wp.kernel
def enlarge(
    grid: wp.array3d(dtype=float),
    zoom: wp.array(dtype=float),
    threshold: wp.array(dtype=float),
    out: wp.array3d(dtype=float),
):
    """The noise at half resolution, enlarged, and 0 again under the threshold."""
    b, y = wp.tid()
    factor = 2.0 / zoom[b]
    for x in range(out.shape[2]):
        value = sample(grid, b, (float(y) + 0.5) * factor - 0.5, (float(x) + 0.5) * factor - 0.5)
        if value < threshold[b]:
            value = 0.0
        out[b, y, x] = value


@wp.kernel
def streaks(
    grid: wp.array3d(dtype=float),
    offsets: wp.array2d(dtype=wp.vec2i),
    weights: wp.array2d(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Blurs along one direction: the weighted mean of cells at some offsets (x, y), held at the border."""
    b, y = wp.tid()
    rows = grid.shape[1]
    columns = grid.shape[2]
    for x in range(columns):
        out[b, y, x] = 0.0
    for k in range(weights.shape[1]):
        w = weights[b, k]
        if w > 0.0:
            py = wp.clamp(y + offsets[b, k][1], 0, rows - 1)
            dx = offsets[b, k][0]
            for x in range(columns):
                out[b, y, x] = out[b, y, x] + w * grid[b, py, wp.clamp(x + dx, 0, columns - 1)]


@wp.kernel
def blend_layer(
    image: wp.array(dtype=wp.uint8),
    layer: wp.array3d(dtype=float),
    keep: wp.array(dtype=float),
    grey: float,
    height: int,
    width: int,
    stride: int,
    highest: wp.array2d(dtype=int),
    out: wp.array(dtype=wp.uint8),
):
    """Whitens, adds the layer and itself turned round, blends with grey; notes the brightest value of each row.

    keep < 1: max(image, 1.5 * luminance + 0.5) takes the rest (ImageNet-C's snow).
    """
    b, y = wp.tid()
    start = b * stride + y * width * 3
    part = int(keep[b] * 256.0 + 0.5)
    most = int(0)
    last = layer.shape[2] - 1
    rest = int((1.0 - grey) * 1024.0)
    base = int(128.0 * grey * 1024.0) + 512
    for q in range(layer.shape[2]):
        add = int((layer[b, y / 2, q] + layer[b, (height - 1 - y) / 2, last - q]) * 255.0)
        for k in range(2):
            x = 2 * q + k
            if x < width:
                i = start + x * 3
                r = int(image[i])
                g = int(image[i + 1])
                w = int(image[i + 2])
                if part < 256:
                    white = (((77 * r + 150 * g + 29 * w) * 3) >> 9) + 127
                    r = (part * r + (256 - part) * wp.max(r, white)) >> 8
                    g = (part * g + (256 - part) * wp.max(g, white)) >> 8
                    w = (part * w + (256 - part) * wp.max(w, white)) >> 8
                r = (wp.min(r + add, 255) * rest + base) >> 10
                g = (wp.min(g + add, 255) * rest + base) >> 10
                w = (wp.min(w + add, 255) * rest + base) >> 10
                most = wp.max(most, wp.max(r, wp.max(g, w)))
                out[i] = wp.uint8(r)
                out[i + 1] = wp.uint8(g)
                out[i + 2] = wp.uint8(w)
    highest[b, y] = most


@wp.kernel
def darken(gain: wp.array(dtype=int), words: int, chunk: int, data: wp.array(dtype=wp.uint32)):
    """Multiplies every byte by gain / 256, four at a time, in place."""
    b, part = wp.tid()
    first = part * chunk
    last = wp.min(first + chunk, words)
    factor = wp.uint32(gain[b])
    limit = wp.uint32(255)
    for i in range(b * words + first, b * words + last):
        word = data[i]
        low = wp.min(((word & limit) * factor) >> wp.uint32(8), limit)
        second = wp.min((((word >> wp.uint32(8)) & limit) * factor) >> wp.uint32(8), limit)
        third = wp.min((((word >> wp.uint32(16)) & limit) * factor) >> wp.uint32(8), limit)
        high = wp.min(((word >> wp.uint32(24)) * factor) >> wp.uint32(8), limit)
        data[i] = low | (second << wp.uint32(8)) | (third << wp.uint32(16)) | (high << wp.uint32(24))


@wp.kernel
def brightest(image: wp.array(dtype=wp.uint8), width: int, stride: int, highest: wp.array2d(dtype=int)):
    """The largest value of each row."""
    b, y = wp.tid()
    most = int(0)
    start = b * stride + y * width * 3
    for i in range(start, start + width * 3):
        most = wp.max(most, int(image[i]))
    highest[b, y] = most


@wp.kernel
def plasma(keys: wp.array(dtype=wp.uint64), decay: wp.array(dtype=float), out: wp.array3d(dtype=float)):
    """Clouds: octaves of smooth noise from 1024 pixels down, each `decay` times weaker; about 0 to 1, not scaled."""
    b, y = wp.tid()
    for x in range(out.shape[2]):
        total = float(0.0)
        weight = float(1.0)
        size = float(256.0)  # nodes of the quarter grid
        for octave in range(8):
            u = float(x) / size
            v = float(y) / size
            column = int(u)
            row = int(v)
            fx = u - float(column)
            fy = v - float(row)
            key = keys[b] + wp.uint64(octave)
            a = unit(draw(key, row * 8192 + column), 0)
            c = unit(draw(key, row * 8192 + column + 1), 0)
            d = unit(draw(key, (row + 1) * 8192 + column), 0)
            e = unit(draw(key, (row + 1) * 8192 + column + 1), 0)
            total += weight * ((a + (c - a) * fx) * (1.0 - fy) + (d + (e - d) * fx) * fy - 0.5)
            weight = weight / decay[b]
            size = size * 0.5
        out[b, y, x] = total


@wp.kernel
def blend_clouds(
    image: wp.array(dtype=wp.uint8),
    grid: wp.array3d(dtype=float),
    low: wp.array(dtype=float),
    span: wp.array(dtype=float),
    amount: wp.array(dtype=float),
    most: wp.array(dtype=float),
    grey: wp.array(dtype=float),
    height: int,
    width: int,
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """(image + amount * clouds) * most / (most + amount), then blended with grey (ImageNet-C's fog, 3DC's end)."""
    b, y = wp.tid()
    fy = (float(y) + 0.5) * 0.25 - 0.5
    row = int(wp.floor(fy))
    start = b * stride + y * width * 3
    scale = most[b] / (most[b] + amount[b]) * (1.0 - grey[b])
    add = amount[b] * 255.0 * scale / span[b]
    base = 128.0 * grey[b] - low[b] * add
    left = cell(grid, b, row, fy - float(row), -1)
    for q in range(-1, grid.shape[2]):
        right = cell(grid, b, row, fy - float(row), q + 1)
        for k in range(4):
            x = q * 4 + 2 + k
            if x >= 0 and x < width:
                veil = (left + (right - left) * (float(k) + 0.5) * 0.25) * add + base
                i = start + x * 3
                out[i] = byte(float(image[i]) * scale + veil)
                out[i + 1] = byte(float(image[i + 1]) * scale + veil)
                out[i + 2] = byte(float(image[i + 2]) * scale + veil)
        left = right


@wp.kernel
def disc(
    centre: wp.array(dtype=wp.vec4),
    radius: wp.array(dtype=float),
    out: wp.array3d(dtype=float),
):
    """A bright disc with gaussian edges at centre (x, y) and a fainter ring at (z, w), grey levels."""
    b, y, x = wp.tid()
    px = (float(x) + 0.5) * 4.0 - 0.5
    py = (float(y) + 0.5) * 4.0 - 0.5
    place = centre[b]
    r = radius[b]
    near = ((px - place[0]) * (px - place[0]) + (py - place[1]) * (py - place[1])) / (r * r)
    light = 255.0 * wp.exp(-0.5 * wp.max(near - 1.0, 0.0))
    ring = wp.sqrt((px - place[2]) * (px - place[2]) + (py - place[3]) * (py - place[3]))
    if ring < 0.6 * r:
        light += 45.0
    out[b, y, x] = light


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
    red = int(0)
    green = int(0)
    blue = int(0)
    for k in range(-half, half + 1):
        i = start + wp.clamp(k, 0, width - 1) * 3
        red += int(image[i])
        green += int(image[i + 1])
        blue += int(image[i + 2])
    taps = 2 * half + 1
    for x in range(width):
        if owner[b, y, x] > wp.int16(0):
            i = start + x * 3
            out[i] = wp.uint8(red / taps)
            out[i + 1] = wp.uint8(green / taps)
            out[i + 2] = wp.uint8(blue / taps)
        enter = start + wp.min(x + half + 1, width - 1) * 3
        leave = start + wp.max(x - half, 0) * 3
        red += int(image[enter]) - int(image[leave])
        green += int(image[enter + 1]) - int(image[leave + 1])
        blue += int(image[enter + 2]) - int(image[leave + 2])


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
            red = int(0)
            green = int(0)
            blue = int(0)
            for k in range(12):
                shrink = 1.0 / (1.0 + zoom[b] * float(k) / 11.0)
                sx = int((float(x) - cx) * shrink + cx + 0.5)
                sy = int((float(y) - cy) * shrink + cy + 0.5)
                i = start + (sy * width + sx) * 3
                red += int(image[i])
                green += int(image[i + 1])
                blue += int(image[i + 2])
            o = start + (y * width + x) * 3
            out[o] = wp.uint8(red / 12)
            out[o + 1] = wp.uint8(green / 12)
            out[o + 2] = wp.uint8(blue / 12)

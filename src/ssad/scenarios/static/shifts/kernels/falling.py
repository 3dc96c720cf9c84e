"""The paper's calibration of snow and rain: layers drawn over the picture, without a world behind it."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import (
    FIELDS,
    ONES,
    TENS,
    cell,
    draw,
    gather,
    pixel_of,
    put_four,
    spread,
    unit,
)

OVER = wp.constant(wp.uint64(256 + (256 << 21) + (256 << 42)))


@wp.kernel
def specks(
    keys: wp.array(dtype=wp.uint64),
    mean: wp.array(dtype=float),
    deviation: wp.array(dtype=float),
    normal: wp.array(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Normal noise: flakes before they are enlarged, cut off and blurred.

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
                out[b, y, x] = mean[b] + deviation[b] * normal[u]


@wp.func
def sample(grid: wp.array3d(dtype=float), b: int, y: float, x: float) -> float:
    """Bilinear value, held at the border."""
    row = int(wp.floor(y))
    column = int(wp.floor(x))
    left = cell(grid, b, row, y - float(row), column)
    right = cell(grid, b, row, y - float(row), column + 1)
    return left + (right - left) * (x - float(column))


@wp.kernel
def flakes(
    grid: wp.array3d(dtype=float),
    step: wp.array(dtype=wp.vec2),
    threshold: wp.array(dtype=float),
    scale: float,
    places: int,
    height: int,
    out: wp.array3d(dtype=float),
):
    """The noise enlarged, 0 under the threshold, at most 1; two rows of pixels in one, places x places in each pixel.

    height: of the picture, whose last row stands for one beyond it; step: cells a published pixel along y and x;
    scale: pixels of the picture a published pixel.
    """
    b, y = wp.tid()
    share = 1.0 / float(places)
    part = 0.5 * share * share
    least = threshold[b]
    for x in range(out.shape[2]):
        out[b, y, x] = 0.0
    for j in range(2 * places):
        line = wp.min(2 * y + j / places, height - 1)
        fy = ((float(line) + (float(j % places) + 0.5) * share) / scale - 0.5) * step[b][0]
        row = int(wp.floor(fy))
        fraction = fy - float(row)
        column = int(-2)
        left = float(0.0)
        right = float(0.0)
        for x in range(out.shape[2]):
            for i in range(places):
                fx = ((float(x) + (float(i) + 0.5) * share) / scale - 0.5) * step[b][1]
                here = int(wp.floor(fx))
                if here != column:
                    column = here
                    left = cell(grid, b, row, fraction, here)
                    right = cell(grid, b, row, fraction, here + 1)
                value = left + (right - left) * (fx - float(here))
                if value >= least:
                    out[b, y, x] = out[b, y, x] + part * wp.clamp(value, 0.0, 1.0)


@wp.func
def tap(grid: wp.array(dtype=float), row: int, columns: int, x: int) -> float:
    """A cell of a row that begins at `row`, held at the border."""
    return grid[row + wp.clamp(x, 0, columns - 1)]


@wp.kernel
def streaks(
    grid: wp.array(dtype=float),
    offsets: wp.array2d(dtype=wp.vec2i),
    weights: wp.array2d(dtype=float),
    rows: int,
    columns: int,
    out: wp.array(dtype=float),
):
    """Blurs along one direction: the weighted mean of cells at some offsets (x, y), held at the border.

    Four offsets are taken at a time (their number is a multiple of four; the weight of those that fill up is 0).
    """
    b, y = wp.tid()
    here = (b * rows + y) * columns
    for x in range(columns):
        out[here + x] = 0.0
    for q in range(weights.shape[1] / 4):
        w0 = weights[b, 4 * q]
        w1 = weights[b, 4 * q + 1]
        w2 = weights[b, 4 * q + 2]
        w3 = weights[b, 4 * q + 3]
        if w0 > 0.0:
            o0 = offsets[b, 4 * q]
            o1 = offsets[b, 4 * q + 1]
            o2 = offsets[b, 4 * q + 2]
            o3 = offsets[b, 4 * q + 3]
            r0 = (b * rows + wp.clamp(y + o0[1], 0, rows - 1)) * columns
            r1 = (b * rows + wp.clamp(y + o1[1], 0, rows - 1)) * columns
            r2 = (b * rows + wp.clamp(y + o2[1], 0, rows - 1)) * columns
            r3 = (b * rows + wp.clamp(y + o3[1], 0, rows - 1)) * columns
            low = wp.min(wp.min(o0[0], o1[0]), wp.min(o2[0], o3[0]))
            high = wp.max(wp.max(o0[0], o1[0]), wp.max(o2[0], o3[0]))
            first = wp.clamp(-low, 0, columns)
            last = wp.clamp(columns - high, first, columns)
            r0 = r0 + o0[0]
            r1 = r1 + o1[0]
            r2 = r2 + o2[0]
            r3 = r3 + o3[0]
            for x in range(first, last):
                total = out[here + x] + w0 * grid[r0 + x]
                total += w1 * grid[r1 + x]
                total += w2 * grid[r2 + x]
                out[here + x] = total + w3 * grid[r3 + x]
            for k in range(first + columns - last):
                x = wp.where(k < first, k, k - first + last)
                total = out[here + x] + w0 * tap(grid, r0 - o0[0], columns, x + o0[0])
                total += w1 * tap(grid, r1 - o1[0], columns, x + o1[0])
                total += w2 * tap(grid, r2 - o2[0], columns, x + o2[0])
                out[here + x] = total + w3 * tap(grid, r3 - o3[0], columns, x + o3[0])


@wp.func
def most_of(fields: wp.uint64, most: int) -> int:
    """The largest of three fields of 8 bits, or `most` if that is larger: looked at only where one is."""
    if ((fields + wp.uint64(255 - most) * ONES) & OVER) != wp.uint64(0):
        p = gather(fields)
        r = int(p & wp.uint32(255))
        g = int((p >> wp.uint32(8)) & wp.uint32(255))
        return wp.max(most, wp.max(r, wp.max(g, int(p >> wp.uint32(16)))))
    return most


@wp.func
def greyed(fields: wp.uint64, rest: wp.uint64, base: wp.uint64) -> wp.uint64:
    """(value * rest + base) / 1024, field by field."""
    return ((fields * rest + base) >> wp.uint64(10)) & FIELDS


@wp.func
def put(
    out: wp.array(dtype=wp.uint32), i: int, most: int, f0: wp.uint64, f1: wp.uint64, f2: wp.uint64, f3: wp.uint64
) -> int:
    """Writes four pixels, given as fields, to three words from i on; the largest value so far."""
    put_four(out, i, gather(f0), gather(f1), gather(f2), gather(f3))
    return most_of(f3, most_of(f2, most_of(f1, most_of(f0, most))))


@wp.func
def snowed(pixel: wp.uint32, part: int, add: int) -> wp.uint64:
    """A pixel whitened by 1 - part / 256 and made brighter by `add`, at most 255, as fields."""
    r = int(pixel & wp.uint32(255))
    g = int((pixel >> wp.uint32(8)) & wp.uint32(255))
    w = int(pixel >> wp.uint32(16))
    white = (((77 * r + 150 * g + 29 * w) * 3) >> 9) + 127
    fields = spread(pixel)
    light = wp.uint64(white) * ONES
    if white < wp.max(r, wp.max(g, w)):
        light = wp.uint64(wp.max(r, white)) | (wp.uint64(wp.max(g, white)) << wp.uint64(21))
        light = light | (wp.uint64(wp.max(w, white)) << wp.uint64(42))
    light = fields * wp.uint64(part) + light * wp.uint64(256 - part)
    total = ((light >> wp.uint64(8)) & TENS) + wp.uint64(add) * ONES
    over = ((total >> wp.uint64(8)) | (total >> wp.uint64(9))) & ONES
    return (total | (over * wp.uint64(255))) & FIELDS


@wp.kernel
def blend_snow(
    image: wp.array(dtype=wp.uint32),
    layer: wp.array(dtype=float),
    keep: wp.array(dtype=float),
    grey: float,
    height: int,
    width: int,
    words: int,
    highest: wp.array2d(dtype=int),
    out: wp.array(dtype=wp.uint32),
):
    """Whitens, adds the layer and itself turned round, blends with grey; notes the brightest value of each row.

    layer: of half the rows. max(image, 1.5 * luminance + 0.5) takes what `keep` leaves (ImageNet-C's snow). Four pixels
    are three words.
    """
    b, y = wp.tid()
    part = int(keep[b] * 256.0 + 0.5)
    most = int(0)
    rest = wp.uint64(int((1.0 - grey) * 1024.0))
    base = wp.uint64(int(128.0 * grey * 1024.0) + 512) * ONES
    rows = (height + 1) / 2
    here = (b * rows + y / 2) * width
    turned = (b * rows + (height - 1 - y) / 2) * width + width - 1
    i = b * words + y * width * 3 / 4
    for _q in range(width / 4):
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        f0 = snowed(pixel_of(w0, w1, w2, 0), part, int((layer[here] + layer[turned]) * 255.0))
        f1 = snowed(pixel_of(w0, w1, w2, 1), part, int((layer[here + 1] + layer[turned - 1]) * 255.0))
        f2 = snowed(pixel_of(w0, w1, w2, 2), part, int((layer[here + 2] + layer[turned - 2]) * 255.0))
        f3 = snowed(pixel_of(w0, w1, w2, 3), part, int((layer[here + 3] + layer[turned - 3]) * 255.0))
        f0 = greyed(f0, rest, base)
        f1 = greyed(f1, rest, base)
        f2 = greyed(f2, rest, base)
        f3 = greyed(f3, rest, base)
        most = put(out, i, most, f0, f1, f2, f3)
        i += 3
        here += 4
        turned -= 4
    highest[b, y] = most


@wp.kernel
def drops(
    keys: wp.array(dtype=wp.uint64),
    density: wp.array(dtype=float),
    place: wp.array(dtype=wp.vec4),
    first: wp.array(dtype=float),
    gate: wp.array3d(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Salt: a share of the cells is between a half and 1 (arcsine law), weakened by the gate where it lies.

    The lattice leans with the rain. place: columns of the gate a cell, columns a row, column of the first cell; rows
    of the gate a row. first: the row of the lattice where the picture begins.
    """
    b, y = wp.tid()
    step = place[b]
    for x in range(out.shape[2]):
        bits = draw(keys[b], y * 8192 + x)
        value = float(0.0)
        if unit(bits, 0) < density[b]:
            value = 0.5 + 0.5 * wp.abs(wp.cos(wp.pi * unit(bits, 16)))
            column = float(x) * step[0] + float(y) * step[1] + step[2]
            value *= sample(gate, b, (float(y) - first[b]) * step[3] - 0.5, column - 0.5)
        out[b, y, x] = value


@wp.kernel
def fall(
    grid: wp.array3d(dtype=float),
    length: wp.array(dtype=int),
    gain: wp.array(dtype=float),
    columns: int,
    box: wp.array2d(dtype=float),
    wedge: wp.array2d(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Blurs down each column over `length` cells, by running sums; the weights decrease linearly and add up to `gain`.

    columns: columns for each thread; box, wedge: zeros.
    """
    b, block = wp.tid()
    k = length[b]
    unit_weight = 2.0 * gain[b] / (float(k) * float(k + 1))
    first = block * columns
    last = wp.min(first + columns, grid.shape[2])
    for y in range(grid.shape[1]):
        for x in range(first, last):
            value = grid[b, y, x]
            slope = wedge[b, x] + float(k) * value - box[b, x]
            total = box[b, x] + value
            if y >= k:
                total -= grid[b, y - k, x]
            box[b, x] = total
            wedge[b, x] = slope
            out[b, y, x] = slope * unit_weight


@wp.func
def rained(pixel: wp.uint32, part: int) -> wp.uint64:
    """A pixel behind grey level 240 by part / 256, as fields."""
    total = spread(pixel) * wp.uint64(256 - part) + wp.uint64(240 * part) * ONES
    return (total >> wp.uint64(8)) & FIELDS


@wp.kernel
def curtain(
    layer: wp.array3d(dtype=float),
    place: wp.array(dtype=wp.vec3),
    first: wp.array(dtype=float),
    places: int,
    out: wp.array3d(dtype=wp.uint8),
):
    """How much of each pixel the drops hide, of 256, at most 255: 1.3 times the layer, the mean of `places` places.

    place: cells of the layer a pixel, columns a row, first column; first: row of the layer where the picture begins.
    """
    b, y = wp.tid()
    step = place[b]
    share = 1.0 / float(places)
    row = (float(y) + 0.5) * step[0] + first[b]
    top = int(wp.floor(row))
    fraction = row - float(top)
    begin = row * step[1] + step[2]
    before = int(-2)
    left = float(0.0)
    right = float(0.0)
    for x in range(out.shape[2]):
        veil = float(0.0)
        for k in range(places):
            place_x = (float(x) + (float(k) + 0.5) * share) * step[0] + begin
            column = int(wp.floor(place_x))
            if column != before:
                left = right
                if column != before + 1:
                    left = cell(layer, b, top, fraction, column)
                right = cell(layer, b, top, fraction, column + 1)
                before = column
            veil += left + (right - left) * (place_x - float(column))
        out[b, y, x] = wp.uint8(wp.min(int(wp.min(1.3 * veil * share, 1.0) * 256.0 + 0.5), 255))


@wp.kernel
def blend_rain(
    image: wp.array(dtype=wp.uint32),
    layer: wp.array(dtype=wp.uint32),
    grey: float,
    width: int,
    words: int,
    highest: wp.array2d(dtype=int),
    out: wp.array(dtype=wp.uint32),
):
    """Drops of grey level 240 over the image, then grey; notes the brightest value of each row.

    layer: what the drops hide of each pixel, of 256, four pixels a word; four pixels of the image are three words.
    """
    b, y = wp.tid()
    rest = wp.uint64(int((1.0 - grey) * 1024.0))
    base = wp.uint64(int(128.0 * grey * 1024.0) + 512) * ONES
    most = int(0)
    i = b * words + y * width * 3 / 4
    j = b * (words / 3) + y * width / 4
    for q in range(width / 4):
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        hidden = layer[j + q]
        f0 = rained(pixel_of(w0, w1, w2, 0), int(hidden & wp.uint32(255)))
        f1 = rained(pixel_of(w0, w1, w2, 1), int((hidden >> wp.uint32(8)) & wp.uint32(255)))
        f2 = rained(pixel_of(w0, w1, w2, 2), int((hidden >> wp.uint32(16)) & wp.uint32(255)))
        f3 = rained(pixel_of(w0, w1, w2, 3), int(hidden >> wp.uint32(24)))
        f0 = greyed(f0, rest, base)
        f1 = greyed(f1, rest, base)
        f2 = greyed(f2, rest, base)
        f3 = greyed(f3, rest, base)
        most = put(out, i, most, f0, f1, f2, f3)
        i += 3
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

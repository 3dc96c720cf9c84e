"""Paper's calibration of snow and rain: layers over the image without a 3D world."""

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

wp.set_module_options({"enable_backward": False})  # see `exposure`

OVER = wp.constant(wp.uint64(256 + (256 << 21) + (256 << 42)))


@wp.kernel
def specks(
    keys: wp.array(dtype=wp.uint64),
    mean: wp.array(dtype=float),
    deviation: wp.array(dtype=float),
    normal: wp.array(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Draw normal noise: flakes before they are enlarged, cut off and blurred.

    normal: inverse distribution function at 65,536 midpoints; four cells per hash.
    """
    b, y = wp.tid()
    columns = out.shape[2]
    for quad in range((columns + 3) / 4):
        bits = draw(keys[b], y * 4096 + quad)
        for lane in range(4):
            x = 4 * quad + lane
            if x < columns:
                table_index = int((bits >> wp.uint64(16 * lane)) & wp.uint64(65535))
                out[b, y, x] = mean[b] + deviation[b] * normal[table_index]


@wp.func
def sample(grid: wp.array3d(dtype=float), b: int, y: float, x: float) -> float:
    """Return the bilinear value, clamped at the border."""
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
    sub_size = 1.0 / float(places)
    sample_weight = 0.5 * sub_size * sub_size
    cutoff = threshold[b]
    for x in range(out.shape[2]):
        out[b, y, x] = 0.0
    for sub_row in range(2 * places):
        image_row = wp.min(2 * y + sub_row / places, height - 1)
        fy = ((float(image_row) + (float(sub_row % places) + 0.5) * sub_size) / scale - 0.5) * step[b][0]
        row = int(wp.floor(fy))
        fraction = fy - float(row)
        current_x = int(-2)
        left = float(0.0)
        right = float(0.0)
        for x in range(out.shape[2]):
            for sub_column in range(places):
                fx = ((float(x) + (float(sub_column) + 0.5) * sub_size) / scale - 0.5) * step[b][1]
                cell_x = int(wp.floor(fx))
                if cell_x != current_x:
                    current_x = cell_x
                    left = cell(grid, b, row, fraction, cell_x)
                    right = cell(grid, b, row, fraction, cell_x + 1)
                value = left + (right - left) * (fx - float(cell_x))
                if value >= cutoff:
                    out[b, y, x] = out[b, y, x] + sample_weight * wp.clamp(value, 0.0, 1.0)


@wp.func
def tap(grid: wp.array(dtype=float), row: int, columns: int, x: int) -> float:
    """Return a cell of a row that begins at `row`, clamped at the border."""
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
    """Blur along one direction: the weighted mean of cells at some offsets (x, y), clamped at the border.

    Offsets are taken four at a time (their number is a multiple of four; padding has weight 0).
    """
    b, y = wp.tid()
    row_start = (b * rows + y) * columns
    for x in range(columns):
        out[row_start + x] = 0.0
    for quad in range(weights.shape[1] / 4):
        w0 = weights[b, 4 * quad]
        w1 = weights[b, 4 * quad + 1]
        w2 = weights[b, 4 * quad + 2]
        w3 = weights[b, 4 * quad + 3]
        if w0 > 0.0:
            o0 = offsets[b, 4 * quad]
            o1 = offsets[b, 4 * quad + 1]
            o2 = offsets[b, 4 * quad + 2]
            o3 = offsets[b, 4 * quad + 3]
            r0 = (b * rows + wp.clamp(y + o0[1], 0, rows - 1)) * columns
            r1 = (b * rows + wp.clamp(y + o1[1], 0, rows - 1)) * columns
            r2 = (b * rows + wp.clamp(y + o2[1], 0, rows - 1)) * columns
            r3 = (b * rows + wp.clamp(y + o3[1], 0, rows - 1)) * columns
            low = wp.min(wp.min(o0[0], o1[0]), wp.min(o2[0], o3[0]))
            high = wp.max(wp.max(o0[0], o1[0]), wp.max(o2[0], o3[0]))
            inner_begin = wp.clamp(-low, 0, columns)
            inner_end = wp.clamp(columns - high, inner_begin, columns)
            r0 = r0 + o0[0]
            r1 = r1 + o1[0]
            r2 = r2 + o2[0]
            r3 = r3 + o3[0]
            # Inner columns, for which no offset leaves the row, need no clamping.
            for x in range(inner_begin, inner_end):
                total = out[row_start + x] + w0 * grid[r0 + x]
                total += w1 * grid[r1 + x]
                total += w2 * grid[r2 + x]
                out[row_start + x] = total + w3 * grid[r3 + x]
            for border_index in range(inner_begin + columns - inner_end):
                x = wp.where(border_index < inner_begin, border_index, border_index - inner_begin + inner_end)
                total = out[row_start + x] + w0 * tap(grid, r0 - o0[0], columns, x + o0[0])
                total += w1 * tap(grid, r1 - o1[0], columns, x + o1[0])
                total += w2 * tap(grid, r2 - o2[0], columns, x + o2[0])
                out[row_start + x] = total + w3 * tap(grid, r3 - o3[0], columns, x + o3[0])


@wp.func
def max_field(fields: wp.uint64, current_max: int) -> int:
    """Return the largest of three fields of 8 bits, or `current_max` if that is larger; unpacked only if one is."""
    if ((fields + wp.uint64(255 - current_max) * ONES) & OVER) != wp.uint64(0):
        word = gather(fields)
        red = int(word & wp.uint32(255))
        green = int((word >> wp.uint32(8)) & wp.uint32(255))
        return wp.max(current_max, wp.max(red, wp.max(green, int(word >> wp.uint32(16)))))
    return current_max


@wp.func
def grey_fields(fields: wp.uint64, image_weight: wp.uint64, base: wp.uint64) -> wp.uint64:
    """Return (value * rest + base) / 1024, field by field."""
    return ((fields * image_weight + base) >> wp.uint64(10)) & FIELDS


@wp.func
def put(
    out: wp.array(dtype=wp.uint32), i: int, current_max: int, f0: wp.uint64, f1: wp.uint64, f2: wp.uint64, f3: wp.uint64
) -> int:
    """Write four pixels, given as fields, to three words from i on; returns the largest value so far."""
    put_four(out, i, gather(f0), gather(f1), gather(f2), gather(f3))
    return max_field(f3, max_field(f2, max_field(f1, max_field(f0, current_max))))


@wp.func
def snow_pixel(pixel: wp.uint32, part: int, add: int) -> wp.uint64:
    """Whiten a pixel by 1 - part / 256 and brighten it by `add`, at most 255, as fields."""
    red = int(pixel & wp.uint32(255))
    green = int((pixel >> wp.uint32(8)) & wp.uint32(255))
    blue = int(pixel >> wp.uint32(16))
    white = (((77 * red + 150 * green + 29 * blue) * 3) >> 9) + 127
    fields = spread(pixel)
    light = wp.uint64(white) * ONES
    if white < wp.max(red, wp.max(green, blue)):
        light = wp.uint64(wp.max(red, white)) | (wp.uint64(wp.max(green, white)) << wp.uint64(21))
        light = light | (wp.uint64(wp.max(blue, white)) << wp.uint64(42))
    light = fields * wp.uint64(part) + light * wp.uint64(256 - part)
    total = ((light >> wp.uint64(8)) & TENS) + wp.uint64(add) * ONES
    # Fields above 255 become 255.
    overflow = ((total >> wp.uint64(8)) | (total >> wp.uint64(9))) & ONES
    return (total | (overflow * wp.uint64(255))) & FIELDS


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
    """Whiten, add the layer and its copy rotated by 180 degrees, blend with grey; record the maximum of each row.

    layer: of half the rows. max(image, 1.5 * luminance + 0.5) takes the share that `keep` leaves (ImageNet-C's snow).
    Four pixels are three words.
    """
    b, y = wp.tid()
    keep_parts = int(keep[b] * 256.0 + 0.5)
    row_max = int(0)
    image_weight = wp.uint64(int((1.0 - grey) * 1024.0))
    grey_offset = wp.uint64(int(128.0 * grey * 1024.0) + 512) * ONES
    rows = (height + 1) / 2
    layer_index = (b * rows + y / 2) * width
    rotated_index = (b * rows + (height - 1 - y) / 2) * width + width - 1
    i = b * words + y * width * 3 / 4
    for _quad in range(width / 4):
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        f0 = snow_pixel(pixel_of(w0, w1, w2, 0), keep_parts, int((layer[layer_index] + layer[rotated_index]) * 255.0))
        f1 = snow_pixel(
            pixel_of(w0, w1, w2, 1), keep_parts, int((layer[layer_index + 1] + layer[rotated_index - 1]) * 255.0)
        )
        f2 = snow_pixel(
            pixel_of(w0, w1, w2, 2), keep_parts, int((layer[layer_index + 2] + layer[rotated_index - 2]) * 255.0)
        )
        f3 = snow_pixel(
            pixel_of(w0, w1, w2, 3), keep_parts, int((layer[layer_index + 3] + layer[rotated_index - 3]) * 255.0)
        )
        f0 = grey_fields(f0, image_weight, grey_offset)
        f1 = grey_fields(f1, image_weight, grey_offset)
        f2 = grey_fields(f2, image_weight, grey_offset)
        f3 = grey_fields(f3, image_weight, grey_offset)
        row_max = put(out, i, row_max, f0, f1, f2, f3)
        i += 3
        layer_index += 4
        rotated_index -= 4
    highest[b, y] = row_max


@wp.kernel
def drops(
    keys: wp.array(dtype=wp.uint64),
    density: wp.array(dtype=float),
    place: wp.array(dtype=wp.vec4),
    first: wp.array(dtype=float),
    gate: wp.array3d(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Draw salt: a share of the cells is between a half and 1 (arcsine law), weakened by the gate at its position.

    The lattice leans with the rain. place: columns of the gate per cell, columns per row, column of the first cell;
    rows of the gate per row. first: row of the lattice at which the image begins.
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
    """Blur down each column over `length` cells by running sums; linearly decreasing weights add up to `gain`.

    columns: columns for each thread; box, wedge: zeros.
    """
    b, block = wp.tid()
    taps = length[b]
    unit_weight = 2.0 * gain[b] / (float(taps) * float(taps + 1))
    begin = block * columns
    end = wp.min(begin + columns, grid.shape[2])
    for y in range(grid.shape[1]):
        for x in range(begin, end):
            value = grid[b, y, x]
            weighted_sum = wedge[b, x] + float(taps) * value - box[b, x]
            window_sum = box[b, x] + value
            if y >= taps:
                window_sum -= grid[b, y - taps, x]
            box[b, x] = window_sum
            wedge[b, x] = weighted_sum
            out[b, y, x] = weighted_sum * unit_weight


@wp.func
def rain_pixel(pixel: wp.uint32, part: int) -> wp.uint64:
    """Blend grey level 240 over a pixel by part / 256, as fields."""
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
    """Compute the part of each pixel that drops hide, of 256, at most 255.

    1.3 times the layer, the mean of `places` places.

    place: cells of the layer per pixel, columns per row, first column; first: row of the layer at which the image
    begins.
    """
    b, y = wp.tid()
    step = place[b]
    share = 1.0 / float(places)
    row = (float(y) + 0.5) * step[0] + first[b]
    row_index = int(wp.floor(row))
    fraction = row - float(row_index)
    line_start = row * step[1] + step[2]
    previous_column = int(-2)
    left = float(0.0)
    right = float(0.0)
    for x in range(out.shape[2]):
        veil = float(0.0)
        for place_index in range(places):
            place_x = (float(x) + (float(place_index) + 0.5) * share) * step[0] + line_start
            column = int(wp.floor(place_x))
            if column != previous_column:
                left = right
                if column != previous_column + 1:
                    left = cell(layer, b, row_index, fraction, column)
                right = cell(layer, b, row_index, fraction, column + 1)
                previous_column = column
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
    """Blend drops of grey level 240 over the image, then grey; record the maximum of each row.

    layer: hidden part of each pixel, of 256, four pixels per word; four pixels of the image are three words.
    """
    b, y = wp.tid()
    image_weight = wp.uint64(int((1.0 - grey) * 1024.0))
    grey_offset = wp.uint64(int(128.0 * grey * 1024.0) + 512) * ONES
    row_max = int(0)
    i = b * words + y * width * 3 / 4
    j = b * (words / 3) + y * width / 4
    for quad in range(width / 4):
        w0 = image[i]
        w1 = image[i + 1]
        w2 = image[i + 2]
        hidden = layer[j + quad]
        f0 = rain_pixel(pixel_of(w0, w1, w2, 0), int(hidden & wp.uint32(255)))
        f1 = rain_pixel(pixel_of(w0, w1, w2, 1), int((hidden >> wp.uint32(8)) & wp.uint32(255)))
        f2 = rain_pixel(pixel_of(w0, w1, w2, 2), int((hidden >> wp.uint32(16)) & wp.uint32(255)))
        f3 = rain_pixel(pixel_of(w0, w1, w2, 3), int(hidden >> wp.uint32(24)))
        f0 = grey_fields(f0, image_weight, grey_offset)
        f1 = grey_fields(f1, image_weight, grey_offset)
        f2 = grey_fields(f2, image_weight, grey_offset)
        f3 = grey_fields(f3, image_weight, grey_offset)
        row_max = put(out, i, row_max, f0, f1, f2, f3)
        i += 3
    highest[b, y] = row_max


@wp.kernel
def darken(gain: wp.array(dtype=int), words: int, chunk: int, data: wp.array(dtype=wp.uint32)):
    """Multiply every byte by gain / 256, four at a time, in place."""
    b, chunk_index = wp.tid()
    begin = chunk_index * chunk
    end = wp.min(begin + chunk, words)
    factor = wp.uint32(gain[b])
    limit = wp.uint32(255)
    for i in range(b * words + begin, b * words + end):
        word = data[i]
        low = wp.min(((word & limit) * factor) >> wp.uint32(8), limit)
        second = wp.min((((word >> wp.uint32(8)) & limit) * factor) >> wp.uint32(8), limit)
        third = wp.min((((word >> wp.uint32(16)) & limit) * factor) >> wp.uint32(8), limit)
        high = wp.min(((word >> wp.uint32(24)) * factor) >> wp.uint32(8), limit)
        data[i] = low | (second << wp.uint32(8)) | (third << wp.uint32(16)) | (high << wp.uint32(24))

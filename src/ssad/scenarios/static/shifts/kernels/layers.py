"""Paper's calibration of fog, sun and motion blur: layers over the image without a 3D world."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import byte, colour, draw, put_colour, unit

wp.set_module_options({"enable_backward": False})  # see `exposure`


@wp.kernel
def brightest(image: wp.array(dtype=wp.uint32), row: int, words: int, highest: wp.array2d(dtype=int)):
    """Find the largest byte of each row of `row` words."""
    b, y = wp.tid()
    row_max = int(0)
    pair_mask = wp.uint32(16711935)
    row_start = b * words + y * row
    for i in range(row_start, row_start + row):
        word = image[i]
        # A byte above the maximum so far overflows into bit 8, so most words need no unpacking.
        headroom = wp.uint32((255 - row_max) * 65537)
        overflow = ((word & pair_mask) + headroom) | (((word >> wp.uint32(8)) & pair_mask) + headroom)
        if (overflow & wp.uint32(16777472)) != wp.uint32(0):
            for byte_index in range(4):
                row_max = wp.max(row_max, int((word >> wp.uint32(8 * byte_index)) & wp.uint32(255)))
    highest[b, y] = row_max


@wp.kernel
def squares(keys: wp.array(dtype=wp.uint64), wibble: wp.array2d(dtype=float), level: int, out: wp.array3d(dtype=float)):
    """Set the centre of each square of corners: diamond-square (Fournier, Fussell, Carpenter 1982) on a torus."""
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
    """Set the edge midpoints of diamond-square, between two corners and two square centres."""
    b, i, j = wp.tid()
    size = out.shape[1]
    step = size >> level
    half = step / 2
    y = i * step
    x = j * step
    up = (y + size - half) % size
    left = (x + size - half) % size
    corner = out[b, y, x]
    centre = out[b, y + half, x + half]
    mean = (corner + out[b, y, (x + step) % size] + centre + out[b, up, x + half]) * 0.25
    noise = 2.0 * unit(draw(keys[b] + wp.uint64(3 * level + 1), i * 8192 + j), 0) - 1.0
    out[b, y, x + half] = mean + wibble[b, level] * noise
    mean = (corner + out[b, (y + step) % size, x] + centre + out[b, y + half, left]) * 0.25
    noise = 2.0 * unit(draw(keys[b] + wp.uint64(3 * level + 2), i * 8192 + j), 0) - 1.0
    out[b, y + half, x] = mean + wibble[b, level] * noise


@wp.kernel
def extremes(grid: wp.array3d(dtype=float), low: wp.array2d(dtype=float), high: wp.array2d(dtype=float)):
    """Find the minimum and the maximum of each row."""
    b, y = wp.tid()
    row_min = grid[b, y, 0]
    row_max = row_min
    for x in range(1, grid.shape[2]):
        row_min = wp.min(row_min, grid[b, y, x])
        row_max = wp.max(row_max, grid[b, y, x])
    low[b, y] = row_min
    high[b, y] = row_max


@wp.kernel
def blend_clouds(
    image: wp.array(dtype=wp.uint8),
    grid: wp.array3d(dtype=float),
    low: wp.array(dtype=float),
    span: wp.array(dtype=float),
    amount: wp.array(dtype=float),
    brightest: wp.array(dtype=float),
    grey: wp.array(dtype=float),
    step: float,
    width: int,
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """Blend clouds into the image, then grey (ImageNet-C's fog, 3DC's end).

    (image + amount * clouds) * most / (most + amount). grid: clouds on a torus, from low to low + span; step: cells
    per pixel.
    """
    b, y = wp.tid()
    size = grid.shape[1]
    fy = float(y) * step
    row = int(fy)
    row_fraction = fy - float(row)
    above = row % size
    below = (row + 1) % size
    row_start = b * stride + y * width * 3
    image_gain = brightest[b] / (brightest[b] + amount[b]) * (1.0 - grey[b])
    cloud_gain = amount[b] * 255.0 * image_gain / span[b]
    offset = 128.0 * grey[b] - low[b] * cloud_gain
    current_x = int(-1)
    left = float(0.0)
    right = float(0.0)
    for x in range(width):
        fx = float(x) * step
        cell_x = int(fx)
        # Both ends of the interpolation change only at a new cell.
        if cell_x != current_x:
            current_x = cell_x
            wrapped_x = cell_x % size
            left = grid[b, above, wrapped_x] * (1.0 - row_fraction) + grid[b, below, wrapped_x] * row_fraction
            wrapped_x = (cell_x + 1) % size
            right = grid[b, above, wrapped_x] * (1.0 - row_fraction) + grid[b, below, wrapped_x] * row_fraction
        veil = (left + (right - left) * (fx - float(cell_x))) * cloud_gain + offset
        pixel = row_start + x * 3
        for channel in range(3):
            out[pixel + channel] = byte(float(image[pixel + channel]) * image_gain + veil)


@wp.func
def brighter(pixel: wp.vec3, shade: wp.vec3, part: float) -> wp.vec3:
    """Blend a colour over a pixel unless that darkens it (HLS lightness, whole grey levels)."""
    blended = pixel * (1.0 - part) + shade * part
    is_lighter = int(wp.max(blended)) + int(wp.min(blended)) > int(wp.max(pixel)) + int(wp.min(pixel))
    return wp.where(is_lighter, blended, pixel)


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
    """Blend a faint coloured disc and then the white sun in place, both with gaussian edges.

    out: holds the image; sun, flare: x, y, deviation in pixels, 0 for none; tint: colour of the disc; strength: its
    weight there.
    """
    b, y = wp.tid()
    row_start = b * stride + y * width * 3
    radius = wp.max(4.0 * sun[b][2], 4.5 * flare[b][2])
    sun_dy = float(y) - sun[b][1]
    flare_dy = float(y) - flare[b][1]
    if wp.abs(sun_dy) > radius and wp.abs(flare_dy) > radius:
        return
    for x in range(width):
        sun_dx = float(x) - sun[b][0]
        flare_dx = float(x) - flare[b][0]
        sun_distance = (sun_dx * sun_dx + sun_dy * sun_dy) / (sun[b][2] * sun[b][2])
        flare_distance = float(100.0)
        if flare[b][2] > 0.0:
            flare_distance = (flare_dx * flare_dx + flare_dy * flare_dy) / (flare[b][2] * flare[b][2])
        if sun_distance < 16.0 or flare_distance < 20.0:
            pixel = row_start + x * 3
            weight = wp.min(4.0 * wp.exp(-0.5 * flare_distance), 1.0) * strength[b]
            blended = brighter(wp.vec3(colour(image, pixel)), tint[b], weight)
            weight = wp.min(1.5 * wp.exp(-0.5 * sun_distance), 1.0)
            blended = brighter(blended, wp.vec3(255.0, 255.0, 255.0), weight)
            for channel in range(3):
                out[pixel + channel] = wp.uint8(wp.clamp(int(blended[channel]), 0, 255))


@wp.kernel
def smear_rows(
    image: wp.array(dtype=wp.uint8),
    owner: wp.array3d(dtype=wp.int16),
    length: wp.array(dtype=int),
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """Apply a horizontal box blur where an object is; length 0: leave the image unchanged."""
    b, y = wp.tid()
    width = owner.shape[2]
    half_length = length[b] / 2
    if half_length < 1:
        return
    row_start = b * stride + y * width * 3
    total = wp.vec3i(0, 0, 0)
    for tap_index in range(-half_length, half_length + 1):
        total += colour(image, row_start + wp.clamp(tap_index, 0, width - 1) * 3)
    tap_count = 2 * half_length + 1
    for x in range(width):
        if owner[b, y, x] > wp.int16(0):
            put_colour(out, row_start + x * 3, total / tap_count)
        entering = row_start + wp.min(x + half_length + 1, width - 1) * 3
        leaving = row_start + wp.max(x - half_length, 0) * 3
        total += colour(image, entering) - colour(image, leaving)


@wp.kernel
def zoom_blur(
    image: wp.array(dtype=wp.uint8),
    owner: wp.array3d(dtype=wp.int16),
    zoom: wp.array(dtype=float),
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """Apply the mean of 12 zooms about the image centre where an object is; zoom 0: leave it unchanged."""
    b, y = wp.tid()
    if zoom[b] <= 0.0:
        return
    width = owner.shape[2]
    height = owner.shape[1]
    centre_x = float(width - 1) * 0.5
    centre_y = float(height - 1) * 0.5
    image_start = b * stride
    for x in range(width):
        if owner[b, y, x] > wp.int16(0):
            total = wp.vec3i(0, 0, 0)
            for zoom_index in range(12):
                inverse_zoom = 1.0 / (1.0 + zoom[b] * float(zoom_index) / 11.0)
                source_x = int((float(x) - centre_x) * inverse_zoom + centre_x + 0.5)
                source_y = int((float(y) - centre_y) * inverse_zoom + centre_y + 0.5)
                total += colour(image, image_start + (source_y * width + source_x) * 3)
            put_colour(out, image_start + (y * width + x) * 3, total / 12)

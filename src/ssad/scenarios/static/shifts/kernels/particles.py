"""Rain drops and snow flakes in the world, as a camera with an exposure time records them."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.light import CODES, WHITE
from ssad.scenarios.static.shifts.kernels.shared import draw, unit

wp.set_module_options({"enable_backward": False})  # see `exposure`

BLOCK = wp.constant(16)  # px, side of the squares that drops on the lens show
SOFT_EDGE = wp.constant(0.45)  # share of a drop's radius over which it fades
LIGHT_PARTS = wp.constant(float(CODES))
HIGHEST_CODE = wp.constant(int(CODES - 1))


@wp.struct
class Air:
    """Falling particles, the same for all cameras of a scene. Lengths in metres, diameters in millimetres.

    Attributes:
        key: Key of its random numbers.
        tile: Period of the particle field.
        wind: m/s.
        slope: Exponent of the size distribution, 1/mm.
        low: Minimum diameter.
        reach: Share of sizes up to the largest.
        drag: 10.3 exp(-0.6 low) of the speed of fall.
        growth: Ratio of visible to melted diameter.
        snow: 1 for flakes, 0 for drops.
        count: Number of particles.
    """

    key: wp.uint64
    tile: wp.vec3
    wind: wp.vec3
    slope: float
    low: float
    reach: float
    drag: float
    growth: float
    snow: int
    count: int


@wp.struct
class LensDrop:
    """Drop on the lens.

    Attributes:
        image: Image that shows it.
        x: Centre, pixels.
        y: Centre, pixels.
        radius: Pixels.
        oval: Height over width.
        oval_phase: Direction of the first uneven part of its outline, rad.
        bump_phase: Direction of the second, rad.
    """

    image: int
    x: float
    y: float
    radius: float
    oval: float
    oval_phase: float
    bump_phase: float


@wp.kernel
def blur_coarsely(
    image: wp.array(dtype=wp.uint8),
    linear: wp.array(dtype=int),
    height: int,
    width: int,
    out: wp.array3d(dtype=wp.vec3),
):
    """Compute the mean light (1 for white) of squares of BLOCK pixels, from every second pixel of every second row.

    They are those of a quincunx, which meets both fields of a fine chequered pattern.
    """
    b, row = wp.tid()
    for column in range(out.shape[2]):
        total = wp.vec3(0.0, 0.0, 0.0)
        count = float(0.0)
        for dy in range(0, BLOCK, 2):
            y = row * BLOCK + dy
            if y < height:
                for dx in range(0, BLOCK, 2):
                    x = column * BLOCK + dx + (dy / 2) % 2
                    if x < width:
                        pixel = ((b * height + y) * width + x) * 3
                        total += wp.vec3(
                            float(linear[int(image[pixel])]),
                            float(linear[int(image[pixel + 1])]),
                            float(linear[int(image[pixel + 2])]),
                        )
                        count += 1.0
        out[b, row, column] = total / (count * WHITE)


@wp.func
def coarse_light(coarse: wp.array3d(dtype=wp.vec3), b: int, y: float, x: float) -> wp.vec3:
    """Return the light at a place of the image, px, between four squares, clamped at the border."""
    grid_y = wp.clamp(y / float(BLOCK) - 0.5, 0.0, float(coarse.shape[1] - 1))
    grid_x = wp.clamp(x / float(BLOCK) - 0.5, 0.0, float(coarse.shape[2] - 1))
    row = wp.min(int(grid_y), wp.max(coarse.shape[1] - 2, 0))
    column = wp.min(int(grid_x), wp.max(coarse.shape[2] - 2, 0))
    next_row = wp.min(row + 1, coarse.shape[1] - 1)
    next_column = wp.min(column + 1, coarse.shape[2] - 1)
    lower_share = grid_y - float(row)
    right_share = grid_x - float(column)
    upper = coarse[b, row, column] * (1.0 - right_share) + coarse[b, row, next_column] * right_share
    lower = coarse[b, next_row, column] * (1.0 - right_share) + coarse[b, next_row, next_column] * right_share
    return upper * (1.0 - lower_share) + lower * lower_share


@wp.kernel
def refract(
    coarse: wp.array3d(dtype=wp.vec3),
    drops: wp.array(dtype=LensDrop),
    first: wp.array(dtype=int),
    linear: wp.array(dtype=int),
    codes: wp.array(dtype=wp.uint8),
    height: int,
    width: int,
    out: wp.array(dtype=wp.uint8),
):
    """Draw drops as small lenses out of focus: the surroundings upside down, reduced and blurred, dark at the rim.

    The surroundings come from an image of coarse squares, as a drop spans many pixels of the scene with each of its
    own; light mixes as light, and the edge is as soft as a thing so near to the lens is.

    One thread per row, the drops of an image one after the other, so that the order of overlapping drops is fixed.
    """
    b, y = wp.tid()
    image_start = b * height * width * 3
    for drop_index in range(first[b], first[b + 1]):
        drop = drops[drop_index]
        share_y = (float(y) - drop.y) / (drop.radius * drop.oval)
        if wp.abs(share_y) < 1.25:
            half_width = int(1.25 * drop.radius) + 1
            for column_offset in range(-half_width, half_width + 1):
                x = int(drop.x) + column_offset
                share_x = (float(x) - drop.x) / drop.radius
                angle = wp.atan2(share_y, share_x)
                uneven = (
                    1.0 + 0.12 * wp.cos(2.0 * angle + drop.oval_phase) + 0.06 * wp.cos(3.0 * angle + drop.bump_phase)
                )
                radius_share = wp.sqrt(share_x * share_x + share_y * share_y) / uneven
                if radius_share < 1.0 and x >= 0 and x < width:
                    # A wide view that bulges: its rim looks farther aside than its middle, past the image border.
                    bulge = (0.35 + 0.2 * radius_share * radius_share) * float(height)
                    light = wp.vec3(0.0, 0.0, 0.0)
                    for tap_index in range(9):
                        tap_x = float(tap_index % 3 - 1)
                        tap_y = float(tap_index / 3 - 1)
                        # Binomial weights over 3 x 3 places, as far apart as the squares are.
                        weight = (2.0 - wp.abs(tap_x)) * (2.0 - wp.abs(tap_y)) / 16.0
                        light += weight * coarse_light(
                            coarse,
                            b,
                            drop.y - share_y * bulge + tap_y * float(BLOCK),
                            drop.x - share_x * bulge + tap_x * float(BLOCK),
                        )
                    edge = wp.clamp((1.0 - radius_share) / SOFT_EDGE, 0.0, 1.0)
                    opacity = 0.85 * edge * edge * (3.0 - 2.0 * edge)
                    gain = (1.0 - 0.45 * radius_share * radius_share) * opacity
                    target_byte = image_start + (y * width + x) * 3
                    for channel in range(3):
                        behind = float(linear[int(out[target_byte + channel])]) / WHITE
                        mixed = behind * (1.0 - opacity) + light[channel] * gain
                        out[target_byte + channel] = codes[wp.clamp(int(mixed * LIGHT_PARTS), 0, HIGHEST_CODE)]


@wp.func
def wrap_coordinate(value: float, period: float) -> float:
    """Return a coordinate of a periodic field, in [-period / 2, period / 2)."""
    return value - period * wp.floor(value / period + 0.5)


@wp.func
def deposit(layer: wp.array3d(dtype=int), b: int, y: int, x: int, amount: float):
    """Add opacity (of 65536) to a cell; integer sums do not depend on the order of the particles."""
    if y >= 0 and y < layer.shape[1] and x >= 0 and x < layer.shape[2]:
        wp.atomic_add(layer, b, y, x, int(amount * 65536.0))


@wp.func
def soft_disc(distance: float, radius: float, soft: float) -> float:
    """Return the cover of a disc at a distance from its middle; its edge fades over `soft`."""
    return wp.clamp((radius - distance) / soft + 0.5, 0.0, 1.0)


@wp.func
def streak_cover(along: float, across: float, length: float, radius: float, soft: float) -> float:
    """Return the share of the exposure for which a soft disc that moves along a line covers a point.

    along, across: the point from the start of the line; the cover is the mean over discs along the line.
    """
    if wp.abs(across) >= radius + 0.5 * soft:
        return 0.0
    if length < 0.25:
        return soft_disc(wp.sqrt(along * along + across * across), radius, soft)
    total = float(0.0)
    # A soft disc is the mean of discs whose radii differ by its edge; the chord of each covers the point in turn.
    for layer_index in range(4):
        disc_radius = radius + soft * ((float(layer_index) + 0.5) * 0.25 - 0.5)
        squared = disc_radius * disc_radius - across * across
        if disc_radius > 0.0 and squared > 0.0:
            chord = wp.sqrt(squared)
            total += wp.max(wp.min(along + chord, length) - wp.max(along - chord, 0.0), 0.0)
    return 0.25 * total / length


@wp.kernel
def splat(
    airs: wp.array(dtype=Air),
    time: wp.array(dtype=float),
    to_camera: wp.array(dtype=wp.mat33),
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    lens: wp.array(dtype=wp.vec4),
    exposure: float,
    aperture: float,
    layer: wp.array3d(dtype=int),
):
    """One thread a particle and image: its streak over the exposure, in cells of two pixels.

    position: of the camera, modulo the tile; velocity: of the ego, m/s; aperture: diameter of the lens, m (near
    particles are out of focus). Opacity times area is kept, whatever the blur.
    """
    b, particle = wp.tid()
    air = airs[b]
    if particle >= air.count:
        return
    first = draw(air.key, particle * 2)
    second = draw(air.key, particle * 2 + 1)
    # diameter: exponential between low and high (Marshall-Palmer, Sekhon-Srivastava)
    size_draw = 1.0 - unit(second, 0) * air.reach
    age = time[b]
    fall_speed = 0.9 + 0.8 * unit(second, 48)
    if air.snow == 0:
        # Atlas, Srivastava and Sekhon 1973: 9.65 - 10.3 exp(-0.6 D)
        fall_speed = 9.65 - air.drag * wp.pow(size_draw, 0.6 / air.slope)
    drift = air.wind + wp.vec3(0.0, 0.0, -fall_speed)
    tile_position = wp.vec3(unit(first, 0) * air.tile[0], unit(first, 16) * air.tile[1], unit(first, 32) * air.tile[2])
    particle_position = tile_position + drift * age - position[b]
    particle_position = wp.vec3(
        wrap_coordinate(particle_position[0], air.tile[0]),
        wrap_coordinate(particle_position[1], air.tile[1]),
        wrap_coordinate(particle_position[2], air.tile[2]),
    )
    # most particles are far outside the image
    focal = lens[b]
    approximate = to_camera[b] * particle_position
    if approximate[2] < 0.1:
        return
    u = focal[0] * approximate[0] / approximate[2] + focal[2]
    v = focal[1] * approximate[1] / approximate[2] + focal[3]
    if u < -400.0 or u > 2.0 * float(layer.shape[2]) + 400.0 or v < -400.0 or v > 2.0 * float(layer.shape[1]) + 400.0:
        return
    melted = air.low - wp.log(size_draw) / air.slope
    if air.snow == 1:
        flutter_phase = unit(second, 16) * 6.2831853
        flutter_rate = 1.0 + 2.0 * unit(second, 32)
        particle_position = (
            particle_position
            + wp.vec3(wp.sin(flutter_rate * age + flutter_phase), wp.cos(flutter_rate * age * 0.8 + flutter_phase), 0.0)
            * 0.08
        )
    # fade out towards the border of the tile, so that no particle appears suddenly
    tile_distance = wp.length(wp.cw_div(particle_position, air.tile)) * 2.0
    if tile_distance >= 1.0:
        return
    fade = wp.clamp((1.0 - tile_distance) * 4.0, 0.0, 1.0)
    half_path = (drift - velocity[b]) * (exposure * 0.5)
    start = to_camera[b] * (particle_position - half_path)
    end_point = to_camera[b] * (particle_position + half_path)
    mean_depth = 0.5 * (start[2] + end_point[2])
    if start[2] < 0.25 or end_point[2] < 0.25:
        return
    # in half-resolution cells, counted from the middle of the first one
    start_x = (focal[0] * start[0] / start[2] + focal[2]) * 0.5 - 0.5
    start_y = (focal[1] * start[1] / start[2] + focal[3]) * 0.5 - 0.5
    end_x = (focal[0] * end_point[0] / end_point[2] + focal[2]) * 0.5 - 0.5
    end_y = (focal[1] * end_point[1] / end_point[2] + focal[3]) * 0.5 - 0.5
    size = melted * air.growth * 0.001 * focal[0] / mean_depth * 0.5
    blur = aperture * focal[0] / mean_depth * 0.5
    diameter = wp.sqrt(size * size + blur * blur + 0.36)
    rows = float(layer.shape[1])
    columns = float(layer.shape[2])
    if wp.max(start_x, end_x) < -diameter or wp.min(start_x, end_x) > columns + diameter:
        return
    if wp.max(start_y, end_y) < -diameter or wp.min(start_y, end_y) > rows + diameter:
        return
    dx = end_x - start_x
    dy = end_y - start_y
    length = wp.sqrt(dx * dx + dy * dy)
    # A disc that moves along a line: each cell is covered for as long as the disc holds it. Its edge is as wide as the
    # smaller of the particle and its blur, since one spreads the other.
    soft = wp.clamp(wp.min(size, blur), 1.0, diameter)
    radius = 0.5 * diameter
    reach = radius + 0.5 * soft
    opacity = wp.min(fade * size * size / (diameter * diameter), 0.95)
    axis_x = float(1.0)
    axis_y = float(0.0)
    if length > 1.0e-3:
        axis_x = dx / length
        axis_y = dy / length
    is_steep = wp.abs(axis_y) >= wp.abs(axis_x)
    # Cells are visited along the longer axis of the streak, and across it around its line.
    start_major = wp.where(is_steep, start_y, start_x)
    end_major = wp.where(is_steep, end_y, end_x)
    start_minor = wp.where(is_steep, start_x, start_y)
    along = wp.where(is_steep, axis_y, axis_x)
    aside = wp.where(is_steep, axis_x, axis_y)
    slope = aside / along
    half_thickness = reach / wp.abs(along)
    low = wp.max(wp.min(start_major, end_major) - reach, 0.0)
    high = wp.min(wp.max(start_major, end_major) + reach, wp.where(is_steep, rows, columns) - 1.0)
    minor_cells = wp.where(is_steep, columns, rows)
    for major in range(int(low), int(wp.ceil(high)) + 1):
        line_centre = start_minor + (float(major) - start_major) * slope
        first_minor = int(wp.max(wp.floor(line_centre - half_thickness), 0.0))
        last_minor = int(wp.min(wp.ceil(line_centre + half_thickness), minor_cells - 1.0))
        for minor in range(first_minor, last_minor + 1):
            y = wp.where(is_steep, major, minor)
            x = wp.where(is_steep, minor, major)
            offset_x = float(x) - start_x
            offset_y = float(y) - start_y
            covered = streak_cover(
                offset_x * axis_x + offset_y * axis_y, offset_y * axis_x - offset_x * axis_y, length, radius, soft
            )
            if covered > 0.0:
                deposit(layer, b, y, x, opacity * covered)

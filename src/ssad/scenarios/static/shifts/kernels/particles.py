"""Rain drops and snow flakes in the world, as a camera with an exposure time records them."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import colour, draw, unit

wp.set_module_options({"enable_backward": False})  # see `exposure`


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
    """

    image: int
    x: float
    y: float
    radius: float
    oval: float


@wp.kernel
def refract(
    image: wp.array(dtype=wp.uint8),
    drops: wp.array(dtype=LensDrop),
    first: wp.array(dtype=int),
    height: int,
    width: int,
    out: wp.array(dtype=wp.uint8),
):
    """Draw drops as small lenses out of focus: the surroundings upside down, reduced and blurred, dark at the rim.

    One thread per row, the drops of an image one after the other, so that the order of overlapping drops is fixed.
    """
    b, y = wp.tid()
    image_start = b * height * width * 3
    for drop_index in range(first[b], first[b + 1]):
        drop = drops[drop_index]
        v = float(y - int(drop.y)) / (drop.radius * drop.oval)
        if wp.abs(v) < 1.0:
            half_width = int(drop.radius) + 1
            for column_offset in range(-half_width, half_width + 1):
                x = int(drop.x) + column_offset
                u = float(column_offset) / drop.radius
                radius_share = wp.sqrt(u * u + v * v)
                if radius_share < 1.0 and x >= 0 and x < width:
                    total = wp.vec3i(0, 0, 0)
                    for tap_index in range(9):
                        # a wide view: the rim looks past the image border, where it is clamped
                        source_x = drop.x - (u + float(tap_index % 3 - 1) * 0.12) * float(height) * 0.55
                        source_y = drop.y - (v + float(tap_index / 3 - 1) * 0.12) * float(height) * 0.55
                        row = wp.clamp(int(source_y), 0, height - 1)
                        total += colour(image, image_start + (row * width + wp.clamp(int(source_x), 0, width - 1)) * 3)
                    opacity = 0.8 * wp.clamp((1.0 - radius_share) * 3.0, 0.0, 1.0)
                    gain = (1.0 - 0.35 * radius_share * radius_share) * opacity / 9.0
                    target_byte = image_start + (y * width + x) * 3
                    for tap_index in range(3):
                        light = (
                            float(out[target_byte + tap_index]) * (1.0 - opacity) + float(total[tap_index]) * gain + 0.5
                        )
                        out[target_byte + tap_index] = wp.uint8(wp.min(light, 255.0))


@wp.func
def wrap_coordinate(value: float, period: float) -> float:
    """Return a coordinate of a periodic field, in [-period / 2, period / 2)."""
    return value - period * wp.floor(value / period + 0.5)


@wp.func
def deposit(layer: wp.array3d(dtype=int), b: int, y: int, x: int, amount: float):
    """Add opacity (of 65536) to a cell; integer sums do not depend on the order of the particles."""
    if y >= 0 and y < layer.shape[1] and x >= 0 and x < layer.shape[2]:
        wp.atomic_add(layer, b, y, x, int(amount * 65536.0))


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
    streak_length = wp.sqrt(dx * dx + dy * dy)
    opacity = wp.min(fade * 0.785 * size * size / (diameter * (streak_length + 0.785 * diameter)), 0.95)
    radius = diameter * 0.5
    if streak_length < 1.0:
        # a disc
        centre_x = 0.5 * (start_x + end_x)
        centre_y = 0.5 * (start_y + end_y)
        disc_reach = int(radius + 1.0)
        x0 = int(wp.floor(centre_x + 0.5))
        y0 = int(wp.floor(centre_y + 0.5))
        for row_offset in range(-disc_reach, disc_reach + 1):
            for column_offset in range(-disc_reach, disc_reach + 1):
                offset_x = float(x0 + column_offset) - centre_x
                offset_y = float(y0 + row_offset) - centre_y
                coverage = wp.clamp(radius + 0.5 - wp.sqrt(offset_x * offset_x + offset_y * offset_y), 0.0, 1.0)
                if coverage > 0.0:
                    deposit(layer, b, y0 + row_offset, x0 + column_offset, opacity * coverage)
    elif wp.abs(dy) >= wp.abs(dx):
        slope = dx / dy
        half_thickness = radius * wp.sqrt(1.0 + slope * slope)
        low = wp.max(wp.min(start_y, end_y) - radius, 0.0)
        high = wp.min(wp.max(start_y, end_y) + radius, rows - 1.0)
        for y in range(int(low), int(high) + 1):
            line_centre = start_x + (float(y) - start_y) * slope
            end_fade = wp.clamp(
                wp.min(float(y) - wp.min(start_y, end_y), wp.max(start_y, end_y) - float(y)) + 0.5 + radius, 0.0, 1.0
            )
            for x in range(
                int(wp.floor(line_centre - half_thickness)), int(wp.floor(line_centre + half_thickness)) + 2
            ):
                coverage = wp.clamp(half_thickness + 0.5 - wp.abs(float(x) - line_centre), 0.0, 1.0) * end_fade
                if coverage > 0.0:
                    deposit(layer, b, y, x, opacity * coverage)
    else:
        slope = dy / dx
        half_thickness = radius * wp.sqrt(1.0 + slope * slope)
        low = wp.max(wp.min(start_x, end_x) - radius, 0.0)
        high = wp.min(wp.max(start_x, end_x) + radius, columns - 1.0)
        for x in range(int(low), int(high) + 1):
            line_centre = start_y + (float(x) - start_x) * slope
            end_fade = wp.clamp(
                wp.min(float(x) - wp.min(start_x, end_x), wp.max(start_x, end_x) - float(x)) + 0.5 + radius, 0.0, 1.0
            )
            for y in range(
                int(wp.floor(line_centre - half_thickness)), int(wp.floor(line_centre + half_thickness)) + 2
            ):
                coverage = wp.clamp(half_thickness + 0.5 - wp.abs(float(y) - line_centre), 0.0, 1.0) * end_fade
                if coverage > 0.0:
                    deposit(layer, b, y, x, opacity * coverage)

"""Rain drops and snow flakes in the air of the world, as a camera with an exposure time sees them."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import colour, draw, unit


@wp.struct
class Air:
    """What falls, the same for all cameras of a scene. Lengths in metres, diameters in millimetres.

    Attributes:
        key: Key of its random numbers.
        tile: Period of the particle field.
        wind: m/s.
        slope: Exponent of the size distribution, 1/mm.
        low: Least diameter.
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
    """A drop on the lens.

    Attributes:
        image: The image that shows it.
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
    """A drop is a small lens out of focus: it shows what is around, upside down, small and blurred, dark at its rim.

    One thread a row, the drops of an image one after the other, so that drops that overlap do so in one order.
    """
    b, y = wp.tid()
    start = b * height * width * 3
    for n in range(first[b], first[b + 1]):
        drop = drops[n]
        v = float(y - int(drop.y)) / (drop.radius * drop.oval)
        if wp.abs(v) < 1.0:
            wide = int(drop.radius) + 1
            for i in range(-wide, wide + 1):
                x = int(drop.x) + i
                u = float(i) / drop.radius
                r = wp.sqrt(u * u + v * v)
                if r < 1.0 and x >= 0 and x < width:
                    total = wp.vec3i(0, 0, 0)
                    for k in range(9):
                        # a wide view: the rim looks past the picture's border, where it is held
                        sx = drop.x - (u + float(k % 3 - 1) * 0.12) * float(height) * 0.55
                        sy = drop.y - (v + float(k / 3 - 1) * 0.12) * float(height) * 0.55
                        row = wp.clamp(int(sy), 0, height - 1)
                        total += colour(image, start + (row * width + wp.clamp(int(sx), 0, width - 1)) * 3)
                    cover = 0.8 * wp.clamp((1.0 - r) * 3.0, 0.0, 1.0)
                    shade = (1.0 - 0.35 * r * r) * cover / 9.0
                    o = start + (y * width + x) * 3
                    for k in range(3):
                        light = float(out[o + k]) * (1.0 - cover) + float(total[k]) * shade + 0.5
                        out[o + k] = wp.uint8(wp.min(light, 255.0))


@wp.func
def wrapped(value: float, period: float) -> float:
    """A coordinate of a periodic field, in [-period / 2, period / 2)."""
    return value - period * wp.floor(value / period + 0.5)


@wp.func
def deposit(layer: wp.array3d(dtype=int), b: int, y: int, x: int, amount: float):
    """Adds opacity (of 65536) to a cell; whole numbers, so that the order of the particles is of no consequence."""
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
    b, i = wp.tid()
    air = airs[b]
    if i >= air.count:
        return
    first = draw(air.key, i * 2)
    second = draw(air.key, i * 2 + 1)
    # diameter: exponential between low and high (Marshall-Palmer, Sekhon-Srivastava)
    rest = 1.0 - unit(second, 0) * air.reach
    t = time[b]
    fall = 0.9 + 0.8 * unit(second, 48)
    if air.snow == 0:
        # Atlas, Srivastava and Sekhon 1973: 9.65 - 10.3 exp(-0.6 D)
        fall = 9.65 - air.drag * wp.pow(rest, 0.6 / air.slope)
    drift = air.wind + wp.vec3(0.0, 0.0, -fall)
    base = wp.vec3(unit(first, 0) * air.tile[0], unit(first, 16) * air.tile[1], unit(first, 32) * air.tile[2])
    p = base + drift * t - position[b]
    p = wp.vec3(wrapped(p[0], air.tile[0]), wrapped(p[1], air.tile[1]), wrapped(p[2], air.tile[2]))
    # far outside of the picture: most are
    focal = lens[b]
    rough = to_camera[b] * p
    if rough[2] < 0.1:
        return
    u = focal[0] * rough[0] / rough[2] + focal[2]
    v = focal[1] * rough[1] / rough[2] + focal[3]
    if u < -400.0 or u > 2.0 * float(layer.shape[2]) + 400.0 or v < -400.0 or v > 2.0 * float(layer.shape[1]) + 400.0:
        return
    melted = air.low - wp.log(rest) / air.slope
    if air.snow == 1:
        phase = unit(second, 16) * 6.2831853
        pace = 1.0 + 2.0 * unit(second, 32)
        p = p + wp.vec3(wp.sin(pace * t + phase), wp.cos(pace * t * 0.8 + phase), 0.0) * 0.08
    # fades out towards the border of the tile, so that nothing pops up there
    away = wp.length(wp.cw_div(p, air.tile)) * 2.0
    if away >= 1.0:
        return
    fade = wp.clamp((1.0 - away) * 4.0, 0.0, 1.0)
    path = (drift - velocity[b]) * (exposure * 0.5)
    a = to_camera[b] * (p - path)
    c = to_camera[b] * (p + path)
    z = 0.5 * (a[2] + c[2])
    if a[2] < 0.25 or c[2] < 0.25:
        return
    # in half-resolution cells, counted from the middle of the first one
    ax = (focal[0] * a[0] / a[2] + focal[2]) * 0.5 - 0.5
    ay = (focal[1] * a[1] / a[2] + focal[3]) * 0.5 - 0.5
    cx = (focal[0] * c[0] / c[2] + focal[2]) * 0.5 - 0.5
    cy = (focal[1] * c[1] / c[2] + focal[3]) * 0.5 - 0.5
    size = melted * air.growth * 0.001 * focal[0] / z * 0.5
    blur = aperture * focal[0] / z * 0.5
    wide = wp.sqrt(size * size + blur * blur + 0.36)
    rows = float(layer.shape[1])
    columns = float(layer.shape[2])
    if wp.max(ax, cx) < -wide or wp.min(ax, cx) > columns + wide:
        return
    if wp.max(ay, cy) < -wide or wp.min(ay, cy) > rows + wide:
        return
    dx = cx - ax
    dy = cy - ay
    long = wp.sqrt(dx * dx + dy * dy)
    opacity = wp.min(fade * 0.785 * size * size / (wide * (long + 0.785 * wide)), 0.95)
    half = wide * 0.5
    if long < 1.0:
        # a disc
        mx = 0.5 * (ax + cx)
        my = 0.5 * (ay + cy)
        span = int(half + 1.0)
        x0 = int(wp.floor(mx + 0.5))
        y0 = int(wp.floor(my + 0.5))
        for j in range(-span, span + 1):
            for k in range(-span, span + 1):
                ex = float(x0 + k) - mx
                ey = float(y0 + j) - my
                cover = wp.clamp(half + 0.5 - wp.sqrt(ex * ex + ey * ey), 0.0, 1.0)
                if cover > 0.0:
                    deposit(layer, b, y0 + j, x0 + k, opacity * cover)
    elif wp.abs(dy) >= wp.abs(dx):
        slope = dx / dy
        thick = half * wp.sqrt(1.0 + slope * slope)
        low = wp.max(wp.min(ay, cy) - half, 0.0)
        high = wp.min(wp.max(ay, cy) + half, rows - 1.0)
        for y in range(int(low), int(high) + 1):
            middle = ax + (float(y) - ay) * slope
            end = wp.clamp(wp.min(float(y) - wp.min(ay, cy), wp.max(ay, cy) - float(y)) + 0.5 + half, 0.0, 1.0)
            for x in range(int(wp.floor(middle - thick)), int(wp.floor(middle + thick)) + 2):
                cover = wp.clamp(thick + 0.5 - wp.abs(float(x) - middle), 0.0, 1.0) * end
                if cover > 0.0:
                    deposit(layer, b, y, x, opacity * cover)
    else:
        slope = dy / dx
        thick = half * wp.sqrt(1.0 + slope * slope)
        low = wp.max(wp.min(ax, cx) - half, 0.0)
        high = wp.min(wp.max(ax, cx) + half, columns - 1.0)
        for x in range(int(low), int(high) + 1):
            middle = ay + (float(x) - ax) * slope
            end = wp.clamp(wp.min(float(x) - wp.min(ax, cx), wp.max(ax, cx) - float(x)) + 0.5 + half, 0.0, 1.0)
            for y in range(int(wp.floor(middle - thick)), int(wp.floor(middle + thick)) + 2):
                cover = wp.clamp(thick + 0.5 - wp.abs(float(y) - middle), 0.0, 1.0) * end
                if cover > 0.0:
                    deposit(layer, b, y, x, opacity * cover)

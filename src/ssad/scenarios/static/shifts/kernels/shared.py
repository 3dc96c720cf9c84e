"""Hashes, interpolation and pixel packing shared by the kernels."""

import warp as wp

GOLDEN = wp.constant(wp.uint64(0x9E3779B97F4A7C15))


@wp.func
def mix(value: wp.uint64) -> wp.uint64:
    """Return 64 well-mixed bits of a counter: the finaliser of splitmix64 (Steele, Lea and Flood 2014)."""
    x = (value ^ (value >> wp.uint64(30))) * wp.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> wp.uint64(27))) * wp.uint64(0x94D049BB133111EB)
    return x ^ (x >> wp.uint64(31))


@wp.func
def draw(key: wp.uint64, counter: int) -> wp.uint64:
    """Return 64 random bits for a key and a counter, independent of earlier draws."""
    return mix(key + wp.uint64(counter) * GOLDEN)


@wp.func
def unit(bits: wp.uint64, shift: int) -> float:
    """Return a uniform number in [0, 1) from 16 of 64 bits."""
    return (float(int((bits >> wp.uint64(shift)) & wp.uint64(65535))) + 0.5) / 65536.0


@wp.func
def byte(value: float) -> wp.uint8:
    """Return the nearest grey level in 0..255."""
    return wp.uint8(wp.clamp(int(value + 0.5), 0, 255))


@wp.func
def colour(image: wp.array(dtype=wp.uint8), i: int) -> wp.vec3i:
    """Return the three bytes from i on."""
    return wp.vec3i(int(image[i]), int(image[i + 1]), int(image[i + 2]))


@wp.func
def put_colour(image: wp.array(dtype=wp.uint8), i: int, value: wp.vec3i):
    """Write three grey levels in 0..255 to the bytes from i on."""
    image[i] = wp.uint8(value[0])
    image[i + 1] = wp.uint8(value[1])
    image[i + 2] = wp.uint8(value[2])


@wp.func
def put_four(out: wp.array(dtype=wp.uint32), i: int, p0: wp.uint32, p1: wp.uint32, p2: wp.uint32, p3: wp.uint32):
    """Write four pixels to three words from i on."""
    out[i] = p0 | (p1 << wp.uint32(24))
    out[i + 1] = (p1 >> wp.uint32(8)) | (p2 << wp.uint32(16))
    out[i + 2] = (p2 >> wp.uint32(16)) | (p3 << wp.uint32(8))


@wp.func
def cell(grid: wp.array3d(dtype=float), b: int, row: int, fraction: float, column: int) -> float:
    """Return the value of a grid between two of its rows; columns are clamped at the border."""
    clamped = wp.clamp(column, 0, grid.shape[2] - 1)
    low = wp.clamp(row, 0, grid.shape[1] - 1)
    high = wp.clamp(row + 1, 0, grid.shape[1] - 1)
    return grid[b, low, clamped] * (1.0 - fraction) + grid[b, high, clamped] * fraction


@wp.func
def lattice(key: wp.uint64, x: int, y: int, z: int) -> float:
    """Return a uniform number in [0, 1) at a point of the integer lattice."""
    counter = (
        wp.uint64(wp.uint32(x)) * wp.uint64(0x8DA6B343)
        + wp.uint64(wp.uint32(y)) * wp.uint64(0xD8163841)
        + wp.uint64(wp.uint32(z)) * wp.uint64(0xCB1AB31F)
    )
    return unit(mix(key + counter * GOLDEN), 0)


@wp.func
def smooth(x: float) -> float:
    """Return the Hermite step of x."""
    return x * x * (3.0 - 2.0 * x)


@wp.func
def value_noise(key: wp.uint64, p: wp.vec3) -> float:
    """Return smooth noise in [0, 1] with unit cells in three dimensions."""
    x = int(wp.floor(p[0]))
    y = int(wp.floor(p[1]))
    z = int(wp.floor(p[2]))
    u = smooth(p[0] - float(x))
    v = smooth(p[1] - float(y))
    w = smooth(p[2] - float(z))
    edge_00 = wp.lerp(lattice(key, x, y, z), lattice(key, x + 1, y, z), u)
    edge_10 = wp.lerp(lattice(key, x, y + 1, z), lattice(key, x + 1, y + 1, z), u)
    edge_01 = wp.lerp(lattice(key, x, y, z + 1), lattice(key, x + 1, y, z + 1), u)
    edge_11 = wp.lerp(lattice(key, x, y + 1, z + 1), lattice(key, x + 1, y + 1, z + 1), u)
    return wp.lerp(wp.lerp(edge_00, edge_10, v), wp.lerp(edge_01, edge_11, v), w)


# three bytes of a pixel in 21-bit fields of one word: one multiplication handles all three
FIELDS = wp.constant(wp.uint64(255 + (255 << 21) + (255 << 42)))
HALF = wp.constant(wp.uint64(512 + (512 << 21) + (512 << 42)))
ONES = wp.constant(wp.uint64(1 + (1 << 21) + (1 << 42)))
# fields of ten bits
TENS = wp.constant(wp.uint64(1023 + (1023 << 21) + (1023 << 42)))


@wp.func
def spread(pixel: wp.uint32) -> wp.uint64:
    """Unpack the lower 24 bits of a word to three fields."""
    word = wp.uint64(pixel)
    return (
        (word & wp.uint64(255))
        | ((word & wp.uint64(65280)) << wp.uint64(13))
        | ((word & wp.uint64(16711680)) << wp.uint64(26))
    )


@wp.func
def gather(fields: wp.uint64) -> wp.uint32:
    """Pack three fields of 8 bits into the lower 24 bits of a word."""
    middle = (fields >> wp.uint64(13)) & wp.uint64(65280)
    last = (fields >> wp.uint64(26)) & wp.uint64(16711680)
    return wp.uint32((fields & wp.uint64(255)) | middle | last)


@wp.func
def fields_of(colour: wp.vec3) -> wp.uint64:
    """Pack a colour, rounded and clipped to 0..1023, into fields."""
    red = wp.uint64(wp.clamp(int(colour[0] + 0.5), 0, 1023))
    green = wp.uint64(wp.clamp(int(colour[1] + 0.5), 0, 1023))
    blue = wp.uint64(wp.clamp(int(colour[2] + 0.5), 0, 1023))
    return red | (green << wp.uint64(21)) | (blue << wp.uint64(42))


@wp.func
def pixel_of(first: wp.uint32, second: wp.uint32, third: wp.uint32, k: int) -> wp.uint32:
    """Return pixel k of the four in three words."""
    if k == 0:
        return first & wp.uint32(16777215)
    if k == 1:
        return (first >> wp.uint32(24)) | ((second & wp.uint32(65535)) << wp.uint32(8))
    if k == 2:
        return (second >> wp.uint32(16)) | ((third & wp.uint32(255)) << wp.uint32(16))
    return third >> wp.uint32(8)

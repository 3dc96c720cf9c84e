"""Integer arithmetic in linear light: `FULL` is white; a mix has 1024 parts."""

import warp as wp

FULL = 65535
CODES = 4096
# right shift from a mix in 1024 parts to one of CODES intervals
DOWN = wp.constant(14)
PARTS = wp.constant(1024)
WHITE = wp.constant(float(FULL))


@wp.func
def light_of(colour: wp.vec3) -> wp.vec3i:
    """Convert a colour in linear light, 1 for white, to integers, rounded and clipped."""
    return wp.vec3i(
        int(wp.clamp(colour[0], 0.0, 1.0) * WHITE + 0.5),
        int(wp.clamp(colour[1], 0.0, 1.0) * WHITE + 0.5),
        int(wp.clamp(colour[2], 0.0, 1.0) * WHITE + 0.5),
    )


@wp.func
def linear_pixel(linear: wp.array(dtype=int), pixel: wp.uint32) -> wp.vec3i:
    """Return the light of a pixel, three codes in the lower 24 bits of a word."""
    return wp.vec3i(
        linear[int(pixel & wp.uint32(255))],
        linear[int((pixel >> wp.uint32(8)) & wp.uint32(255))],
        linear[int((pixel >> wp.uint32(16)) & wp.uint32(255))],
    )


@wp.func
def coded_pixel(codes: wp.array(dtype=wp.uint8), mixed: wp.vec3i) -> wp.uint32:
    """Return the pixel of light in 1024 parts of `FULL`."""
    red = wp.uint32(codes[mixed[0] >> DOWN])
    green = wp.uint32(codes[mixed[1] >> DOWN])
    blue = wp.uint32(codes[mixed[2] >> DOWN])
    return red | (green << wp.uint32(8)) | (blue << wp.uint32(16))

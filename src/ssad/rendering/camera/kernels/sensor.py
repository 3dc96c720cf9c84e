"""Sensor: linear light to photosites, and photosites to 8 bits. See `ssad.rendering.camera.sensor` for the chain."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Response:
    """Sensor of a view.

    Attributes:
        exposure: Factor of the light, RGB.
        centre: Weight of a pixel in the lens's blur along an axis.
        side: Weight of each of its two neighbours.
        full: Light at which a photosite is full.
        photons: Variance for each unit of light.
        dark: Standard deviation without light.
        seed: Seed of the noise.
        mosaic: 1 for a sensor with a colour mosaic.
        curve: Row of its curve.
        saturation: Distance of colours from grey, over that of the light.
    """

    exposure: wp.vec3
    centre: float
    side: float
    full: float
    photons: float
    dark: float
    seed: int
    mosaic: int
    curve: int
    saturation: float


@wp.func
def mirrored(index: int, count: int) -> int:
    """Return an index mirrored into the image at its outermost pixel."""
    inside = wp.abs(index)
    if inside >= count:
        # The outermost pixel is not repeated, which keeps the order of the mosaic.
        inside = 2 * count - 2 - inside
    return wp.max(inside, 0)


@wp.func
def code_of(curves: wp.array2d(dtype=wp.uint8), row: int, light: float) -> wp.uint8:
    """Look up the camera's curve, listed over the square root of light in 0..4."""
    position = wp.sqrt(wp.clamp(light, 0.0, 3.999)) * 0.5 * float(curves.shape[1])
    return curves[row, int(position)]


@wp.func
def saturated(light: float, grey: float, saturation: float) -> float:
    """Return a colour at another distance from its grey."""
    return light * saturation + grey * (1.0 - saturation)


@wp.func
def put(
    out: wp.array4d(dtype=wp.uint8),
    view: int,
    y: int,
    x: int,
    red: float,
    green: float,
    blue: float,
    saturation: float,
    row: int,
    curves: wp.array2d(dtype=wp.uint8),
):
    """Write the codes of a pixel by a row of the curves."""
    final_red = red
    final_green = green
    final_blue = blue
    if saturation != 1.0:
        grey = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        final_red = saturated(red, grey, saturation)
        final_green = saturated(green, grey, saturation)
        final_blue = saturated(blue, grey, saturation)
    out[view, y, x, 0] = code_of(curves, row, final_red)
    out[view, y, x, 1] = code_of(curves, row, final_green)
    out[view, y, x, 2] = code_of(curves, row, final_blue)


@wp.func
def filled(response: Response, light: float, normal: float) -> float:
    """Return the content of a photosite: light with noise, at most the full value."""
    deviation = wp.sqrt(response.photons * wp.max(light, 0.0) + response.dark * response.dark)
    return wp.min(light + deviation * normal, response.full)


@wp.func
def site_noise(seed: int, y: int, x: int, width: int) -> float:
    """Return the noise of the photosite at y, x in standard deviations."""
    # Seeded by the position: noise does not depend on the order of the threads.
    state = wp.rand_init(seed, y * width + x)
    return wp.randn(state)


@wp.func
def spread_row(
    radiance: wp.array3d(dtype=wp.vec3), b: int, y: int, left: int, x: int, right: int, c: int, response: Response
) -> float:
    """Return one colour of a row, spread along it."""
    return response.centre * radiance[b, y, x][c] + response.side * (radiance[b, y, left][c] + radiance[b, y, right][c])


@wp.func
def site(
    radiance: wp.array3d(dtype=wp.vec3),
    b: int,
    y: int,
    x: int,
    above: int,
    below: int,
    left: int,
    right: int,
    c: int,
    response: Response,
) -> float:
    """Return the content of the photosite of colour c at y, x."""
    light = response.centre * spread_row(radiance, b, y, left, x, right, c, response)
    light += response.side * (
        spread_row(radiance, b, above, left, x, right, c, response)
        + spread_row(radiance, b, below, left, x, right, c, response)
    )
    light = light * response.exposure[c]
    if response.dark > 0.0:
        return filled(response, light, site_noise(response.seed, y, x, radiance.shape[2]))
    return wp.min(light, response.full)


@wp.kernel
def draw_noise(seed: int, noise: wp.array2d(dtype=float)):
    """Draw the noise [H, W] that `expose` gives a view with this seed, in standard deviations."""
    y, x = wp.tid()
    noise[y, x] = site_noise(seed, y, x, noise.shape[1])


@wp.kernel
def expose(
    radiance: wp.array3d(dtype=wp.vec3), responses: wp.array(dtype=Response), raw: wp.array3d(dtype=float)
):  # fmt: skip
    """Expose photosites raw [B, H, W] to light, for views with a mosaic.

    Each thread handles a square of four, so that no thread has to choose its colour.
    """
    view, row, column = wp.tid()
    response = responses[view]
    if response.mosaic == 0:
        return
    height = radiance.shape[1]
    width = radiance.shape[2]
    y = 2 * row
    x = 2 * column
    above = mirrored(y - 1, height)
    left = mirrored(x - 1, width)
    below = mirrored(y + 1, height)
    right = mirrored(x + 1, width)
    raw[view, y, x] = site(radiance, view, y, x, above, below, left, right, 0, response)
    if x + 1 < width:
        raw[view, y, right] = site(radiance, view, y, right, above, below, x, mirrored(x + 2, width), 1, response)
    if y + 1 < height:
        second_below = mirrored(y + 2, height)
        raw[view, below, x] = site(radiance, view, below, x, y, second_below, left, right, 1, response)
        if x + 1 < width:
            raw[view, below, right] = site(
                radiance, view, below, right, y, second_below, x, mirrored(x + 2, width), 2, response
            )


@wp.kernel
def develop(
    raw: wp.array3d(dtype=float),
    responses: wp.array(dtype=Response),
    curves: wp.array2d(dtype=wp.uint8),
    out: wp.array4d(dtype=wp.uint8),
):
    """Develop photosites to 8 bits out [B, H, W, 3], for views with a mosaic.

    First the missing colours are interpolated (Malvar, He and Cutler 2004), then the curve is applied. Each
    thread handles a square of four.
    """
    view, row, column = wp.tid()
    response = responses[view]
    if response.mosaic == 0:
        return
    saturation = response.saturation
    curve = response.curve
    height = raw.shape[1]
    width = raw.shape[2]
    y2 = 2 * row
    x2 = 2 * column
    y0 = mirrored(y2 - 2, height)
    y1 = mirrored(y2 - 1, height)
    y3 = mirrored(y2 + 1, height)
    y4 = mirrored(y2 + 2, height)
    y5 = mirrored(y2 + 3, height)
    x0 = mirrored(x2 - 2, width)
    x1 = mirrored(x2 - 1, width)
    x3 = mirrored(x2 + 1, width)
    x4 = mirrored(x2 + 2, width)
    x5 = mirrored(x2 + 3, width)
    # The 6 x 6 photosites around the square, except the far corners; the letter is the colour.
    g01 = raw[view, y0, x3]
    r00 = raw[view, y0, x2]
    b10 = raw[view, y1, x1]
    g10 = raw[view, y1, x2]
    b11 = raw[view, y1, x3]
    g11 = raw[view, y1, x4]
    r20 = raw[view, y2, x0]
    g20 = raw[view, y2, x1]
    r21 = raw[view, y2, x2]
    g21 = raw[view, y2, x3]
    r22 = raw[view, y2, x4]
    g22 = raw[view, y2, x5]
    g30 = raw[view, y3, x0]
    b30 = raw[view, y3, x1]
    g31 = raw[view, y3, x2]
    b31 = raw[view, y3, x3]
    g32 = raw[view, y3, x4]
    b32 = raw[view, y3, x5]
    g40 = raw[view, y4, x1]
    r41 = raw[view, y4, x2]
    g41 = raw[view, y4, x3]
    r42 = raw[view, y4, x4]
    g51 = raw[view, y5, x2]
    b51 = raw[view, y5, x3]
    # red's site
    green = 0.5 * r21 + 0.25 * (g20 + g21 + g10 + g31) - 0.125 * (r20 + r22 + r00 + r41)
    blue = 0.75 * r21 + 0.25 * (b10 + b11 + b30 + b31) - 0.1875 * (r20 + r22 + r00 + r41)
    put(out, view, y2, x2, r21, green, blue, saturation, curve, curves)
    if x2 + 1 < width:
        # green's, red left and right
        near = 0.625 * g21 - 0.125 * (g10 + g11 + g31 + g32)
        red = near + 0.5 * (r21 + r22) - 0.125 * (g20 + g22) + 0.0625 * (g01 + g41)
        blue = near + 0.5 * (b11 + b31) - 0.125 * (g01 + g41) + 0.0625 * (g20 + g22)
        put(out, view, y2, x3, red, g21, blue, saturation, curve, curves)
    if y2 + 1 < height:
        # green's, red above and below
        near = 0.625 * g31 - 0.125 * (g20 + g21 + g40 + g41)
        red = near + 0.5 * (r21 + r41) - 0.125 * (g10 + g51) + 0.0625 * (g30 + g32)
        blue = near + 0.5 * (b30 + b31) - 0.125 * (g30 + g32) + 0.0625 * (g10 + g51)
        put(out, view, y3, x2, red, g31, blue, saturation, curve, curves)
    if x2 + 1 < width and y2 + 1 < height:
        # blue's
        green = 0.5 * b31 + 0.25 * (g31 + g32 + g21 + g41) - 0.125 * (b30 + b32 + b11 + b51)
        red = 0.75 * b31 + 0.25 * (r21 + r22 + r41 + r42) - 0.1875 * (b30 + b32 + b11 + b51)
        put(out, view, y3, x3, red, green, b31, saturation, curve, curves)


@wp.kernel
def develop_plain(
    radiance: wp.array3d(dtype=wp.vec3),
    responses: wp.array(dtype=Response),
    curves: wp.array2d(dtype=wp.uint8),
    out: wp.array4d(dtype=wp.uint8),
):
    """Develop light to 8 bits out [B, H, W, 3], for views without a mosaic: every photosite has three colours."""
    view, y, x = wp.tid()
    response = responses[view]
    if response.mosaic == 1:
        return
    height = radiance.shape[1]
    width = radiance.shape[2]
    light = radiance[view, y, x]
    if response.side > 0.0:
        left = mirrored(x - 1, width)
        right = mirrored(x + 1, width)
        above = mirrored(y - 1, height)
        below = mirrored(y + 1, height)
        horizontal = radiance[view, y, left] + radiance[view, y, right]
        diagonal = (
            radiance[view, above, left]
            + radiance[view, above, right]
            + radiance[view, below, left]
            + radiance[view, below, right]
        )
        vertical = radiance[view, above, x] + radiance[view, below, x]
        light = light * (response.centre * response.centre) + (horizontal + vertical) * (
            response.centre * response.side
        )
        light += diagonal * (response.side * response.side)
    light = wp.cw_mul(light, response.exposure)
    if response.dark > 0.0:
        state = wp.rand_init(response.seed, y * width + x)
        for channel in range(3):
            light[channel] = filled(response, light[channel], wp.randn(state))
    for channel in range(3):
        light[channel] = wp.min(light[channel], response.full)
    put(out, view, y, x, light[0], light[1], light[2], response.saturation, response.curve, curves)

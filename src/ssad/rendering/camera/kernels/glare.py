"""Glare of a lens: scattered light as a pyramid of images, ghosts, and the disc of the sun."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

GHOSTS = wp.constant(4)


@wp.struct
class Ghost:
    """Image of the whole scene that two reflections between lenses make.

    Attributes:
        size: Height over that of the image; negative: upside down.
        light: Radiance of the ghost for a radiance of 1, RGB.
    """

    size: float
    light: wp.vec3


@wp.kernel
def shrink(
    image: wp.array3d(dtype=wp.vec3),
    row_weights: wp.array2d(dtype=float),
    column_weights: wp.array2d(dtype=float),
    out: wp.array3d(dtype=wp.vec3),
):
    """Halve images. Weights [size, 4] are those of the rows 2 i - 1 to 2 i + 2, 0 outside of the image."""
    view_index, half_row = wp.tid()
    height = image.shape[1]
    width = image.shape[2]
    for half_column in range(out.shape[2]):
        total = wp.vec3(0.0, 0.0, 0.0)
        left = wp.max(2 * half_column - 1, 0)
        right = wp.min(2 * half_column + 2, width - 1)
        middle = wp.min(2 * half_column + 1, width - 1)
        for tap in range(4):
            y = wp.clamp(2 * half_row - 1 + tap, 0, height - 1)
            row_index = (
                image[view_index, y, left] * column_weights[half_column, 0]
                + image[view_index, y, 2 * half_column] * column_weights[half_column, 1]
            )
            row_index += (
                image[view_index, y, middle] * column_weights[half_column, 2]
                + image[view_index, y, right] * column_weights[half_column, 3]
            )
            total += row_index * row_weights[half_row, tap]
        out[view_index, half_row, half_column] = total


@wp.func
def enlarged(image: wp.array3d(dtype=wp.vec3), view_index: int, y: int, x: int) -> wp.vec3:
    """Return a pixel of an image of twice the size, interpolated between four."""
    row_index = y / 2
    column = x / 2
    other_row = wp.clamp(row_index - 1 + 2 * (y - 2 * row_index), 0, image.shape[1] - 1)
    other_column = wp.clamp(column - 1 + 2 * (x - 2 * column), 0, image.shape[2] - 1)
    upper = image[view_index, row_index, column] * 0.75 + image[view_index, row_index, other_column] * 0.25
    lower = image[view_index, other_row, column] * 0.75 + image[view_index, other_row, other_column] * 0.25
    return upper * 0.75 + lower * 0.25


@wp.kernel
def gather(
    level: wp.array3d(dtype=wp.vec3),
    coarser: wp.array3d(dtype=wp.vec3),
    weights: wp.array2d(dtype=float),
    row: int,
    coarser_share: float,
    out: wp.array3d(dtype=wp.vec3),
):
    """Add a level of the pyramid times its weight, a row of weights [levels, B], to the sum of the coarser ones.

    coarser_share: 0 where there is none.
    """
    view_index, y = wp.tid()
    weight = weights[row, view_index]
    for x in range(out.shape[2]):
        total = level[view_index, y, x] * weight
        if coarser_share > 0.0:
            total += enlarged(coarser, view_index, y, x)
        out[view_index, y, x] = total


@wp.func
def texel(image: wp.array3d(dtype=wp.vec3), view_index: int, y: int, x: int) -> wp.vec3:
    """Return a pixel of an image, black outside."""
    if y < 0 or x < 0 or y >= image.shape[1] or x >= image.shape[2]:
        return wp.vec3(0.0, 0.0, 0.0)
    return image[view_index, y, x]


@wp.kernel
def add_ghosts(
    source: wp.array3d(dtype=wp.vec3),
    ghosts: wp.array2d(dtype=Ghost),
    centres: wp.array(dtype=wp.vec2),
    scale: float,
    source_scale: float,
    out: wp.array3d(dtype=wp.vec3),
):
    """Add ghosts [B, GHOSTS] of a blurred level of the pyramid to another level.

    centres: principal points, px from the corner of the image; scale, source_scale: px of the image along a pixel of
    the level and of the source.
    """
    view_index, y = wp.tid()
    centre = centres[view_index]
    for x in range(out.shape[2]):
        total = out[view_index, y, x]
        for index in range(GHOSTS):
            ghost = ghosts[view_index, index]
            if ghost.light[1] > 0.0:
                source_x = (((float(x) + 0.5) * scale - centre[0]) / ghost.size + centre[0]) / source_scale - 0.5
                source_y = (((float(y) + 0.5) * scale - centre[1]) / ghost.size + centre[1]) / source_scale - 0.5
                column = int(wp.floor(source_x))
                row_index = int(wp.floor(source_y))
                right_share = source_x - float(column)
                lower_share = source_y - float(row_index)
                # Smaller images leave most of the picture dark.
                if row_index >= -1 and column >= -1 and row_index < source.shape[1] and column < source.shape[2]:
                    upper = texel(source, view_index, row_index, column) * (1.0 - right_share)
                    upper += texel(source, view_index, row_index, column + 1) * right_share
                    lower = texel(source, view_index, row_index + 1, column) * (1.0 - right_share)
                    lower += texel(source, view_index, row_index + 1, column + 1) * right_share
                    total += wp.cw_mul(upper * (1.0 - lower_share) + lower * lower_share, ghost.light)
        out[view_index, y, x] = total


@wp.kernel
def mix(
    radiance: wp.array3d(dtype=wp.vec3),
    scattered: wp.array3d(dtype=wp.vec3),
    direct: wp.array(dtype=float),
    out: wp.array3d(dtype=wp.vec3),
):
    """Compute the light behind the lens: the direct share [B] of the radiance, and the scattered light.

    scattered has half the size. A view whose direct share is 1 is copied.
    """
    view_index, y = wp.tid()
    share = direct[view_index]
    for x in range(out.shape[2]):
        if share < 1.0:
            out[view_index, y, x] = radiance[view_index, y, x] * share + enlarged(scattered, view_index, y, x)
        else:
            out[view_index, y, x] = radiance[view_index, y, x]


@wp.kernel
def add_enlarged(scattered: wp.array3d(dtype=wp.vec3), lamps: wp.array(dtype=float), out: wp.array3d(dtype=wp.vec3)):
    """Add light of half the size to the views in which lamps are on."""
    view_index, row_index = wp.tid()
    if lamps[view_index] > 0.0:
        for column in range(out.shape[2]):
            out[view_index, row_index, column] = out[view_index, row_index, column] + enlarged(
                scattered, view_index, row_index, column
            )


@wp.struct
class SunDisc:
    """Disc of the sun in an image.

    Attributes:
        x: Middle, px from the middle of the first pixel.
        y: The same along columns.
        radius: px.
        light: Radiance; 0 for no disc.
    """

    x: float
    y: float
    radius: float
    light: wp.vec3


@wp.kernel
def add_sun(discs: wp.array(dtype=SunDisc), tag: wp.array3d(dtype=int), side: int, radiance: wp.array3d(dtype=wp.vec3)):
    """Add the disc of the sun to the sky of images: 4 x 4 samples a pixel, in squares of `side` px."""
    view_index, row_index, column = wp.tid()
    disc = discs[view_index]
    if disc.light[0] <= 0.0:
        return
    image_row = int(wp.floor(disc.y)) - side / 2 + row_index
    image_column = int(wp.floor(disc.x)) - side / 2 + column
    if image_row < 0 or image_column < 0 or image_row >= radiance.shape[1] or image_column >= radiance.shape[2]:
        return
    if tag[view_index, image_row, image_column] >= 0:
        return
    inside = int(0)
    for sample in range(16):
        dx = float(image_column) + (float(sample % 4) - 1.5) * 0.25 - disc.x
        dy = float(image_row) + (float(sample / 4) - 1.5) * 0.25 - disc.y
        if dx * dx + dy * dy < disc.radius * disc.radius:
            inside += 1
    if inside > 0:
        radiance[view_index, image_row, image_column] = radiance[view_index, image_row, image_column] + disc.light * (
            float(inside) / 16.0
        )

"""Mirror image of a picture in water on the ground, which is the plane z = 0 of the world.

Every pixel is mirrored at the plane and projected again (Cichocki, Optimized pixel-projected reflections for planar
reflectors, SIGGRAPH 2017). Sums along the columns then blur the mirror image vertically at one cost for all widths,
as small waves do.
"""

import warp as wp

from ssad.rendering.camera.kernels.raster import NONE

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

LAST = wp.constant(wp.uint64(4294967295))
ROWS = wp.constant(2)  # rows of a picture for one of its mirror image
LOWEST = wp.constant(0.03)  # m above the ground: what is lower is the ground itself
FAINTEST = wp.constant(0.002)  # share of light below which water mirrors nothing


@wp.kernel
def mirror_pixels(
    depth: wp.array3d(dtype=float),
    lens: wp.array(dtype=wp.vec4),
    to_world: wp.array(dtype=wp.mat44),
    lanes: int,
    keys: wp.array3d(dtype=wp.uint64),
):
    """Enter each pixel of every second row into the mirror image [B, H / 2, W]: one over depth, above its index.

    The largest key wins, so the result does not depend on the order of the threads.
    """
    view_index, row_index, first_column = wp.tid()
    pose = to_world[view_index]
    focal = lens[view_index]
    width = depth.shape[2]
    eye = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
    across = wp.vec3(pose[0, 0], pose[1, 0], pose[2, 0])
    down = wp.vec3(pose[0, 1], pose[1, 1], pose[2, 1])
    axis = wp.vec3(pose[0, 2], pose[1, 2], pose[2, 2])
    pixel_row = row_index * ROWS
    if eye[2] <= LOWEST:
        return
    for column in range(first_column, width, lanes):
        distance_ahead = depth[view_index, pixel_row, column]
        ray = wp.vec3((float(column) - focal[2]) / focal[0], (float(pixel_row) - focal[3]) / focal[1], 1.0)
        ahead = across * ray[0] + down * ray[1] + axis
        mirrored = wp.vec3(ahead[0], ahead[1], -ahead[2]) * 1.0e5
        height = ahead[2]
        if distance_ahead < 1.0e9:
            point = eye + ahead * distance_ahead
            height = point[2] - LOWEST
            mirrored = wp.vec3(point[0], point[1], -point[2]) - eye
        distance = wp.dot(mirrored, axis)
        if height > 0.0 and distance > 0.05:
            mirrored_column = wp.dot(mirrored, across) / distance * focal[0] + focal[2]
            mirrored_row = wp.dot(mirrored, down) / distance * focal[1] + focal[3]
            if (
                mirrored_column > -0.5
                and mirrored_row > -0.5
                and mirrored_column < float(width) - 0.5
                and mirrored_row < float(depth.shape[1]) - 0.5
            ):
                key = (wp.uint64(wp.cast(1.0 / distance, wp.uint32)) << wp.uint64(32)) | wp.uint64(
                    pixel_row * width + column
                )
                wp.atomic_max(
                    keys,
                    view_index,
                    wp.min(int(mirrored_row + 0.5) / ROWS, keys.shape[1] - 1),
                    int(mirrored_column + 0.5),
                    key,
                )


@wp.func(inline=True)
def mirrored_pixel(
    keys: wp.array3d(dtype=wp.uint64), source: wp.array3d(dtype=wp.vec3), view_index: int, row_index: int, column: int
) -> wp.vec4:
    """Return the light of a pixel of the mirror image, and one over its depth; all 0 where it is empty."""
    if column < 0 or column >= keys.shape[2]:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    key = keys[view_index, row_index, column]
    if key == NONE:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    index = int(key & LAST)
    colour = source[view_index, index / source.shape[2], index % source.shape[2]]
    return wp.vec4(colour[0], colour[1], colour[2], wp.cast(wp.uint32(key >> wp.uint64(32)), float))


@wp.kernel
def sum_columns(
    keys: wp.array3d(dtype=wp.uint64),
    source: wp.array3d(dtype=wp.vec3),
    lanes: int,
    sums: wp.array3d(dtype=wp.vec4),
    counts: wp.array3d(dtype=float),
):
    """Compute, for each row of the mirror image, the sums over the rows above it: light, one over depth, and number.

    sums, counts: [B, H / 2 + 1, W].
    """
    view_index, first_column = wp.tid()
    for row_index in range(keys.shape[1]):
        for column in range(first_column, keys.shape[2], lanes):
            value = mirrored_pixel(keys, source, view_index, row_index, column)
            count = float(1.0)
            if value[3] == 0.0:
                # An empty pixel between others is a gap of the projection.
                left = mirrored_pixel(keys, source, view_index, row_index, column - 1)
                right = mirrored_pixel(keys, source, view_index, row_index, column + 1)
                count = 0.0
                if left[3] > 0.0:
                    value = left
                    count = 1.0
                if right[3] > 0.0:
                    value = (value + right) / (count + 1.0)
                    count = 1.0
            sums[view_index, row_index + 1, column] = sums[view_index, row_index, column] + value
            counts[view_index, row_index + 1, column] = counts[view_index, row_index, column] + count


@wp.func(inline=True)
def part_of(row_index: float, count: int) -> wp.vec2:
    """Return a position between rows, clamped to 0..count: its row, and the share of the next."""
    position = wp.clamp(row_index, 0.0, float(count))
    first = wp.min(wp.floor(position), float(count - 1))
    return wp.vec2(first, position - first)


@wp.func(inline=True)
def sum_up_to(sums: wp.array3d(dtype=wp.vec4), view_index: int, row_index: float, column: int) -> wp.vec4:
    """Return the sum over the rows above a position."""
    part = part_of(row_index, sums.shape[1] - 1)
    first = int(part[0])
    return sums[view_index, first, column] * (1.0 - part[1]) + sums[view_index, first + 1, column] * part[1]


@wp.func(inline=True)
def count_up_to(counts: wp.array3d(dtype=float), view_index: int, row_index: float, column: int) -> float:
    """Return the number of pixels above a position."""
    part = part_of(row_index, counts.shape[1] - 1)
    first = int(part[0])
    return counts[view_index, first, column] * (1.0 - part[1]) + counts[view_index, first + 1, column] * part[1]


@wp.kernel
def add_mirror_image(
    depth: wp.array3d(dtype=float),
    lens: wp.array(dtype=wp.vec4),
    sums: wp.array3d(dtype=wp.vec4),
    counts: wp.array3d(dtype=float),
    mirror: wp.array3d(dtype=wp.vec4),
    spread: wp.array3d(dtype=float),
    lanes: int,
    radiance: wp.array3d(dtype=wp.vec3),
):
    """Replace what water mirrors of the mean surroundings by the mirror image, where the picture shows its source."""
    view_index, pixel_row, first_column = wp.tid()
    for column in range(first_column, depth.shape[2], lanes):
        water = mirror[view_index, pixel_row, column]
        if water[3] > FAINTEST:
            centre = (float(pixel_row) + 0.5) / float(ROWS)
            widest = wp.max(spread[view_index, pixel_row, column] * lens[view_index][1] / float(ROWS), 0.75)
            count = count_up_to(counts, view_index, centre + widest, column) - count_up_to(
                counts, view_index, centre - widest, column
            )
            if count > 0.01:
                near = sum_up_to(sums, view_index, centre + widest, column) - sum_up_to(
                    sums, view_index, centre - widest, column
                )
                # Water close to what it mirrors blurs it less.
                share = wp.clamp(1.0 - depth[view_index, pixel_row, column] * near[3] / count, 0.0, 1.0)
                half = wp.max(widest * share, 0.75)
                inner = 0.5 * half
                total = sum_up_to(sums, view_index, centre + half, column) - sum_up_to(
                    sums, view_index, centre - half, column
                )
                total += sum_up_to(sums, view_index, centre + inner, column) - sum_up_to(
                    sums, view_index, centre - inner, column
                )
                found = count_up_to(counts, view_index, centre + half, column) - count_up_to(
                    counts, view_index, centre - half, column
                )
                found += count_up_to(counts, view_index, centre + inner, column) - count_up_to(
                    counts, view_index, centre - inner, column
                )
                if found > 0.01:
                    cover = wp.min(found / (2.0 * (half + inner)), 1.0)
                    image = wp.vec3(total[0], total[1], total[2]) * (water[3] / found)
                    radiance[view_index, pixel_row, column] += (image - wp.vec3(water[0], water[1], water[2])) * cover

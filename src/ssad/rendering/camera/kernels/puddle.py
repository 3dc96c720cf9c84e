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
    view, row, lane = wp.tid()
    pose = to_world[view]
    focal = lens[view]
    width = depth.shape[2]
    eye = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
    across = wp.vec3(pose[0, 0], pose[1, 0], pose[2, 0])
    down = wp.vec3(pose[0, 1], pose[1, 1], pose[2, 1])
    axis = wp.vec3(pose[0, 2], pose[1, 2], pose[2, 2])
    y = row * ROWS
    if eye[2] <= LOWEST:
        return
    for x in range(lane, width, lanes):
        z = depth[view, y, x]
        ray = wp.vec3((float(x) - focal[2]) / focal[0], (float(y) - focal[3]) / focal[1], 1.0)
        ahead = across * ray[0] + down * ray[1] + axis
        mirrored = wp.vec3(ahead[0], ahead[1], -ahead[2]) * 1.0e5
        height = ahead[2]
        if z < 1.0e9:
            point = eye + ahead * z
            height = point[2] - LOWEST
            mirrored = wp.vec3(point[0], point[1], -point[2]) - eye
        distance = wp.dot(mirrored, axis)
        if height > 0.0 and distance > 0.05:
            u = wp.dot(mirrored, across) / distance * focal[0] + focal[2]
            v = wp.dot(mirrored, down) / distance * focal[1] + focal[3]
            if u > -0.5 and v > -0.5 and u < float(width) - 0.5 and v < float(depth.shape[1]) - 0.5:
                key = (wp.uint64(wp.cast(1.0 / distance, wp.uint32)) << wp.uint64(32)) | wp.uint64(y * width + x)
                wp.atomic_max(keys, view, wp.min(int(v + 0.5) / ROWS, keys.shape[1] - 1), int(u + 0.5), key)


@wp.func(inline=True)
def mirrored_pixel(
    keys: wp.array3d(dtype=wp.uint64), source: wp.array3d(dtype=wp.vec3), view: int, row: int, x: int
) -> wp.vec4:
    """Return the light of a pixel of the mirror image, and one over its depth; all 0 where it is empty."""
    if x < 0 or x >= keys.shape[2]:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    key = keys[view, row, x]
    if key == NONE:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    index = int(key & LAST)
    colour = source[view, index / source.shape[2], index % source.shape[2]]
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
    view, lane = wp.tid()
    for row in range(keys.shape[1]):
        for x in range(lane, keys.shape[2], lanes):
            value = mirrored_pixel(keys, source, view, row, x)
            count = float(1.0)
            if value[3] == 0.0:
                # An empty pixel between others is a gap of the projection.
                left = mirrored_pixel(keys, source, view, row, x - 1)
                right = mirrored_pixel(keys, source, view, row, x + 1)
                count = 0.0
                if left[3] > 0.0:
                    value = left
                    count = 1.0
                if right[3] > 0.0:
                    value = (value + right) / (count + 1.0)
                    count = 1.0
            sums[view, row + 1, x] = sums[view, row, x] + value
            counts[view, row + 1, x] = counts[view, row, x] + count


@wp.func(inline=True)
def part_of(row: float, count: int) -> wp.vec2:
    """Return a position between rows, clamped to 0..count: its row, and the share of the next."""
    position = wp.clamp(row, 0.0, float(count))
    first = wp.min(wp.floor(position), float(count - 1))
    return wp.vec2(first, position - first)


@wp.func(inline=True)
def sum_up_to(sums: wp.array3d(dtype=wp.vec4), view: int, row: float, x: int) -> wp.vec4:
    """Return the sum over the rows above a position."""
    part = part_of(row, sums.shape[1] - 1)
    first = int(part[0])
    return sums[view, first, x] * (1.0 - part[1]) + sums[view, first + 1, x] * part[1]


@wp.func(inline=True)
def count_up_to(counts: wp.array3d(dtype=float), view: int, row: float, x: int) -> float:
    """Return the number of pixels above a position."""
    part = part_of(row, counts.shape[1] - 1)
    first = int(part[0])
    return counts[view, first, x] * (1.0 - part[1]) + counts[view, first + 1, x] * part[1]


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
    view, y, lane = wp.tid()
    for x in range(lane, depth.shape[2], lanes):
        water = mirror[view, y, x]
        if water[3] > FAINTEST:
            centre = (float(y) + 0.5) / float(ROWS)
            widest = wp.max(spread[view, y, x] * lens[view][1] / float(ROWS), 0.75)
            count = count_up_to(counts, view, centre + widest, x) - count_up_to(counts, view, centre - widest, x)
            if count > 0.01:
                near = sum_up_to(sums, view, centre + widest, x) - sum_up_to(sums, view, centre - widest, x)
                # Water close to what it mirrors blurs it less.
                share = wp.clamp(1.0 - depth[view, y, x] * near[3] / count, 0.0, 1.0)
                half = wp.max(widest * share, 0.75)
                inner = 0.5 * half
                total = sum_up_to(sums, view, centre + half, x) - sum_up_to(sums, view, centre - half, x)
                total += sum_up_to(sums, view, centre + inner, x) - sum_up_to(sums, view, centre - inner, x)
                found = count_up_to(counts, view, centre + half, x) - count_up_to(counts, view, centre - half, x)
                found += count_up_to(counts, view, centre + inner, x) - count_up_to(counts, view, centre - inner, x)
                if found > 0.01:
                    cover = wp.min(found / (2.0 * (half + inner)), 1.0)
                    image = wp.vec3(total[0], total[1], total[2]) * (water[3] / found)
                    radiance[view, y, x] += (image - wp.vec3(water[0], water[1], water[2])) * cover

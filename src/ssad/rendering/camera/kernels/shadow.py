"""Shadow maps of the sun: hard shadows, and soft ones whose penumbra grows with the distance of the occluder."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SUN = wp.constant(0.00465)  # tangent of the sun's angular radius
STEEPEST = wp.constant(8.0)  # slope up to which a surface is compared with its own plane


@wp.struct
class SunMap:
    """Shadow map of the sun for each view.

    Attributes:
        keys: One over depth above slot, as in the visibility pass.
        blocks: Depth nearest to and farthest from the sun in each square of four blocks, as in `keys`; [1, 1, 1] for
            hard shadows. A block has twice `search` texels along each side.
        to_texels: From the world to texels, and metres along the light.
        texel: m.
        hardest: Smallest radius of the filter of soft shadows, texels.
        search: Texels to each side in which soft shadows look for occluders, an even number.
    """

    keys: wp.array3d(dtype=wp.uint64)
    blocks: wp.array3d(dtype=wp.vec2)
    to_texels: wp.array(dtype=wp.mat44)
    texel: float
    hardest: float
    search: int


@wp.func
def open_texel(
    shadows: wp.array3d(dtype=wp.uint64), view_index: int, row_index: int, column: int, depth: float
) -> float:
    """Return 1 if the texel holds nothing nearer to the light, else 0."""
    if wp.cast(wp.uint32(shadows[view_index, row_index, column] >> wp.uint64(32)), float) <= depth:
        return 1.0
    return 0.0


@wp.func
def sun_share(shadows: wp.array3d(dtype=wp.uint64), view_index: int, p: wp.vec3, bias: float) -> float:
    """Return the share of the sun that reaches a point, from four weighted texels of a shadow map.

    p: the point in texels, and in metres along the light. Points outside the map give -1.
    """
    size = shadows.shape[1]
    if size < 4:
        return -1.0
    x = p[0] - 0.5
    y = p[1] - 0.5
    i = int(wp.floor(x))
    j = int(wp.floor(y))
    if i < 0 or j < 0 or i >= size - 1 or j >= size - 1:
        return -1.0
    u = x - float(i)
    v = y - float(j)
    depth = (1.0e3 - p[2] + bias) * 1.0e-3
    upper_row = (
        open_texel(shadows, view_index, j, i, depth) * (1.0 - u) + open_texel(shadows, view_index, j, i + 1, depth) * u
    )
    lower_row = (
        open_texel(shadows, view_index, j + 1, i, depth) * (1.0 - u)
        + open_texel(shadows, view_index, j + 1, i + 1, depth) * u
    )
    return upper_row * (1.0 - v) + lower_row * v


@wp.func(inline=True)
def depth_of(keys: wp.array3d(dtype=wp.uint64), view_index: int, row_index: int, column: int) -> float:
    """Return how far a texel's surface is towards the sun, in thousands of metres; 0 where there is none."""
    return wp.cast(wp.uint32(keys[view_index, row_index, column] >> wp.uint64(32)), float)


@wp.func(inline=True)
def soft_share(map: SunMap, view_index: int, p: wp.vec3, n: wp.vec3) -> float:
    """Return the share of the sun that reaches a point with a normal; -1 for a point outside the map.

    The mean distance of the occluders around the point gives the width of the penumbra (Fernando, Percentage-closer
    soft shadows, SIGGRAPH 2005). Texels are compared with the plane of the surface, not with the point.
    """
    size = map.keys.shape[1]
    search = map.search
    if size <= 2 * search + 1:
        return -1.0
    to_texels = map.to_texels[view_index]
    q = wp.transform_point(to_texels, p + n * (map.texel * 0.5))
    x = q[0] - 0.5
    y = q[1] - 0.5
    column = int(wp.floor(x + 0.5))
    row_index = int(wp.floor(y + 0.5))
    if column < search or row_index < search or column >= size - search or row_index >= size - search:
        return -1.0
    # The plane of the surface, in metres along the light for a texel to the right and one down.
    axis = wp.transform_vector(to_texels, n)
    steepness = -map.texel * map.texel / wp.min(axis[2], -1.0e-3)
    limit = STEEPEST * map.texel
    slope_x = wp.clamp(axis[0] * steepness, -limit, limit)
    slope_y = wp.clamp(axis[1] * steepness, -limit, limit)
    own_depth = (1.0e3 - q[2] + map.texel) * 1.0e-3
    margin = (wp.abs(slope_x) + wp.abs(slope_y)) * float(search + 1) * 1.0e-3
    block = map.blocks[view_index, (row_index - search) / (2 * search), (column - search) / (2 * search)]
    if block[0] <= own_depth - margin:
        return 1.0
    if block[1] > own_depth + margin:
        return 0.0
    # Every second texel of every second row is enough to measure the distance of the occluders.
    gap = float(0.0)
    count = int(0)
    for dy in range(-search, search + 1, 2):
        across = own_depth - (float(row_index + dy) - y) * slope_y * 1.0e-3
        for dx in range(-search, search + 1, 2):
            plane = across - (float(column + dx) - x) * slope_x * 1.0e-3
            depth = depth_of(map.keys, view_index, row_index + dy, column + dx)
            # Sums without branches: which texels occlude is hard to predict.
            gap += wp.max(depth - plane, 0.0)
            count += wp.where(depth > plane, 1, 0)
    if count == 0:
        return 1.0
    if count == (search + 1) * (search + 1):
        return 0.0
    radius = wp.clamp(gap / float(count) * 1.0e3 * SUN / map.texel, map.hardest, float(search) - 0.5) + 0.5
    inverse = 1.0 / (radius * radius)
    reach = int(radius + 0.5)
    open_weight = float(0.0)
    weight_sum = float(0.0)
    for dy in range(-reach, reach + 1):
        v = float(row_index + dy) - y
        across = own_depth - v * slope_y * 1.0e-3
        for dx in range(-reach, reach + 1):
            u = float(column + dx) - x
            weight = wp.max(1.0 - (u * u + v * v) * inverse, 0.0)
            weight_sum += weight
            depth = depth_of(map.keys, view_index, row_index + dy, column + dx)
            open_weight += wp.where(depth <= across - u * slope_x * 1.0e-3, weight, 0.0)
    return open_weight / weight_sum


@wp.kernel
def gather_blocks(keys: wp.array3d(dtype=wp.uint64), block: int, lanes: int, blocks: wp.array3d(dtype=wp.vec2)):
    """Compute the depths nearest to and farthest from the sun in each block of a shadow map."""
    view_index, row_index, lane = wp.tid()
    for column in range(lane, blocks.shape[2], lanes):
        nearest = wp.uint64(0)
        farthest = wp.uint64(0xFFFFFFFFFFFFFFFF)
        for dy in range(block):
            for dx in range(block):
                key = keys[view_index, row_index * block + dy, column * block + dx]
                nearest = wp.max(nearest, key)
                farthest = wp.min(farthest, key)
        blocks[view_index, row_index, column] = wp.vec2(
            wp.cast(wp.uint32(nearest >> wp.uint64(32)), float), wp.cast(wp.uint32(farthest >> wp.uint64(32)), float)
        )


@wp.kernel
def join_blocks(blocks: wp.array3d(dtype=wp.vec2), lanes: int, square_blocks: wp.array3d(dtype=wp.vec2)):
    """Compute the same depths for each square of four blocks, by its first block."""
    view_index, row_index, lane = wp.tid()
    count = blocks.shape[1]
    for column in range(lane, count, lanes):
        nearest = float(0.0)
        farthest = float(1.0e9)
        for block_row in range(row_index, wp.min(row_index + 2, count)):
            for block_column in range(column, wp.min(column + 2, count)):
                block = blocks[view_index, block_row, block_column]
                nearest = wp.max(nearest, block[0])
                farthest = wp.min(farthest, block[1])
        square_blocks[view_index, row_index, column] = wp.vec2(nearest, farthest)

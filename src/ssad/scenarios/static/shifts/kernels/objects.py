"""Objects that are moved, resized, sheared or blurred inside their projected 3D boxes."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import spread

wp.set_module_options({"enable_backward": False})  # see `exposure`


@wp.struct
class Item:
    """A box in one image, before (old) and after (new) a shift; camera frame in metres, else pixels.

    Attributes:
        image: Its image.
        into: Camera frame to the unit cube of the new box, matrix.
        into_origin: The same, origin.
        back: Unit cube to the old box, matrix.
        back_origin: The same, origin.
        middle: A point inside both outlines.
        new_first: First point of the new outline (convex) in `points`.
        new_count: Number of its points.
        old_first: First point of the old outline (convex) in `points`.
        old_count: Number of its points.
        low_x: First column that may change.
        low_y: First row that may change.
        high_x: End of the columns that may change.
        high_y: End of the rows that may change.
        node_first: First of its displacement nodes.
        node_wide: Columns of these nodes.
        node_high: Rows of these nodes.
        rank: Order among the boxes of the image, 1 for the farthest.
        skip: 1 where there is nothing to paint: the box only hides others.
        streak: Vector of its motion blur, pixels.
    """

    image: int
    into: wp.mat33
    into_origin: wp.vec3
    back: wp.mat33
    back_origin: wp.vec3
    middle: wp.vec2
    new_first: int
    new_count: int
    old_first: int
    old_count: int
    low_x: int
    low_y: int
    high_x: int
    high_y: int
    node_first: int
    node_wide: int
    node_high: int
    rank: int
    skip: int
    streak: wp.vec2


STEP = wp.constant(4)  # pixels from one displacement node to the next
DONE = wp.constant(16384)  # bit of `owner`: the pixel is painted


@wp.func
def outline_reach(points: wp.array(dtype=wp.vec2), first: int, count: int, origin: wp.vec2, u: wp.vec2) -> float:
    """Return the distance from a point inside a convex outline to its border in the direction `u` (unit)."""
    distance = float(1.0e6)
    for edge_index in range(count):
        edge_start = points[first + edge_index] - origin
        edge_end = points[first + (edge_index + 1) % count] - origin
        edge = edge_end - edge_start
        normal = wp.vec2(edge[1], -edge[0])
        height = wp.dot(normal, edge_start)
        if height < 0.0:
            normal = -normal
            height = -height
        slope = wp.dot(normal, u)
        if slope > 1.0e-6:
            distance = wp.min(distance, height / slope)
    return distance


@wp.func
def row_span(points: wp.array(dtype=wp.vec2), first: int, count: int, y: float) -> wp.vec2:
    """Return the minimum and maximum x of a convex outline on a row; (1, 0) where it has none."""
    low = float(1.0e9)
    high = float(-1.0e9)
    for edge_index in range(count):
        edge_start = points[first + edge_index]
        edge_end = points[first + (edge_index + 1) % count]
        if (edge_start[1] <= y and edge_end[1] >= y) or (edge_end[1] <= y and edge_start[1] >= y):
            edge_height = edge_end[1] - edge_start[1]
            if wp.abs(edge_height) < 1.0e-6:
                low = wp.min(low, wp.min(edge_start[0], edge_end[0]))
                high = wp.max(high, wp.max(edge_start[0], edge_end[0]))
            else:
                x = edge_start[0] + (edge_end[0] - edge_start[0]) * (y - edge_start[1]) / edge_height
                low = wp.min(low, x)
                high = wp.max(high, x)
    if low > high:
        return wp.vec2(1.0, 0.0)
    return wp.vec2(low, high)


@wp.kernel
def stamp(
    items: wp.array(dtype=Item),
    item_first: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec2),
    owner: wp.array3d(dtype=wp.int16),
):
    """Set owner[b, y, x] to the rank of the nearest box whose old outline covers the pixel centre.

    Pixels without a box keep their value, 0.
    """
    b, y = wp.tid()
    width = owner.shape[2]
    # Items come far to near, so that the nearest one is written last.
    for item_index in range(item_first[b], item_first[b + 1]):
        span = row_span(points, items[item_index].old_first, items[item_index].old_count, float(y) + 0.5)
        if span[0] <= span[1]:
            low = wp.clamp(int(wp.ceil(span[0] - 0.5)), 0, width)
            high = wp.clamp(int(wp.floor(span[1] - 0.5)) + 1, 0, width)
            for x in range(low, high):
                owner[b, y, x] = wp.int16(items[item_index].rank)


@wp.kernel
def displace(
    items: wp.array(dtype=Item),
    points: wp.array(dtype=wp.vec2),
    lens: wp.array(dtype=wp.vec4),
    nodes: wp.array(dtype=wp.vec4),
):
    """Compute the source of the colour at each node of an item's grid, the centre of a pixel.

    (dx, dy, pixels inside the new outline, 1 where the surroundings must stretch). Inside, the viewing ray meets the
    surface of the new box, and the same point of the old box is looked up. Where the new outline lies inside the old
    one, the surroundings stretch radially to fill the gap; elsewhere they stay.
    """
    item_index, row = wp.tid()
    item = items[item_index]
    if item.skip == 1 or row >= item.node_high:
        return
    focal = lens[item.image]
    for column in range(item.node_wide):
        pixel = wp.vec2(float(item.low_x + column * STEP) + 0.5, float(item.low_y + row * STEP) + 0.5)
        ray = wp.vec3((pixel[0] - focal[2]) / focal[0], (pixel[1] - focal[3]) / focal[1], 1.0)
        direction = item.into * ray
        origin = item.into_origin
        entry = float(-1.0e9)
        departure = float(1.0e9)
        for axis in range(3):
            speed = direction[axis]
            if wp.abs(speed) < 1.0e-9:
                speed = 1.0e-9
            t0 = (-0.5 - origin[axis]) / speed
            t1 = (0.5 - origin[axis]) / speed
            entry = wp.max(entry, wp.min(t0, t1))
            departure = wp.min(departure, wp.max(t0, t1))
        result = wp.vec4(0.0, 0.0, -1.0e3, 0.0)
        offset = pixel - item.middle
        radius = wp.length(offset)
        radial = wp.vec2(1.0, 0.0)
        if radius > 1.0e-3:
            radial = offset / radius
        new_reach = outline_reach(points, item.new_first, item.new_count, item.middle, radial)
        if entry <= departure and entry > 0.0:
            old_point = item.back * (origin + direction * entry) + item.back_origin
            old_depth = wp.max(old_point[2], 0.2)
            dx = focal[0] * old_point[0] / old_depth + focal[2] - pixel[0]
            dy = focal[1] * old_point[1] / old_depth + focal[3] - pixel[1]
            result = wp.vec4(dx, dy, wp.max(new_reach - radius, 0.0), 0.0)
        else:
            old_reach = outline_reach(points, item.old_first, item.old_count, item.middle, radial)
            if old_reach > new_reach + 0.5:
                outer_edge = old_reach * 1.25 + 8.0
                if radius < outer_edge:
                    # start slightly outside the old outline, since boxes are not pixel-accurate
                    inner_edge = old_reach * 1.02 + 1.5
                    source_radius = inner_edge + (wp.max(radius, new_reach) - new_reach) * (outer_edge - inner_edge) / (
                        outer_edge - new_reach
                    )
                    result = wp.vec4(
                        radial[0] * (source_radius - radius),
                        radial[1] * (source_radius - radius),
                        new_reach - radius,
                        1.0,
                    )
            elif radius < new_reach + 8.0:
                # continue smoothly past the outline, for interpolation just inside it
                source_radius = radius * old_reach / new_reach
                result = wp.vec4(
                    radial[0] * (source_radius - radius), radial[1] * (source_radius - radius), new_reach - radius, 0.0
                )
        nodes[item.node_first + row * item.node_wide + column] = result


# half of 4096 in each of three fields of 21 bits
MIDDLE = wp.constant(wp.uint64(2048 + (2048 << 21) + (2048 << 42)))


@wp.func
def between(words: wp.array(dtype=wp.uint32), i: int, right: wp.uint64, left: wp.uint64) -> wp.uint64:
    """Return the weighted pixel at byte i and its right neighbour as fields: two or three words hold both."""
    word_index = i >> 2
    shift = wp.uint64((i & 3) * 8)
    packed = (wp.uint64(words[word_index]) | (wp.uint64(words[word_index + 1]) << wp.uint64(32))) >> shift
    if shift > wp.uint64(16):
        packed = packed | (wp.uint64(words[word_index + 2]) << wp.uint64(40))
    return spread(wp.uint32(packed)) * left + spread(wp.uint32(packed >> wp.uint64(24))) * right


@wp.kernel
def paint(
    image: wp.array(dtype=wp.uint32),
    items: wp.array(dtype=Item),
    item_first: wp.array(dtype=int),
    owner: wp.array3d(dtype=wp.int16),
    nodes: wp.array(dtype=wp.vec4),
    respect: int,
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """Draw the items of an image row by row, the nearest first, always from the unchanged image.

    A pixel is drawn once: then it is marked as done in `owner`. respect = 1: an item is not drawn over a nearer box
    nor with a nearer box's pixels.
    """
    b, y = wp.tid()
    height = owner.shape[1]
    width = owner.shape[2]
    image_start = b * stride
    last = item_first[b + 1] - 1
    for item_offset in range(last - item_first[b] + 1):
        item_index = last - item_offset
        if items[item_index].skip == 0 and y >= items[item_index].low_y and y < items[item_index].high_y:
            rank = items[item_index].rank
            low_column = items[item_index].low_x
            node_columns = items[item_index].node_wide
            node_row = (y - items[item_index].low_y) / STEP
            row_fraction = float(y - items[item_index].low_y - node_row * STEP) / float(STEP)
            first = items[item_index].node_first + node_row * node_columns
            end_column = items[item_index].high_x
            left = nodes[first] * (1.0 - row_fraction) + nodes[first + node_columns] * row_fraction
            for node_column in range(node_columns - 1):
                node = first + node_column + 1
                right = nodes[node] * (1.0 - row_fraction) + nodes[node + node_columns] * row_fraction
                if left[2] > 0.0 or right[2] > 0.0 or left[3] + right[3] > 0.0:
                    for lane in range(STEP):
                        x = low_column + node_column * STEP + lane
                        if x < end_column:
                            owner_rank = int(owner[b, y, x])
                            if owner_rank < DONE and (respect == 0 or owner_rank <= rank):
                                displacement = left + (right - left) * (float(lane) / float(STEP))
                                inside = displacement[2] > 0.0
                                if inside or (
                                    displacement[3] > 0.5 and wp.abs(displacement[0]) + wp.abs(displacement[1]) > 0.2
                                ):
                                    source_x = wp.clamp(float(x) + displacement[0], 0.0, float(width) - 2.0)
                                    source_y = wp.clamp(float(y) + displacement[1], 0.0, float(height) - 2.0)
                                    x0 = int(source_x)
                                    y0 = int(source_y)
                                    is_allowed = respect == 0
                                    if respect == 1:
                                        source_rank = int(owner[b, y0, x0]) & (DONE - 1)
                                        is_allowed = source_rank <= rank
                                        if not inside:
                                            is_allowed = (source_rank == 0 or source_rank == rank) and (
                                                owner_rank == 0 or owner_rank == rank
                                            )
                                    if is_allowed:
                                        x_weight = int((source_x - float(x0)) * 64.0)
                                        y_weight = int((source_y - float(y0)) * 64.0)
                                        source_byte = image_start + (y0 * width + x0) * 3
                                        lower_byte = source_byte + width * 3
                                        w01 = wp.uint64(x_weight * (64 - y_weight))
                                        w10 = wp.uint64((64 - x_weight) * y_weight)
                                        w11 = wp.uint64(x_weight * y_weight)
                                        w00 = wp.uint64(4096) - w01 - w10 - w11
                                        total = between(image, source_byte, w01, w00) + between(
                                            image, lower_byte, w11, w10
                                        )
                                        total += MIDDLE
                                        owner[b, y, x] = wp.int16(owner_rank | DONE)
                                        target_byte = image_start + (y * width + x) * 3
                                        out[target_byte] = wp.uint8(total >> wp.uint64(12))
                                        out[target_byte + 1] = wp.uint8((total >> wp.uint64(33)) & wp.uint64(255))
                                        out[target_byte + 2] = wp.uint8((total >> wp.uint64(54)) & wp.uint64(255))
                left = right


@wp.func
def on_line(first: int, slope: float, low: int, step: int, flat: wp.bool) -> wp.vec2i:
    """Return pixel (x, y) of a step on a line from `first` across and `low` along the longer side of a streak."""
    side = first + int(wp.floor(slope * float(step) + 0.5))
    if flat:
        return wp.vec2i(low + step, side)
    return wp.vec2i(side, low + step)


@wp.func
def is_in_image(pixel: wp.vec2i, width: int, height: int) -> wp.bool:
    """Check that a pixel lies in the image."""
    return pixel[0] >= 0 and pixel[0] < width and pixel[1] >= 0 and pixel[1] < height


@wp.kernel
def smear(
    image: wp.array(dtype=wp.uint8),
    items: wp.array(dtype=Item),
    chosen: wp.array(dtype=int),
    owner: wp.array3d(dtype=wp.int16),
    stride: int,
    out: wp.array(dtype=wp.uint8),
):
    """Blur items along their streak with a box filter, one thread per line of pixels.

    Within the item all pixels of the window count, as the background shows through at its ends; beside it, the item's
    own pixels are laid over the sharp background. A line steps one pixel along the longer side of the streak; lines
    of one slope cover every pixel once. The sum over the window is updated incrementally, so that the cost does not
    depend on the length of the streak.
    """
    item_number, line = wp.tid()
    item_index = chosen[item_number]
    item = items[item_index]
    b = item.image
    width = owner.shape[2]
    height = owner.shape[1]
    dx = item.streak[0]
    dy = item.streak[1]
    is_horizontal = wp.abs(dx) >= wp.abs(dy)
    slope = float(0.0)
    line_start = item.low_y
    line_length = item.high_y - item.low_y
    line_count = item.high_x - item.low_x
    first_lane = item.low_x
    streak_length = wp.abs(dy)
    if is_horizontal:
        slope = dy / dx
        line_start = item.low_x
        line_length = item.high_x - item.low_x
        line_count = item.high_y - item.low_y
        first_lane = item.low_y
        streak_length = wp.abs(dx)
    else:
        slope = dx / dy
    extra_lines = int(wp.ceil(wp.abs(slope) * float(line_length))) + 1
    if line >= line_count + extra_lines:
        return
    first = first_lane + line
    if slope > 0.0:
        first = first_lane + line - extra_lines
    half_length = int(streak_length * 0.5 + 0.5)
    total = wp.vec3i(0, 0, 0)
    background = wp.vec3i(0, 0, 0)
    item_count = int(0)
    background_count = int(0)
    image_start = b * stride
    window_size = float(2 * half_length + 1)
    for step in range(-half_length, line_length + half_length):
        # the pixel that enters the window, half a streak ahead
        entering = step + half_length
        if entering < line_length:
            pixel = on_line(first, slope, line_start, entering, is_horizontal)
            if is_in_image(pixel, width, height):
                pixel_byte = image_start + (pixel[1] * width + pixel[0]) * 3
                rank = int(owner[b, pixel[1], pixel[0]])
                if rank == item.rank:
                    total = total + wp.vec3i(
                        int(image[pixel_byte]), int(image[pixel_byte + 1]), int(image[pixel_byte + 2])
                    )
                    item_count += 1
                elif rank < item.rank:
                    background = background + wp.vec3i(
                        int(image[pixel_byte]), int(image[pixel_byte + 1]), int(image[pixel_byte + 2])
                    )
                    background_count += 1
        if step >= 0 and step < line_length and item_count > 0:
            pixel = on_line(first, slope, line_start, step, is_horizontal)
            if is_in_image(pixel, width, height):
                rank = int(owner[b, pixel[1], pixel[0]])
                if rank == item.rank:
                    pixel_byte = image_start + (pixel[1] * width + pixel[0]) * 3
                    scale = 1.0 / float(item_count + background_count)
                    out[pixel_byte] = wp.uint8(float(total[0] + background[0]) * scale + 0.5)
                    out[pixel_byte + 1] = wp.uint8(float(total[1] + background[1]) * scale + 0.5)
                    out[pixel_byte + 2] = wp.uint8(float(total[2] + background[2]) * scale + 0.5)
                elif rank < item.rank:
                    pixel_byte = image_start + (pixel[1] * width + pixel[0]) * 3
                    alpha = float(item_count) / window_size
                    scale = alpha / float(item_count)
                    out[pixel_byte] = wp.uint8(float(out[pixel_byte]) * (1.0 - alpha) + float(total[0]) * scale + 0.5)
                    out[pixel_byte + 1] = wp.uint8(
                        float(out[pixel_byte + 1]) * (1.0 - alpha) + float(total[1]) * scale + 0.5
                    )
                    out[pixel_byte + 2] = wp.uint8(
                        float(out[pixel_byte + 2]) * (1.0 - alpha) + float(total[2]) * scale + 0.5
                    )
        leaving = step - half_length
        if leaving >= 0 and leaving < line_length:
            pixel = on_line(first, slope, line_start, leaving, is_horizontal)
            if is_in_image(pixel, width, height):
                pixel_byte = image_start + (pixel[1] * width + pixel[0]) * 3
                rank = int(owner[b, pixel[1], pixel[0]])
                if rank == item.rank:
                    total = total - wp.vec3i(
                        int(image[pixel_byte]), int(image[pixel_byte + 1]), int(image[pixel_byte + 2])
                    )
                    item_count -= 1
                elif rank < item.rank:
                    background = background - wp.vec3i(
                        int(image[pixel_byte]), int(image[pixel_byte + 1]), int(image[pixel_byte + 2])
                    )
                    background_count -= 1

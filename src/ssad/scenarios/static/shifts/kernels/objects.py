"""Objects moved, resized, sheared or blurred inside their projected 3D boxes."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import spread


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
    """How far a convex outline reaches from a point inside it in the direction `u` (unit)."""
    best = float(1.0e6)
    for k in range(count):
        a = points[first + k] - origin
        b = points[first + (k + 1) % count] - origin
        e = b - a
        normal = wp.vec2(e[1], -e[0])
        above = wp.dot(normal, a)
        if above < 0.0:
            normal = -normal
            above = -above
        slope = wp.dot(normal, u)
        if slope > 1.0e-6:
            best = wp.min(best, above / slope)
    return best


@wp.func
def row_span(points: wp.array(dtype=wp.vec2), first: int, count: int, y: float) -> wp.vec2:
    """Least and largest x of a convex outline on a row; (1, 0) where it has none."""
    low = float(1.0e9)
    high = float(-1.0e9)
    for k in range(count):
        a = points[first + k]
        b = points[first + (k + 1) % count]
        if (a[1] <= y and b[1] >= y) or (b[1] <= y and a[1] >= y):
            d = b[1] - a[1]
            if wp.abs(d) < 1.0e-6:
                low = wp.min(low, wp.min(a[0], b[0]))
                high = wp.max(high, wp.max(a[0], b[0]))
            else:
                x = a[0] + (b[0] - a[0]) * (y - a[1]) / d
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
    """owner[b, y, x]: rank of the nearest box whose old outline covers the pixel's middle; 0, as it came, for none."""
    b, y = wp.tid()
    width = owner.shape[2]
    for k in range(item_first[b], item_first[b + 1]):
        span = row_span(points, items[k].old_first, items[k].old_count, float(y) + 0.5)
        if span[0] <= span[1]:
            low = wp.clamp(int(wp.ceil(span[0] - 0.5)), 0, width)
            high = wp.clamp(int(wp.floor(span[1] - 0.5)) + 1, 0, width)
            for x in range(low, high):
                owner[b, y, x] = wp.int16(items[k].rank)


@wp.kernel
def displace(
    items: wp.array(dtype=Item),
    points: wp.array(dtype=wp.vec2),
    lens: wp.array(dtype=wp.vec4),
    nodes: wp.array(dtype=wp.vec4),
):
    """Where each node of an item's grid, the middle of a pixel, takes its colour from.

    (dx, dy, pixels inside the new outline, 1 where the surroundings must stretch). Inside, the viewing ray meets the
    surface of the new box, and the same point of the old box is looked up. Where the new outline lies inside the old
    one, the surroundings stretch radially to fill the gap; elsewhere they stay.
    """
    k, row = wp.tid()
    item = items[k]
    if item.skip == 1 or row >= item.node_high:
        return
    focal = lens[item.image]
    for column in range(item.node_wide):
        p = wp.vec2(float(item.low_x + column * STEP) + 0.5, float(item.low_y + row * STEP) + 0.5)
        ray = wp.vec3((p[0] - focal[2]) / focal[0], (p[1] - focal[3]) / focal[1], 1.0)
        d = item.into * ray
        o = item.into_origin
        enter = float(-1.0e9)
        leave = float(1.0e9)
        for axis in range(3):
            speed = d[axis]
            if wp.abs(speed) < 1.0e-9:
                speed = 1.0e-9
            t0 = (-0.5 - o[axis]) / speed
            t1 = (0.5 - o[axis]) / speed
            enter = wp.max(enter, wp.min(t0, t1))
            leave = wp.min(leave, wp.max(t0, t1))
        result = wp.vec4(0.0, 0.0, -1.0e3, 0.0)
        away = p - item.middle
        r = wp.length(away)
        u = wp.vec2(1.0, 0.0)
        if r > 1.0e-3:
            u = away / r
        new = outline_reach(points, item.new_first, item.new_count, item.middle, u)
        if enter <= leave and enter > 0.0:
            q = item.back * (o + d * enter) + item.back_origin
            z = wp.max(q[2], 0.2)
            dx = focal[0] * q[0] / z + focal[2] - p[0]
            dy = focal[1] * q[1] / z + focal[3] - p[1]
            result = wp.vec4(dx, dy, wp.max(new - r, 0.0), 0.0)
        else:
            old = outline_reach(points, item.old_first, item.old_count, item.middle, u)
            if old > new + 0.5:
                edge = old * 1.25 + 8.0
                if r < edge:
                    # from a little outside the old outline: boxes are not drawn to the pixel
                    rim = old * 1.02 + 1.5
                    source = rim + (wp.max(r, new) - new) * (edge - rim) / (edge - new)
                    result = wp.vec4(u[0] * (source - r), u[1] * (source - r), new - r, 1.0)
            elif r < new + 8.0:
                # goes on smoothly past the outline, for the pixels just inside
                source = r * old / new
                result = wp.vec4(u[0] * (source - r), u[1] * (source - r), new - r, 0.0)
        nodes[item.node_first + row * item.node_wide + column] = result


# half of 4096 in each of three fields of 21 bits
MIDDLE = wp.constant(wp.uint64(2048 + (2048 << 21) + (2048 << 42)))


@wp.func
def between(words: wp.array(dtype=wp.uint32), i: int, right: wp.uint64, left: wp.uint64) -> wp.uint64:
    """The pixel at byte i and its right neighbour, weighted, as fields: two or three words hold both."""
    w = i >> 2
    shift = wp.uint64((i & 3) * 8)
    both = (wp.uint64(words[w]) | (wp.uint64(words[w + 1]) << wp.uint64(32))) >> shift
    if shift > wp.uint64(16):
        both = both | (wp.uint64(words[w + 2]) << wp.uint64(40))
    return spread(wp.uint32(both)) * left + spread(wp.uint32(both >> wp.uint64(24))) * right


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
    """Draws the items of an image row by row, the nearest first, always from the unchanged image.

    A pixel is drawn once: then it is marked as done in `owner`. respect = 1: an item is not drawn over a nearer box nor
    with a nearer box's pixels.
    """
    b, y = wp.tid()
    height = owner.shape[1]
    width = owner.shape[2]
    start = b * stride
    last = item_first[b + 1] - 1
    for back in range(last - item_first[b] + 1):
        k = last - back
        if items[k].skip == 0 and y >= items[k].low_y and y < items[k].high_y:
            rank = items[k].rank
            low = items[k].low_x
            wide = items[k].node_wide
            ny = (y - items[k].low_y) / STEP
            ty = float(y - items[k].low_y - ny * STEP) / float(STEP)
            first = items[k].node_first + ny * wide
            end = items[k].high_x
            left = nodes[first] * (1.0 - ty) + nodes[first + wide] * ty
            for nx in range(wide - 1):
                j = first + nx + 1
                right = nodes[j] * (1.0 - ty) + nodes[j + wide] * ty
                if left[2] > 0.0 or right[2] > 0.0 or left[3] + right[3] > 0.0:
                    for m in range(STEP):
                        x = low + nx * STEP + m
                        if x < end:
                            hidden = int(owner[b, y, x])
                            if hidden < DONE and (respect == 0 or hidden <= rank):
                                n = left + (right - left) * (float(m) / float(STEP))
                                inside = n[2] > 0.0
                                if inside or (n[3] > 0.5 and wp.abs(n[0]) + wp.abs(n[1]) > 0.2):
                                    sx = wp.clamp(float(x) + n[0], 0.0, float(width) - 2.0)
                                    sy = wp.clamp(float(y) + n[1], 0.0, float(height) - 2.0)
                                    x0 = int(sx)
                                    y0 = int(sy)
                                    fine = respect == 0
                                    if respect == 1:
                                        seen = int(owner[b, y0, x0]) & (DONE - 1)
                                        fine = seen <= rank
                                        if not inside:
                                            fine = (seen == 0 or seen == rank) and (hidden == 0 or hidden == rank)
                                    if fine:
                                        ax = int((sx - float(x0)) * 64.0)
                                        ay = int((sy - float(y0)) * 64.0)
                                        i = start + (y0 * width + x0) * 3
                                        d = i + width * 3
                                        w01 = wp.uint64(ax * (64 - ay))
                                        w10 = wp.uint64((64 - ax) * ay)
                                        w11 = wp.uint64(ax * ay)
                                        w00 = wp.uint64(4096) - w01 - w10 - w11
                                        total = between(image, i, w01, w00) + between(image, d, w11, w10)
                                        total += MIDDLE
                                        owner[b, y, x] = wp.int16(hidden | DONE)
                                        o = start + (y * width + x) * 3
                                        out[o] = wp.uint8(total >> wp.uint64(12))
                                        out[o + 1] = wp.uint8((total >> wp.uint64(33)) & wp.uint64(255))
                                        out[o + 2] = wp.uint8((total >> wp.uint64(54)) & wp.uint64(255))
                left = right


@wp.func
def on_line(first: int, slope: float, low: int, step: int, flat: wp.bool) -> wp.vec2i:
    """Pixel (x, y) of a step on a line that begins at `first` across and `low` along the longer side of a streak."""
    side = first + int(wp.floor(slope * float(step) + 0.5))
    if flat:
        return wp.vec2i(low + step, side)
    return wp.vec2i(side, low + step)


@wp.func
def inside(pixel: wp.vec2i, width: int, height: int) -> wp.bool:
    """Whether a pixel lies in the picture."""
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
    """Blurs items along their streak: a box filter, one thread a line of pixels.

    Within the item all pixels of the window count, as the background shows through at its ends; beside it, the item's
    own pixels are laid over the sharp background.
    A line steps one pixel along the longer side of the streak; lines of one slope cover every pixel once. The sum
    over the window is carried along, so that the cost does not depend on the length of the streak.
    """
    n, line = wp.tid()
    k = chosen[n]
    item = items[k]
    b = item.image
    width = owner.shape[2]
    height = owner.shape[1]
    dx = item.streak[0]
    dy = item.streak[1]
    flat = wp.abs(dx) >= wp.abs(dy)
    slope = float(0.0)
    low = item.low_y
    steps = item.high_y - item.low_y
    lanes = item.high_x - item.low_x
    across = item.low_x
    reach = wp.abs(dy)
    if flat:
        slope = dy / dx
        low = item.low_x
        steps = item.high_x - item.low_x
        lanes = item.high_y - item.low_y
        across = item.low_y
        reach = wp.abs(dx)
    else:
        slope = dx / dy
    extra = int(wp.ceil(wp.abs(slope) * float(steps))) + 1
    if line >= lanes + extra:
        return
    first = across + line
    if slope > 0.0:
        first = across + line - extra
    half = int(reach * 0.5 + 0.5)
    total = wp.vec3i(0, 0, 0)
    beside = wp.vec3i(0, 0, 0)
    weight = int(0)
    count = int(0)
    start = b * stride
    window = float(2 * half + 1)
    for s in range(-half, steps + half):
        # the pixel that enters the window, half a streak ahead
        ahead = s + half
        if ahead < steps:
            pixel = on_line(first, slope, low, ahead, flat)
            if inside(pixel, width, height):
                i = start + (pixel[1] * width + pixel[0]) * 3
                rank = int(owner[b, pixel[1], pixel[0]])
                if rank == item.rank:
                    total = total + wp.vec3i(int(image[i]), int(image[i + 1]), int(image[i + 2]))
                    weight += 1
                elif rank < item.rank:
                    beside = beside + wp.vec3i(int(image[i]), int(image[i + 1]), int(image[i + 2]))
                    count += 1
        if s >= 0 and s < steps and weight > 0:
            pixel = on_line(first, slope, low, s, flat)
            if inside(pixel, width, height):
                rank = int(owner[b, pixel[1], pixel[0]])
                if rank == item.rank:
                    i = start + (pixel[1] * width + pixel[0]) * 3
                    scale = 1.0 / float(weight + count)
                    out[i] = wp.uint8(float(total[0] + beside[0]) * scale + 0.5)
                    out[i + 1] = wp.uint8(float(total[1] + beside[1]) * scale + 0.5)
                    out[i + 2] = wp.uint8(float(total[2] + beside[2]) * scale + 0.5)
                elif rank < item.rank:
                    i = start + (pixel[1] * width + pixel[0]) * 3
                    alpha = float(weight) / window
                    scale = alpha / float(weight)
                    out[i] = wp.uint8(float(out[i]) * (1.0 - alpha) + float(total[0]) * scale + 0.5)
                    out[i + 1] = wp.uint8(float(out[i + 1]) * (1.0 - alpha) + float(total[1]) * scale + 0.5)
                    out[i + 2] = wp.uint8(float(out[i + 2]) * (1.0 - alpha) + float(total[2]) * scale + 0.5)
        behind = s - half
        if behind >= 0 and behind < steps:
            pixel = on_line(first, slope, low, behind, flat)
            if inside(pixel, width, height):
                i = start + (pixel[1] * width + pixel[0]) * 3
                rank = int(owner[b, pixel[1], pixel[0]])
                if rank == item.rank:
                    total = total - wp.vec3i(int(image[i]), int(image[i + 1]), int(image[i + 2]))
                    weight -= 1
                elif rank < item.rank:
                    beside = beside - wp.vec3i(int(image[i]), int(image[i + 1]), int(image[i + 2]))
                    count -= 1

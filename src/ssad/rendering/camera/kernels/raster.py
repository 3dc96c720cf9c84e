"""Visibility pass: the visible triangle at each sample.

A draw is a range of faces under one matrix (object to camera) in one view. Each face has two slots, since clipping at
the near plane can make two triangles of it. A sample keeps the largest key, inverse depth above slot: the result does
not depend on the order of the threads. Without fused multiply-adds, CPU and CUDA give the same bits.

Camera frame: x right, y down, z forward. Samples: `scale` by `scale` a pixel, at their centres.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})
REGISTERS = 64  # a CUDA thread's, at most: more threads are resident, and 128 views a call take 2 to 16 % less (H200)

NONE = wp.constant(wp.uint64(0))
LOW = wp.constant(0.21)  # m above the ground (or a body's base): what is lower casts no shadow
LEAF_LENGTH = wp.constant(0.62)  # half the length of a leaf, in cells of its card
LEAF_WIDTH = wp.constant(0.30)  # half its width
# The slot is stored as LAST - slot, so that of equal depths the lower slot wins.
LAST = wp.constant(wp.uint64(4294967295))


@wp.struct
class Triangle:
    """Corners as (x, y, inverse depth) in samples; its view; its slot, which identifies it in the view.

    twig: 0 for a solid triangle; for a card of leaves, rows + 64 columns of leaves + 4096 variation.
    """

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    view: int
    slot: int
    twig: int


@wp.func
def project_point(p: wp.vec3, lens: wp.vec4, scale: float, ortho: int) -> wp.vec3:
    """Project a point of the camera frame to (x, y, inverse depth) in samples."""
    inverse_depth = 1.0 / p[2]
    perspective = inverse_depth
    if ortho == 1:
        # linear in depth, as a parallel projection must interpolate
        inverse_depth = (1.0e3 - p[2]) * 1.0e-3
        perspective = 1.0
    x = (lens[0] * p[0] * perspective + lens[2] + 0.5) * scale
    y = (lens[1] * p[1] * perspective + lens[3] + 0.5) * scale
    return wp.vec3(x, y, inverse_depth)


@wp.func
def clip_edge(p: wp.vec3, q: wp.vec3, near: float) -> wp.vec3:
    """Return the point where the edge from p to q meets the near plane."""
    t = (near - p[2]) / (q[2] - p[2])
    return wp.vec3(p[0] + (q[0] - p[0]) * t, p[1] + (q[1] - p[1]) * t, near)


@wp.func
def is_outside(t: Triangle, width: float, height: float) -> int:
    """Return 1 unless the triangle faces the camera and its extent meets the image."""
    area = (t.b[0] - t.a[0]) * (t.c[1] - t.a[1]) - (t.b[1] - t.a[1]) * (t.c[0] - t.a[0])
    # y points down in samples: a face that is counter-clockwise seen from outside has a negative area.
    if area >= 0.0:
        return 1
    if wp.max(t.a[0], wp.max(t.b[0], t.c[0])) < 0.0 or wp.min(t.a[0], wp.min(t.b[0], t.c[0])) > width:
        return 1
    if wp.max(t.a[1], wp.max(t.b[1], t.c[1])) < 0.0 or wp.min(t.a[1], wp.min(t.b[1], t.c[1])) > height:
        return 1
    return 0


@wp.func
def edge_crossing(p: wp.vec3, q: wp.vec3, y: float) -> float:
    """Return the x where an edge crosses a row; both triangles that share the edge get the same number."""
    # The order of the end points fixes the rounding, so that shared edges leave no gap.
    if p[1] < q[1] or (p[1] == q[1] and p[0] < q[0]):
        return p[0] + (y - p[1]) * ((q[0] - p[0]) / (q[1] - p[1]))
    return q[0] + (y - q[1]) * ((p[0] - q[0]) / (p[1] - q[1]))


@wp.func
def leaf_draw(column: int, row: int, seed: int) -> int:
    """Return 16 pseudo-random bits for a cell of a card."""
    bits = wp.uint32(column) * wp.uint32(374761393) + wp.uint32(row) * wp.uint32(668265263)
    bits = bits + wp.uint32(seed) * wp.uint32(1540483477)
    bits = (bits ^ (bits >> wp.uint32(13))) * wp.uint32(1274126177)
    return int((bits >> wp.uint32(15)) & wp.uint32(65535))


@wp.func
def is_on_leaf(t: Triangle, x: float, y: float) -> bool:
    """Return whether a sample of a card lies on a leaf.

    Two grids of cells cover the card, from the edge between a and c to the corner b. Each cell has a leaf with a
    direction of its own if the middle of the leaf is on the card: no leaf is cut by an edge of the card.
    """
    ux = t.b[0] - t.a[0]
    uy = t.b[1] - t.a[1]
    vx = t.c[0] - t.a[0]
    vy = t.c[1] - t.a[1]
    px = x - t.a[0]
    py = y - t.a[1]
    area = ux * vy - uy * vx
    tip = (px * vy - py * vx) / area
    right = (ux * py - uy * px) / area
    # Shares of the corners on the card, not in the image: divided by depth, leaves keep their form in perspective.
    left = (1.0 - tip - right) * t.a[2]
    tip = tip * t.b[2]
    right = right * t.c[2]
    total = left + tip + right
    rows = float(t.twig % 64)
    columns = float((t.twig / 64) % 64)
    seed = t.twig / 4096
    u = (right + 0.5 * tip) / total * columns
    v = tip / total * rows
    for grid in range(2):
        offset = 0.5 * float(grid)
        column = wp.floor(u + offset)
        row = wp.floor(v + offset)
        bits = leaf_draw(int(column), int(row), seed + 97 * grid)
        # Direction by a parabola in place of sine and cosine, which differ between devices.
        turn = float(bits & 255) / 256.0 - 0.5
        lean = 1.0 - 4.0 * turn * turn
        norm = 1.0 / wp.sqrt(4.0 * turn * turn + lean * lean)
        middle_u = column - offset + 0.35 + 0.3 * float((bits >> 8) & 15) / 15.0
        middle_v = row - offset + 0.35 + 0.3 * float((bits >> 12) & 15) / 15.0
        along = ((u - middle_u) * 2.0 * turn + (v - middle_v) * lean) * norm
        across = wp.abs((u - middle_u) * lean - (v - middle_v) * 2.0 * turn) * norm
        if across < LEAF_WIDTH * (1.0 - along * along / (LEAF_LENGTH * LEAF_LENGTH)):
            height = middle_v / rows
            aside = wp.abs(middle_u / columns - 0.5)
            if height > 0.0 and aside < 0.5 * (1.0 - height):
                return True
    return False


@wp.func
def fill_row(t: Triangle, y: int, samples: wp.array3d(dtype=wp.uint64), gx: float, gy: float):
    """Enter a triangle into one row of samples."""
    sample_y = float(y) + 0.5
    left = float(1.0e9)
    right = float(-1.0e9)
    if (t.a[1] <= sample_y) != (t.b[1] <= sample_y):
        x = edge_crossing(t.a, t.b, sample_y)
        left = wp.min(left, x)
        right = wp.max(right, x)
    if (t.b[1] <= sample_y) != (t.c[1] <= sample_y):
        x = edge_crossing(t.b, t.c, sample_y)
        left = wp.min(left, x)
        right = wp.max(right, x)
    if (t.c[1] <= sample_y) != (t.a[1] <= sample_y):
        x = edge_crossing(t.c, t.a, sample_y)
        left = wp.min(left, x)
        right = wp.max(right, x)
    left = wp.clamp(left, -1.0, float(samples.shape[2]) + 1.0)
    right = wp.clamp(right, -1.0, float(samples.shape[2]) + 1.0)
    # Samples lie at the centres: column x is covered if low <= x + 0.5 < high.
    first = wp.max(int(wp.ceil(left - 0.5)), 0)
    last = wp.min(int(wp.ceil(right - 0.5)), samples.shape[2])
    if first >= last:
        return
    row_start = t.a[2] + gy * (sample_y - t.a[1]) + gx * (0.5 - t.a[0])
    slot_bits = LAST - wp.uint64(t.slot)
    for x in range(first, last):
        # Positive floats order like their bits, so the key can compare them as integers.
        inverse_depth = wp.max(row_start + gx * float(x), 1.0e-9)
        key = (wp.uint64(wp.cast(inverse_depth, wp.uint32)) << wp.uint64(32)) | slot_bits
        # Cheap test first: an atomic operation is only needed where the key can win.
        if key > samples[t.view, y, x]:
            if t.twig == 0 or is_on_leaf(t, float(x) + 0.5, sample_y):
                wp.atomic_max(samples, t.view, y, x, key)


@wp.func
def slopes(t: Triangle) -> wp.vec2:
    """Return the change of inverse depth for one sample to the right and one down."""
    ux = t.b[0] - t.a[0]
    uy = t.b[1] - t.a[1]
    vx = t.c[0] - t.a[0]
    vy = t.c[1] - t.a[1]
    area = ux * vy - uy * vx
    du = t.b[2] - t.a[2]
    dv = t.c[2] - t.a[2]
    return wp.vec2((du * vy - dv * uy) / area, (dv * ux - du * vx) / area)


@wp.func
def rows_of(t: Triangle, height: int) -> wp.vec2i:
    """Return the first row and last + 1 whose sample centres the triangle can cover."""
    top = wp.clamp(wp.min(t.a[1], wp.min(t.b[1], t.c[1])), -1.0, float(height) + 1.0)
    bottom = wp.clamp(wp.max(t.a[1], wp.max(t.b[1], t.c[1])), -1.0, float(height) + 1.0)
    return wp.vec2i(wp.max(int(wp.ceil(top - 0.5)), 0), wp.min(int(wp.ceil(bottom - 0.5)), height))


@wp.func
def enter(
    t: Triangle, largest: float, samples: wp.array3d(dtype=wp.uint64), large: wp.array(dtype=Triangle),
    count: wp.array(dtype=int),
):  # fmt: skip
    """Enter a triangle into the samples, or list it in `large` if it is large and there is room, see `fill`."""
    if is_outside(t, float(samples.shape[2]), float(samples.shape[1])) == 1:
        return
    rows = rows_of(t, samples.shape[1])
    width = wp.max(t.a[0], wp.max(t.b[0], t.c[0])) - wp.min(t.a[0], wp.min(t.b[0], t.c[0]))
    if float(rows[1] - rows[0]) * wp.min(width, float(samples.shape[2])) > largest:
        position = wp.atomic_add(count, 0, 1)
        if position < large.shape[0]:
            large[position] = t
            return
    slope = slopes(t)
    for y in range(rows[0], rows[1]):
        fill_row(t, y, samples, slope[0], slope[1])


@wp.kernel(cuda_max_registers=REGISTERS)
def fill(
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array2d(dtype=int),
    twigs: wp.array(dtype=int),
    listed: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    firsts: wp.array(dtype=int),
    views: wp.array(dtype=int),
    matrices: wp.array(dtype=wp.mat44),
    lens: wp.array(dtype=wp.vec4),
    near: float,
    scale: float,
    ortho: int,
    lanes: int,
    largest: float,
    owners: wp.array(dtype=wp.vec2i),
    samples: wp.array3d(dtype=wp.uint64),
    large: wp.array(dtype=Triangle),
    count: wp.array(dtype=int),
):
    """Project each listed face, clip it, and enter it into the samples unless it faces away.

    Triangles whose extent has more than `largest` samples are listed in `large` instead while there is room.

    twigs: of each face, see `Triangle`. owners: the draw and the face of each index. A parallel projection is the sun:
    the ground casts no shadow.
    Each draw has `lanes` threads, which take its faces in turn.
    """
    draw, lane = wp.tid()
    view = views[draw]
    plane = near
    if ortho == 1:
        plane = -900.0
    for index in range(starts[draw] + lane, starts[draw + 1], lanes):
        face = listed[firsts[draw] + index - starts[draw]]
        owners[index] = wp.vec2i(draw, face)
        u = vertices[faces[face, 0]]
        v = vertices[faces[face, 1]]
        w = vertices[faces[face, 2]]
        if ortho == 0 or wp.max(u[2], wp.max(v[2], w[2])) >= LOW:
            to_camera = matrices[draw]  # inside the loop: fewer registers, and no slower
            focal = lens[view]
            p = wp.transform_point(to_camera, u)
            q = wp.transform_point(to_camera, v)
            r = wp.transform_point(to_camera, w)
            # Rotate the corners so that the first is in front whenever one is.
            if p[2] < plane:
                if q[2] >= plane:
                    swapped = p
                    p = q
                    q = r
                    r = swapped
                elif r[2] >= plane:
                    swapped = p
                    p = r
                    r = q
                    q = swapped
            if p[2] >= plane:
                triangle = Triangle()
                triangle.view = view
                triangle.slot = 2 * index
                triangle.twig = twigs[face]
                triangle.a = project_point(p, focal, scale, ortho)
                if q[2] >= plane:
                    triangle.b = project_point(q, focal, scale, ortho)
                    if r[2] >= plane:
                        triangle.c = project_point(r, focal, scale, ortho)
                    else:
                        triangle.c = project_point(clip_edge(q, r, plane), focal, scale, ortho)
                else:
                    triangle.b = project_point(clip_edge(p, q, plane), focal, scale, ortho)
                    if r[2] >= plane:
                        triangle.c = project_point(clip_edge(r, q, plane), focal, scale, ortho)
                    else:
                        triangle.c = project_point(clip_edge(p, r, plane), focal, scale, ortho)
                pieces = int(1)
                if (q[2] >= plane) != (r[2] >= plane):
                    pieces = 2  # one corner behind the plane: four corners remain
                for piece in range(pieces):
                    if piece == 1:
                        triangle.slot += 1
                        triangle.b = triangle.c
                        if q[2] >= plane:
                            triangle.c = project_point(clip_edge(p, r, plane), focal, scale, ortho)
                        else:
                            triangle.c = project_point(r, focal, scale, ortho)
                    enter(triangle, largest, samples, large, count)


@wp.kernel(cuda_max_registers=REGISTERS)
def fill_large(
    large: wp.array(dtype=Triangle),
    count: wp.array(dtype=int),
    lanes: int,
    samples: wp.array3d(dtype=wp.uint64),
):
    """Fill the listed large triangles with `lanes` threads each, every thread taking each `lanes`-th row."""
    entry, lane = wp.tid()
    if entry >= wp.min(count[0], large.shape[0]):
        return
    triangle = large[entry]
    rows = rows_of(triangle, samples.shape[1])
    slope = slopes(triangle)
    for y in range(rows[0] + lane, rows[1], lanes):
        fill_row(triangle, y, samples, slope[0], slope[1])

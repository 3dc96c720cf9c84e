"""The visibility pass: which triangle is seen at each sample.

A draw is a range of faces under one matrix (object to camera) in one view. Each face has two slots, since clipping at
the near plane can make two triangles of it. A sample keeps the largest key, inverse depth above slot: the result does
not depend on the order of the threads. Without fused multiply-adds, CPU and CUDA give the same bits.

Camera frame: x right, y down, z forward. Samples: `scale` by `scale` a pixel, at their centres.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NONE = wp.constant(wp.uint64(0))
LOW = wp.constant(0.21)  # m above the ground (or a body's base): what is lower casts no shadow
LAST = wp.constant(wp.uint64(4294967295))


@wp.struct
class Triangle:
    """Corners as (x, y, inverse depth) in samples; view -1: nothing to draw."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    view: int


@wp.func
def draw_of(starts: wp.array(dtype=int), index: int) -> int:
    """The draw whose faces begin at or before an index (binary search)."""
    low = int(0)
    high = starts.shape[0] - 1
    while high - low > 1:
        middle = (low + high) / 2
        if starts[middle] <= index:
            low = middle
        else:
            high = middle
    return low


@wp.func
def shown(p: wp.vec3, lens: wp.vec4, scale: float, ortho: int) -> wp.vec3:
    """A point of the camera frame as (x, y, inverse depth) in samples."""
    if ortho == 1:
        # linear in depth, as a parallel projection must interpolate
        return wp.vec3(
            (lens[0] * p[0] + lens[2] + 0.5) * scale, (lens[1] * p[1] + lens[3] + 0.5) * scale, (1.0e3 - p[2]) * 1.0e-3
        )
    near = 1.0 / p[2]
    return wp.vec3(
        (lens[0] * p[0] * near + lens[2] + 0.5) * scale, (lens[1] * p[1] * near + lens[3] + 0.5) * scale, near
    )


@wp.func
def cut(p: wp.vec3, q: wp.vec3, near: float) -> wp.vec3:
    """Where the edge from p to q meets the near plane."""
    t = (near - p[2]) / (q[2] - p[2])
    return wp.vec3(p[0] + (q[0] - p[0]) * t, p[1] + (q[1] - p[1]) * t, near)


@wp.func
def outside(t: Triangle, width: float, height: float) -> int:
    """1 unless the triangle faces the camera and its extent meets the picture."""
    area = (t.b[0] - t.a[0]) * (t.c[1] - t.a[1]) - (t.b[1] - t.a[1]) * (t.c[0] - t.a[0])
    # y points down in samples: a face that is counter-clockwise seen from outside has a negative area
    if area >= 0.0:
        return 1
    if wp.max(t.a[0], wp.max(t.b[0], t.c[0])) < 0.0 or wp.min(t.a[0], wp.min(t.b[0], t.c[0])) > width:
        return 1
    if wp.max(t.a[1], wp.max(t.b[1], t.c[1])) < 0.0 or wp.min(t.a[1], wp.min(t.b[1], t.c[1])) > height:
        return 1
    return 0


@wp.kernel
def setup(
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array2d(dtype=int),
    listed: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    firsts: wp.array(dtype=int),
    views: wp.array(dtype=int),
    matrices: wp.array(dtype=wp.mat44),
    lens: wp.array(dtype=wp.vec4),
    near: float,
    scale: float,
    ortho: int,
    width: float,
    height: float,
    triangles: wp.array(dtype=Triangle),
    owners: wp.array(dtype=wp.vec2i),
):
    """Moves each listed face into its camera, drops what is turned away or out of the picture, clips, projects.

    owners: the draw and the face of each index. A parallel projection is light: the ground casts no shadow.
    """
    index = wp.tid()
    draw = draw_of(starts, index)
    face = listed[firsts[draw] + index - starts[draw]]
    owners[index] = wp.vec2i(draw, face)
    if ortho == 1 and vertices[faces[face, 0]][2] < LOW:
        if vertices[faces[face, 1]][2] < LOW and vertices[faces[face, 2]][2] < LOW:
            triangles[2 * index].view = -1
            triangles[2 * index + 1].view = -1
            return
    m = matrices[draw]
    view = views[draw]
    p = wp.transform_point(m, vertices[faces[face, 0]])
    q = wp.transform_point(m, vertices[faces[face, 1]])
    r = wp.transform_point(m, vertices[faces[face, 2]])
    first = Triangle()
    second = Triangle()
    first.view = -1
    second.view = -1
    focal = lens[view]
    plane = near
    if ortho == 1:
        plane = -900.0
    # rotate the corners so that the first is in front whenever one is
    if p[2] < plane:
        if q[2] >= plane:
            o = p
            p = q
            q = r
            r = o
        elif r[2] >= plane:
            o = p
            p = r
            r = q
            q = o
    if p[2] >= plane:
        if q[2] >= plane and r[2] >= plane:
            first.a = shown(p, focal, scale, ortho)
            first.b = shown(q, focal, scale, ortho)
            first.c = shown(r, focal, scale, ortho)
            first.view = view
        elif q[2] >= plane:
            qr = shown(cut(q, r, plane), focal, scale, ortho)
            first.a = shown(p, focal, scale, ortho)
            first.b = shown(q, focal, scale, ortho)
            first.c = qr
            first.view = view
            second.a = first.a
            second.b = qr
            second.c = shown(cut(p, r, plane), focal, scale, ortho)
            second.view = view
        elif r[2] >= plane:
            first.a = shown(p, focal, scale, ortho)
            first.b = shown(cut(p, q, plane), focal, scale, ortho)
            first.c = shown(cut(r, q, plane), focal, scale, ortho)
            first.view = view
            second.a = first.a
            second.b = first.c
            second.c = shown(r, focal, scale, ortho)
            second.view = view
        else:
            first.a = shown(p, focal, scale, ortho)
            first.b = shown(cut(p, q, plane), focal, scale, ortho)
            first.c = shown(cut(p, r, plane), focal, scale, ortho)
            first.view = view
    if first.view >= 0 and outside(first, width, height) == 1:
        first.view = -1
    if second.view >= 0 and outside(second, width, height) == 1:
        second.view = -1
    triangles[2 * index] = first
    triangles[2 * index + 1] = second


@wp.func
def crossing(p: wp.vec3, q: wp.vec3, y: float) -> float:
    """x at which the edge crosses a row; the same number for both triangles that share it."""
    if p[1] < q[1] or (p[1] == q[1] and p[0] < q[0]):
        return p[0] + (y - p[1]) * ((q[0] - p[0]) / (q[1] - p[1]))
    return q[0] + (y - q[1]) * ((p[0] - q[0]) / (p[1] - q[1]))


@wp.func
def fill_row(t: Triangle, slot: int, y: int, samples: wp.array3d(dtype=wp.uint64), gx: float, gy: float):
    """Enters a triangle into one row of samples."""
    yc = float(y) + 0.5
    low = float(1.0e9)
    high = float(-1.0e9)
    if (t.a[1] <= yc) != (t.b[1] <= yc):
        x = crossing(t.a, t.b, yc)
        low = wp.min(low, x)
        high = wp.max(high, x)
    if (t.b[1] <= yc) != (t.c[1] <= yc):
        x = crossing(t.b, t.c, yc)
        low = wp.min(low, x)
        high = wp.max(high, x)
    if (t.c[1] <= yc) != (t.a[1] <= yc):
        x = crossing(t.c, t.a, yc)
        low = wp.min(low, x)
        high = wp.max(high, x)
    low = wp.clamp(low, -1.0, float(samples.shape[2]) + 1.0)
    high = wp.clamp(high, -1.0, float(samples.shape[2]) + 1.0)
    first = wp.max(int(wp.ceil(low - 0.5)), 0)
    last = wp.min(int(wp.ceil(high - 0.5)), samples.shape[2])
    if first >= last:
        return
    start = t.a[2] + gy * (yc - t.a[1]) + gx * (0.5 - t.a[0])
    tail = LAST - wp.uint64(slot)
    for x in range(first, last):
        near = wp.max(start + gx * float(x), 1.0e-9)
        key = (wp.uint64(wp.cast(near, wp.uint32)) << wp.uint64(32)) | tail
        if key > samples[t.view, y, x]:
            wp.atomic_max(samples, t.view, y, x, key)


@wp.func
def slopes(t: Triangle) -> wp.vec2:
    """Change of inverse depth for one sample to the right and one down."""
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
    """First row and last + 1 whose sample centres the triangle can cover."""
    top = wp.clamp(wp.min(t.a[1], wp.min(t.b[1], t.c[1])), -1.0, float(height) + 1.0)
    bottom = wp.clamp(wp.max(t.a[1], wp.max(t.b[1], t.c[1])), -1.0, float(height) + 1.0)
    return wp.vec2i(wp.max(int(wp.ceil(top - 0.5)), 0), wp.min(int(wp.ceil(bottom - 0.5)), height))


@wp.kernel
def fill(
    triangles: wp.array(dtype=Triangle),
    largest: float,
    samples: wp.array3d(dtype=wp.uint64),
    large: wp.array(dtype=int),
    count: wp.array(dtype=int),
):
    """Enters each triangle into the samples; those whose extent has more than `largest` samples are listed in `large`
    as long as there is room."""
    slot = wp.tid()
    t = triangles[slot]
    if t.view < 0:
        return
    rows = rows_of(t, samples.shape[1])
    wide = wp.max(t.a[0], wp.max(t.b[0], t.c[0])) - wp.min(t.a[0], wp.min(t.b[0], t.c[0]))
    if float(rows[1] - rows[0]) * wp.min(wide, float(samples.shape[2])) > largest:
        place = wp.atomic_add(count, 0, 1)
        if place < large.shape[0]:
            large[place] = slot
            return
    slope = slopes(t)
    for y in range(rows[0], rows[1]):
        fill_row(t, slot, y, samples, slope[0], slope[1])


@wp.kernel
def fill_large(
    triangles: wp.array(dtype=Triangle),
    large: wp.array(dtype=int),
    count: wp.array(dtype=int),
    lanes: int,
    samples: wp.array3d(dtype=wp.uint64),
):
    """The listed large triangles: `lanes` threads each, every one takes each so-manieth row."""
    n, lane = wp.tid()
    if n >= wp.min(count[0], large.shape[0]):
        return
    slot = large[n]
    t = triangles[slot]
    rows = rows_of(t, samples.shape[1])
    slope = slopes(t)
    y = rows[0] + lane
    while y < rows[1]:
        fill_row(t, slot, y, samples, slope[0], slope[1])
        y += lanes

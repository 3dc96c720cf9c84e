"""The visibility pass: which triangle is seen at each sample.

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
LAST = wp.constant(wp.uint64(4294967295))


@wp.struct
class Triangle:
    """Corners as (x, y, inverse depth) in samples; its view; its slot, which names it there."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    view: int
    slot: int


@wp.func
def shown(p: wp.vec3, lens: wp.vec4, scale: float, ortho: int) -> wp.vec3:
    """A point of the camera frame as (x, y, inverse depth) in samples."""
    near = 1.0 / p[2]
    shrink = near
    if ortho == 1:
        # linear in depth, as a parallel projection must interpolate
        near = (1.0e3 - p[2]) * 1.0e-3
        shrink = 1.0
    x = (lens[0] * p[0] * shrink + lens[2] + 0.5) * scale
    y = (lens[1] * p[1] * shrink + lens[3] + 0.5) * scale
    return wp.vec3(x, y, near)


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


@wp.func
def crossing(p: wp.vec3, q: wp.vec3, y: float) -> float:
    """Where an edge crosses a row: x, the same number for both triangles that share the edge."""
    if p[1] < q[1] or (p[1] == q[1] and p[0] < q[0]):
        return p[0] + (y - p[1]) * ((q[0] - p[0]) / (q[1] - p[1]))
    return q[0] + (y - q[1]) * ((p[0] - q[0]) / (p[1] - q[1]))


@wp.func
def fill_row(t: Triangle, y: int, samples: wp.array3d(dtype=wp.uint64), gx: float, gy: float):
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
    tail = LAST - wp.uint64(t.slot)
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


@wp.func
def enter(
    t: Triangle, largest: float, samples: wp.array3d(dtype=wp.uint64), large: wp.array(dtype=Triangle),
    count: wp.array(dtype=int),
):  # fmt: skip
    """Enters a triangle into the samples, or lists it in `large` if it is large and there is room, see `fill`."""
    if outside(t, float(samples.shape[2]), float(samples.shape[1])) == 1:
        return
    rows = rows_of(t, samples.shape[1])
    wide = wp.max(t.a[0], wp.max(t.b[0], t.c[0])) - wp.min(t.a[0], wp.min(t.b[0], t.c[0]))
    if float(rows[1] - rows[0]) * wp.min(wide, float(samples.shape[2])) > largest:
        place = wp.atomic_add(count, 0, 1)
        if place < large.shape[0]:
            large[place] = t
            return
    slope = slopes(t)
    for y in range(rows[0], rows[1]):
        fill_row(t, y, samples, slope[0], slope[1])


@wp.kernel(cuda_max_registers=REGISTERS)
def fill(
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
    lanes: int,
    largest: float,
    owners: wp.array(dtype=wp.vec2i),
    samples: wp.array3d(dtype=wp.uint64),
    large: wp.array(dtype=Triangle),
    count: wp.array(dtype=int),
):
    """Projects each listed face, clipped, and enters it into the samples unless it is turned away.

    Triangles whose extent has more than `largest` samples are listed in `large` instead as long as there is room.

    owners: the draw and the face of each index. A parallel projection is light: the ground casts no shadow. Each draw
    has `lanes` threads, which take its faces in turn.
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
            m = matrices[draw]  # here and not before the loop: fewer registers, and no slower
            focal = lens[view]
            p = wp.transform_point(m, u)
            q = wp.transform_point(m, v)
            r = wp.transform_point(m, w)
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
                t = Triangle()
                t.view = view
                t.slot = 2 * index
                t.a = shown(p, focal, scale, ortho)
                if q[2] >= plane:
                    t.b = shown(q, focal, scale, ortho)
                    if r[2] >= plane:
                        t.c = shown(r, focal, scale, ortho)
                    else:
                        t.c = shown(cut(q, r, plane), focal, scale, ortho)
                else:
                    t.b = shown(cut(p, q, plane), focal, scale, ortho)
                    if r[2] >= plane:
                        t.c = shown(cut(r, q, plane), focal, scale, ortho)
                    else:
                        t.c = shown(cut(p, r, plane), focal, scale, ortho)
                pieces = int(1)
                if (q[2] >= plane) != (r[2] >= plane):
                    pieces = 2  # one corner behind the plane: what is left has four
                for piece in range(pieces):
                    if piece == 1:
                        t.slot += 1
                        t.b = t.c
                        if q[2] >= plane:
                            t.c = shown(cut(p, r, plane), focal, scale, ortho)
                        else:
                            t.c = shown(r, focal, scale, ortho)
                    enter(t, largest, samples, large, count)


@wp.kernel(cuda_max_registers=REGISTERS)
def fill_large(
    large: wp.array(dtype=Triangle),
    count: wp.array(dtype=int),
    lanes: int,
    samples: wp.array3d(dtype=wp.uint64),
):
    """The listed large triangles: `lanes` threads each, every one takes each so-manieth row."""
    n, lane = wp.tid()
    if n >= wp.min(count[0], large.shape[0]):
        return
    t = large[n]
    rows = rows_of(t, samples.shape[1])
    slope = slopes(t)
    for y in range(rows[0] + lane, rows[1], lanes):
        fill_row(t, y, samples, slope[0], slope[1])

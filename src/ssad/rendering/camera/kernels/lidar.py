"""Rays of a LiDAR against the triangles of a street and of things: what each beam meets first.

A thing is tested in its own frame, where its mesh was indexed once; rays of one column (azimuth) share the list of
things that they can meet. Glass lets a beam through unless its number says otherwise.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PANES = wp.constant(3)  # panes of glass that a beam can pass
PAST = wp.constant(1.0e-3)  # m behind a pane, where the beam goes on


@wp.struct
class Target:
    """A thing that beams can meet.

    Attributes:
        mesh: Id of its mesh.
        turn: Rotation from world to object.
        place: Position of the sensor in the object frame, m.
        velocity: World, m/s.
        centre: Centre of its bounding sphere relative to the sensor, m.
        radius: Radius of that sphere, m.
        first: Number of its first face.
        paint: Luminance of its paint.
        tag: Its tag.
    """

    mesh: wp.uint64
    turn: wp.mat33
    place: wp.vec3
    velocity: wp.vec3
    centre: wp.vec3
    radius: float
    first: int
    paint: float
    tag: int


@wp.kernel
def cast(
    street: wp.uint64,
    eye: wp.vec3,
    targets: wp.array(dtype=Target),
    listed: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    directions: wp.array2d(dtype=wp.vec3),
    offsets: wp.array(dtype=wp.vec3),
    times: wp.array(dtype=float),
    material: wp.array(dtype=int),
    echo: wp.array(dtype=float),
    clear: wp.array(dtype=int),
    chance: wp.array3d(dtype=float),
    glass: float,
    reach: float,
    distance: wp.array2d(dtype=float),
    cosine: wp.array2d(dtype=float),
    albedo: wp.array2d(dtype=float),
    tag: wp.array2d(dtype=int),
):
    """Distance (m, 0: nothing within reach), cosine of incidence, albedo and tag for each azimuth and beam.

    street: mesh of the street or 0; eye: sensor in the world; starts [A + 1] into `listed`: the targets of a column;
    directions [A, B] unit, world; offsets [A] of the sensor from `eye`, m, and times [A], s, when a column is fired;
    material: that of each face, the street's first; echo: luminance of materials, negative where paint; clear: 1 for
    glass; chance [A, B, 3] in 0..1; glass: share of beams that a pane returns.
    """
    a, b = wp.tid()
    ray = directions[a, b]
    shift = offsets[a]
    time = times[a]
    from_ = float(0.0)
    found = float(0.0)
    for pane in range(PANES + 1):
        best = reach
        face = int(-1)
        slope = float(0.0)
        shade = float(0.0)
        name = int(0)
        for k in range(starts[a], starts[a + 1]):
            n = listed[k]
            move = shift - targets[n].velocity * time
            # nearest approach to the middle of the bounding sphere
            away = targets[n].centre - move
            along = wp.dot(away, ray)
            radius = targets[n].radius
            off = wp.dot(away, away) - along * along
            if off <= radius * radius and along + radius > from_ and along - radius < best:
                turn = targets[n].turn
                towards = turn * ray
                q = wp.mesh_query_ray(
                    targets[n].mesh, targets[n].place + turn * move + towards * from_, towards, best - from_
                )
                if q.result:
                    best = from_ + q.t
                    face = targets[n].first + q.face
                    slope = wp.abs(wp.dot(q.normal, towards))
                    shade = targets[n].paint
                    name = targets[n].tag
        if street != wp.uint64(0):
            q = wp.mesh_query_ray(street, eye + shift + ray * from_, ray, best - from_)
            if q.result:
                best = from_ + q.t
                face = q.face
                slope = wp.abs(wp.dot(q.normal, ray))
                name = 0
        if face < 0:
            break
        m = material[face]
        through = int(0)
        if clear[m] == 1 and pane < PANES:
            if chance[a, b, pane] >= glass:
                through = 1
        if through == 1:
            from_ = best + PAST
        else:
            found = best
            if echo[m] >= 0.0:
                shade = echo[m]
            cosine[a, b] = slope
            albedo[a, b] = shade
            tag[a, b] = name
            break
    distance[a, b] = found

"""Rays of a LiDAR against the triangles of a street and of objects: the first hit of each beam.

An object is tested in its own frame, where its mesh was indexed once; rays of one column (azimuth) share the list of
objects that they can hit. Glass passes a beam unless its random number reflects it.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PANES = wp.constant(3)  # panes of glass that a beam can pass
PAST = wp.constant(1.0e-3)  # m behind a pane, where the beam continues


@wp.struct
class Target:
    """Object that beams can hit.

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
    """Compute distance (m, 0: no hit), cosine of incidence, albedo and tag for each azimuth and beam.

    street: mesh of the street or 0; eye: sensor in the world; starts [A + 1] into `listed`: the targets of a
    column; directions [A, B] unit, world; offsets [A] of the sensor from `eye`, m, and times [A], s, when a
    column is fired; material: that of each face, the street's first; echo: luminance of materials, negative
    where paint; clear: 1 for glass; chance [A, B, 3] in 0..1; glass: share of beams that a pane returns.
    """
    column, beam = wp.tid()
    ray = directions[column, beam]
    column_offset = offsets[column]
    fire_time = times[column]
    start = float(0.0)
    hit_distance = float(0.0)
    for pane in range(PANES + 1):
        best = reach
        face = int(-1)
        hit_cosine = float(0.0)
        hit_albedo = float(0.0)
        hit_tag = int(0)
        for entry in range(starts[column], starts[column + 1]):
            target = listed[entry]
            sensor_offset = column_offset - targets[target].velocity * fire_time
            # Nearest approach to the centre of the bounding sphere.
            to_centre = targets[target].centre - sensor_offset
            axial_distance = wp.dot(to_centre, ray)
            radius = targets[target].radius
            squared_miss = wp.dot(to_centre, to_centre) - axial_distance * axial_distance
            # The bounding sphere rejects most targets without a query of their mesh.
            if squared_miss <= radius * radius and axial_distance + radius > start and axial_distance - radius < best:
                rotation = targets[target].turn
                local_ray = rotation * ray
                query = wp.mesh_query_ray(
                    targets[target].mesh,
                    targets[target].place + rotation * sensor_offset + local_ray * start,
                    local_ray,
                    best - start,
                )
                if query.result:
                    best = start + query.t
                    face = targets[target].first + query.face
                    hit_cosine = wp.abs(wp.dot(query.normal, local_ray))
                    hit_albedo = targets[target].paint
                    hit_tag = targets[target].tag
        if street != wp.uint64(0):
            query = wp.mesh_query_ray(street, eye + column_offset + ray * start, ray, best - start)
            if query.result:
                best = start + query.t
                face = query.face
                hit_cosine = wp.abs(wp.dot(query.normal, ray))
                hit_tag = 0
        if face < 0:
            break
        surface = material[face]
        passes = int(0)
        if clear[surface] == 1 and pane < PANES:
            if chance[column, beam, pane] >= glass:
                passes = 1
        if passes == 1:
            start = best + PAST
        else:
            hit_distance = best
            if echo[surface] >= 0.0:
                hit_albedo = echo[surface]
            cosine[column, beam] = hit_cosine
            albedo[column, beam] = hit_albedo
            tag[column, beam] = hit_tag
            break
    distance[column, beam] = hit_distance

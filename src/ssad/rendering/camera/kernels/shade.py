"""Shading: light from each sample, averaged to pixels; linear in the colour of every surface.

One evaluation a pixel and triangle, at the mean of the samples that the triangle covers. Sun with two shadow maps
(one fine, around the focus), ambient light of sky and ground with contact occlusion, lamps, a mirror term for glass,
paint and wet roads, fog by distance.
"""

import warp as wp

from ssad.rendering.camera.kernels.layers import Fragment, Layers, on_decal, on_layer
from ssad.rendering.camera.kernels.light import CELLS, Near, cell_of, lamp_at, lamp_emission, openness, spot_of
from ssad.rendering.camera.kernels.matter import Surface, textured
from ssad.rendering.camera.kernels.raster import LAST, REGISTERS
from ssad.rendering.camera.kernels.sky import Light, cloudy, sky, surroundings

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Geometry:
    """Arrays of a scene, as in `ssad.rendering.camera.scene.RenderScene`."""

    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array2d(dtype=int)
    normals: wp.array2d(dtype=wp.vec3)
    uvs: wp.array2d(dtype=wp.vec2)
    material: wp.array(dtype=int)
    surfaces: wp.array(dtype=Surface)
    wearable: wp.array(dtype=int)


@wp.struct
class DrawRanges:
    """Ranges of listed faces, each under one matrix (see `ssad.rendering.camera.scene.DrawCalls`).

    Attributes:
        samples: Key of what each sample shows.
        owners: Draw and face of each key.
        matrices: Object to camera, of each draw.
        paints: Linear RGB of each draw.
        tags: Tag of each draw.
        lit: Bits of the lamps of the draw's body, as of `ssad.rendering.camera.kernels.light.LAMPS_ON`.
        split: Distance from the body's axis beyond which head lamps and tail lamps are indicators, m.
    """

    samples: wp.array3d(dtype=wp.uint64)
    owners: wp.array(dtype=wp.vec2i)
    matrices: wp.array(dtype=wp.mat44)
    paints: wp.array(dtype=wp.vec3)
    tags: wp.array(dtype=int)
    lit: wp.array(dtype=int)
    split: wp.array(dtype=wp.vec2)


@wp.struct
class SunShadows:
    """Shadow maps of the sun: one wide, one fine; matrices from the world to texels; m a texel."""

    wide: wp.array3d(dtype=wp.uint64)
    fine: wp.array3d(dtype=wp.uint64)
    to_wide: wp.array(dtype=wp.mat44)
    to_fine: wp.array(dtype=wp.mat44)
    wide_texel: float
    fine_texel: float


@wp.struct
class Output:
    """Outputs of `shade`.

    Attributes:
        radiance: [B, H, W].
        tag: [B, H, W].
        depth: [B, H, W], m.
        fragments: Pieces of textured surfaces.
        found: Number of fragments.
        surface: 1 if the following four are exported, [B, H, W] each; they describe the surface that covers
            most of a pixel.
        albedo: Linear.
        normal: Unit vectors, world.
        irradiance: Of all light, over pi.
        gain: Gain of the pixel's radiance per unit of albedo.
    """

    radiance: wp.array3d(dtype=wp.vec3)
    tag: wp.array3d(dtype=int)
    depth: wp.array3d(dtype=float)
    fragments: wp.array(dtype=Fragment)
    found: wp.array(dtype=int)
    surface: int
    albedo: wp.array3d(dtype=wp.vec3)
    normal: wp.array3d(dtype=wp.vec3)
    irradiance: wp.array3d(dtype=wp.vec3)
    gain: wp.array3d(dtype=wp.vec3)


@wp.struct
class Hit:
    """Intersection of a ray with a face.

    Attributes:
        draw: Its draw.
        face: Its face.
        place: Point in the world, m.
        normal: Unit normal in the world.
        uv: Texture coordinates.
        z: Depth along the optical axis, m.
        distance: Distance from the camera, m.
        slant: Cosine between the ray and the face's normal.
        stretch: Texture area for 1 m^2 of the face.
    """

    draw: int
    face: int
    place: wp.vec3
    normal: wp.vec3
    uv: wp.vec2
    z: float
    distance: float
    slant: float
    stretch: float


@wp.struct
class PointLight:
    """Light on a point.

    Attributes:
        light: Irradiance / pi of all light.
        sun: Part that comes straight from the sun, as a share of the sun's light, 0 to 1.
        open_: Share of the sky that the point sees.
    """

    light: wp.vec3
    sun: float
    open_: float


@wp.struct
class SurfaceLight:
    """Light that a surface sends to the camera: its colour, and its gain per unit of albedo."""

    colour: wp.vec3
    gain: wp.vec3


@wp.func
def open_texel(shadows: wp.array3d(dtype=wp.uint64), view: int, row: int, column: int, depth: float) -> float:
    """Return 1 if the texel holds nothing nearer to the light, else 0."""
    if wp.cast(wp.uint32(shadows[view, row, column] >> wp.uint64(32)), float) <= depth:
        return 1.0
    return 0.0


@wp.func
def sun_share(shadows: wp.array3d(dtype=wp.uint64), view: int, p: wp.vec3, bias: float) -> float:
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
    upper_row = open_texel(shadows, view, j, i, depth) * (1.0 - u) + open_texel(shadows, view, j, i + 1, depth) * u
    lower_row = (
        open_texel(shadows, view, j + 1, i, depth) * (1.0 - u) + open_texel(shadows, view, j + 1, i + 1, depth) * u
    )
    return upper_row * (1.0 - v) + lower_row * v


@wp.func
def sun_at(shadows: SunShadows, view: int, p: wp.vec3, n: wp.vec3) -> float:
    """Return the share of the sun that reaches a point with a normal, by the fine map if it contains the point."""
    texel = shadows.fine_texel
    # The offset along the normal keeps a surface from shading itself.
    share = sun_share(shadows.fine, view, wp.transform_point(shadows.to_fine[view], p + n * (texel * 1.5)), texel)
    if share < 0.0:
        texel = shadows.wide_texel
        share = sun_share(shadows.wide, view, wp.transform_point(shadows.to_wide[view], p + n * (texel * 1.5)), texel)
    if share < 0.0:
        share = 1.0
    return share


@wp.func
def hit_of(geometry: Geometry, draw_samples: DrawRanges, slot: int, ray: wp.vec3, pose: wp.mat44) -> Hit:
    """Intersect a ray (camera frame, z = 1) with the plane of a slot's face, clamped to its edges."""
    hit = Hit()
    owner = draw_samples.owners[slot / 2]
    hit.draw = owner[0]
    hit.face = owner[1]
    face = hit.face
    to_camera = draw_samples.matrices[hit.draw]
    a = wp.transform_point(to_camera, geometry.vertices[geometry.faces[face, 0]])
    b = wp.transform_point(to_camera, geometry.vertices[geometry.faces[face, 1]])
    c = wp.transform_point(to_camera, geometry.vertices[geometry.faces[face, 2]])
    ab = b - a
    ac = c - a
    plane = wp.cross(ab, ac)
    along = wp.dot(plane, ray)
    # A face seen edge-on: the negative sign is that of a face turned to the camera.
    if wp.abs(along) < 1.0e-12:
        along = -1.0e-12
    hit.z = wp.clamp(wp.dot(plane, a) / along, 0.05, 2.0e3)
    # barycentric coordinates, clamped: the mean of a pixel's samples can lie outside the face
    offset = ray * hit.z - a
    squared_area = wp.dot(plane, plane)
    b_share = wp.clamp(wp.dot(wp.cross(offset, ac), plane) / squared_area, 0.0, 1.0)
    c_share = wp.clamp(wp.dot(wp.cross(ab, offset), plane) / squared_area, 0.0, 1.0 - b_share)
    a_share = 1.0 - b_share - c_share
    hit.uv = geometry.uvs[face, 0] * a_share + geometry.uvs[face, 1] * b_share + geometry.uvs[face, 2] * c_share
    corner_normal = (
        geometry.normals[face, 0] * a_share + geometry.normals[face, 1] * b_share + geometry.normals[face, 2] * c_share
    )
    hit.normal = wp.normalize(wp.transform_vector(pose, wp.transform_vector(to_camera, corner_normal)))
    length = wp.length(ray)
    hit.distance = hit.z * length
    hit.place = wp.transform_point(pose, ray * hit.z)
    hit.slant = wp.max(wp.abs(along) / (wp.sqrt(squared_area) * length), 0.05)
    uv_ab = geometry.uvs[face, 1] - geometry.uvs[face, 0]
    uv_ac = geometry.uvs[face, 2] - geometry.uvs[face, 0]
    hit.stretch = wp.abs(uv_ab[0] * uv_ac[1] - uv_ab[1] * uv_ac[0]) / wp.sqrt(squared_area)
    return hit


@wp.func
def light_at(
    light: Light, shadows: SunShadows, near: Near, view: int, row: int, p: wp.vec3, n: wp.vec3, open_: float
) -> PointLight:
    """Return all light on a point with a normal, except from lamps that project a texture."""
    lit = PointLight()
    lit.open_ = open_
    facing = wp.dot(n, light.sun)
    if facing > 0.0:
        lit.sun = facing * sun_at(shadows, view, p, n)
    up = 0.5 + 0.5 * n[2]
    lit.light = light.sun_colour * lit.sun
    # Ambient light: hemispheres of sky and ground, weighted by how far the normal points up.
    lit.light += (light.zenith * (0.65 * up) + light.horizon * (0.35 * up)) * open_ + light.ground * (1.0 - up)
    if row >= 0:
        for entry in range(near.lamp_start[row], near.lamp_start[row + 1]):
            lamp_index = near.lamp_list[entry]
            if near.lamps[lamp_index].texture < 0:
                irradiance = lamp_at(near.lamps, lamp_index, near.shadows, p, n, light.fog)
                if irradiance > 0.0:
                    lit.light += near.lamps[lamp_index].light * (irradiance * open_)
    return lit


@wp.func
def reflected_light(
    light: Light,
    near: Near,
    row: int,
    surface: Surface,
    albedo: wp.vec3,
    emission: wp.vec3,
    hit: Hit,
    lit: PointLight,
    away: wp.vec3,
) -> SurfaceLight:
    """Return the light that a lit surface sends back along a unit ray: its own colour, reflections, and fog."""
    result = SurfaceLight()
    n = hit.normal
    p = hit.place
    colour = wp.cw_mul(albedo, lit.light) + emission
    gain = lit.light
    mirror = surface.specular
    gloss = surface.gloss
    if surface.paint == 1:
        mirror = 0.05
    wet = int(0)
    if light.wet > 0.0 and n[2] > 0.9:
        wet = 1
        # A film of water darkens the surface, and mirrors better the deeper it is.
        water_film = light.wet * wp.clamp(0.25 + 1.5 * (cloudy(p[0] * 0.35, p[1] * 0.35) - 0.3), 0.0, 1.0)
        darkening = 1.0 - 0.45 * light.wet
        colour = colour * darkening
        gain = gain * darkening
        mirror = wp.max(mirror, 0.02)
        gloss = wp.max(gloss, 0.35 * light.wet + 0.6 * water_film)
    sharpness = float(1.0)
    if wet == 1:
        sharpness = 0.1
    mirror_ray = away - n * (2.0 * wp.dot(n, away))
    grazing = 1.0 - wp.max(-wp.dot(n, away), 0.0)
    fresnel = grazing * grazing * grazing * grazing * grazing
    # Subtracting the first 2 % avoids a step where the mirror term begins.
    mirror_share = wp.max((mirror + (1.0 - mirror) * fresnel) * gloss - 0.02, 0.0) / 0.98
    if mirror_share > 0.0:
        colour = colour * (1.0 - mirror_share) + surroundings(light, mirror_ray, p, sharpness) * (
            mirror_share * lit.open_
        )
        gain = gain * (1.0 - mirror_share)
    if gloss > 0.2:
        power = 8.0 + 400.0 * gloss * gloss
        highlight = (mirror + fresnel) * gloss * 6.0
        if lit.sun > 0.0:
            colour += light.sun_colour * (wp.pow(wp.max(wp.dot(mirror_ray, light.sun), 0.0), power) * highlight)
        if light.lamps > 0.0 and row >= 0:
            # The mirror image of a lamp is stretched on a wet road, as by small waves.
            lobe_power = power
            if wet == 1:
                lobe_power = 60.0
            # Smaller cosines contribute less than a thousandth: skip the power function.
            min_cosine = 0.99 * wp.pow(0.001, 1.0 / lobe_power)
            for entry in range(near.lamp_start[row], near.lamp_start[row + 1]):
                lamp_index = near.lamp_list[entry]
                if near.lamps[lamp_index].texture < 0:
                    toward = wp.normalize(near.lamps[lamp_index].place - p)
                    alignment = wp.dot(mirror_ray, toward)
                    if alignment > min_cosine:
                        shine = wp.pow(alignment, lobe_power)
                        if shine > 0.001:
                            irradiance = lamp_at(near.lamps, lamp_index, near.shadows, p, toward, light.fog)
                            colour += near.lamps[lamp_index].light * (irradiance * shine * highlight * 0.5)
    if light.fog > 0.0:
        transmission = wp.exp(-light.fog * hit.distance)
        colour = colour * transmission + light.horizon * (1.0 - transmission)
        gain = gain * transmission
    result.colour = colour
    result.gain = gain
    return result


@wp.func
def list_fragment(out: Output, fragment: Fragment):
    """List a fragment if there is room."""
    # Fragments beyond the room are still counted, so that `render` can report the overflow.
    position = wp.atomic_add(out.found, 0, 1)
    if position < out.fragments.shape[0]:
        out.fragments[position] = fragment


@wp.func
def project(
    out: Output,
    near: Near,
    row: int,
    fragment: Fragment,
    hit: Hit,
    albedo: wp.vec3,
    through: wp.vec3,
    span: float,
    open_: float,
    fog: float,
):
    """List the fragments of lamps that project a texture onto a pixel.

    through: share of the light that the surface sends on to the camera; span: area of the surface in the pixel,
    m^2.
    """
    for entry in range(near.lamp_start[row], near.lamp_start[row + 1]):
        lamp_index = near.lamp_list[entry]
        if near.lamps[lamp_index].texture >= 0:
            irradiance = lamp_at(near.lamps, lamp_index, near.shadows, hit.place, hit.normal, fog)
            if irradiance > 0.0:
                lamp = near.lamps[lamp_index]
                spot = spot_of(lamp, hit.place, hit.normal)
                piece = fragment
                piece.texture = lamp.texture
                piece.u = 0.5 + 0.5 * spot[0]
                piece.v = 0.5 + 0.5 * spot[1]
                piece.area = spot[2] * span
                piece.light = wp.cw_mul(wp.cw_mul(albedo, through), lamp.light) * (irradiance * open_)
                list_fragment(out, piece)


@wp.func
def remaining_own_colour(all: Layers, view: int, draw: int, wearable: int, hit: Hit, tag: int) -> float:
    """Return the share of a surface's own colour that its layers and the decals leave."""
    remaining = float(1.0)
    if wearable == 1:
        for index in range(all.start[draw], all.start[draw + 1]):
            remaining = remaining * (1.0 - on_layer(all, all.layers[index], hit.uv)[2])
    for index in range(all.decal_start[view], all.decal_start[view + 1]):
        remaining = remaining * (1.0 - on_decal(all, all.decals[index], hit.place, hit.normal, tag)[2])
    return remaining


@wp.func
def list_layer_fragments(
    out: Output,
    all: Layers,
    view: int,
    draw: int,
    wearable: int,
    fragment: Fragment,
    hit: Hit,
    tag: int,
    gain: wp.vec3,
    span: float,
):
    """List the fragments of decals and layers in a pixel, from the top down.

    span: area of the surface in the pixel, m^2.
    """
    remaining = float(1.0)
    count = all.decal_start[view + 1] - all.decal_start[view]
    # From the top down: each texture hides part of the ones below it.
    for index in range(count):
        decal = all.decals[all.decal_start[view + 1] - 1 - index]
        lookup = on_decal(all, decal, hit.place, hit.normal, tag)
        if lookup[2] > 0.0:
            piece = fragment
            piece.texture = decal.texture
            piece.u = lookup[0]
            piece.v = lookup[1]
            piece.area = span * wp.abs(wp.dot(hit.normal, decal.ahead)) / decal.area
            piece.light = gain * (remaining * lookup[2])
            list_fragment(out, piece)
            remaining = remaining * (1.0 - lookup[2])
    if wearable == 1:
        count = all.start[draw + 1] - all.start[draw]
        for index in range(count):
            layer = all.layers[all.start[draw + 1] - 1 - index]
            lookup = on_layer(all, layer, hit.uv)
            if lookup[2] > 0.0:
                piece = fragment
                piece.texture = layer.texture
                piece.u = lookup[0]
                piece.v = lookup[1]
                piece.area = hit.stretch / ((layer.box[2] - layer.box[0]) * (layer.box[3] - layer.box[1])) * span
                piece.light = gain * (remaining * lookup[2])
                list_fragment(out, piece)
                remaining = remaining * (1.0 - lookup[2])


@wp.func
def shade_pixel(
    geometry: Geometry,
    draw_samples: DrawRanges,
    layers: Layers,
    focal: wp.vec4,
    pose: wp.mat44,
    light: Light,
    shadows: SunShadows,
    near: Near,
    projecting: int,
    scale: int,
    out: Output,
    view: int,
    y: int,
    x: int,
):
    """Shade one pixel, see `shade`."""
    total = wp.vec3(0.0, 0.0, 0.0)
    best = int(0)
    best_tag = int(-1)
    best_depth = float(wp.inf)
    count = scale * scale
    sample_size = 1.0 / float(scale)
    eye = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
    # The lower half of a key identifies the triangle, 0 the sky.
    top_row = y * scale
    left_column = x * scale
    first_key = draw_samples.samples[view, top_row, left_column] & LAST
    different_count = int(0)
    for dy in range(scale):
        for dx in range(scale):
            if (draw_samples.samples[view, top_row + dy, left_column + dx] & LAST) != first_key:
                different_count += 1
    # Most pixels show one triangle: a single evaluation is enough.
    evaluations = count
    if different_count == 0:
        evaluations = 1
    for sample in range(evaluations):
        key = first_key
        covered = count
        sum_x = 0.5 * float(count * (scale - 1))
        sum_y = sum_x
        is_first = int(1)
        if different_count > 0:
            # A triangle is shaded at its first sample.
            key = draw_samples.samples[view, top_row + sample / scale, left_column + sample % scale] & LAST
            covered = int(0)
            sum_x = float(0.0)
            sum_y = float(0.0)
            sample_index = int(0)
            for dy in range(scale):
                for dx in range(scale):
                    if (draw_samples.samples[view, top_row + dy, left_column + dx] & LAST) == key:
                        if sample_index < sample:
                            is_first = 0
                        covered += 1
                        sum_x += float(dx)
                        sum_y += float(dy)
                    sample_index += 1
        if is_first == 1:
            u = float(x) + (sum_x / float(covered) + 0.5) * sample_size - 0.5
            v = float(y) + (sum_y / float(covered) + 0.5) * sample_size - 0.5
            ray = wp.vec3((u - focal[2]) / focal[0], (v - focal[3]) / focal[1], 1.0)
            away = wp.normalize(wp.transform_vector(pose, ray))
            colour = wp.vec3(0.0, 0.0, 0.0)
            surface_tag = int(-1)
            z = float(wp.inf)
            if key == wp.uint64(0):
                colour = sky(light, away, 1)
                if light.fog > 0.0:
                    veil = wp.exp(-light.fog * 300.0 / (0.15 + wp.max(away[2], 0.0) * 3.0))
                    colour = colour * veil + light.horizon * (1.0 - veil)
            else:
                slot = int(LAST - key)
                hit = hit_of(geometry, draw_samples, slot, ray, pose)
                z = hit.z
                surface_tag = draw_samples.tags[hit.draw]
                surface = geometry.surfaces[geometry.material[hit.face]]
                albedo = surface.colour
                if surface.paint == 1:
                    albedo = draw_samples.paints[hit.draw]
                albedo = textured(surface, albedo, hit.uv, hit.distance / (focal[0] * hit.slant))
                if layers.any == 1:
                    albedo = albedo * remaining_own_colour(
                        layers, view, hit.draw, geometry.wearable[hit.face], hit, surface_tag
                    )
                row = cell_of(hit.place, eye)
                open_ = float(1.0)
                if row >= 0:
                    row = view * CELLS * CELLS + row
                    if hit.normal[2] > 0.7:
                        open_ = openness(near, row, hit.place)
                lit = light_at(light, shadows, near, view, row, hit.place, hit.normal, open_)
                side = float(0.0)
                if surface.lamp > 0:
                    to_camera = draw_samples.matrices[hit.draw]
                    leftward = wp.vec3(to_camera[0, 1], to_camera[1, 1], to_camera[2, 1])
                    side = wp.dot(leftward, ray * hit.z - wp.vec3(to_camera[0, 3], to_camera[1, 3], to_camera[2, 3]))
                emission = lamp_emission(
                    surface, draw_samples.lit[hit.draw], side, draw_samples.split[hit.draw], light.lamps
                )
                shaded = reflected_light(light, near, row, surface, albedo, emission, hit, lit, away)
                colour = shaded.colour
                share = float(covered) / float(count)
                if layers.any == 1 or (projecting == 1 and row >= 0):
                    piece = Fragment()
                    piece.place = (view * out.radiance.shape[1] + y) * out.radiance.shape[2] + x
                    piece.slot = slot
                    # surface area that the pixel spans
                    span = hit.distance * hit.distance / (focal[0] * focal[1] * hit.slant)
                    span = span / (wp.length(ray) * wp.dot(ray, ray))
                    gain = shaded.gain * share
                    if layers.any == 1:
                        list_layer_fragments(
                            out,
                            layers,
                            view,
                            hit.draw,
                            geometry.wearable[hit.face],
                            piece,
                            hit,
                            surface_tag,
                            gain,
                            span,
                        )
                    if projecting == 1 and row >= 0:
                        through = wp.cw_div(gain, wp.max(lit.light, wp.vec3(1.0e-6, 1.0e-6, 1.0e-6)))
                        project(out, near, row, piece, hit, albedo, through, span, open_, light.fog)
                if out.surface == 1 and (covered > best or (covered == best and z < best_depth)):
                    out.albedo[view, y, x] = albedo
                    out.normal[view, y, x] = hit.normal
                    out.irradiance[view, y, x] = lit.light
                    out.gain[view, y, x] = shaded.gain * share
            total = total + colour * float(covered)
            if covered > best or (covered == best and z < best_depth):
                best = covered
                best_tag = surface_tag
                best_depth = z
    out.radiance[view, y, x] = total / float(count)
    out.tag[view, y, x] = best_tag
    out.depth[view, y, x] = best_depth


@wp.kernel(cuda_max_registers=REGISTERS)
def shade(
    geometry: Geometry,
    draw_samples: DrawRanges,
    layers: Layers,
    lens: wp.array(dtype=wp.vec4),
    to_world: wp.array(dtype=wp.mat44),
    lights: wp.array(dtype=Light),
    shadows: SunShadows,
    near: Near,
    projecting: int,
    scale: int,
    lanes: int,
    out: Output,
):
    """Compute linear light, tag of the surface that covers most of a pixel (-1 sky) and depth (inf sky).

    The radiance is without layers and decals, as if they were black; they are listed as fragments in any order,
    and so is the light that texture-projecting lamps add to a surface's own colour (`projecting`: 1 if any).
    See `Output`.

    Each row has `lanes` threads, which take its pixels in turn: as many as pixels on a GPU, one on a CPU, where
    every thread copies all the arguments anew.
    """
    view, y, lane = wp.tid()
    focal = lens[view]
    light = lights[view]
    pose = to_world[view]
    for x in range(lane, out.radiance.shape[2], lanes):
        shade_pixel(
            geometry, draw_samples, layers, focal, pose, light, shadows, near, projecting, scale, out, view, y, x
        )  # fmt: skip

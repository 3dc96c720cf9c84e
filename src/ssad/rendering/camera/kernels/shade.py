"""Shading: light from each sample, averaged to pixels; linear in the colour of every surface.

One evaluation a pixel and triangle, at the mean of the samples that the triangle covers. Sun with two shadow maps
(one fine, around the focus), ambient light of sky and ground with contact occlusion, lamps, a mirror term for glass,
paint and wet roads, fog and haze by distance.
"""

import warp as wp

from ssad.rendering.camera.kernels.layers import Fragment, Layers, on_decal, on_layer
from ssad.rendering.camera.kernels.light import CELLS, Near, cell_of, lamp_at, lamp_emission, openness, spot_of
from ssad.rendering.camera.kernels.matter import GLASS, Surface, textured
from ssad.rendering.camera.kernels.probe import ROUGH, Probes, mirrored_light
from ssad.rendering.camera.kernels.raster import LAST, REGISTERS
from ssad.rendering.camera.kernels.shadow import SunMap, soft_share, sun_share
from ssad.rendering.camera.kernels.sky import Light, air_transmission, cloudy, sky, surroundings

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


PANES = wp.constant(0.17)  # share of the light that a window with two panes mirrors, seen straight on
ROOM = wp.constant(0.4)  # share of a window's own colour that remains of it in front of a dark room
POOL = wp.constant(0.06)  # m above or below the road's level: water there mirrors what stands on the road
WAVES = wp.constant(0.16)  # rad: blur of the mirror image in the thinnest film of water
FAINTEST = wp.constant(0.002)  # share of light below which a surface mirrors nothing of a probe
MIRRORED_TEXTURE = wp.constant(0.35)  # albedo that stands for a texture in mirror images


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
    """Shadow maps of the sun: one wide, one fine.

    Attributes:
        wide: Reaches far.
        fine: Lies around the focus.
        soft: 1 where shadows have a penumbra.
    """

    wide: SunMap
    fine: SunMap
    soft: int


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
        wet: 1 if the following three are exported for the reflections of wet roads, [B, H, W] each.
        mirror: What the pixel's water mirrors, RGB, and the share that it mirrors.
        spread: Blur of the mirror image, rad.
        source: Radiance as water mirrors it, with grey in place of textures.
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
    wet: int
    mirror: wp.array3d(dtype=wp.vec4)
    spread: wp.array3d(dtype=float)
    source: wp.array3d(dtype=wp.vec3)


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
    """Light that a surface sends to the camera.

    Attributes:
        colour: All of it.
        gain: Gain per unit of albedo.
        mirror: Part that water on the ground mirrors, RGB, and the share that it mirrors.
        spread: Blur of the mirror image in that water, rad.
    """

    colour: wp.vec3
    gain: wp.vec3
    mirror: wp.vec4
    spread: float


@wp.func(inline=True)
def sun_at(shadows: SunShadows, view: int, p: wp.vec3, n: wp.vec3) -> float:
    """Return the share of the sun that reaches a point with a normal, by the fine map if it contains the point."""
    if shadows.soft == 1:
        share = soft_share(shadows.fine, view, p, n)
        if share < 0.0:
            share = soft_share(shadows.wide, view, p, n)
    else:
        texel = shadows.fine.texel
        # The offset along the normal keeps a surface from shading itself.
        share = sun_share(
            shadows.fine.keys, view, wp.transform_point(shadows.fine.to_texels[view], p + n * (texel * 1.5)), texel
        )
        if share < 0.0:
            texel = shadows.wide.texel
            share = sun_share(
                shadows.wide.keys, view, wp.transform_point(shadows.wide.to_texels[view], p + n * (texel * 1.5)), texel
            )
    if share < 0.0:
        share = 1.0
    return share


@wp.func(inline=True)
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


@wp.func(inline=True)
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


@wp.func(inline=True)
def reflected_light(
    light: Light,
    near: Near,
    probes: Probes,
    view: int,
    mirrors_picture: int,
    row: int,
    surface: Surface,
    albedo: wp.vec3,
    emission: wp.vec3,
    hit: Hit,
    lit: PointLight,
    away: wp.vec3,
) -> SurfaceLight:
    """Return the light that a lit surface sends back along a unit ray: its own colour, reflections, and fog.

    mirrors_picture: 1 where the mirror image of the picture in water on the ground is added later.
    """
    result = SurfaceLight()
    n = hit.normal
    p = hit.place
    colour = wp.cw_mul(albedo, lit.light) + emission
    gain = lit.light
    mirror = surface.specular
    gloss = surface.gloss
    if surface.paint == 1:
        mirror = 0.05
    if probes.is_on == 1 and surface.pattern == GLASS:
        mirror = PANES
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
        image = wp.vec3(0.0, 0.0, 0.0)
        if probes.is_on == 0:
            image = surroundings(light, mirror_ray, p, sharpness)
        elif mirror_share > FAINTEST:
            roughness = 1.0 - gloss
            if wet == 1 and mirrors_picture == 1:
                # The mirror image of the picture will replace most of this.
                roughness = wp.max(roughness, ROUGH)
            image = mirrored_light(probes, view, mirror_ray, p, roughness)
        colour = colour * (1.0 - mirror_share) + image * (mirror_share * lit.open_)
        gain = gain * (1.0 - mirror_share)
        if wet == 1 and wp.abs(p[2]) < POOL:
            image = image * (mirror_share * lit.open_)
            result.mirror = wp.vec4(image[0], image[1], image[2], mirror_share)
            result.spread = WAVES * (1.0 - gloss)
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
    if light.haze > 0.0:
        clearness = air_transmission(light, hit.distance)
        colour = wp.cw_mul(colour, clearness) + wp.cw_mul(light.horizon, wp.vec3(1.0, 1.0, 1.0) - clearness)
        gain = wp.cw_mul(gain, clearness)
        result.mirror = result.mirror * clearness[1]
    elif light.fog > 0.0:
        transmission = wp.exp(-light.fog * hit.distance)
        colour = colour * transmission + light.horizon * (1.0 - transmission)
        gain = gain * transmission
        result.mirror = result.mirror * transmission
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


@wp.func(inline=True)
def shade_pixel(
    geometry: Geometry,
    draw_samples: DrawRanges,
    layers: Layers,
    focal: wp.vec4,
    pose: wp.mat44,
    light: Light,
    shadows: SunShadows,
    near: Near,
    probes: Probes,
    projecting: int,
    scale: int,
    out: Output,
    view: int,
    y: int,
    x: int,
):
    """Shade one pixel, see `shade`."""
    total = wp.vec3(0.0, 0.0, 0.0)
    total_mirror = wp.vec4(0.0, 0.0, 0.0, 0.0)
    hidden_part = wp.vec3(0.0, 0.0, 0.0)
    spread = float(0.0)
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
                if probes.is_on == 1 and surface.pattern == GLASS:
                    albedo = albedo * ROOM
                remaining = float(1.0)
                if layers.any == 1:
                    remaining = remaining_own_colour(
                        layers, view, hit.draw, geometry.wearable[hit.face], hit, surface_tag
                    )
                    albedo = albedo * remaining
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
                shaded = reflected_light(
                    light, near, probes, view, out.wet, row, surface, albedo, emission, hit, lit, away
                )
                colour = shaded.colour
                share = float(covered) / float(count)
                if out.wet == 1:
                    if shaded.mirror[3] > 0.0:
                        total_mirror += shaded.mirror * share
                        spread = shaded.spread
                    if layers.any == 1:
                        hidden_part += shaded.gain * (share * MIRRORED_TEXTURE * (1.0 - remaining))
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
    if out.wet == 1:
        out.mirror[view, y, x] = total_mirror
        out.spread[view, y, x] = spread
        out.source[view, y, x] = total / float(count) + hidden_part


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
    probes: Probes,
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
            geometry,
            draw_samples,
            layers,
            focal,
            pose,
            light,
            shadows,
            near,
            probes,
            projecting,
            scale,
            out,
            view,
            y,
            x,
        )

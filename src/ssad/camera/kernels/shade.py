"""Shading: what light comes from each sample, averaged to pixels. Linear in the colour of every surface.

One evaluation a pixel and triangle, at the mean of the samples that the triangle covers. Sun with shadow map, sky and
ground as ambient light, a mirror term for glass and paint, lamps by night, fog by distance.
"""

import warp as wp

from ssad.camera.kernels.raster import LAST, draw_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PLAIN = wp.constant(0)
GRAIN = wp.constant(1)  # asphalt, concrete: fine noise and large patches
LEAF = wp.constant(2)  # leaves, grass: strong noise
BRICK = wp.constant(3)  # courses of bricks, in metres
SLAB = wp.constant(4)  # paving slabs
TILE = wp.constant(5)  # roof tiles, boards
GLASS = wp.constant(6)


@wp.struct
class Surface:
    """A material: linear albedo, mirror share, gloss, emission, 1 where it takes the paint, pattern."""

    colour: wp.vec3
    specular: float
    gloss: float
    emission: float
    paint: int
    pattern: int


@wp.struct
class Fragment:
    """A piece of a textured surface in a pixel: its light is what the pixel gains per unit of the texture's colour.

    place: view, row and column in one number; slot: the triangle's; u, v in the texture's rectangle, 0 to 1; area:
    share of the texture that the pixel spans; light: RGB.
    """

    place: int
    slot: int
    texture: int
    u: float
    v: float
    area: float
    light: wp.vec3


@wp.struct
class Light:
    """Light of a view: unit vector to the sun, its colour (irradiance / pi), sky overhead and at the horizon, light
    from the ground; extinction of fog, 1/m; clouds in 0..1; wet in 0..1; lamps: strength of head lamps and street
    lamps; turn: offset of the clouds."""

    sun: wp.vec3
    sun_colour: wp.vec3
    zenith: wp.vec3
    horizon: wp.vec3
    ground: wp.vec3
    fog: float
    clouds: float
    wet: float
    lamps: float
    turn: float


@wp.func
def speck(x: int, y: int) -> float:
    """A fixed random number in [0, 1) for a cell."""
    h = wp.uint32(x) * wp.uint32(374761393) + wp.uint32(y) * wp.uint32(668265263)
    h = (h ^ (h >> wp.uint32(13))) * wp.uint32(1274126177)
    h = h ^ (h >> wp.uint32(16))
    return float(h & wp.uint32(65535)) / 65536.0


@wp.func
def cloudy(x: float, y: float) -> float:
    """Smooth noise in [0, 1] with unit cells."""
    i = wp.floor(x)
    j = wp.floor(y)
    u = x - i
    v = y - j
    u = u * u * (3.0 - 2.0 * u)
    v = v * v * (3.0 - 2.0 * v)
    a = int(i)
    b = int(j)
    low = speck(a, b) * (1.0 - u) + speck(a + 1, b) * u
    high = speck(a, b + 1) * (1.0 - u) + speck(a + 1, b + 1) * u
    return low * (1.0 - v) + high * v


@wp.func
def sky(light: Light, ray: wp.vec3, fine: int) -> wp.vec3:
    """Light from a direction of the sky (unit vector, world)."""
    up = wp.max(ray[2], 0.0)
    mix = wp.sqrt(up)
    colour = light.horizon * (1.0 - mix) + light.zenith * mix
    if fine == 1 and ray[2] > 0.0:
        # a layer of clouds high above
        reach = 3.0 / (ray[2] + 0.12)
        x = ray[0] * reach + light.turn
        y = ray[1] * reach
        form = cloudy(x, y) * 0.55 + cloudy(x * 2.3, y * 2.3) * 0.3 + cloudy(x * 5.1, y * 5.1) * 0.15
        amount = wp.clamp((form - 1.0 + light.clouds * 1.05) * 3.0, 0.0, 1.0) * wp.min(up * 8.0, 1.0)
        white = light.horizon * 0.9 + light.sun_colour * 0.25
        colour = colour * (1.0 - amount) + white * amount
        toward = wp.dot(ray, light.sun)
        if toward > 0.0:
            glow = wp.pow(toward, 64.0) * 0.35 + wp.pow(toward, 2000.0) * 40.0
            colour = colour + light.sun_colour * glow * (1.0 - 0.9 * light.clouds)
    return colour


@wp.func
def sunlit(shadows: wp.array3d(dtype=wp.uint64), view: int, p: wp.vec3, bias: float) -> float:
    """Share of the sun that reaches a point given in texels and metres along the light: four texels, weighted."""
    size = shadows.shape[1]
    if size < 4:
        return 1.0
    x = p[0] - 0.5
    y = p[1] - 0.5
    i = int(wp.floor(x))
    j = int(wp.floor(y))
    if i < 0 or j < 0 or i >= size - 1 or j >= size - 1:
        return 1.0
    u = x - float(i)
    v = y - float(j)
    depth = (1.0e3 - p[2] + bias) * 1.0e-3
    total = float(0.0)
    if wp.cast(wp.uint32(shadows[view, j, i] >> wp.uint64(32)), float) <= depth:
        total += (1.0 - u) * (1.0 - v)
    if wp.cast(wp.uint32(shadows[view, j, i + 1] >> wp.uint64(32)), float) <= depth:
        total += u * (1.0 - v)
    if wp.cast(wp.uint32(shadows[view, j + 1, i] >> wp.uint64(32)), float) <= depth:
        total += (1.0 - u) * v
    if wp.cast(wp.uint32(shadows[view, j + 1, i + 1] >> wp.uint64(32)), float) <= depth:
        total += u * v
    return total


@wp.func
def textured(surface: Surface, albedo: wp.vec3, uv: wp.vec2, fine: float) -> wp.vec3:
    """Albedo with the pattern of the material; `fine` is metres a pixel, so that what is too small fades out."""
    if surface.pattern == PLAIN or surface.pattern == GLASS:
        return albedo
    factor = float(1.0)
    if surface.pattern == GRAIN:
        factor = 0.86 + 0.28 * cloudy(uv[0] * 0.23, uv[1] * 0.23)
        if fine < 0.06:
            factor = factor * (0.85 + 0.3 * cloudy(uv[0] * 21.0, uv[1] * 21.0))
    elif surface.pattern == LEAF:
        factor = 0.75 + 0.5 * cloudy(uv[0] * 1.3, uv[1] * 1.3)
        if fine < 0.2:
            factor = factor * (0.7 + 0.6 * cloudy(uv[0] * 9.0, uv[1] * 9.0))
    else:
        wide = float(0.25)
        tall = float(0.08)
        joint = float(0.012)
        if surface.pattern == SLAB:
            wide = 0.6
            tall = 0.6
            joint = 0.015
        if surface.pattern == TILE:
            wide = 0.3
            tall = 0.22
            joint = 0.02
        row = wp.floor(uv[1] / tall)
        x = uv[0] / wide
        if surface.pattern != SLAB:
            x = x + 0.5 * (row - 2.0 * wp.floor(row * 0.5))
        column = wp.floor(x)
        keep = wp.clamp(1.5 - fine / tall * 2.0, 0.0, 1.0)
        factor = 1.0 + (speck(int(column), int(row)) - 0.5) * 0.35 * keep
        edge = wp.min((x - column) * wide, (uv[1] / tall - row) * tall)
        if edge < joint:
            factor = factor * (1.0 - 0.35 * keep)
    return albedo * factor


@wp.kernel
def shade(
    samples: wp.array3d(dtype=wp.uint64),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array2d(dtype=int),
    normals: wp.array2d(dtype=wp.vec3),
    uvs: wp.array2d(dtype=wp.vec2),
    material: wp.array(dtype=int),
    surfaces: wp.array(dtype=Surface),
    listed: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    firsts: wp.array(dtype=int),
    matrices: wp.array(dtype=wp.mat44),
    paints: wp.array(dtype=wp.vec3),
    tags: wp.array(dtype=int),
    textures: wp.array(dtype=int),
    rectangles: wp.array(dtype=wp.vec4),
    wearable: wp.array(dtype=int),
    lens: wp.array(dtype=wp.vec4),
    to_world: wp.array(dtype=wp.mat44),
    lights: wp.array(dtype=Light),
    shadows: wp.array3d(dtype=wp.uint64),
    to_shadow: wp.array(dtype=wp.mat44),
    texel: float,
    scale: int,
    radiance: wp.array3d(dtype=wp.vec3),
    tag: wp.array3d(dtype=int),
    depth: wp.array3d(dtype=float),
    fragments: wp.array(dtype=Fragment),
    found: wp.array(dtype=int),
):
    """Linear light [B, H, W], tag of what covers most of a pixel (-1 sky), depth along the axis (inf sky).

    Textured surfaces are black in `radiance`; their pieces are listed in `fragments`, in any order, `found` of them.
    """
    view, y, x = wp.tid()
    focal = lens[view]
    light = lights[view]
    pose = to_world[view]
    total = wp.vec3(0.0, 0.0, 0.0)
    best = int(0)
    seen = int(-1)
    far = float(wp.inf)
    count = scale * scale
    step = 1.0 / float(scale)
    eye = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])
    # the lower half of a key names the triangle, 0 the sky
    whole = int(1)
    name = samples[view, y * scale, x * scale] & LAST
    for s in range(1, count):
        if (samples[view, y * scale + s / scale, x * scale + s % scale] & LAST) != name:
            whole = 0
    rounds = count
    if whole == 1:
        rounds = 1
    for s in range(rounds):
        key = samples[view, y * scale + s / scale, x * scale + s % scale] & LAST
        # a triangle is shaded where it comes first
        fresh = int(1)
        for e in range(s):
            if (samples[view, y * scale + e / scale, x * scale + e % scale] & LAST) == key:
                fresh = 0
        if fresh == 1:
            covered = int(0)
            px = float(0.0)
            py = float(0.0)
            if whole == 1:
                covered = count
                px = 0.5 * float(count * (scale - 1))
                py = px
            else:
                for e in range(s, count):
                    if (samples[view, y * scale + e / scale, x * scale + e % scale] & LAST) == key:
                        covered += 1
                        px += float(e % scale)
                        py += float(e / scale)
            u = float(x) + (px / float(covered) + 0.5) * step - 0.5
            v = float(y) + (py / float(covered) + 0.5) * step - 0.5
            ray = wp.vec3((u - focal[2]) / focal[0], (v - focal[3]) / focal[1], 1.0)
            away = wp.transform_vector(pose, ray)
            length = wp.length(away)
            away = away / length
            colour = wp.vec3(0.0, 0.0, 0.0)
            mine = int(-1)
            z = float(wp.inf)
            if key == wp.uint64(0):
                colour = sky(light, away, 1)
                if light.fog > 0.0:
                    veil = wp.exp(-light.fog * 300.0 / (0.15 + wp.max(away[2], 0.0) * 3.0))
                    colour = colour * veil + light.horizon * (1.0 - veil)
            else:
                slot = int(LAST - key)
                draw = draw_of(starts, slot / 2)
                face = listed[firsts[draw] + slot / 2 - starts[draw]]
                m = matrices[draw]
                mine = tags[draw]
                a = wp.transform_point(m, vertices[faces[face, 0]])
                b = wp.transform_point(m, vertices[faces[face, 1]])
                c = wp.transform_point(m, vertices[faces[face, 2]])
                # where the ray meets the plane, in shares of the corners
                ab = b - a
                ac = c - a
                plane = wp.cross(ab, ac)
                along = wp.dot(plane, ray)
                if wp.abs(along) < 1.0e-12:
                    along = -1.0e-12
                z = wp.clamp(wp.dot(plane, a) / along, 0.05, 2.0e3)
                hit = ray * z - a
                square = wp.dot(plane, plane)
                sb = wp.clamp(wp.dot(wp.cross(hit, ac), plane) / square, 0.0, 1.0)
                sc = wp.clamp(wp.dot(wp.cross(ab, hit), plane) / square, 0.0, 1.0 - sb)
                sa = 1.0 - sb - sc
                uv = uvs[face, 0] * sa + uvs[face, 1] * sb + uvs[face, 2] * sc
                bent = normals[face, 0] * sa + normals[face, 1] * sb + normals[face, 2] * sc
                n = wp.normalize(wp.transform_vector(pose, wp.transform_vector(m, bent)))
                surface = surfaces[material[face]]
                albedo = surface.colour
                if surface.paint == 1:
                    albedo = paints[draw]
                distance = z * length
                worn = textures[draw]
                tx = float(0.0)
                ty = float(0.0)
                if worn >= 0:
                    box = rectangles[draw]
                    tx = (uv[0] - box[0]) / (box[2] - box[0])
                    ty = (uv[1] - box[1]) / (box[3] - box[1])
                    if wearable[face] == 0 or tx < 0.0 or tx > 1.0 or ty < 0.0 or ty > 1.0:
                        worn = -1
                albedo = textured(surface, albedo, uv, distance / focal[0])
                if worn >= 0:
                    albedo = wp.vec3(0.0, 0.0, 0.0)
                p = eye + away * distance
                facing = wp.dot(n, light.sun)
                direct = float(0.0)
                if facing > 0.0:
                    q = wp.transform_point(to_shadow[view], p + n * (texel * 1.5))
                    direct = facing * sunlit(shadows, view, q, texel)
                open = 0.5 + 0.5 * n[2]
                around = light.zenith * (0.65 * open) + light.horizon * (0.35 * open) + light.ground * (1.0 - open)
                # near the ground beneath things less of the sky is seen: folded into the shadow of the sun
                lamp = light.lamps * wp.max(-wp.dot(n, away), 0.0) * 14.0 / (distance * distance + 8.0)
                lit = light.sun_colour * direct + around + wp.vec3(1.0, 0.95, 0.85) * lamp
                colour = wp.cw_mul(albedo, lit) + albedo * surface.emission
                gain = lit * (float(covered) / float(count))
                # mirror: the sky above, the street below
                mirror = surface.specular
                if surface.paint == 1:
                    mirror = 0.05
                if light.wet > 0.0 and n[2] > 0.9:
                    mirror = mirror + 0.05 * light.wet
                    colour = colour * (1.0 - 0.4 * light.wet)
                    gain = gain * (1.0 - 0.4 * light.wet)
                back = away - n * (2.0 * wp.dot(n, away))
                glance = 1.0 - wp.max(-wp.dot(n, away), 0.0)
                fresnel = glance * glance * glance * glance * glance
                mirror = (mirror + (1.0 - mirror) * fresnel) * surface.gloss
                if mirror > 0.02:
                    image = light.ground
                    if back[2] > 0.0:
                        image = sky(light, back, 0)
                    colour = colour * (1.0 - mirror) + image * mirror
                    gain = gain * (1.0 - mirror)
                if direct > 0.0 and surface.gloss > 0.2:
                    shine = wp.max(wp.dot(back, light.sun), 0.0)
                    power = 8.0 + 400.0 * surface.gloss * surface.gloss
                    colour = colour + light.sun_colour * (
                        wp.pow(shine, power) * (surface.specular + fresnel) * surface.gloss * 6.0
                    )
                if light.fog > 0.0:
                    clear = wp.exp(-light.fog * distance)
                    colour = colour * clear + light.horizon * (1.0 - clear)
                    gain = gain * clear
                if worn >= 0:
                    at = wp.atomic_add(found, 0, 1)
                    if at < fragments.shape[0]:
                        piece = Fragment()
                        piece.place = (view * radiance.shape[1] + y) * radiance.shape[2] + x
                        piece.slot = slot
                        piece.texture = worn
                        piece.u = tx
                        piece.v = ty
                        box = rectangles[draw]
                        ua = uvs[face, 1] - uvs[face, 0]
                        ub = uvs[face, 2] - uvs[face, 0]
                        flat = wp.abs(ua[0] * ub[1] - ua[1] * ub[0]) / ((box[2] - box[0]) * (box[3] - box[1]))
                        # area of the surface that the pixel spans, over the area of the triangle, times its texture
                        slant = wp.abs(along) / (wp.sqrt(square) * length)
                        span = distance * distance / (focal[0] * focal[1]) / wp.max(slant, 0.05) / (length * length)
                        piece.area = flat / wp.sqrt(square) * span * length
                        piece.light = gain
                        fragments[at] = piece
            total = total + colour * float(covered)
            if covered > best or (covered == best and z < far):
                best = covered
                seen = mine
                far = z
    radiance[view, y, x] = total / float(count)
    tag[view, y, x] = seen
    depth[view, y, x] = far


@wp.kernel
def develop(
    radiance: wp.array3d(dtype=wp.vec3),
    exposure: wp.array(dtype=float),
    noise: wp.array(dtype=wp.vec2),
    seed: wp.array(dtype=int),
    curve: wp.array(dtype=wp.uint8),
    out: wp.array4d(dtype=wp.uint8),
):
    """Linear light to 8 bits: exposure, noise, then the camera's curve, listed over the square root of light in 0..4.

    noise: variance for each unit of light (of photons), and deviation without light (of reading).
    """
    b, y, x = wp.tid()
    light = radiance[b, y, x] * exposure[b]
    amount = noise[b]
    if amount[0] + amount[1] > 0.0:
        state = wp.rand_init(seed[b], y * out.shape[2] + x)
        for c in range(3):
            spread = wp.sqrt(amount[0] * wp.max(light[c], 0.0) + amount[1] * amount[1])
            light[c] = light[c] + spread * wp.randn(state)
    for c in range(3):
        v = wp.sqrt(wp.clamp(light[c], 0.0, 3.999)) * 0.5 * float(curve.shape[0])
        out[b, y, x, c] = curve[int(v)]

"""Textures on bodies and decals in the world: position and opacity."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Fragment:
    """Piece of a textured surface, or of a surface onto which a lamp projects a texture, within a pixel.

    Attributes:
        place: View, row and column in one number.
        slot: Slot of the triangle.
        texture: Index of the texture.
        u: Position in the texture's rectangle, 0 to 1.
        v: The same downwards.
        area: Share of the texture that the pixel spans.
        light: Gain of the pixel per unit of the texture's colour, RGB.
    """

    place: int
    slot: int
    texture: int
    u: float
    v: float
    area: float
    light: wp.vec3


@wp.struct
class Layer:
    """Texture on a body.

    Attributes:
        texture: Index of the texture.
        box: Rectangle of the atlas that it covers: u0, v0, u1, v1.
        opacity: 0 to 1.
        mask: First entry of its opacities in `Layers.masks`; -1 where the opacity is even.
        columns: Columns of the mask.
        rows: Rows of the mask.
    """

    texture: int
    box: wp.vec4
    opacity: float
    mask: int
    columns: int
    rows: int


@wp.struct
class Decal:
    """Texture on all surfaces within a box in the world.

    Attributes:
        texture: Index of the texture.
        place: Middle of the box, m.
        across: Unit vector across the texture, divided by half its width.
        down: Unit vector down the texture, divided by half its height.
        ahead: Unit vector into the surface.
        depth: Half the depth of the box, m.
        area: Area of the texture, m^2.
        tag: Tag of the only body that wears it; -1 for any.
        opacity: 0 to 1.
        mask: See `Layer`.
        columns: See `Layer`.
        rows: See `Layer`.
    """

    texture: int
    place: wp.vec3
    across: wp.vec3
    down: wp.vec3
    ahead: wp.vec3
    depth: float
    area: float
    tag: int
    opacity: float
    mask: int
    columns: int
    rows: int


@wp.struct
class Layers:
    """Layers of all draws and decals of all views; decals are above layers.

    Attributes:
        layers: The layers of each draw, bottom first.
        start: The layers of draw d begin at start[d] and end at start[d + 1].
        decals: The decals of each view, bottom first.
        decal_start: The same as `start`, for the decals of each view.
        masks: Opacities of all masks.
        any: 0 where there are neither layers nor decals.
    """

    layers: wp.array(dtype=Layer)
    start: wp.array(dtype=int)
    decals: wp.array(dtype=Decal)
    decal_start: wp.array(dtype=int)
    masks: wp.array(dtype=float)
    any: int


@wp.func
def opacity(masks: wp.array(dtype=float), start: int, columns: int, rows: int, u: float, v: float) -> float:
    """Return the opacity of a mask at (u, v) in 0..1, interpolated between its texels."""
    x = wp.clamp(u * float(columns) - 0.5, 0.0, float(columns - 1))
    y = wp.clamp(v * float(rows) - 0.5, 0.0, float(rows - 1))
    # Keep the right neighbour inside; a mask of one column has none.
    i = wp.min(int(x), wp.max(columns - 2, 0))
    j = wp.min(int(y), wp.max(rows - 2, 0))
    next_column = wp.min(i + 1, columns - 1)
    next_row = wp.min(j + 1, rows - 1)
    x = x - float(i)
    y = y - float(j)
    upper = masks[start + j * columns + i] * (1.0 - x) + masks[start + j * columns + next_column] * x
    lower = masks[start + next_row * columns + i] * (1.0 - x) + masks[start + next_row * columns + next_column] * x
    return upper * (1.0 - y) + lower * y


@wp.func
def on_layer(all: Layers, layer: Layer, uv: wp.vec2) -> wp.vec3:
    """Return u, v in a layer's texture and its opacity there, 0 outside it."""
    box = layer.box
    u = (uv[0] - box[0]) / (box[2] - box[0])
    v = (uv[1] - box[1]) / (box[3] - box[1])
    if u < 0.0 or u > 1.0 or v < 0.0 or v > 1.0:
        return wp.vec3(u, v, 0.0)
    share = layer.opacity
    if layer.mask >= 0:
        share = share * opacity(all.masks, layer.mask, layer.columns, layer.rows, u, v)
    return wp.vec3(u, v, share)


@wp.func
def on_decal(all: Layers, decal: Decal, p: wp.vec3, n: wp.vec3, tag: int) -> wp.vec3:
    """Return u, v in a decal's texture and its opacity there, 0 outside it and on surfaces that face away."""
    offset = p - decal.place
    u = 0.5 + 0.5 * wp.dot(offset, decal.across)
    v = 0.5 + 0.5 * wp.dot(offset, decal.down)
    if u < 0.0 or u > 1.0 or v < 0.0 or v > 1.0 or wp.abs(wp.dot(offset, decal.ahead)) > decal.depth:
        return wp.vec3(u, v, 0.0)
    # `ahead` points into the surface, so a surface that wears the decal has a normal against it.
    if wp.dot(n, decal.ahead) >= 0.0 or (decal.tag >= 0 and decal.tag != tag):
        return wp.vec3(u, v, 0.0)
    share = decal.opacity
    if decal.mask >= 0:
        share = share * opacity(all.masks, decal.mask, decal.columns, decal.rows, u, v)
    return wp.vec3(u, v, share)

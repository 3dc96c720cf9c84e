"""Materials of surfaces, and procedural patterns finer than their triangles."""

import warp as wp

from ssad.rendering.camera.kernels.sky import cloudy, speck

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
    """Material of a surface.

    Attributes:
        colour: Linear albedo.
        specular: Share of the light that is mirrored.
        gloss: Strength and sharpness of the mirror image, 0 to 1.
        emission: Emission by day.
        night: Additional emission at night.
        paint: 1 where it takes the paint of its body.
        lamp: Kind of lamp, such as `ssad.rendering.camera.kernels.light.HEAD_LAMP`; 0 for none.
        pattern: Such as `BRICK`.
    """

    colour: wp.vec3
    specular: float
    gloss: float
    emission: float
    night: float
    paint: int
    lamp: int
    pattern: int


@wp.func
def octave(uv: wp.vec2, rate: float, depth: float, fine: float) -> float:
    """Return smooth noise around 1 with amplitude `depth` and `rate` cells per metre.

    It fades out where a pixel (`fine` m) is larger than a third of a cell.
    """
    visibility = wp.clamp(2.0 - 3.0 * fine * rate, 0.0, 1.0)
    if visibility <= 0.0:
        return 1.0
    return 1.0 + visibility * depth * (cloudy(uv[0] * rate, uv[1] * rate) - 0.5)


@wp.func
def textured(surface: Surface, albedo: wp.vec3, uv: wp.vec2, fine: float) -> wp.vec3:
    """Return the albedo with the pattern of the material.

    `fine` is metres a pixel; detail that is smaller fades out.
    """
    if surface.pattern == PLAIN or surface.pattern == GLASS:
        return albedo
    factor = float(1.0)
    if surface.pattern == GRAIN:
        factor = octave(uv, 0.21, 0.30, fine) * octave(uv, 7.0, 0.24, fine) * octave(uv, 37.0, 0.36, fine)
    elif surface.pattern == LEAF:
        factor = octave(uv, 0.31, 0.3, fine) * octave(uv, 1.3, 0.5, fine)
        factor = factor * octave(uv, 9.0, 0.6, fine) * octave(uv, 31.0, 0.4, fine)
    else:
        width = float(0.25)
        height = float(0.08)
        joint_width = float(0.012)
        if surface.pattern == SLAB:
            width = 0.6
            height = 0.6
            joint_width = 0.015
        if surface.pattern == TILE:
            width = 0.3
            height = 0.22
            joint_width = 0.02
        row = wp.floor(uv[1] / height)
        x = uv[0] / width
        if surface.pattern != SLAB:
            # Every second course is shifted by half a brick.
            x = x + 0.5 * (row - 2.0 * wp.floor(row * 0.5))
        column = wp.floor(x)
        visibility = wp.clamp(1.5 - fine / height * 2.0, 0.0, 1.0)
        factor = 1.0 + (speck(int(column), int(row)) - 0.5) * 0.35 * visibility
        edge_distance = wp.min((x - column) * width, (uv[1] / height - row) * height)
        if edge_distance < joint_width:
            factor = factor * (1.0 - 0.35 * visibility)
        factor = factor * octave(uv, 0.27, 0.22, fine) * octave(uv, 11.0, 0.14, fine)
    return albedo * factor

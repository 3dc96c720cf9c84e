"""Nearby light: lamps, and bodies that occlude the sky from the ground below and beside them.

A grid of cells around the camera limits each pixel to the lamps and bodies that can reach it.
"""

import warp as wp

from ssad.rendering.camera.kernels.matter import Surface
from ssad.rendering.camera.kernels.raster import NONE

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CELLS = wp.constant(32)  # squares along each side of the grid
CELL = wp.constant(8.0)  # m

# Bits of the state of a body's lamps.
LAMPS_ON = wp.constant(1)
BRAKING = wp.constant(2)
TURNING_LEFT = wp.constant(4)
TURNING_RIGHT = wp.constant(8)

# Kinds of lamps among the materials.
HEAD_LAMP = wp.constant(1)
TAIL_LAMP = wp.constant(2)
INDICATOR = wp.constant(3)
BRAKE_LAMP = wp.constant(4)
STREET_LAMP = wp.constant(5)

# Emission of lit signals of vehicles. On the scale of noon their luminance is about 12,000 cd/m^2: that of stop lamps
# of 100 cd (UN Regulation No. 7) and indicators of 200 cd (No. 6) with lenses of 0.8 and 1.7 dm^2.
BRAKE_LIGHT = wp.constant(wp.vec3(4.0, 0.08, 0.05))
TURN_LIGHT = wp.constant(wp.vec3(2.4, 0.65, 0.0))

# Shapes of the light of a lamp.
ELLIPSE = wp.constant(0)
RECTANGLE = wp.constant(1)
LOW_BEAM = wp.constant(2)
BEAM_EDGE = wp.constant(0.7)  # tangent of the angle to the axis beyond which a low beam is dark


@wp.struct
class Lamp:
    """Lamp in the world.

    Attributes:
        place: Position, m.
        across: Axis across its light, divided by the tangent of the spread.
        down: Axis down its light, divided by the tangent of the spread.
        ahead: Axis of its light.
        light: Irradiance / pi on a plane 1 m ahead, RGB.
        inner: Square of the share of the spread that is fully lit.
        shape: `ELLIPSE`, `RECTANGLE` or `LOW_BEAM`; the axes of a low beam are not divided by its spread, and its light
            is that of its brightest direction at a distance of 1 m.
        reach: Distance beyond which it lights nothing, m.
        layer: Layer of the lamp shadow maps; -1 for none.
        texture: Texture that it projects; -1 for plain light.
        spread: Area that it lights on a plane 1 m ahead, m^2.
    """

    place: wp.vec3
    across: wp.vec3
    down: wp.vec3
    ahead: wp.vec3
    light: wp.vec3
    inner: float
    shape: int
    reach: float
    layer: int
    texture: int
    spread: float


@wp.struct
class Occluder:
    """Body that stands on the ground and occludes the sky from it.

    Attributes:
        place: Position, m.
        heading: Cosine and sine.
        half: Half length and half width of the covered ground, m.
        under: Height of its underside, m.
        middle: Height of its middle, m.
        reach: Distance from its position beyond which it hides nothing, m.
    """

    place: wp.vec3
    heading: wp.vec2
    half: wp.vec2
    under: float
    middle: float
    reach: float


@wp.struct
class Near:
    """Lamps and occluders of all views, with their grids.

    Attributes:
        lamps: All lamps.
        lamp_start: First entry of a cell in `lamp_list`, in row `view * CELLS * CELLS + cell`; the next row
            holds the end.
        lamp_list: Indices of the lamps that can reach each cell.
        occluders: All occluders.
        occluder_start: The same as `lamp_start`, for occluders.
        occluder_list: The same as `lamp_list`, for occluders.
        shadows: Shadow maps of lamps.
    """

    lamps: wp.array(dtype=Lamp)
    lamp_start: wp.array(dtype=int)
    lamp_list: wp.array(dtype=int)
    occluders: wp.array(dtype=Occluder)
    occluder_start: wp.array(dtype=int)
    occluder_list: wp.array(dtype=int)
    shadows: wp.array3d(dtype=wp.uint64)


@wp.func
def cell_of(p: wp.vec3, eye: wp.vec3) -> int:
    """Return the cell of the grid around the camera that contains a point, -1 outside."""
    # The grid moves with the camera; 32 squares of 8 m reach 128 m to each side.
    column = int(wp.floor((p[0] - eye[0]) / CELL)) + CELLS / 2
    row = int(wp.floor((p[1] - eye[1]) / CELL)) + CELLS / 2
    if column < 0 or row < 0 or column >= CELLS or row >= CELLS:
        return -1
    return row * CELLS + column


@wp.func
def corner(x: float, y: float, height: float) -> float:
    """Return the signed share of the sky that a horizontal rectangle from straight above to (x, y) hides."""
    x_slant = wp.sqrt(height * height + x * x)
    y_slant = wp.sqrt(height * height + y * y)
    return (x / x_slant * wp.atan(y / x_slant) + y / y_slant * wp.atan(x / y_slant)) * 0.15915494


@wp.func
def hidden(half: wp.vec2, x: float, y: float, height: float) -> float:
    """Return the share of an even sky's light that a rectangle above a point keeps from flat ground there.

    The configuration factor between an element and a parallel rectangle (Howell, catalog of factors, B-4).
    """
    # A rectangle in the plane of the ground would divide by zero.
    height = max(height, 0.02)
    return (
        corner(half[0] - x, half[1] - y, height)
        + corner(half[0] + x, half[1] - y, height)
        + corner(half[0] - x, half[1] + y, height)
        + corner(half[0] + x, half[1] + y, height)
    )


@wp.func
def openness(near: Near, row: int, p: wp.vec3) -> float:
    """Return the share of the sky's light that bodies leave to flat ground at a point."""
    open_share = float(1.0)
    for entry in range(near.occluder_start[row], near.occluder_start[row + 1]):
        body = near.occluders[near.occluder_list[entry]]
        if p[2] < body.place[2] + body.under:
            dx = p[0] - body.place[0]
            dy = p[1] - body.place[1]
            if dx * dx + dy * dy < body.reach * body.reach:
                x = dx * body.heading[0] + dy * body.heading[1]
                y = dy * body.heading[0] - dx * body.heading[1]
                underside_share = hidden(body.half, x, y, body.place[2] + body.under - p[2])
                middle_share = hidden(body.half, x, y, body.place[2] + body.middle - p[2])
                fade = wp.clamp((1.0 - wp.sqrt(dx * dx + dy * dy) / body.reach) * 3.0, 0.0, 1.0)
                open_share = open_share * (1.0 - fade * wp.max(underside_share, middle_share))
    return wp.max(open_share, 0.0)


@wp.func
def passes(shadows: wp.array3d(dtype=wp.uint64), layer: int, row: int, column: int, depth: float) -> float:
    """Return 1 if a texel of a lamp's shadow map holds nothing nearer to the lamp (depth: inverse, 1/m), else 0."""
    key = shadows[layer, row, column]
    if key == NONE or wp.cast(wp.uint32(key >> wp.uint64(32)), float) <= depth:
        return 1.0
    return 0.0


@wp.func
def lamp_shadow(shadows: wp.array3d(dtype=wp.uint64), layer: int, x: float, y: float, z: float) -> float:
    """Return the share of a lamp's light that reaches a point.

    x and y are in -1..1 of the lamp's spread, z m ahead. Four texels are weighted bilinearly.
    """
    size = shadows.shape[1]
    u = (0.5 * x + 0.5) * float(size) - 0.5
    v = (0.5 * y + 0.5) * float(size) - 0.5
    # The clamp keeps all four texels inside the map.
    i = wp.clamp(int(wp.floor(u)), 0, size - 2)
    j = wp.clamp(int(wp.floor(v)), 0, size - 2)
    u = wp.clamp(u - float(i), 0.0, 1.0)
    v = wp.clamp(v - float(j), 0.0, 1.0)
    depth = 1.0 / z
    upper_row = passes(shadows, layer, j, i, depth) * (1.0 - u) + passes(shadows, layer, j, i + 1, depth) * u
    lower_row = passes(shadows, layer, j + 1, i, depth) * (1.0 - u) + passes(shadows, layer, j + 1, i + 1, depth) * u
    return upper_row * (1.0 - v) + lower_row * v


@wp.func
def low_beam(across: float, down: float) -> float:
    """Return the intensity of a low beam towards a direction, as a share of its largest one.

    across, down: tangents of the direction, to the right and down. The cut-off lies 1 % below the horizon on the left
    and rises by 15 degrees on the right, as UN Regulation No. 112 draws it for right-hand traffic; the intensities meet
    its limits for a lamp of class B with a peak of 12,000 cd.
    """
    squared_radius = across * across + down * down
    if squared_radius >= BEAM_EDGE * BEAM_EDGE:
        return 0.0
    # Degrees; towards the edge, tangents of angles serve as well.
    right = across * 57.29578
    above = 0.57 - down * 57.29578 - wp.min(0.268 * wp.max(right, 0.0), 1.1)
    fade = wp.min(5.0 * (BEAM_EDGE * BEAM_EDGE - squared_radius), 1.0)
    light = 0.018 * fade
    # Most points lie above the cut-off, where only stray light goes.
    if above < 0.2:
        edge = wp.min(0.5 - 2.5 * above, 1.0)
        edge = edge * edge * (3.0 - 2.0 * edge)
        below = wp.max(-above, 0.0)
        squared_right = right * right
        ridge = 1.0 + squared_right / 98.0
        hot = 1.0 / (ridge * ridge * (1.0 + below / 3.0 + below * below / 12.0))
        wide = fade / ((1.0 + squared_right / 968.0) * (1.0 + below / 8.0 + below * below / 100.0))
        light += edge * (hot + 0.12 * wide)
    return light


@wp.func
def lamp_emission(surface: Surface, state: int, side: float, split: wp.vec2, lamps: float) -> wp.vec3:
    """Return the light that a surface emits.

    state: bits of the lamps of its body, such as `BRAKING`; side: distance to the left of the body's axis, m; split:
    distance beyond which head lamps and tail lamps are indicators, m; lamps: how far lamps are on, 0 to 1.
    """
    glow = surface.emission + surface.night * lamps
    if surface.lamp == 0:
        return surface.colour * glow
    turning = TURNING_LEFT
    if side < 0.0:
        turning = TURNING_RIGHT
    if (state & turning) != 0:
        outside = wp.abs(side)
        if (
            surface.lamp == INDICATOR
            or (surface.lamp == HEAD_LAMP and outside > split[0])
            or (surface.lamp == TAIL_LAMP and outside > split[1])
        ):
            return TURN_LIGHT
    if (state & BRAKING) != 0 and (surface.lamp == TAIL_LAMP or surface.lamp == BRAKE_LAMP):
        return BRAKE_LIGHT
    if (state & LAMPS_ON) == 0:
        glow = 0.0
    return surface.colour * glow


@wp.func
def lamp_at(
    lamps: wp.array(dtype=Lamp), k: int, shadows: wp.array3d(dtype=wp.uint64), p: wp.vec3, n: wp.vec3, fog: float
) -> float:
    """Return the irradiance / pi that a lamp with light 1 gives a point with a normal."""
    offset = p - lamps[k].place
    facing = wp.dot(n, offset)
    ahead = wp.dot(offset, lamps[k].ahead)
    # Most lamps that can reach the cell leave the point dark: these tests are the cheapest.
    if facing >= 0.0 or ahead <= 0.02:
        return 0.0
    squared_distance = wp.max(wp.dot(offset, offset), 1.0e-4)
    distance = wp.sqrt(squared_distance)
    reach = lamps[k].reach
    if distance >= reach:
        return 0.0
    x = wp.dot(offset, lamps[k].across) / ahead
    y = wp.dot(offset, lamps[k].down) / ahead
    weight = float(1.0)
    shape = lamps[k].shape
    if shape == LOW_BEAM:
        weight = low_beam(x, y)
    elif shape == RECTANGLE:
        if wp.abs(x) > 1.0 or wp.abs(y) > 1.0:
            weight = 0.0
    else:
        radius = x * x + y * y
        inner = lamps[k].inner
        if radius > inner:
            weight = wp.max((1.0 - radius) / (1.0 - inner), 0.0)
    if weight <= 0.0:
        return 0.0
    layer = lamps[k].layer
    if layer >= 0:
        weight = weight * lamp_shadow(shadows, layer, x, y, ahead - 0.02 - 0.004 * ahead)
    # The last third of the reach fades, so that no edge is visible.
    weight = weight * wp.clamp(3.0 * (1.0 - distance / reach), 0.0, 1.0)
    if fog > 0.0:
        weight = weight * wp.exp(-fog * distance)
    if shape == LOW_BEAM:
        return weight * (-facing / distance) / squared_distance
    # A plane across the axis is lit evenly: the intensity grows with the cube of the secant.
    secant = distance / ahead
    return weight * (secant * secant * secant * (-facing / distance) / squared_distance)


@wp.func
def spot_of(lamp: Lamp, p: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Return the position of a point in a lamp's spread and the scale of the spread there.

    x and y are in the lamp's spread (-1 to 1), z is the share of the spread that an area of 1 m^2 at the point
    takes.
    """
    offset = p - lamp.place
    squared_distance = wp.max(wp.dot(offset, offset), 1.0e-4)
    distance = wp.sqrt(squared_distance)
    ahead = wp.dot(offset, lamp.ahead)
    secant = distance / ahead
    plane_share = secant * secant * secant * (-wp.dot(n, offset) / distance) / squared_distance
    return wp.vec3(wp.dot(offset, lamp.across) / ahead, wp.dot(offset, lamp.down) / ahead, plane_share / lamp.spread)

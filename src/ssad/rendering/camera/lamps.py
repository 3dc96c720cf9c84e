"""Lamps that light a scene, and bodies that occlude the sky from the ground, as tables for the kernels.

A lamp lights a plane across its axis evenly: an ellipse, or the rectangle that it projects. So its power spreads
over the lit plane at any distance, and one model covers head lamps, street lamps, projectors, flashlights and
lasers. Only the low beam of vehicles has a pattern. Irradiance over pi of one lux is about 1/60, on the scale on which
the sun at noon is 2.6.

Lamps of vehicles have the intensities of UN Regulations: low beam No. 112 (class B), stop lamps and position lamps No.
7, indicators No. 6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import warp as wp

from ssad.core.colours import LUMINANCE
from ssad.core.errors import ConfigError
from ssad.core.rotations import upright_pose
from ssad.core.types import F64, I32
from ssad.rendering.camera import street_lighting
from ssad.rendering.camera.kernels import light as kernels

if TYPE_CHECKING:
    from ssad.rendering.camera.render import SceneWeather, View
    from ssad.rendering.camera.scene import ObjectTable, RenderScene

LAMP_SHADOWS = 512  # texels a side of a lamp's shadow map
NIGHT_LUX = 1.0 / 60.0  # irradiance over pi of one lux at night; basis of the lamps of street and vehicles
LAMP_NEAR = 0.05  # m: nearer surfaces cast no shadow (the lamp's own housing)
HEAD_LAMPS = (7.0, (0.60, 0.06), (1.0, 0.97, 0.90), 60.0, 0.055)  # power, spread, colour, reach (m), tilt (rad)
TAIL_LAMPS = (0.25, (1.6, 1.0), (1.0, 0.05, 0.03), 8.0, 0.0)
BRAKE_RATIO = 100.0 / 8.0  # of the light of stop lamps to that of position lamps: 100 and 8 cd
BEAM_CANDELA = 12000.0  # largest intensity of a low beam
BEAM_HEIGHT = 0.65  # m
BEAM_REACH, OWN_BEAM_REACH = 60.0, 120.0  # m, of other vehicles and of the one that carries the camera
BEAM_COLOUR = (1.0, 0.97, 0.90)
STREET_LAMP = (26.0, (2.4, 1.7), (1.0, 0.86, 0.66), 28.0)
LIT_UP_TO = 130.0  # m from the eye up to which lamps of bodies and of the street are on
SHADED_UP_TO = 60.0  # m: the same for bodies that occlude the sky from the ground
NOSE = 3.7  # m from the rear axle of a car to its front
FLAT = 0.25  # m: lower bodies do not occlude the sky from the ground
BEAM_SPREAD = (float(kernels.BEAM_EDGE), float(kernels.BEAM_EDGE))
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # a lamp that looks along x


Pattern = Literal["even", "low_beam", "head_lamp"]


@dataclass(frozen=True, slots=True)
class SceneLamp:
    """Lamp with a pose, a power and the area that it lights.

    Attributes:
        pose: Lamp to world [4, 4]; x across, y down, z ahead, as of a camera.
        power: Emitted light, in units of (irradiance / pi) m^2: over any plane that catches all of it, the
            integral of irradiance / pi is the power, for each colour with value 1.
        spread: Tangents of the half angles across and down.
        colour: Linear RGB that the power is multiplied by.
        soft: Share of the spread's radius over which an ellipse fades at its edge, 0 to 1.
        square: Whether it lights a rectangle; else an ellipse.
        reach: m; light fades in the last third and ends here.
        shadows: Whether bodies and street block its light.
        pattern: How its light is spread: "even"; "low_beam": as that of both head lamps of a vehicle in right-hand
            traffic, with the spread `BEAM_SPREAD`; "head_lamp": even, or a low beam with the effect `low-beams`.
        texture: Index of the texture that it projects, -1 for none. The image is then a linear function of that
            texture (see `ssad.rendering.camera.texture`): u across, v down its spread. A projector lights a rectangle.
    """

    pose: F64
    power: float
    spread: tuple[float, float] = (0.5, 0.5)
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    soft: float = 0.3
    square: bool = False
    reach: float = 80.0
    shadows: bool = True
    texture: int = -1
    pattern: Pattern = "even"

    def __post_init__(self) -> None:
        numbers = (self.power, *self.spread, *self.colour, self.soft, self.reach)
        if not np.isfinite([*numbers, *np.ravel(self.pose)]).all() or np.shape(self.pose) != (4, 4):
            raise ConfigError("a lamp needs a pose [4, 4] and finite numbers")
        if min(self.power, *self.colour) < 0.0 or min(*self.spread, self.reach) <= 0.0 or not 0.0 <= self.soft <= 1.0:
            raise ConfigError("a lamp: power and colour from 0, spread and reach above 0, soft from 0 to 1")
        if self.pattern not in get_args(Pattern):
            raise ConfigError(f"a lamp has the pattern {', '.join(get_args(Pattern))}, not {self.pattern!r}")
        if self.pattern == "low_beam" and (self.is_square or tuple(self.spread) != BEAM_SPREAD):
            raise ConfigError(f"a low beam has the spread {BEAM_SPREAD}, is no rectangle and projects no texture")

    @property
    def is_square(self) -> bool:
        """True if the lamp lights a rectangle, as projectors always do."""
        return self.square or self.texture >= 0

    def area(self) -> float:
        """Lit area of a plane 1 m ahead, m^2; where the light fades, weighted by it. Of a low beam: solid angle."""
        across, down = self.spread
        if self.pattern == "low_beam":
            return beam_solid_angle()
        if self.is_square:
            return 4.0 * across * down
        return float(np.pi * across * down * (1.0 + (1.0 - self.soft) ** 2) / 2.0)


@lru_cache(maxsize=1)
def beam_solid_angle() -> float:
    """Return the integral of the relative intensity of a low beam over all directions, sr."""
    tangents = np.linspace(-BEAM_SPREAD[0], BEAM_SPREAD[0], 1401)
    across, down = np.meshgrid(tangents, tangents)
    # An area on the plane 1 m ahead covers a solid angle that falls with the cube of the secant.
    secants = np.sqrt(1.0 + across**2 + down**2)
    return float((beam_shape(across, down) / secants**3).sum() * (tangents[1] - tangents[0]) ** 2)


def beam_shape(across: F64, down: F64) -> F64:
    """Return the relative intensity of a low beam towards directions, as `kernels.light.low_beam` has it.

    Args:
        across: Tangents of the directions to the right.
        down: Tangents downwards, of the same shape.
    """
    edge_squared = BEAM_SPREAD[0] ** 2
    right, squared_radius = np.degrees(across), across**2 + down**2
    above = 0.57 - np.degrees(down) - np.minimum(0.268 * np.maximum(right, 0.0), 1.1)
    fade = np.clip(5.0 * (edge_squared - squared_radius), 0.0, 1.0)
    edge = np.clip(0.5 - 2.5 * above, 0.0, 1.0)
    edge = edge * edge * (3.0 - 2.0 * edge)
    below = np.maximum(-above, 0.0)
    hot = 1.0 / ((1.0 + right**2 / 98.0) ** 2 * (1.0 + below / 3.0 + below**2 / 12.0))
    wide = fade / ((1.0 + right**2 / 968.0) * (1.0 + below / 8.0 + below**2 / 100.0))
    light = 0.018 * fade + edge * (hot + 0.12 * wide)
    return np.asarray(np.where(squared_radius < edge_squared, light, 0.0), np.float64)


def own_lamps(vehicle: F64, weather: SceneWeather) -> tuple[SceneLamp, ...]:
    """Return the low beam of the vehicle that carries the camera, which is not drawn itself; none by day.

    The effect `low-beams` gives it its pattern (see `with_low_beams`).

    Args:
        vehicle: Vehicle to world [4, 4]: x forward, z up, on the ground, `NOSE` m behind its front.
        weather: Weather that decides how bright lamps are.
    """
    strength = lamp_strength(weather.sun_height)
    pose = vehicle @ upright_pose(NOSE, 0.0, 0.0, BEAM_HEIGHT)
    return (_beam(pose, HEAD_LAMPS, strength),) if strength > 0.0 else ()


def low_beam(pose: F64, strength: float, reach: float) -> SceneLamp:
    """Return both head lamps of a vehicle as one lamp with the pattern of a low beam.

    Args:
        pose: Frame in the middle of the lamps that looks along x [4, 4].
        strength: How bright lamps are, 0 to 1.
        reach: m.
    """
    power = 2.0 * BEAM_CANDELA * beam_solid_angle() * NIGHT_LUX * strength / float(np.dot(BEAM_COLOUR, LUMINANCE))
    return SceneLamp(pose @ AHEAD, power, BEAM_SPREAD, BEAM_COLOUR, 0.0, False, reach, False, pattern="low_beam")


def with_low_beams(lamps: Sequence[SceneLamp]) -> tuple[SceneLamp, ...]:
    """Return lamps with the pattern of a low beam on those that are head lamps."""
    return tuple(_with_low_beam(lamp) if lamp.pattern == "head_lamp" else lamp for lamp in lamps)


def _with_low_beam(lamp: SceneLamp) -> SceneLamp:
    power, *_, tilt = HEAD_LAMPS
    frame = lamp.pose.copy()
    # The pattern has its cut-off below a level axis, in place of the tilt of an even light.
    frame[:3, :3] = frame[:3, :3] @ _downward_rotation(-tilt) @ AHEAD[:3, :3].T
    return low_beam(frame, lamp.power / power, OWN_BEAM_REACH)


def lamp_strength(sun_height: float) -> float:
    """Return how bright lamps are: 0 by day, 1 at night."""
    return float(np.clip((0.08 - sun_height) / 0.15, 0, 1))


def nearby_lights(
    scene: RenderScene,
    views: Sequence[View],
    bodies: ObjectTable,
    *,
    lamps: bool = True,
    contact: bool = True,
    low_beams: bool = False,
) -> Any:
    """Build lamps and occluders of B views with their grids for the kernels, without shadow maps.

    Args:
        scene: Street and bodies.
        views: The views; their own lamps come first, in the order in which their shadow maps are numbered.
        bodies: The objects of the views.
        lamps: Whether lamps of the street and of bodies are lit at dusk and night, too.
        contact: Whether bodies occlude the sky from the ground.
        low_beams: Whether the head lamps of bodies have the pattern of a low beam.
    """
    light_tables = kernels.Near()
    tables = {
        "lamp": (kernels.Lamp, _lamps(scene, views, bodies, low_beams=low_beams) if lamps else _own_lamps(views)),
        "occluder": (
            kernels.Occluder,
            _occluders(scene, views, bodies) if contact else _empty_struct(kernels.Occluder),
        ),
    }
    for name, (kernel_struct, (rows, circles)) in tables.items():
        starts, indices = _circles_by_cell(circles, len(views))
        table = rows if len(rows) else np.zeros(1, rows.dtype)
        setattr(light_tables, f"{name}s", wp.array(table, dtype=kernel_struct, device=scene.device))
        setattr(light_tables, f"{name}_start", wp.array(starts, dtype=int, device=scene.device))
        setattr(light_tables, f"{name}_list", wp.array(indices, dtype=int, device=scene.device))
    return light_tables


Rows = tuple[Any, F64]
"""Rows of a kernel's struct, and where on the map they matter [N, 4]: view, x and y from its eye, radius, m."""


def _empty_struct(struct: Any) -> Rows:
    return np.zeros(0, struct.numpy_dtype()), np.zeros((0, 4))


def _own_lamps(views: Sequence[View]) -> Rows:
    """Return the lamps of the views themselves."""
    rows: list[tuple[Any, ...]] = []
    places = []
    layer_count = 0
    for view_index, view in enumerate(views):
        for lamp in view.lamps:
            rows.append(_lamp_row(lamp, layer_count if lamp.shadows else -1))
            layer_count += lamp.shadows
            centre, radius = lit_circle(lamp)
            places.append((view_index, *(centre - view.pose[:2, 3]), radius))
    return np.array(rows, kernels.Lamp.numpy_dtype()), np.array(places, np.float64).reshape(-1, 4)  # type: ignore[attr-defined]


def _lamps(scene: RenderScene, views: Sequence[View], bodies: ObjectTable, *, low_beams: bool) -> Rows:
    """Return the lamps of views, and at dusk and night the lit lamps of the street and of bodies."""
    tables = [_own_lamps(views)]
    strength = np.array([lamp_strength(view_index.weather.sun_height) for view_index in views])
    eye_positions = np.array([view_index.pose[:2, 3] for view_index in views])
    dark_views = np.flatnonzero(strength > 0.0)
    for lighting in sorted({views[view_index].weather.lighting for view_index in dark_views.tolist()}):
        lit_views = dark_views[[views[view_index].weather.lighting == lighting for view_index in dark_views.tolist()]]
        street_rows, circles = scene.compute_once(
            ("street lamps", lighting), partial(_street_lamp_rows, scene, lighting)
        )
        offsets = circles[None, :, :2] - eye_positions[lit_views, None]
        lit_index, lamp_index = np.nonzero(np.hypot(*np.moveaxis(offsets, -1, 0)) < LIT_UP_TO)
        rows = street_rows[lamp_index]
        rows["light"] *= strength[lit_views[lit_index], None]
        tables.append(
            (rows, np.column_stack([lit_views[lit_index], offsets[lit_index, lamp_index], circles[lamp_index, 2]]))
        )
    is_shining = bodies.lit & (strength[bodies.view] > 0.0)
    is_shining &= np.hypot(*(bodies.pose[:, :2, 3] - eye_positions[bodies.view]).T) < LIT_UP_TO
    view_index, pose = bodies.view[is_shining], bodies.pose[is_shining]
    mesh_tables, row_index, owner = _rows_of_meshes(
        bodies.mesh[is_shining], lambda mesh: _cached_beams(scene, mesh, low_beams=low_beams)
    )
    if len(row_index):
        rows, circles = (
            np.concatenate([mesh_table[column] for mesh_table in mesh_tables])[row_index] for column in (0, 1)
        )
        view_index, pose = view_index[owner], pose[owner]
        # In the frame of the body, lamps at its rear look backwards.
        is_stop_lamp = (rows["ahead"][:, 0] < 0.0) & (bodies.signals[is_shining][owner] & kernels.BRAKING > 0)
        rows["light"] *= np.where(is_stop_lamp, BRAKE_RATIO, 1.0)[:, None]
        # Cached rows are in the body's frame: rotate them, then shift the position.
        for name in ("across", "down", "ahead", "place"):
            rows[name] = np.einsum("nij,nj->ni", pose[:, :3, :3], rows[name])
        rows["place"] += pose[:, :3, 3]
        rows["light"] *= strength[view_index, None]
        centre = np.einsum("nij,nj->ni", pose[:, :2, :2], circles[:, :2]) + pose[:, :2, 3] - eye_positions[view_index]
        tables.append((rows, np.column_stack([view_index, centre, circles[:, 2]])))
    return np.concatenate([rows for rows, _ in tables]), np.concatenate([places for _, places in tables])


def _rows_of_meshes(mesh: I32, find: Callable[[int], Rows]) -> tuple[list[Rows], Any, Any]:
    """Return the rows of the bodies of meshes [N].

    Returns:
        Rows of each mesh that occurs, one after the other; for each row of each body, its place among them; and the
        body it belongs to.
    """
    mesh_indices, mesh_of_body = np.unique(mesh, return_inverse=True)
    tables = [find(int(mesh_index)) for mesh_index in mesh_indices]
    mesh_counts = np.array([len(rows) for rows, _ in tables], np.int64)
    row_counts = mesh_counts[mesh_of_body] if len(mesh_indices) else mesh_counts
    owners = np.repeat(np.arange(len(mesh)), row_counts)
    first_rows = (np.cumsum(mesh_counts) - mesh_counts)[mesh_of_body[owners]]
    return tables, first_rows + np.arange(len(owners)) - (np.cumsum(row_counts) - row_counts)[owners], owners


def _cached_beams(scene: RenderScene, mesh: int, *, low_beams: bool) -> Rows:
    """Return the lamps of a body in its own frame, with their circles; cached."""
    return scene.compute_once(  # type: ignore[no-any-return]
        ("lamps", mesh, low_beams), lambda: _fixed_lamps(_beams(scene, mesh, low_beams=low_beams))
    )


def _fixed_lamps(lamps: Sequence[SceneLamp]) -> Rows:
    """Return rows of lamps without shadow maps, and the circles [N, 3] (x, y, radius) that contain their light."""
    circles = [(*centre, radius) for centre, radius in map(lit_circle, lamps)]
    rows = np.array([_lamp_row(lamp, -1) for lamp in lamps], kernels.Lamp.numpy_dtype())  # type: ignore[attr-defined]
    return rows, np.array(circles, np.float64).reshape(-1, 3)


def _street_lamp_rows(scene: RenderScene, lighting: str) -> Rows:
    """Return the rows of the lamps of the street, with the circles [N, 3] that contain their light."""
    rows, circles = _fixed_lamps(_street_lamps(scene, lighting))
    if lighting and scene.street is not None and len(circles):
        # Their light falls on the ground below them, so that the reach says little.
        heights = scene.street.lamps[:, 2].astype(np.float64)
        circles[:, :2], circles[:, 2] = scene.street.lamps[:, :2], max(street_lighting.SPREAD) * (heights + 1.0)
    return rows, circles


def _street_lamps(scene: RenderScene, lighting: str) -> list[SceneLamp]:
    """Return the lamps of the street under a class of lighting; none where it is unlit."""
    if lighting == street_lighting.UNLIT or scene.street is None:
        return []
    power, spread, colour, reach = STREET_LAMP
    soft = 0.5
    if lighting:
        power = street_lighting.luminaire_power(scene.street, lighting, NIGHT_LUX) / float(np.dot(colour, LUMINANCE))
        spread, soft, reach = street_lighting.SPREAD, street_lighting.SOFT, street_lighting.REACH
    street_lamps = []
    for x, y, z, heading in scene.street.lamps.astype(np.float64).tolist():
        pose = upright_pose(x, y, heading, z - 0.05) @ np.diag([1.0, -1.0, -1.0, 1.0])
        street_lamps.append(SceneLamp(pose, power, spread, colour, soft, False, reach, False))
    return street_lamps


def _beams(scene: RenderScene, mesh: int, *, low_beams: bool) -> list[SceneLamp]:
    """Return the head and tail lamps of a body, in its own frame."""
    body_lamps = []
    for name, (position, area) in scene.lights(mesh).items():
        if area > 0.0:
            is_head_lamp = name == "head_lamp"
            pose = upright_pose(
                float(position[0]), float(position[1]), 0.0 if is_head_lamp else np.pi, float(position[2])
            )
            if is_head_lamp and low_beams:
                body_lamps.append(low_beam(pose, 1.0, BEAM_REACH))
            else:
                body_lamps.append(_beam(pose, HEAD_LAMPS if is_head_lamp else TAIL_LAMPS, 1.0))
    return body_lamps


def _occluders(scene: RenderScene, views: Sequence[View], bodies: ObjectTable) -> Rows:
    """Return the bodies of views that occlude the sky from the ground."""
    rows, places = _empty_struct(kernels.Occluder)
    eye_positions = np.array([entry.pose[:2, 3] for entry in views])[bodies.view]
    # The model of an occluder is a level rectangle: tilted bodies are left out.
    is_near = (np.hypot(*(bodies.pose[:, :2, 3] - eye_positions).T) < SHADED_UP_TO) & (bodies.pose[:, 2, 2] > 0.9)
    mesh_indices, mesh_of_body = np.unique(bodies.mesh[is_near], return_inverse=True)
    if not len(mesh_indices):
        return rows, places
    ground_covers = zip(*(scene.ground_cover(int(mesh)) for mesh in mesh_indices), strict=True)
    centres, half_sizes, underside_heights, heights = (np.array(values)[mesh_of_body] for values in ground_covers)
    is_high = heights > FLAT
    centres, half_sizes, underside_heights, heights = (
        array[is_high] for array in (centres, half_sizes, underside_heights, heights)
    )
    view_index, poses, eye_positions = (array[is_near][is_high] for array in (bodies.view, bodies.pose, eye_positions))
    rows = np.zeros(len(view_index), rows.dtype)
    rows["place"] = np.einsum("nij,nj->ni", poses[:, :3, :2], centres) + poses[:, :3, 3]
    rows["heading"] = poses[:, :2, 0] / np.maximum(np.hypot(*poses[:, :2, 0].T), 1e-9)[:, None]
    rows["half"], rows["under"], rows["middle"] = half_sizes, underside_heights, 0.5 * heights
    rows["reach"] = np.hypot(*half_sizes.T) + 2.0 * heights
    return rows, np.column_stack([view_index, rows["place"][:, :2] - eye_positions, rows["reach"]])


def struct_array(row_type: Any, rows: Sequence[tuple[Any, ...]]) -> Any:
    """Rows as an array of a kernel's struct; one row of zeros where there is none."""
    dtype = row_type.numpy_dtype()
    return np.array(rows, dtype) if rows else np.zeros(1, dtype)


def _circles_by_cell(places: F64, views: int) -> tuple[I32, I32]:
    """List the circles (view, x, y, radius; m from the eye) that touch each cell of the grid of each view.

    Returns:
        First entry of each cell, and the list of circle indices.
    """
    cells_per_side, cell_size = int(kernels.CELLS), float(kernels.CELL)
    first_cell = np.clip(
        np.floor((places[:, 1:3] - places[:, 3:]) / cell_size) + cells_per_side // 2, 0, cells_per_side
    ).astype(int)
    last_cell = np.clip(
        np.floor((places[:, 1:3] + places[:, 3:]) / cell_size) + cells_per_side // 2, -1, cells_per_side - 1
    ).astype(int)
    column_counts, row_counts = np.maximum(last_cell - first_cell + 1, 0).T
    circle_index = np.repeat(np.arange(len(places)), column_counts * row_counts)
    cell_order = np.arange(len(circle_index)) - np.repeat(
        np.cumsum(column_counts * row_counts) - column_counts * row_counts, column_counts * row_counts
    )
    column, row = (
        first_cell[circle_index, 0] + cell_order % column_counts[circle_index],
        first_cell[circle_index, 1] + cell_order // column_counts[circle_index],
    )
    cell_index = places[circle_index, 0].astype(int) * cells_per_side * cells_per_side + row * cells_per_side + column
    # A stable sort keeps the entries of a cell in their given order.
    by_cell = np.argsort(cell_index, kind="stable")
    starts = np.concatenate(
        [[0], np.cumsum(np.bincount(cell_index, minlength=views * cells_per_side * cells_per_side))]
    )
    return starts.astype(np.int32), circle_index[by_cell].astype(np.int32) if len(circle_index) else np.zeros(
        1, np.int32
    )


def _lamp_row(lamp: SceneLamp, layer: int) -> tuple[Any, ...]:
    """Return the row of a lamp for the kernels."""
    across, down = lamp.spread
    rotation, position = lamp.pose[:3, :3], lamp.pose[:3, 3]
    light = np.asarray(lamp.colour) * lamp.power / lamp.area()
    is_low_beam = lamp.pattern == "low_beam"
    if is_low_beam:
        across, down = 1.0, 1.0
    inner_squared = (1.0 - lamp.soft) ** 2 - 1e-6  # the width of the fade is never 0
    return (
        tuple(position),
        tuple(rotation[:, 0] / across),
        tuple(rotation[:, 1] / down),
        tuple(rotation[:, 2]),
        tuple(light),
        inner_squared,
        int(kernels.LOW_BEAM if is_low_beam else kernels.RECTANGLE if lamp.is_square else kernels.ELLIPSE),
        lamp.reach,
        layer,
        lamp.texture,
        4.0 * across * down,
    )


def lit_circle(lamp: SceneLamp) -> tuple[F64, float]:
    """Return a circle on the map that contains everything a lamp lights.

    It is the circle of the smallest ball around the sector that the lamp's spread and reach bound.

    Returns:
        Middle [2] and radius, m.
    """
    across, down = lamp.spread
    cosine = 1.0 / float(np.hypot(1.0, np.hypot(across, down) if lamp.is_square else max(across, down)))
    sine = float(np.sqrt(1.0 - cosine**2))
    # Wide sectors: the ball around the base circle; narrow ones: that through apex and rim.
    centre_share, radius_share = (cosine, sine) if sine > cosine else (0.5 / cosine, 0.5 / cosine)
    return lamp.pose[:2, 3] + lamp.pose[:2, 2] * (lamp.reach * centre_share), lamp.reach * radius_share


def _beam(pose: F64, kind: tuple[Any, ...], strength: float) -> SceneLamp:
    """A lamp of a vehicle with even light, at the origin of a frame that looks along x."""
    power, spread, colour, reach, tilt = kind
    lamp_pose = pose @ AHEAD
    lamp_pose[:3, :3] = lamp_pose[:3, :3] @ _downward_rotation(tilt)
    pattern: Pattern = "head_lamp" if kind is HEAD_LAMPS else "even"
    return SceneLamp(lamp_pose, power * strength, spread, colour, 0.6, False, reach, False, pattern=pattern)


def lamp_lens(lamp: SceneLamp) -> tuple[float, float, float, float]:
    """Return the intrinsics of the camera that takes the shadow map of a lamp, texels: fx, fy, cx, cy."""
    half = LAMP_SHADOWS / 2
    return half / lamp.spread[0], half / lamp.spread[1], half - 0.5, half - 0.5


def _downward_rotation(angle: float) -> F64:
    """Return a rotation of the axis downwards (camera frame)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])

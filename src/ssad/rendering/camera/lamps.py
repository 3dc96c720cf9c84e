"""Lamps that light a scene, and the bodies that keep light from the ground: what the kernels read of them.

A lamp lights a plane across its axis evenly: an ellipse, or the rectangle of what it projects. So its power spreads
over the plane that it lights whatever the distance, and head lamps, street lamps, projectors, flashlights and lasers
are one thing. Irradiance over pi of one lux is about 1/60, on the scale on which the sun at noon is 2.6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.rotations import upright_pose
from ssad.core.types import F64, I32
from ssad.rendering.camera.kernels import light as kernels

if TYPE_CHECKING:
    from ssad.rendering.camera.render import View, Weather
    from ssad.rendering.camera.scene import Bodies, Scene

LAMP_SHADOWS = 512  # texels a side of a lamp's shadow map
LAMP_NEAR = 0.05  # m: what is nearer to a lamp casts no shadow (its own housing)
HEAD_LAMPS = (7.0, (0.60, 0.06), (1.0, 0.97, 0.90), 60.0, 0.055)  # power, spread, colour, reach (m), tilt (rad)
TAIL_LAMPS = (0.25, (1.6, 1.0), (1.0, 0.05, 0.03), 8.0, 0.0)
STREET_LAMP = (26.0, (2.4, 1.7), (1.0, 0.86, 0.66), 28.0)
LIT_UP_TO = 130.0  # m from the eye up to which lamps of bodies and of the street are on
SHADED_UP_TO = 60.0  # m: likewise bodies that keep light from the ground
NOSE = 3.7  # m from the rear axle of a car to its front
FLAT = 0.25  # m: what is lower keeps no light from the ground
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # a lamp that looks along x


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lamp: what it lights, and how strongly.

    Attributes:
        pose: Lamp to world [4, 4]; x across, y down, z ahead, as of a camera.
        power: Light that leaves it, in units of (irradiance / pi) m^2: over any plane that catches the whole of it, the
            integral of irradiance / pi is the power, for each of the colours 1.
        spread: Tangents of the half angles across and down.
        colour: Linear RGB that the power is multiplied by.
        soft: Share of the spread's radius over which an ellipse fades at its edge, 0 to 1.
        square: Whether it lights a rectangle; else an ellipse.
        reach: m; in the last third it fades, beyond it is dark.
        shadows: Whether bodies and street stand in its way.
        texture: Which texture it projects onto what it lights, -1 for none. Its image is then a linear function of that
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

    def __post_init__(self) -> None:
        numbers = (self.power, *self.spread, *self.colour, self.soft, self.reach)
        if not np.isfinite([*numbers, *np.ravel(self.pose)]).all() or np.shape(self.pose) != (4, 4):
            raise ConfigError("a lamp needs a pose [4, 4] and finite numbers")
        if min(self.power, *self.colour) < 0.0 or min(*self.spread, self.reach) <= 0.0 or not 0.0 <= self.soft <= 1.0:
            raise ConfigError("a lamp: power and colour from 0, spread and reach above 0, soft from 0 to 1")

    @property
    def is_square(self) -> bool:
        """Whether it lights a rectangle, as what projects a texture always does."""
        return self.square or self.texture >= 0

    def area(self) -> float:
        """What it lights of a plane 1 m ahead, m^2; where it fades, as much as it is lit."""
        across, down = self.spread
        if self.is_square:
            return 4.0 * across * down
        return float(np.pi * across * down * (1.0 + (1.0 - self.soft) ** 2) / 2.0)


def own_lamps(vehicle: F64, weather: Weather) -> tuple[Lamp, ...]:
    """The low beam of a vehicle that carries the camera and is not seen: none by day.

    Args:
        vehicle: Vehicle to world [4, 4]: x forward, z up, on the ground, `NOSE` m behind its front.
        weather: Says how far lamps are on.
    """
    strength = lamp_strength(weather.sun_height)
    return (_beam(vehicle @ upright_pose(NOSE, 0.0, 0.0, 0.65), HEAD_LAMPS, strength),) if strength > 0.0 else ()


def lamp_strength(sun_height: float) -> float:
    """How far lamps are on: 0 by day, 1 by night."""
    return float(np.clip((0.08 - sun_height) / 0.15, 0, 1))


def near_of(scene: Scene, views: Sequence[View], bodies: Bodies, *, lamps: bool = True, contact: bool = True) -> Any:
    """Lamps and occluders of B views with their grids, as the kernels read them, without shadow maps.

    Args:
        scene: Street and bodies.
        views: What is seen; their own lamps come first, in the order in which their shadow maps are numbered.
        bodies: The things of the views.
        lamps: Whether by dusk and night those of the street and of bodies are lit, too.
        contact: Whether bodies keep light from the ground.
    """
    near = kernels.Near()
    tables = {
        "lamp": (kernels.Lamp, _lamps(scene, views, bodies) if lamps else _own_lamps(views)),
        "occluder": (kernels.Occluder, _occluders(scene, views, bodies) if contact else _nothing(kernels.Occluder)),
    }
    for name, (struct, (rows, places)) in tables.items():
        start, listed = _grid(places, len(views))
        table = rows if len(rows) else np.zeros(1, rows.dtype)
        setattr(near, f"{name}s", wp.array(table, dtype=struct, device=scene.device))
        setattr(near, f"{name}_start", wp.array(start, dtype=int, device=scene.device))
        setattr(near, f"{name}_list", wp.array(listed, dtype=int, device=scene.device))
    return near


Rows = tuple[Any, F64]
"""Rows of a kernel's struct, and where on the map they matter [N, 4]: view, x and y from its eye, radius, m."""


def _nothing(struct: Any) -> Rows:
    return np.zeros(0, struct.numpy_dtype()), np.zeros((0, 4))


def _own_lamps(views: Sequence[View]) -> Rows:
    """The lamps that views bring with them."""
    rows: list[tuple[Any, ...]] = []
    places = []
    layers = 0
    for number, view in enumerate(views):
        for lamp in view.lamps:
            rows.append(_lamp_row(lamp, layers if lamp.shadows else -1))
            layers += lamp.shadows
            middle, radius = lit_circle(lamp)
            places.append((number, *(middle - view.pose[:2, 3]), radius))
    return np.array(rows, kernels.Lamp.numpy_dtype()), np.array(places, np.float64).reshape(-1, 4)  # type: ignore[attr-defined]


def _lamps(scene: Scene, views: Sequence[View], bodies: Bodies) -> Rows:
    """The lamps of views, and by dusk and night those of the street and of bodies that have them lit."""
    found = [_own_lamps(views)]
    strength = np.array([lamp_strength(view.weather.sun_height) for view in views])
    eyes = np.array([view.pose[:2, 3] for view in views])
    dark = np.flatnonzero(strength > 0.0)
    if len(dark):
        street, circles = scene.kept("street lamps", lambda: _fixed(_street_lamps(scene)))
        away = circles[None, :, :2] - eyes[dark, None]
        at, lamp = np.nonzero(np.hypot(*np.moveaxis(away, -1, 0)) < LIT_UP_TO)
        rows = street[lamp]
        rows["light"] *= strength[dark[at], None]
        found.append((rows, np.column_stack([dark[at], away[at, lamp], circles[lamp, 2]])))
    shining = bodies.lit & (strength[bodies.view] > 0.0)
    shining &= np.hypot(*(bodies.pose[:, :2, 3] - eyes[bodies.view]).T) < LIT_UP_TO
    view, pose = bodies.view[shining], bodies.pose[shining]
    beams, beam, owner = _of_meshes(bodies.mesh[shining], lambda mesh: _kept_beams(scene, mesh))
    if len(beam):
        rows, circles = (np.concatenate([part[k] for part in beams])[beam] for k in (0, 1))
        view, pose = view[owner], pose[owner]
        for name in ("across", "down", "ahead", "place"):
            rows[name] = np.einsum("nij,nj->ni", pose[:, :3, :3], rows[name])
        rows["place"] += pose[:, :3, 3]
        rows["light"] *= strength[view, None]
        middle = np.einsum("nij,nj->ni", pose[:, :2, :2], circles[:, :2]) + pose[:, :2, 3] - eyes[view]
        found.append((rows, np.column_stack([view, middle, circles[:, 2]])))
    return np.concatenate([rows for rows, _ in found]), np.concatenate([places for _, places in found])


def _of_meshes(mesh: I32, find: Callable[[int], Rows]) -> tuple[list[Rows], Any, Any]:
    """What belongs to the bodies of meshes [N].

    Returns:
        Rows of each mesh that occurs, one after the other; for each row of each body, its place among them; and the
        body it belongs to.
    """
    kinds, kind = np.unique(mesh, return_inverse=True)
    found = [find(int(number)) for number in kinds]
    counts = np.array([len(rows) for rows, _ in found], np.int64)
    count = counts[kind] if len(kinds) else counts
    owner = np.repeat(np.arange(len(mesh)), count)
    first = (np.cumsum(counts) - counts)[kind[owner]]
    return found, first + np.arange(len(owner)) - (np.cumsum(count) - count)[owner], owner


def _kept_beams(scene: Scene, mesh: int) -> Rows:
    """The lamps of a body in its own frame, with their circles."""
    return scene.kept(("lamps", mesh), lambda: _fixed(_beams(scene, mesh)))  # type: ignore[no-any-return]


def _fixed(lamps: Sequence[Lamp]) -> Rows:
    """Rows of lamps without shadow maps, and the circles [N, 3] (x, y, radius) that hold what they light."""
    circles = [(*middle, radius) for middle, radius in map(lit_circle, lamps)]
    rows = np.array([_lamp_row(lamp, -1) for lamp in lamps], kernels.Lamp.numpy_dtype())  # type: ignore[attr-defined]
    return rows, np.array(circles, np.float64).reshape(-1, 3)


def _street_lamps(scene: Scene) -> list[Lamp]:
    """The lamps of the street."""
    power, spread, colour, reach = STREET_LAMP
    found = []
    for x, y, z, heading in [] if scene.street is None else scene.street.lamps.astype(np.float64).tolist():
        pose = upright_pose(x, y, heading, z - 0.05) @ np.diag([1.0, -1.0, -1.0, 1.0])
        found.append(Lamp(pose, power, spread, colour, 0.5, False, reach, False))
    return found


def _beams(scene: Scene, mesh: int) -> list[Lamp]:
    """The head and tail lamps of a body, in its own frame."""
    found = []
    for name, (place, area) in scene.lights(mesh).items():
        if area > 0.0:
            head = name == "head_lamp"
            pose = upright_pose(float(place[0]), float(place[1]), 0.0 if head else np.pi, float(place[2]))
            found.append(_beam(pose, HEAD_LAMPS if head else TAIL_LAMPS, 1.0))
    return found


def _occluders(scene: Scene, views: Sequence[View], bodies: Bodies) -> Rows:
    """The bodies of views that keep light from the ground."""
    rows, places = _nothing(kernels.Occluder)
    eyes = np.array([v.pose[:2, 3] for v in views])[bodies.view]
    keep = (np.hypot(*(bodies.pose[:, :2, 3] - eyes).T) < SHADED_UP_TO) & (bodies.pose[:, 2, 2] > 0.9)
    kinds, kind = np.unique(bodies.mesh[keep], return_inverse=True)
    if not len(kinds):
        return rows, places
    standing = zip(*(scene.standing(int(mesh)) for mesh in kinds), strict=True)
    middle, half, under, height = (np.array(column)[kind] for column in standing)
    high = height > FLAT
    middle, half, under, height = (a[high] for a in (middle, half, under, height))
    view, pose, eyes = (a[keep][high] for a in (bodies.view, bodies.pose, eyes))
    rows = np.zeros(len(view), rows.dtype)
    rows["place"] = np.einsum("nij,nj->ni", pose[:, :3, :2], middle) + pose[:, :3, 3]
    rows["heading"] = pose[:, :2, 0] / np.maximum(np.hypot(*pose[:, :2, 0].T), 1e-9)[:, None]
    rows["half"], rows["under"], rows["middle"] = half, under, 0.5 * height
    rows["reach"] = np.hypot(*half.T) + 2.0 * height
    return rows, np.column_stack([view, rows["place"][:, :2] - eyes, rows["reach"]])


def struct_array(struct: Any, rows: Sequence[tuple[Any, ...]]) -> Any:
    """Rows as an array of a kernel's struct; one row of zeros where there is none."""
    dtype = struct.numpy_dtype()
    return np.array(rows, dtype) if rows else np.zeros(1, dtype)


def _grid(places: F64, views: int) -> tuple[I32, I32]:
    """Which squares of the grid of each view circles (view, x, y, radius; m from the eye) touch."""
    cells, cell = int(kernels.CELLS), float(kernels.CELL)
    low = np.clip(np.floor((places[:, 1:3] - places[:, 3:]) / cell) + cells // 2, 0, cells).astype(int)
    high = np.clip(np.floor((places[:, 1:3] + places[:, 3:]) / cell) + cells // 2, -1, cells - 1).astype(int)
    wide, tall = np.maximum(high - low + 1, 0).T
    number = np.repeat(np.arange(len(places)), wide * tall)
    order = np.arange(len(number)) - np.repeat(np.cumsum(wide * tall) - wide * tall, wide * tall)
    column, row = low[number, 0] + order % wide[number], low[number, 1] + order // wide[number]
    square = places[number, 0].astype(int) * cells * cells + row * cells + column
    sort = np.argsort(square, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(square, minlength=views * cells * cells))])
    return start.astype(np.int32), number[sort].astype(np.int32) if len(number) else np.zeros(1, np.int32)


def _lamp_row(lamp: Lamp, layer: int) -> tuple[Any, ...]:
    """A lamp as the kernels want it."""
    across, down = lamp.spread
    turn, place = lamp.pose[:3, :3], lamp.pose[:3, 3]
    light = np.asarray(lamp.colour) * lamp.power / lamp.area()
    inner = (1.0 - lamp.soft) ** 2 - 1e-6  # its fade is as wide as this, also where it has none
    return (
        tuple(place),
        tuple(turn[:, 0] / across),
        tuple(turn[:, 1] / down),
        tuple(turn[:, 2]),
        tuple(light),
        inner,
        int(lamp.is_square),
        lamp.reach,
        layer,
        lamp.texture,
        4.0 * across * down,
    )


def lit_circle(lamp: Lamp) -> tuple[F64, float]:
    """A circle on the map that contains everything a lamp lights.

    It is the circle of the smallest ball around the sector that the lamp's spread and reach bound.

    Returns:
        Middle [2] and radius, m.
    """
    across, down = lamp.spread
    cosine = 1.0 / float(np.hypot(1.0, np.hypot(across, down) if lamp.is_square else max(across, down)))
    sine = float(np.sqrt(1.0 - cosine**2))
    ahead, radius = (cosine, sine) if sine > cosine else (0.5 / cosine, 0.5 / cosine)
    return lamp.pose[:2, 3] + lamp.pose[:2, 2] * (lamp.reach * ahead), lamp.reach * radius


def _beam(pose: F64, kind: tuple[Any, ...], strength: float) -> Lamp:
    """A lamp of a vehicle, at the origin of a frame that looks along x."""
    power, spread, colour, reach, tilt = kind
    ahead = pose @ AHEAD
    ahead[:3, :3] = ahead[:3, :3] @ _tilted(tilt)
    return Lamp(ahead, power * strength, spread, colour, 0.6, False, reach, False)


def lamp_lens(lamp: Lamp) -> tuple[float, float, float, float]:
    """Focal lengths and middle of the camera that a lamp's shadow map is taken with, texels."""
    half = LAMP_SHADOWS / 2
    return half / lamp.spread[0], half / lamp.spread[1], half - 0.5, half - 0.5


def _tilted(angle: float) -> F64:
    """A turn of the axis downwards (camera frame)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])

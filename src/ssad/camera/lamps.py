"""Lamps that light a scene, and the bodies that keep light from the ground: what the kernels read of them.

A lamp lights a plane across its axis evenly: an ellipse, or the rectangle of what it projects. So its power spreads
over the plane that it lights whatever the distance, and head lamps, street lamps, projectors, flashlights and lasers
are one thing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ssad.camera.kernels import light as kernels
from ssad.core.errors import ConfigError
from ssad.core.types import F64, I32

if TYPE_CHECKING:
    from ssad.camera.render import View, Weather
    from ssad.camera.scene import Scene

LUX = 1 / 60  # irradiance / pi of one lux, on the scale on which the sun at noon is about 2.6
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
            texture (see `ssad.camera.texture`): u across, v down its spread. A projector lights a rectangle.
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

    def area(self) -> float:
        """What it lights of a plane 1 m ahead, m^2; where it fades, as much as it is lit."""
        across, down = self.spread
        if self.square or self.texture >= 0:
            return 4.0 * across * down
        return float(np.pi * across * down * (1.0 + (1.0 - self.soft) ** 2) / 2.0)


def own_lamps(vehicle: F64, weather: Weather) -> tuple[Lamp, ...]:
    """The low beam of a vehicle that carries the camera and is not seen: none by day.

    Args:
        vehicle: Vehicle to world [4, 4]: x forward, z up, on the ground, `NOSE` m behind its front.
        weather: Says how far lamps are on.
    """
    strength = lamp_strength(weather.sun_height)
    return (_beam(vehicle @ _moved(np.array([NOSE, 0.0, 0.65])), HEAD_LAMPS, strength),) if strength > 0.0 else ()


def lamps_of(scene: Scene, view: View) -> list[Lamp]:
    """The lamps of a view: its own, and by dusk and night those of the street and of bodies that have them lit."""
    found = list(view.lamps)
    strength = lamp_strength(view.weather.sun_height)
    if strength <= 0.0:
        return found
    eye = view.pose[:3, 3]
    if scene.street is not None:
        down = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
        power, spread, colour, reach = STREET_LAMP
        for x, y, z, heading in scene.street.lamps.astype(np.float64).tolist():
            if np.hypot(x - eye[0], y - eye[1]) < LIT_UP_TO:
                pose = np.eye(4)
                pose[:3, :3] = _turn(heading) @ down
                pose[:3, 3] = x, y, z - 0.05
                found.append(Lamp(pose, power * strength, spread, colour, 0.5, False, reach, False))
    for thing in view.things:
        if thing.lit and np.hypot(*(thing.pose[:2, 3] - eye[:2])) < LIT_UP_TO:
            for place, kind, back in _own(scene, thing.mesh):
                turned = np.diag([-1.0, -1.0, 1.0, 1.0]) if back else np.eye(4)
                found.append(_beam(thing.pose @ _moved(place) @ turned, kind, strength))
    return found


def lamp_strength(sun_height: float) -> float:
    """How far lamps are on: 0 by day, 1 by night."""
    return float(np.clip((0.08 - sun_height) / 0.15, 0, 1))


def near_of(scene: Scene, views: Sequence[View], lamps: Sequence[Sequence[Lamp]], *, contact: bool) -> Any:
    """Lamps and occluders of B views with their grids, as the kernels read them, without shadow maps.

    lamps: of each view, in the order in which their shadow maps are numbered; contact: whether bodies keep light from
    the ground.
    """
    lamp_rows, lamp_places, occluder_rows, occluder_places = [], [], [], []
    layer = 0
    for number, (view, own) in enumerate(zip(views, lamps, strict=True)):
        eye = view.pose[:3, 3]
        for lamp in own:
            lamp_rows.append(_lamp_row(lamp, layer if lamp.shadows else -1))
            layer += lamp.shadows
            middle, around = _lit_circle(lamp)
            lamp_places.append((number, *(middle - eye[:2]), around))
        if contact:
            for thing in view.things:
                away = float(np.hypot(*(thing.pose[:2, 3] - eye[:2])))
                if away < SHADED_UP_TO and thing.pose[2, 2] > 0.9 and scene.standing(thing.mesh)[3] > FLAT:
                    row, middle, around = _occluder_row(scene, thing.mesh, thing.pose)
                    occluder_rows.append(row)
                    occluder_places.append((number, *(middle - eye[:2]), around))
    near = kernels.Near()
    device = scene.device
    tables: Any = (
        ("lamp", kernels.Lamp, lamp_rows, lamp_places),
        ("occluder", kernels.Occluder, occluder_rows, occluder_places),
    )
    for name, struct, rows, places in tables:
        table: Any = struct_array(struct, rows)
        start, listed = _grid(np.array(places, np.float64).reshape(-1, 4), len(views))
        setattr(near, f"{name}s", wp.array(table, dtype=struct, device=device))
        setattr(near, f"{name}_start", wp.array(start, dtype=int, device=device))
        setattr(near, f"{name}_list", wp.array(listed, dtype=int, device=device))
    return near


def struct_array(struct: Any, rows: Sequence[tuple[Any, ...]]) -> Any:
    """Rows as an array of a kernel's struct; one row of zeros where there is none."""
    dtype = struct.numpy_dtype()
    return np.array(rows, dtype) if rows else np.zeros(1, dtype)


def _grid(places: F64, views: int) -> tuple[I32, I32]:
    """Which squares of the grid of each view circles (view, x, y, radius; m from the eye) touch."""
    cells, cell = int(kernels.CELLS), float(kernels.CELL)
    pairs = []
    for number, (view, x, y, radius) in enumerate(places.tolist()):
        low = [max(int(np.floor((v - radius) / cell)) + cells // 2, 0) for v in (x, y)]
        high = [min(int(np.floor((v + radius) / cell)) + cells // 2, cells - 1) for v in (x, y)]
        columns, rows = np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)
        squares = (int(view) * cells * cells + rows[:, None] * cells + columns[None]).ravel()
        pairs.append(np.stack([squares, np.full(len(squares), number)], 1))
    pair = np.concatenate(pairs) if pairs else np.zeros((0, 2), int)
    pair = pair[np.argsort(pair[:, 0], kind="stable")]
    start = np.searchsorted(pair[:, 0], np.arange(views * cells * cells + 1))
    return start.astype(np.int32), pair[:, 1].astype(np.int32) if len(pair) else np.zeros(1, np.int32)


def _lamp_row(lamp: Lamp, layer: int) -> tuple[Any, ...]:
    """A lamp as the kernels want it."""
    across, down = lamp.spread
    turn, place = lamp.pose[:3, :3], lamp.pose[:3, 3]
    square = lamp.square or lamp.texture >= 0
    light = np.asarray(lamp.colour) * lamp.power / lamp.area()
    inner = (1.0 - lamp.soft) ** 2 - 1e-6  # its fade is as wide as this, also where it has none
    return (
        tuple(place), tuple(turn[:, 0] / across), tuple(turn[:, 1] / down), tuple(turn[:, 2]), tuple(light),
        inner, int(square), lamp.reach, layer, lamp.texture, 4.0 * across * down,
    )  # fmt: skip


def _lit_circle(lamp: Lamp) -> tuple[F64, float]:
    """A circle on the map, middle [2] and radius (m), that holds what a lamp lights."""
    ahead = lamp.pose[:3, 2] * lamp.reach
    wide = float(np.hypot(*lamp.spread))
    if wide > 1.0:
        return lamp.pose[:2, 3], lamp.reach
    half = 0.5 * lamp.reach * float(np.sqrt(1.0 + wide * wide))
    return lamp.pose[:2, 3] + 0.5 * ahead[:2], half * (1.0 + wide)


def _occluder_row(scene: Scene, mesh: int, pose: F64) -> tuple[tuple[Any, ...], F64, float]:
    """A body as an occluder for the kernels, where it stands, and how far it works, m."""
    middle, half, under, height = scene.standing(mesh)
    place = pose[:3, :3] @ [middle[0], middle[1], 0.0] + pose[:3, 3]
    forward = pose[:2, 0] / max(float(np.hypot(*pose[:2, 0])), 1e-9)
    reach = float(np.hypot(*half)) + 2.0 * height
    return (tuple(place), tuple(forward), tuple(half), under, 0.5 * height, reach), place[:2], reach


def _own(scene: Scene, mesh: int) -> list[tuple[F64, tuple[Any, ...], bool]]:
    """Where a body has its head and tail lamps (object frame), what they are, and whether they look back."""
    found = []
    for name, (place, area) in scene.lights(mesh).items():
        kind, back = (HEAD_LAMPS, False) if name == "head_lamp" else (TAIL_LAMPS, True)
        if area > 0.0:
            found.append((place, kind, back))
    return found


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


def _turn(heading: float) -> F64:
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _moved(place: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, 3] = place
    return matrix


def _tilted(angle: float) -> F64:
    """A turn of the axis downwards (camera frame)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])

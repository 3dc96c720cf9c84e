"""What can be seen: the triangles of a street and of bodies on a device, and what stands where in a view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.machine import quiet_warp
from ssad.core.types import F32, F64, I32, Bool
from ssad.rendering.camera.kernels import matter
from ssad.rendering.camera.kernels import shade as kernels
from ssad.rendering.meshes.mesh import Material, Mesh
from ssad.rendering.street.model import Street

# pattern of a material by its name; others are plain
PATTERNS = {
    "asphalt": matter.GRAIN,
    "asphalt_patch": matter.GRAIN,
    "asphalt_worn": matter.GRAIN,
    "driveway": matter.GRAIN,
    "kerb": matter.GRAIN,
    "stone": matter.GRAIN,
    "plaster": matter.GRAIN,
    "soil": matter.GRAIN,
    "roofing_felt": matter.GRAIN,
    "cobbles": matter.SLAB,
    "paving": matter.SLAB,
    "brick": matter.BRICK,
    "grass": matter.LEAF,
    "dry_grass": matter.LEAF,
    "lawn": matter.LEAF,
    "meadow": matter.LEAF,
    "hedge": matter.LEAF,
    "forest": matter.LEAF,
    "hills": matter.LEAF,
    "leaves_round": matter.LEAF,
    "leaves_tall": matter.LEAF,
    "leaves_birch": matter.LEAF,
    "leaves_conifer": matter.LEAF,
    "bark": matter.GRAIN,
    "roof_tiles": matter.TILE,
    "boards": matter.TILE,
    "window": matter.GLASS,
    "shop_window": matter.GLASS,
}


@dataclass(frozen=True, slots=True)
class Layer:
    """A texture that a thing wears.

    Attributes:
        texture: Which texture; several layers may show the same.
        rectangle: What it covers of the body's atlas: u0, v0, u1, v1.
        opacity: From 0 to 1.
        mask: Opacity of each texel [h, w] over the rectangle, 0 to 1, of any size; None where it is even.
    """

    texture: int
    rectangle: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    opacity: float = 1.0
    mask: F32 | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        u0, v0, u1, v1 = self.rectangle
        if not (u0 < u1 and v0 < v1 and np.isfinite(self.rectangle).all()):
            raise ConfigError(f"a layer's rectangle is u0, v0, u1, v1 with u0 < u1 and v0 < v1, not {self.rectangle}")
        check_opacity(self.texture, self.opacity, self.mask)


@dataclass(frozen=True, slots=True)
class Decal:
    """A texture on whatever lies in a box in the world and faces it: a road, a wall, a sign, a jacket.

    Attributes:
        texture: Which texture.
        pose: Decal to world [4, 4]: x right and y down on the texture, z into the surface; the origin is its middle.
        size: Width and height, m.
        depth: How far before and behind its middle it reaches, m.
        tag: Of the only thing that wears it; -1 for all, 0 for the street.
        opacity: From 0 to 1.
        mask: As of a layer.
    """

    texture: int
    pose: F64
    size: tuple[float, float]
    depth: float = 0.3
    tag: int = -1
    opacity: float = 1.0
    mask: F32 | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if np.shape(self.pose) != (4, 4) or not np.isfinite(self.pose).all() or not min(*self.size, self.depth) > 0.0:
            raise ConfigError("a decal needs a finite pose [4, 4], and size and depth above 0")
        check_opacity(self.texture, self.opacity, self.mask)


def check_opacity(texture: int, opacity: float, mask: F32 | None) -> None:
    """ConfigError unless a texture has a number from 0 and opacities lie in 0 to 1."""
    if texture < 0 or not 0.0 <= opacity <= 1.0:
        raise ConfigError(f"texture {texture} with opacity {opacity}: numbers start at 0, opacity is 0 to 1")
    if mask is not None and not (np.ndim(mask) == 2 and np.size(mask) and np.min(mask) >= 0 and np.max(mask) <= 1):
        raise ConfigError("a mask of opacities is [h, w] with values from 0 to 1")


@dataclass(frozen=True, slots=True)
class Thing:
    """A body in a view.

    Attributes:
        mesh: Index of its mesh in the stage.
        pose: Object to world [4, 4].
        paint: Linear RGB.
        tag: Number that identifies it in masks and boxes.
        layers: Textures that it wears, the lowest first; faces outside all panels (windows, lamps, tyres) never wear
            any.
        lit: Whether its lamps are on; by night they light what is in front of them.
        hidden: Whether it is invisible; it still casts its shadow.
    """

    mesh: int
    pose: F64
    paint: tuple[float, float, float] = (0.5, 0.5, 0.5)
    tag: int = 0
    layers: tuple[Layer, ...] = ()
    lit: bool = True
    hidden: bool = False


@dataclass(frozen=True, slots=True)
class Draws:
    """N ranges of listed faces, each under one matrix (object to camera) in one view."""

    firsts: I32
    counts: I32
    views: I32
    matrices: F32
    paints: F32
    tags: I32
    lit: I32
    layers: tuple[tuple[Layer, ...], ...]


@dataclass(frozen=True, slots=True)
class Bodies:
    """The N things of B views, view by view.

    Attributes:
        things: The things themselves.
        view: View of each [N].
        mesh: Index of its mesh in the stage [N].
        pose: Object to world [N, 4, 4].
        paint: Linear RGB [N, 3].
        tag: [N].
        lit: Whether its lamps are on [N].
        hidden: Whether it only casts a shadow [N].
    """

    things: tuple[Thing, ...]
    view: I32
    mesh: I32
    pose: F64
    paint: F32
    tag: I32
    lit: Bool
    hidden: Bool


def collect(things: Sequence[Sequence[Thing]]) -> Bodies:
    """The things of B views in arrays.

    Args:
        things: Those of each view.
    """
    flat = tuple(thing for row in things for thing in row)
    return Bodies(
        flat,
        np.repeat(np.arange(len(things), dtype=np.int32), [len(row) for row in things]),
        np.array([t.mesh for t in flat], np.int32),
        np.array([t.pose for t in flat], np.float64).reshape(-1, 4, 4),
        np.array([t.paint for t in flat], np.float32).reshape(-1, 3),
        np.array([t.tag for t in flat], np.int32),
        np.array([t.lit for t in flat], bool),
        np.array([t.hidden for t in flat], bool),
    )


LAMPS = ("head_lamp", "tail_lamp")
NIGHT = {  # what the night adds to the emission of a material while lamps are on
    "head_lamp": 2.0,
    "tail_lamp": 0.8,
    "lamp_light": 4.0,
    "street_light": 4.0,
    "window_blind": 0.3,
    "shop_window": 0.5,
}


class Scene:
    """Triangles of a street (or none) and of meshes, on a device."""

    def __init__(self, street: Street | None, meshes: Sequence[Mesh], *, device: str = "cpu") -> None:
        quiet_warp()
        self.street, self.device = street, device
        if street is not None:
            x, y = np.meshgrid(np.arange(street.nx), np.arange(street.ny))
            self.low = np.stack([street.origin[0] + street.tile * x, street.origin[1] + street.tile * y], -1).reshape(
                -1, 2
            )
        parts: list[Any] = [street] if street is not None else []
        parts += meshes
        if not parts:
            raise ConfigError("a stage needs a street or a mesh")
        vertices, faces, normals, uvs, material, surfaces = [], [], [], [], [], []
        listed = [street.order.astype(np.int32)] if street is not None else []
        first, count, centre, radius = [], [], [], []
        base_v = base_f = base_m = 0
        place = len(listed[0]) if listed else 0
        for number, part in enumerate(parts):
            vertices.append(part.vertices)
            faces.append(part.faces + base_v)
            normals.append(part.normals)
            uvs.append(part.uv)
            material.append(part.material + base_m)
            surfaces += [surface(m) for m in part.materials]
            if street is None or number > 0:
                listed.append(np.arange(base_f, base_f + len(part.faces), dtype=np.int32))
                first.append(place)
                count.append(len(part.faces))
                low, high = part.bounds()
                centre.append((low + high) / 2)
                radius.append(float(np.linalg.norm(high - low) / 2))
                place += len(part.faces)
            base_v, base_f, base_m = base_v + len(part.vertices), base_f + len(part.faces), base_m + len(part.materials)

        # of each mesh: where its faces begin in the list, how many there are, and the ball around it
        self.first, self.count = np.array(first, np.int32), np.array(count, np.int32)
        self.centre, self.radius = np.array(centre, np.float64).reshape(-1, 3), np.array(radius, np.float64)

        def on(values: Any, dtype: Any) -> Any:
            return wp.array(values, dtype=dtype, device=device)

        self.vertices = on(np.concatenate(vertices), wp.vec3)
        self.faces = on(np.concatenate(faces).astype(np.int32), wp.int32)
        self.normals = on(np.concatenate(normals), wp.vec3)
        self.uvs = on(np.concatenate(uvs), wp.vec2)
        self.material = on(np.concatenate(material).astype(np.int32), wp.int32)
        worn = [p.panel >= 0 if isinstance(p, Mesh) else np.zeros(len(p.faces), bool) for p in parts]
        self.wearable = on(np.concatenate(worn).astype(np.int32), wp.int32)
        self.meshes = tuple(meshes)
        self._kept: dict[Any, Any] = {}
        rows: Any = np.array(surfaces, dtype=matter.Surface.numpy_dtype())  # type: ignore[attr-defined]
        self.surfaces = on(rows, matter.Surface)
        self.listed = on(np.concatenate(listed), wp.int32)
        self.geometry = kernels.Geometry()
        for name in ("vertices", "faces", "normals", "uvs", "material", "surfaces", "wearable"):
            setattr(self.geometry, name, getattr(self, name))

    def kept(self, key: Any, make: Callable[[], Any]) -> Any:
        """What was made once for this scene."""
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]

    def lights(self, mesh: int) -> dict[str, tuple[F64, float]]:
        """Middle [3] (object frame, m) and area (m^2) of the head lamps and of the tail lamps of a mesh."""
        body = self.meshes[mesh]
        names, areas, middles = [m.name for m in body.materials], body.areas(), body.corners().mean(1)
        found = {}
        for name in LAMPS:
            weight = areas * np.isin(body.material, [k for k, other in enumerate(names) if other == name])
            total = float(weight.sum())
            found[name] = (weight @ middles / max(total, 1e-12), total)
        return found

    def standing(self, mesh: int) -> tuple[F64, F64, float, float]:
        """What a mesh covers of the ground.

        The faces that look down from at most half its height decide how much of the bounding rectangle is covered, and
        from which height.

        Args:
            mesh: Index of the mesh.

        Returns:
            Middle [2]; half length and half width of what is covered [2]; height of its underside; and height of its
            top, all in the object frame, m.
        """
        return self.kept(("standing", mesh), lambda: _standing(self.meshes[mesh]))  # type: ignore[no-any-return]

    def tiles(
        self, eyes: F64, axes: F64 | None, *, reach: tuple[float, float], far: F64, horizon: bool
    ) -> tuple[I32, I32, I32]:
        """The street's tiles that B views need.

        Args:
            eyes: Positions [B, 3].
            axes: Viewing directions [B, 3]: what lies wholly behind is left out. None: all around.
            reach: Distances up to which tiles are drawn in full, and without small things, m.
            far: Distance beyond which tiles are not drawn at all [B], m.
            horizon: Whether the far ground belongs to them.

        Returns:
            First and count in the list of faces, and the view, of each tile.
        """
        street = self.street
        if street is None:
            return (np.zeros(0, np.int32),) * 3
        gap = np.maximum(np.maximum(self.low - eyes[:, None, :2], eyes[:, None, :2] - self.low - street.tile), 0.0)
        away = np.hypot(gap[..., 0], gap[..., 1])
        keep = away <= far[:, None]
        if axes is not None:
            middle = self.low + street.tile / 2 - eyes[:, None, :2]
            ahead = np.einsum("btk,bk->bt", middle, axes[:, :2]) > -0.75 * street.tile
            keep &= ahead | (np.abs(axes[:, 2:3]) > 0.7)
        level = (away > reach[0]).astype(int) + (away > reach[1])
        view, tile = np.nonzero(keep)
        levels = level[keep]
        if horizon:
            view = np.concatenate([view, np.arange(len(eyes))])
            tile = np.concatenate([tile, np.full(len(eyes), street.nx * street.ny)])
            levels = np.concatenate([levels, np.zeros(len(eyes), int)])
        start = street.offset[levels, tile]
        count = street.offset[levels, tile + 1] - start
        some = count > 0
        return start[some].astype(np.int32), count[some].astype(np.int32), view[some].astype(np.int32)

    def gather(
        self,
        inverses: F64,
        bodies: Bodies,
        *,
        eyes: F64,
        axes: F64 | None,
        reach: tuple[float, float],
        far: F64,
        horizon: bool = True,
        casting: bool = False,
    ) -> Draws:
        """What B views need: tiles of the street, and things that are neither wholly behind them nor too far away.

        Args:
            inverses: World to camera [B, 4, 4].
            bodies: The things of all views.
            eyes: See `tiles`.
            axes: See `tiles`.
            reach: See `tiles`.
            far: Distance beyond which nothing is drawn [B], m.
            horizon: See `tiles`.
            casting: Whether hidden things are needed too.
        """
        first, count, view = self.tiles(eyes, axes, reach=reach, far=far, horizon=horizon)
        tiles = len(first)
        matrices = inverses[view]
        seen = np.arange(len(bodies.things)) if casting else np.flatnonzero(~bodies.hidden)
        if len(seen):
            mesh, owner = bodies.mesh[seen], bodies.view[seen]
            moved = inverses[owner] @ bodies.pose[seen]
            middle, radius = self.centre[mesh], self.radius[mesh]
            local = np.einsum("nij,nj->ni", moved[:, :3, :3], middle) + moved[:, :3, 3]
            limit = far[owner]
            if axes is not None:
                keep = (local[:, 2] > -radius) & (local[:, 2] < limit)
            else:
                keep = np.abs(local[:, :2]).max(1) < limit
            seen, mesh, owner = seen[keep], mesh[keep], owner[keep]
            first = np.concatenate([first, self.first[mesh]])
            count = np.concatenate([count, self.count[mesh]])
            view = np.concatenate([view, owner])
            matrices = np.concatenate([matrices, moved[keep]])
        if not len(first):  # nothing but sky: one range without faces
            first, count, view, matrices = *(np.zeros(1, np.int32) for _ in range(3)), np.eye(4)[None]
            tiles = 1
        n = len(first)
        paints, tags, lit = np.zeros((n, 3), np.float32), np.zeros(n, np.int32), np.ones(n, np.int32)
        paints[tiles:], tags[tiles:], lit[tiles:] = bodies.paint[seen], bodies.tag[seen], bodies.lit[seen]
        layers = ((),) * tiles + tuple(bodies.things[k].layers for k in seen.tolist())
        return Draws(first, count, view, matrices.astype(np.float32), paints, tags, lit, layers)


def surface(material: Material) -> tuple[Any, ...]:
    """A material as the kernels want it."""
    pattern = PATTERNS.get(material.name, matter.PLAIN)
    night, lamp = NIGHT.get(material.name, 0.0), int(material.name in LAMPS)
    return (
        material.colour,
        material.specular,
        material.gloss,
        material.emission,
        night,
        int(material.paint),
        lamp,
        int(pattern),
    )


def _standing(body: Mesh) -> tuple[F64, F64, float, float]:
    """See `Scene.standing`."""
    low, high = body.bounds()
    corners = body.corners()
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat, heights = np.maximum(-0.5 * cross[:, 2], 0.0), corners[..., 2].mean(1)
    flat = flat * (heights <= 0.5 * high[2])
    sides = np.maximum(high[:2] - low[:2], 1e-3)
    fill = float(np.clip(flat.sum() / sides.prod(), 0.1, 1.0))
    under = float((flat * heights).sum() / max(float(flat.sum()), 1e-9)) if flat.any() else 0.0
    return low[:2] + 0.5 * sides, 0.5 * sides * np.sqrt(fill), max(under, 0.03), float(high[2])

"""Scenes: the triangles of a street and of bodies on a device, and the objects of a view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any

import numpy as np
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.machine import start_warp_quietly
from ssad.core.types import F32, F64, I32, Bool
from ssad.rendering.camera.kernels import light as light_kernels
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
    "tree_line": matter.LEAF,
    "field_meadow": matter.LEAF,
    "field_crop": matter.LEAF,
    "field_stubble": matter.LEAF,
    "field_soil": matter.GRAIN,
    "parking_bay": matter.GRAIN,
    "leaves_round": matter.LEAF,
    "leaves_tall": matter.LEAF,
    "leaves_birch": matter.LEAF,
    "leaves_conifer": matter.LEAF,
    "twigs": matter.LEAF,
    "bark": matter.GRAIN,
    "roof_tiles": matter.TILE,
    "boards": matter.TILE,
    "window": matter.GLASS,
    "shop_window": matter.GLASS,
    "window_curtain": matter.GLASS,
    "window_room": matter.GLASS,
    "shop_back": matter.GLASS,
    "shop_ceiling": matter.GLASS,
    "shop_goods": matter.GLASS,
}


@dataclass(frozen=True, slots=True)
class TextureLayer:
    """Texture on an object.

    Attributes:
        texture: Index of the texture; several layers may show the same.
        rectangle: Part of the body's atlas that it covers: u0, v0, u1, v1.
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
class TextureDecal:
    """Texture on all surfaces in a box in the world that face it: a road, a wall, a sign, a jacket.

    Attributes:
        texture: Index of the texture.
        pose: Decal to world [4, 4]: x right and y down on the texture, z into the surface; the origin is its
            middle.
        size: Width and height, m.
        depth: Reach in front of and behind its middle, m.
        tag: Tag of the only object that wears it; -1 for all, 0 for the street.
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
    """Check that a texture index is at least 0 and opacities lie in 0 to 1.

    Raises:
        ConfigError: A value is outside its range.
    """
    if texture < 0 or not 0.0 <= opacity <= 1.0:
        raise ConfigError(f"texture {texture} with opacity {opacity}: numbers start at 0, opacity is 0 to 1")
    if mask is not None and not (np.ndim(mask) == 2 and np.size(mask) and np.min(mask) >= 0 and np.max(mask) <= 1):
        raise ConfigError("a mask of opacities is [h, w] with values from 0 to 1")


@dataclass(frozen=True, slots=True)
class Finish:
    """Finish of a body beyond the colour of its paint.

    Attributes:
        metallic: Strength of the effect pigments in its paint, 0 to 1: surfaces that face the camera are lighter,
            those that turn away darker, as flakes that lie flat in the paint make them.
        dirt: Amount of dirt and dust, 0 to 1.
        wear: Chalking, scratches and rust of its paint, 0 to 1.
        seed: Of its pattern.

    Raises:
        ConfigError: A value is outside its range.
    """

    metallic: float = 0.0
    dirt: float = 0.0
    wear: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not all(0.0 <= amount <= 1.0 for amount in (self.metallic, self.dirt, self.wear)):
            raise ConfigError(
                f"a finish of {self.metallic} (metallic), {self.dirt} (dirt), {self.wear} (wear): give 0 to 1"
            )


@dataclass(frozen=True, slots=True)
class SceneObject:
    """Body in a view.

    Attributes:
        mesh: Index of its mesh in the scene.
        pose: Object to world [4, 4].
        paint: Linear RGB.
        tag: Number that identifies it in masks and boxes.
        layers: Textures that it wears, the lowest first; faces outside all panels (windows, lamps, tyres) never
            wear any.
        is_lit: Whether its lamps are on; at night they light the scene.
        is_hidden: Whether it is invisible; it still casts its shadow.
        signals: `LampSignal` bits of its stop lamps and indicators that shine.
        effect: Name of the effect of the rendering without which it is not drawn; "": always.
        finish: Metallic paint, dirt and wear; None for a clean body. What wears textures stays clean.
    """

    mesh: int
    pose: F64
    paint: tuple[float, float, float] = (0.5, 0.5, 0.5)
    tag: int = 0
    layers: tuple[TextureLayer, ...] = ()
    is_lit: bool = True
    is_hidden: bool = False
    signals: int = 0
    effect: str = ""
    finish: Finish | None = None


class LampSignal(IntFlag):
    """Stop lamps and indicators of a vehicle."""

    BRAKE = int(light_kernels.BRAKING)
    LEFT = int(light_kernels.TURNING_LEFT)
    RIGHT = int(light_kernels.TURNING_RIGHT)


@dataclass(frozen=True, slots=True)
class DrawCalls:
    """N ranges of listed faces, each under one matrix (object to camera) in one view.

    `lit` are bits of the kernels: lamps on, and `LampSignal`. `splits` [N, 2] are as of `RenderScene.lamp_split`.
    """

    firsts: I32
    counts: I32
    views: I32
    matrices: F32
    paints: F32
    tags: I32
    lit: I32
    splits: F32
    layers: tuple[tuple[TextureLayer, ...], ...]


@dataclass(frozen=True, slots=True)
class ObjectTable:
    """The N objects of B views as arrays, view by view.

    Attributes:
        objects: The objects themselves.
        view: View of each [N].
        mesh: Index of its mesh in the scene [N].
        pose: Object to world [N, 4, 4].
        paint: Linear RGB [N, 3].
        tag: [N].
        lit: Whether its lamps are on [N].
        hidden: Whether it only casts a shadow [N].
        signals: `LampSignal` bits [N].
    """

    objects: tuple[SceneObject, ...]
    view: I32
    mesh: I32
    pose: F64
    paint: F32
    tag: I32
    lit: Bool
    hidden: Bool
    signals: I32


def collect_objects(objects_by_view: Sequence[Sequence[SceneObject]]) -> ObjectTable:
    """The things of B views in arrays.

    Args:
        objects_by_view: Those of each view.
    """
    flat_objects = tuple(scene_object for view_objects in objects_by_view for scene_object in view_objects)
    return ObjectTable(
        flat_objects,
        np.repeat(
            np.arange(len(objects_by_view), dtype=np.int32), [len(view_objects) for view_objects in objects_by_view]
        ),
        np.array([entry.mesh for entry in flat_objects], np.int32),
        np.array([entry.pose for entry in flat_objects], np.float64).reshape(-1, 4, 4),
        np.array([entry.paint for entry in flat_objects], np.float32).reshape(-1, 3),
        np.array([entry.tag for entry in flat_objects], np.int32),
        np.array([entry.is_lit for entry in flat_objects], bool),
        np.array([entry.is_hidden for entry in flat_objects], bool),
        np.array([entry.signals for entry in flat_objects], np.int32),
    )


LAMPS = ("head_lamp", "tail_lamp")
LAMP_KINDS = {  # kind of lamp of a material by its name
    "head_lamp": int(light_kernels.HEAD_LAMP),
    "tail_lamp": int(light_kernels.TAIL_LAMP),
    "indicator": int(light_kernels.INDICATOR),
    "brake_lamp": int(light_kernels.BRAKE_LAMP),
    "lamp_light": int(light_kernels.STREET_LAMP),
}
LEAF = 0.13  # m from leaf to leaf on a card
INDICATOR_SHARE = 0.35  # outer share of the width of a head or tail lamp that is its indicator
CLUSTER_SIDE = 0.35  # m from the axis that a lamp with an indicator reaches: those of motorcycles do not
NIGHT = {  # added to the emission of a material at night, while lamps are on
    "head_lamp": 2.0,
    "tail_lamp": 0.8,
    "lamp_light": 4.0,
    "street_light": 4.0,
    "window_blind": 0.3,
    "shop_window": 0.5,
}


class RenderScene:
    """Triangles of a street (or none) and of meshes, on a device."""

    def __init__(self, street: Street | None, meshes: Sequence[Mesh], *, device: str = "cpu") -> None:
        start_warp_quietly()
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
        listed_faces = [street.order.astype(np.int32)] if street is not None else []
        firsts, counts, centres, radii = [], [], [], []
        vertex_base = face_base = material_base = 0
        list_position = len(listed_faces[0]) if listed_faces else 0
        for part_index, part in enumerate(parts):
            # Parts share one buffer: indices are shifted by the entries before them.
            vertices.append(part.vertices)
            faces.append(part.faces + vertex_base)
            normals.append(part.normals)
            uvs.append(part.uv)
            material.append(part.material + material_base)
            surfaces += [surface(entry) for entry in part.materials]
            if street is None or part_index > 0:
                listed_faces.append(np.arange(face_base, face_base + len(part.faces), dtype=np.int32))
                firsts.append(list_position)
                counts.append(len(part.faces))
                lower, upper = part.bounds()
                centres.append((lower + upper) / 2)
                radii.append(float(np.linalg.norm(upper - lower) / 2))
                list_position += len(part.faces)
            vertex_base, face_base, material_base = (
                vertex_base + len(part.vertices),
                face_base + len(part.faces),
                material_base + len(part.materials),
            )

        # Per mesh: first face in the list, number of faces, and bounding sphere.
        self.first, self.count = np.array(firsts, np.int32), np.array(counts, np.int32)
        self.centre, self.radius = np.array(centres, np.float64).reshape(-1, 3), np.array(radii, np.float64)

        def to_device(values: Any, dtype: Any) -> Any:
            return wp.array(values, dtype=dtype, device=device)

        self.vertices = to_device(np.concatenate(vertices), wp.vec3)
        self.faces = to_device(np.concatenate(faces).astype(np.int32), wp.int32)
        self.normals = to_device(np.concatenate(normals), wp.vec3)
        self.uvs = to_device(np.concatenate(uvs), wp.vec2)
        self.material = to_device(np.concatenate(material).astype(np.int32), wp.int32)
        has_panel = [
            each_part.panel >= 0 if isinstance(each_part, Mesh) else np.zeros(len(each_part.faces), bool)
            for each_part in parts
        ]
        self.wearable = to_device(np.concatenate(has_panel).astype(np.int32), wp.int32)
        self.meshes = tuple(meshes)
        self.material_names = tuple(entry.name for part in parts for entry in part.materials)
        self._cache: dict[Any, Any] = {}
        surface_rows: Any = np.array(surfaces, dtype=matter.Surface.numpy_dtype())  # type: ignore[attr-defined]
        self.surfaces = to_device(surface_rows, matter.Surface)
        self.listed = to_device(np.concatenate(listed_faces), wp.int32)
        self.twigs = to_device(
            _twigs(np.concatenate(vertices), np.concatenate(faces), self.material_names, np.concatenate(material)),
            wp.int32,
        )
        self.geometry = kernels.Geometry()
        for name in ("vertices", "faces", "normals", "uvs", "material", "surfaces", "wearable"):
            setattr(self.geometry, name, getattr(self, name))

    def compute_once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return a value that is computed once for this scene, under a key."""
        if key not in self._cache:
            self._cache[key] = make()
        return self._cache[key]

    def lights(self, mesh: int) -> dict[str, tuple[F64, float]]:
        """Return middle [3] (object frame, m) and area (m^2) of the head lamps and tail lamps of a mesh."""
        body = self.meshes[mesh]
        names, areas, middles = (
            [body_material.name for body_material in body.materials],
            body.areas(),
            body.corners().mean(1),
        )
        lights_by_kind = {}
        for name in LAMPS:
            weight = areas * np.isin(
                body.material,
                [material_index for material_index, material_name in enumerate(names) if material_name == name],
            )
            total = float(weight.sum())
            lights_by_kind[name] = (weight @ middles / max(total, 1e-12), total)
        return lights_by_kind

    def lamp_split(self, mesh: int) -> tuple[float, float]:
        """Return the distances from the axis of a mesh beyond which its head lamps and tail lamps are indicators, m.

        They are infinite where the mesh has indicators of its own, or lamps that are not at its sides.
        """
        return self.compute_once(("lamp split", mesh), lambda: _lamp_split(self.meshes[mesh]))  # type: ignore[no-any-return]

    def extent(self, mesh: int) -> tuple[F64, F64]:
        """Return the smallest and the largest corner of a mesh in its own frame, m, [3] each."""
        return self.compute_once(("extent", mesh), self.meshes[mesh].bounds)  # type: ignore[no-any-return]

    def ground_cover(self, mesh: int) -> tuple[F64, F64, float, float]:
        """Return the ground that a mesh covers.

        The faces that look down from at most half its height determine the covered share of the bounding rectangle,
        and the height of the underside.

        Args:
            mesh: Index of the mesh.

        Returns:
            Middle [2]; half length and half width of the covered area [2]; height of its underside; and height of
            its top, all in the object frame, m.
        """
        return self.compute_once(("standing", mesh), lambda: _ground_cover(self.meshes[mesh]))  # type: ignore[no-any-return]

    def tiles(
        self, eyes: F64, axes: F64 | None, *, reach: tuple[float, float], far: F64, horizon: bool
    ) -> tuple[I32, I32, I32]:
        """Return the tiles of the street that B views need.

        Args:
            eyes: Positions [B, 3].
            axes: Viewing directions [B, 3]; tiles completely behind the view are left out. None: all around.
            reach: Distances up to which tiles are drawn in full, and without small objects, m.
            far: Distance beyond which tiles are not drawn at all [B], m.
            horizon: Whether the far ground is included.

        Returns:
            First and count in the list of faces, and the view, of each tile.
        """
        street = self.street
        if street is None:
            return (np.zeros(0, np.int32),) * 3
        axis_gaps = np.maximum(
            np.maximum(self.low - eyes[:, None, :2], eyes[:, None, :2] - self.low - street.tile), 0.0
        )
        distances = np.hypot(axis_gaps[..., 0], axis_gaps[..., 1])
        is_near = distances <= far[:, None]
        if axes is not None:
            tile_centres = self.low + street.tile / 2 - eyes[:, None, :2]
            is_ahead = np.einsum("btk,bk->bt", tile_centres, axes[:, :2]) > -0.75 * street.tile
            # A steep view direction says little about the tiles that it reaches.
            is_near &= is_ahead | (np.abs(axes[:, 2:3]) > 0.7)
        tile_levels = (distances > reach[0]).astype(int) + (distances > reach[1])
        view_index, tile_index = np.nonzero(is_near)
        kept_levels = tile_levels[is_near]
        if horizon:
            view_index = np.concatenate([view_index, np.arange(len(eyes))])
            tile_index = np.concatenate([tile_index, np.full(len(eyes), street.nx * street.ny)])
            kept_levels = np.concatenate([kept_levels, np.zeros(len(eyes), int)])
        first_faces = street.offset[kept_levels, tile_index]
        face_counts = street.offset[kept_levels, tile_index + 1] - first_faces
        has_faces = face_counts > 0
        return (
            first_faces[has_faces].astype(np.int32),
            face_counts[has_faces].astype(np.int32),
            view_index[has_faces].astype(np.int32),
        )

    def gather_draw_calls(
        self,
        inverses: F64,
        bodies: ObjectTable,
        *,
        eyes: F64,
        axes: F64 | None,
        reach: tuple[float, float],
        far: F64,
        horizon: bool = True,
        casts_shadows: bool = False,
        street_lit: Bool | None = None,
    ) -> DrawCalls:
        """Return what B views draw: tiles of the street, and objects neither wholly behind them nor too far away.

        Args:
            inverses: World to camera [B, 4, 4].
            bodies: The things of all views.
            eyes: See `tiles`.
            axes: See `tiles`.
            reach: See `tiles`.
            far: Distance beyond which nothing is drawn [B], m.
            horizon: See `tiles`.
            casts_shadows: Whether hidden things are needed too.
            street_lit: Whether the lamps of the street are on in each view [B]; None: in all.
        """
        firsts, counts, views = self.tiles(eyes, axes, reach=reach, far=far, horizon=horizon)
        tile_count = len(firsts)
        matrices = inverses[views]
        visible = np.arange(len(bodies.objects)) if casts_shadows else np.flatnonzero(~bodies.hidden)
        if len(visible):
            meshes, owners = bodies.mesh[visible], bodies.view[visible]
            to_camera = inverses[owners] @ bodies.pose[visible]
            centres, radii = self.centre[meshes], self.radius[meshes]
            camera_centres = np.einsum("nij,nj->ni", to_camera[:, :3, :3], centres) + to_camera[:, :3, 3]
            far_limits = far[owners]
            if axes is not None:
                is_in_range = (camera_centres[:, 2] > -radii) & (camera_centres[:, 2] < far_limits)
            else:
                is_in_range = np.abs(camera_centres[:, :2]).max(1) < far_limits
            visible, meshes, owners = visible[is_in_range], meshes[is_in_range], owners[is_in_range]
            firsts = np.concatenate([firsts, self.first[meshes]])
            counts = np.concatenate([counts, self.count[meshes]])
            views = np.concatenate([views, owners])
            matrices = np.concatenate([matrices, to_camera[is_in_range]])
        if not len(firsts):  # nothing but sky: one range without faces
            firsts, counts, views, matrices = *(np.zeros(1, np.int32) for _ in range(3)), np.eye(4)[None]
            tile_count = 1
        draw_count = len(firsts)
        paints, tags, lit = (
            np.zeros((draw_count, 3), np.float32),
            np.zeros(draw_count, np.int32),
            np.ones(draw_count, np.int32),
        )
        splits = np.full((draw_count, 2), np.inf, np.float32)
        if street_lit is not None:
            lit[:tile_count] = street_lit[views[:tile_count]]
        paints[tile_count:], tags[tile_count:], lit[tile_count:] = (
            bodies.paint[visible],
            bodies.tag[visible],
            bodies.lit[visible] | bodies.signals[visible],
        )
        for draw in np.flatnonzero(bodies.signals[visible]).tolist():
            splits[tile_count + draw] = self.lamp_split(int(bodies.mesh[visible[draw]]))
        layers = ((),) * tile_count + tuple(bodies.objects[object_index].layers for object_index in visible.tolist())
        return DrawCalls(firsts, counts, views, matrices.astype(np.float32), paints, tags, lit, splits, layers)


def _twigs(vertices: F32, faces: I32, names: Sequence[str], material: I32) -> I32:
    """Return what the visibility pass cuts out of each face [F]: 0 for nothing.

    A card of leaves has rows and columns of leaves of about `LEAF` m, and one of 64 variations: see `raster.Triangle`.
    """
    twigs = np.zeros(len(faces), np.int32)
    cards = np.flatnonzero(np.isin(material, [index for index, name in enumerate(names) if name == "twigs"]))
    corners = vertices[faces[cards]]
    bases = corners[:, 2] - corners[:, 0]
    heights = np.linalg.norm(corners[:, 1] - 0.5 * (corners[:, 0] + corners[:, 2]), axis=1)
    rows, columns = (np.clip(np.round(size / LEAF), 2, 63) for size in (heights, np.linalg.norm(bases, axis=1)))
    twigs[cards] = rows + 64 * columns + 4096 * (cards % 64)
    return twigs


def surface(material: Material) -> tuple[Any, ...]:
    """Return the row of a material for the kernels."""
    pattern = PATTERNS.get(material.name, matter.PLAIN)
    night, lamp = NIGHT.get(material.name, 0.0), LAMP_KINDS.get(material.name, 0)
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


def _lamp_split(body: Mesh) -> tuple[float, float]:
    """See `RenderScene.lamp_split`."""
    corners = body.corners()
    kinds = np.array([LAMP_KINDS.get(material.name, 0) for material in body.materials])[body.material]
    indicators = corners[kinds == LAMP_KINDS["indicator"]].reshape(-1, 3)
    splits = []
    for name in LAMPS:
        lamps = corners[kinds == LAMP_KINDS[name]].reshape(-1, 3)
        sides = np.abs(lamps[:, 1])
        if not len(lamps) or sides.max() < CLUSTER_SIDE:
            splits.append(np.inf)
            continue
        # Indicators of its own are those at the same end of the body.
        is_same_end = np.abs(indicators[:, 0] - lamps[:, 0].mean()) < 0.3 * np.ptp(corners[..., 0])
        split = sides.max() - INDICATOR_SHARE * (sides.max() - sides.min())
        splits.append(np.inf if is_same_end.any() else float(split))
    return splits[0], splits[1]


def _ground_cover(body: Mesh) -> tuple[F64, F64, float, float]:
    """See `RenderScene.ground_cover`."""
    lower, upper = body.bounds()
    corners = body.corners()
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    downward_areas, face_heights = np.maximum(-0.5 * face_normals[:, 2], 0.0), corners[..., 2].mean(1)
    downward_areas = downward_areas * (face_heights <= 0.5 * upper[2])
    sides = np.maximum(upper[:2] - lower[:2], 1e-3)
    covered_share = float(np.clip(downward_areas.sum() / sides.prod(), 0.1, 1.0))
    underside = (
        float((downward_areas * face_heights).sum() / max(float(downward_areas.sum()), 1e-9))
        if downward_areas.any()
        else 0.0
    )
    # The square root shrinks both sides so that the area is the covered share.
    return lower[:2] + 0.5 * sides, 0.5 * sides * np.sqrt(covered_share), max(underside, 0.03), float(upper[2])

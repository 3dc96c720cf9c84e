"""Construction of the street of a town from its lane graph, deterministic for town, seed and style."""

from __future__ import annotations

import contextlib
import hashlib

import numpy as np

from ssad.core.errors import FormatError, StoreError
from ssad.core.lane_graph import LaneGraph
from ssad.core.safeio import home_folder
from ssad.core.seeding import generator
from ssad.rendering.meshes.mesh import F32
from ssad.rendering.street.bays import lay_bays
from ssad.rendering.street.dressing import (
    Masts,
    place_furniture,
    place_limit_signs,
    place_signal_masts,
    place_street_lamps,
    plant_grass,
    plant_trees,
)
from ssad.rendering.street.free_ground import FreeGround, sides
from ssad.rendering.street.markings import paint_markings
from ssad.rendering.street.model import FORMAT, TILE, Street, load_street, save_street
from ssad.rendering.street.palette import STYLES, TownMaterials, style_of
from ssad.rendering.street.paving import pave_ground, pave_sidewalks
from ssad.rendering.street.plots import build_along_streets, fill_blocks
from ssad.rendering.street.region import survey
from ssad.rendering.street.triangles import Palette, TriangleBuilder, join, tiles
from ssad.rendering.street.yards import entrances, lay_yards
from ssad.world.roads.library import load_town

REVISION = 10  # of the construction: a cached street of another revision is not used


def build_street(town: LaneGraph | str, *, seed: int = 0, style: str | None = None) -> Street:
    """Build the static geometry of a town; equal arguments give equal bytes.

    Args:
        town: A lane graph, or the name of a town.
        seed: Seed of facades, colours and plants.
        style: One of STYLES; None: that of the town.

    Raises:
        MapError: The town is not flat, or has no drivable lane.
        UnknownNameError: There is no such town or style.
    """
    graph = load_town(town) if isinstance(town, str) else town
    name = style_of(graph.name, style)
    materials = TownMaterials(
        STYLES[name],
        Palette(),
        generator("street", graph.name, seed, name),
        generator("street details", graph.name, seed, name),
    )
    builder, ground = TriangleBuilder(), survey(graph)
    free_ground, masts, street_sides = FreeGround(graph, ground), Masts(), sides(graph)
    # The order matters: each step occupies free ground and draws from the same generator.
    pave_ground(builder, graph, ground, materials)
    paint_markings(builder, graph, materials)
    place_signal_masts(builder, graph, free_ground, materials, masts)
    place_street_lamps(builder, free_ground, materials, street_sides, masts)
    limit_signs = place_limit_signs(graph, free_ground, street_sides)
    yards = lay_yards(builder, free_ground, materials, street_sides)
    plots = build_along_streets(builder, free_ground, materials, street_sides)
    fill_blocks(builder, free_ground, materials, tries=int(ground.paved.size / 700))
    place_furniture(builder, free_ground, materials, street_sides)
    plant_trees(builder, free_ground, materials, plots.parks)
    plant_grass(builder, free_ground, materials, street_sides)
    bays = lay_bays(builder, free_ground, materials)
    yard_entrances = entrances(free_ground, yards.frontages, _f32(bays, 5).astype(np.float64))
    pave_sidewalks(builder, graph, materials, yard_entrances)
    geometry = join(builder.pieces)
    origin, nx, ny, order, offset = tiles(np.concatenate(builder.owner), geometry.levels)
    return Street(
        name=graph.name,
        style=name,
        vertices=_f32(geometry.vertices, 3),
        faces=np.ascontiguousarray(geometry.faces, np.int32),
        normals=np.ascontiguousarray(geometry.normals, np.float32),
        uv=np.ascontiguousarray(geometry.uv, np.float32),
        material=np.ascontiguousarray(geometry.material, np.int32),
        materials=tuple(materials.palette.table),
        tile=TILE,
        origin=origin,
        nx=nx,
        ny=ny,
        order=order,
        offset=offset,
        lamps=_f32(masts.lamps, 4),
        heads=_f32(masts.heads, 4),
        head_signal=np.array(masts.signal, np.int32),
        head_lens=np.array(masts.lens, np.int32).reshape(-1, 3, 2),
        parking=_f32(plots.parking + yards.cells, 3),
        bays=_f32(bays, 5),
        yards=_f32(yards.rows, 5),
        limit_signs=_f32(limit_signs, 5),
    )


def _f32(rows: object, columns: int) -> F32:
    return np.asarray(rows, np.float32).reshape(-1, columns)


def cached_street(town: LaneGraph | str, *, seed: int = 0, style: str | None = None) -> Street:
    """Return `build_street` from a cache in $SSAD_HOME/cache/streets.

    If the cache cannot be written, the street is built each time.
    """
    graph = load_town(town) if isinstance(town, str) else town
    name = style_of(graph.name, style)
    digest = hashlib.sha256(f"{FORMAT} {REVISION} {graph.name} {seed} {name}".encode())
    for key in (
        "xy",
        "width",
        "offset",
        "kind",
        "junction",
        "left",
        "right",
        "left_marking",
        "right_marking",
        "signal_xy",
        "signal_yaw",
        "signal_virtual",
        "stop_s",
        "stop_lane",
        "crosswalk_xy",
        "sign_xy",
        "sign_kind",
        "rule_sign",
        "rule_lane",
        "speed_limit",
        "left_hand",
    ):
        digest.update(getattr(graph, key).tobytes())
    path = home_folder() / "cache" / "streets" / f"{digest.hexdigest()[:24]}.npz"
    if path.exists():
        with contextlib.suppress(FormatError):  # a broken file is built again below
            return load_street(path)
    street = build_street(graph, seed=seed, style=name)
    with contextlib.suppress(StoreError):
        save_street(street, path)
    return street

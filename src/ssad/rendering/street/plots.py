"""Plots along streets and inside blocks: buildings with their drives, fences and hedges, car parks, small parks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.buildings import draw_building, draw_size
from ssad.rendering.street.free_ground import FreeGround, Side, footprint, place
from ssad.rendering.street.furniture import bench, fence, wheelie_bin
from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.paving import EARTH
from ssad.rendering.street.plants import hedge
from ssad.rendering.street.triangles import ALL, TriangleBuilder, TrianglePiece, flat
from ssad.rendering.street.yards import DEPTHS as YARD_DEPTHS

Pose = tuple[float, float, float]
FLAT = EARTH + 0.012  # m, height of drives and yards over the earth
DETACHED = ("house", "bungalow")


@dataclass(frozen=True)
class _PlotBuilder:
    """Shared state of plot building: geometry, free ground, materials and common pieces."""

    triangles: TriangleBuilder
    ground: FreeGround
    materials: TownMaterials
    hedges: list[TrianglePiece]
    fences: list[TrianglePiece]
    bins: TrianglePiece


@dataclass
class Plots:
    """Results of plot building: places for parked cars (x, y, yaw) and parks (frame, width, depth)."""

    parking: list[Pose] = field(default_factory=list)
    parks: list[tuple[Pose, float, float]] = field(default_factory=list)


def build_along_streets(
    triangles: TriangleBuilder, ground: FreeGround, materials: TownMaterials, sides: list[Side]
) -> Plots:
    """Buildings along all sides of streets."""
    style, rng = materials.style, materials.generator
    hedges = [hedge(materials, material) for material in materials.hedge]
    fences = [fence(building_kind, materials) for building_kind in ("pickets", "wall", "planks", "rail")]
    context, plots = _PlotBuilder(triangles, ground, materials, hedges, fences, wheelie_bin(materials)), Plots()
    for side in sides:
        if not side.frontage:
            continue
        station, last_station = -7.0, side.length + 7.0
        while station < last_station - 4.0:
            building_kind = _draw_kind(style.buildings, materials)
            if rng.random() < style.vacant:
                station += _fill_open_plot(context, plots, side, station)
                continue
            width, depth = draw_size(building_kind, materials)
            setback = float(rng.uniform(*style.setback))
            # A smaller building often fits where the full size does not.
            # Behind a yard it stands back; a detached house would lay its drive across the yard.
            yard_depths = [0.0] if building_kind in DETACHED else [0.0, *YARD_DEPTHS]
            for scale, yard_depth in product((1.0, 0.75), yard_depths):
                size = (width * scale, depth * scale, setback)
                pose = _facing(side, station + size[0] / 2, setback + yard_depth)
                if yard_depth and not ground.is_occupied(footprint(pose, (0.0, 0.0), (-setback - yard_depth, 0.0))):
                    continue
                if _place_building(context, plots, pose, kind=building_kind, size=size):
                    station += size[0] + float(rng.uniform(*style.gap))
                    break
            else:
                station += 1.5
    return plots


def _draw_kind(table: Mapping[str, float], materials: TownMaterials) -> str:
    kinds = list(table)
    weights = np.array([table[kind] for kind in kinds])
    return str(materials.generator.choice(kinds, p=weights / weights.sum()))


def _facing(side: Side, arc_length: float, distance: float) -> Pose:
    """Return the frame of a building whose front is `distance` m behind the sidewalk: y points away from the street."""
    x, y, yaw = side.pose(arc_length, distance)
    return x, y, yaw + np.pi


def _place_building(
    plot_builder: _PlotBuilder, plots: Plots, pose: Pose, *, kind: str, size: tuple[float, float, float]
) -> bool:
    """One building of a size (front, depth, distance from the sidewalk), if there is room."""
    builder, site, materials = plot_builder.triangles, plot_builder.ground, plot_builder.materials
    width, depth, setback = size
    is_detached = kind in DETACHED
    yard_depth = 3.0 if is_detached else 0.5
    # Terraced buildings share walls: their ground may touch that of the neighbours.
    side_margin = 0.25 if materials.style.gap[0] > 0.0 else -0.45
    ground_points = footprint(pose, (-width / 2 - side_margin, width / 2 + side_margin), (-0.05, depth + yard_depth))
    if not site.is_free(ground_points, distance=0.05 if setback < 2.0 else 1.5):
        return False
    builder.place(draw_building(kind, (width, depth), materials), [(pose[0], pose[1], EARTH - 0.02, pose[2])])
    site.occupy(footprint(pose, (-width / 2, width / 2), (-0.6 if is_detached else 0.0, depth + 0.4)))
    if is_detached:
        _lay_garden(plot_builder, plots, pose, size)
    elif setback > 1.5:
        # paved ground before the door
        half_width = width / 2 if kind in ("office", "tower", "hall", "shop") else 1.0
        _lay_slab(
            plot_builder,
            pose,
            (-half_width, half_width),
            (-setback, 0.0),
            material=materials.slab if kind != "hall" else materials.drive,
        )
    if kind in ("flats", "terrace") and materials.generator.random() < 0.5 and setback > 0.4:
        bin_spot = place(pose, np.array([[width / 2 - 0.8, -min(0.5, setback / 2)]]))
        if site.ground.at(site.ground.paved, bin_spot)[0] > -0.2:
            builder.place(plot_builder.bins, [(*bin_spot[0], EARTH, pose[2] - np.pi / 2)])
    return True


def _lay_slab(
    plot_builder: _PlotBuilder,
    pose: Pose,
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    material: int,
    z: float = FLAT,
) -> bool:
    """Paved ground on the earth, where no road is; nothing else is put there."""
    site, ground_points = plot_builder.ground, footprint(pose, x, y)
    if (site.ground.at(site.ground.road, ground_points) < 0.1).any():
        return False
    corners = place(pose, np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]]))
    plot_builder.triangles.add(
        flat(np.column_stack([corners, np.full(4, z)])[None], material, levels=ALL), corners.mean(axis=0)
    )
    site.occupy(ground_points)
    return True


def _lay_garden(plot_builder: _PlotBuilder, plots: Plots, pose: Pose, size: tuple[float, float, float]) -> None:
    """Drive, path, and a fence or hedge towards the street of a detached house."""
    builder, site, materials = plot_builder.triangles, plot_builder.ground, plot_builder.materials
    width, _, setback = size
    rng = materials.generator
    drive_on_left = rng.random() < 0.5
    drive_span = (-width / 2 + 0.4, -width / 2 + 3.2) if drive_on_left else (width / 2 - 3.2, width / 2 - 0.4)
    has_drive = _lay_slab(plot_builder, pose, drive_span, (-setback, 0.0), material=materials.drive)
    _lay_slab(plot_builder, pose, (-0.6, 0.6), (-setback, 0.0), material=materials.slab, z=FLAT + 0.006)
    if has_drive and setback > 5.2:
        position = place(pose, np.array([[sum(drive_span) / 2, -setback + 2.55]]))[0]
        # A car is about 4.5 m long: half of it must not reach the sidewalk.
        if site.ground.at(site.ground.paved, position)[0] > 2.0:
            plots.parking.append((float(position[0]), float(position[1]), pose[2] + np.pi / 2))
    position = place(pose, np.array([[drive_span[0] - 0.5 if drive_on_left else drive_span[1] + 0.5, -0.6]]))[0]
    if site.ground.at(site.ground.paved, position)[0] > 0.4:
        builder.place(plot_builder.bins, [(*position, EARTH, pose[2] - np.pi / 2)])
    chance = rng.random()
    if chance > materials.style.hedges + materials.style.fences:
        return
    barriers = plot_builder.hedges if chance < materials.style.hedges else plot_builder.fences
    barrier = barriers[int(rng.integers(len(barriers)))]
    height_scale = float(rng.uniform(0.8, 1.5)) if chance < materials.style.hedges else 1.0
    offsets = np.arange(-width / 2 - 1.0, width / 2 + 1.0)
    is_open = ~((offsets > drive_span[0] - 0.7) & (offsets < drive_span[1] + 0.7)) & (np.abs(offsets) > 1.2)
    positions = place(pose, np.column_stack([offsets[is_open], np.full(int(is_open.sum()), -setback + 0.75)]))
    free_positions = [position_xy for position_xy in positions if site.is_free(position_xy, distance=0.3)]
    if free_positions:
        builder.place(
            barrier,
            [(*position_xy, EARTH - 0.02, pose[2]) for position_xy in free_positions],
            scale=np.array([[1.0, 1.0, height_scale]] * len(free_positions)),
        )
        site.occupy(np.array(free_positions))


def _fill_open_plot(plot_builder: _PlotBuilder, plots: Plots, side: Side, arc_length: float) -> float:
    """A car park or a small park instead of a building; gives the length used, m."""
    builder, site, materials = plot_builder.triangles, plot_builder.ground, plot_builder.materials
    rng = materials.generator
    stall_count = int(rng.integers(4, 9))
    width, depth = 2.6 * stall_count + 1.0, 11.5
    pose = _facing(side, arc_length + width / 2, 0.4)
    if not site.is_free(footprint(pose, (-width / 2, width / 2), (0.0, depth)), distance=0.3):
        return 4.0
    if rng.random() < 0.55:
        if not _lay_slab(plot_builder, pose, (-width / 2, width / 2), (-0.4, depth), material=materials.asphalt):
            return 4.0
        stall_edges = -width / 2 + 0.5 + 2.6 * np.arange(stall_count + 1)
        bar_outline = np.array([[-0.05, 6.2], [0.05, 6.2], [0.05, 11.2], [-0.05, 11.2]])
        bars = np.array([place(pose, bar_outline + np.array([x, 0.0])) for x in stall_edges])
        z = np.full((len(bars), 4, 1), FLAT + 0.008)
        builder.add(flat(np.concatenate([bars, z], axis=2), materials.white, levels=NEAR | MID))
        for position in place(pose, np.column_stack([stall_edges[:-1] + 1.3, np.full(stall_count, 8.7)])).tolist():
            plots.parking.append((position[0], position[1], pose[2] + float(rng.choice([-1.0, 1.0])) * np.pi / 2))
        return width + 0.5
    if not _lay_slab(plot_builder, pose, (-0.9, 0.9), (-0.4, depth), material=materials.slab):
        return 4.0
    plots.parks.append((pose, width, depth))
    bench_piece = bench(materials)
    for x, seat_yaw in ((1.6, 0.0), (-1.6, np.pi)):
        position = place(pose, np.array([[x, 4.0]]))[0]
        builder.place(bench_piece, [(*position, EARTH, pose[2] + seat_yaw)])
        site.occupy(footprint((*position, pose[2]), (-0.6, 0.6), (-1.0, 1.0)))
    return width + 0.5


def fill_blocks(triangles: TriangleBuilder, ground: FreeGround, materials: TownMaterials, *, tries: int) -> None:
    """Buildings behind those along the streets, at random places, turned like a grid of their own."""
    rng = materials.generator
    for _ in range(tries):
        centre: F64 = rng.uniform(ground.low + 6.0, ground.high - 6.0)
        cell = np.round(centre - ground.low).astype(int)
        # Only blocks that streets enclose, and only behind the first row of buildings.
        if not ground.ground.inner[cell[1], cell[0]] or ground.ground.paved[cell[1], cell[0]] < 9.0:
            continue
        kind = _draw_kind(materials.style.back, materials)
        width, depth = draw_size(kind, materials)
        pose = (float(centre[0]), float(centre[1]), float(rng.integers(4)) * np.pi / 2 + float(rng.normal(0.0, 0.08)))
        margin = 2.0 if kind == "shed" else 4.0
        if not ground.is_free(
            footprint(pose, (-width / 2 - margin, width / 2 + margin), (-margin, depth + margin)), distance=6.0
        ):
            continue
        triangles.place(draw_building(kind, (width, depth), materials), [(pose[0], pose[1], EARTH - 0.02, pose[2])])
        ground.occupy(footprint(pose, (-width / 2, width / 2), (-0.5, depth + 0.5)))

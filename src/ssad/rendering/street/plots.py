"""Plots along streets and inside blocks: buildings with their drives, fences and hedges, car parks, small parks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.buildings import draw_building, draw_size
from ssad.rendering.street.free_ground import FreeGround, Side, footprint, place
from ssad.rendering.street.furniture import bench, fence, wheelie_bin
from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import Look
from ssad.rendering.street.paving import EARTH
from ssad.rendering.street.plants import hedge
from ssad.rendering.street.triangles import ALL, Piece, TriangleBuilder, flat

Pose = tuple[float, float, float]
FLAT = EARTH + 0.012  # m, height of drives and yards over the earth
DETACHED = ("house", "bungalow")


@dataclass(frozen=True)
class _Works:
    """Where plots are built, and the pieces that they share."""

    soup: TriangleBuilder
    site: FreeGround
    look: Look
    hedges: list[Piece]
    fences: list[Piece]
    bins: Piece


@dataclass
class Plots:
    """What plots leave behind: places for parked cars (x, y, yaw); parks (frame, width, depth)."""

    parking: list[Pose] = field(default_factory=list)
    parks: list[tuple[Pose, float, float]] = field(default_factory=list)


def line_streets(soup: TriangleBuilder, site: FreeGround, look: Look, sides: list[Side]) -> Plots:
    """Buildings along all sides of streets."""
    style, rng = look.style, look.generator
    hedges = [hedge(look, m) for m in look.hedge]
    fences = [fence(kind, look) for kind in ("pickets", "wall", "planks", "rail")]
    works, plots = _Works(soup, site, look, hedges, fences, wheelie_bin(look)), Plots()
    for side in sides:
        if not side.frontage:
            continue
        s, end = -7.0, side.length + 7.0
        while s < end - 4.0:
            kind = _draw(style.buildings, look)
            if rng.random() < style.vacant:
                s += _open_plot(works, plots, side, s)
                continue
            front, depth = draw_size(kind, look)
            back = float(rng.uniform(*style.setback))
            for shrink in (1.0, 0.75):
                size = (front * shrink, depth * shrink, back)
                if _build(works, plots, _facing(side, s + size[0] / 2, back), kind=kind, size=size):
                    s += size[0] + float(rng.uniform(*style.gap))
                    break
            else:
                s += 1.5
    return plots


def _draw(table: Mapping[str, float], look: Look) -> str:
    names = list(table)
    weight = np.array([table[n] for n in names])
    return str(look.generator.choice(names, p=weight / weight.sum()))


def _facing(side: Side, s: float, away: float) -> Pose:
    """Frame of a building whose front is `away` m behind the sidewalk: y points away from the street."""
    x, y, yaw = side.pose(s, away)
    return x, y, yaw + np.pi


def _build(works: _Works, plots: Plots, pose: Pose, *, kind: str, size: tuple[float, float, float]) -> bool:
    """One building of a size (front, depth, distance from the sidewalk), if there is room."""
    soup, site, look = works.soup, works.site, works.look
    front, depth, back = size
    detached = kind in DETACHED
    yard = 3.0 if detached else 0.5
    spread = 0.25 if look.style.gap[0] > 0.0 else -0.45
    area = footprint(pose, (-front / 2 - spread, front / 2 + spread), (-0.05, depth + yard))
    if not site.free(area, away=0.05 if back < 2.0 else 1.5):
        return False
    soup.place(draw_building(kind, (front, depth), look), [(pose[0], pose[1], EARTH - 0.02, pose[2])])
    site.take(footprint(pose, (-front / 2, front / 2), (-0.6 if detached else 0.0, depth + 0.4)))
    if detached:
        _garden(works, plots, pose, size)
    elif back > 1.5:
        # paved ground before the door
        half = front / 2 if kind in ("office", "tower", "hall", "shop") else 1.0
        _slab(works, pose, (-half, half), (-back, 0.0), material=look.slab if kind != "hall" else look.drive)
    if kind in ("flats", "terrace") and look.generator.random() < 0.5 and back > 0.4:
        spot = place(pose, np.array([[front / 2 - 0.8, -min(0.5, back / 2)]]))
        if site.ground.at(site.ground.paved, spot)[0] > -0.2:
            soup.place(works.bins, [(*spot[0], EARTH, pose[2] - np.pi / 2)])
    return True


def _slab(
    works: _Works, pose: Pose, x: tuple[float, float], y: tuple[float, float], *, material: int, z: float = FLAT
) -> bool:
    """Paved ground on the earth, where no road is; nothing else is put there."""
    site, area = works.site, footprint(pose, x, y)
    if (site.ground.at(site.ground.road, area) < 0.1).any():
        return False
    corners = place(pose, np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]]))
    works.soup.add(flat(np.column_stack([corners, np.full(4, z)])[None], material, levels=ALL), corners.mean(axis=0))
    site.take(area)
    return True


def _garden(works: _Works, plots: Plots, pose: Pose, size: tuple[float, float, float]) -> None:
    """Drive, path, and a fence or hedge towards the street of a detached house."""
    soup, site, look = works.soup, works.site, works.look
    front, _, back = size
    rng = look.generator
    left = rng.random() < 0.5
    x = (-front / 2 + 0.4, -front / 2 + 3.2) if left else (front / 2 - 3.2, front / 2 - 0.4)
    drive = _slab(works, pose, x, (-back, 0.0), material=look.drive)
    _slab(works, pose, (-0.6, 0.6), (-back, 0.0), material=look.slab, z=FLAT + 0.006)
    if drive and back > 5.2:
        spot = place(pose, np.array([[sum(x) / 2, -back + 2.55]]))[0]
        if site.ground.at(site.ground.paved, spot)[0] > 2.0:
            plots.parking.append((float(spot[0]), float(spot[1]), pose[2] + np.pi / 2))
    spot = place(pose, np.array([[x[0] - 0.5 if left else x[1] + 0.5, -0.6]]))[0]
    if site.ground.at(site.ground.paved, spot)[0] > 0.4:
        soup.place(works.bins, [(*spot, EARTH, pose[2] - np.pi / 2)])
    draw = rng.random()
    if draw > look.style.hedges + look.style.fences:
        return
    stock = works.hedges if draw < look.style.hedges else works.fences
    unit = stock[int(rng.integers(len(stock)))]
    tall = float(rng.uniform(0.8, 1.5)) if draw < look.style.hedges else 1.0
    at = np.arange(-front / 2 - 1.0, front / 2 + 1.0)
    keep = ~((at > x[0] - 0.7) & (at < x[1] + 0.7)) & (np.abs(at) > 1.2)
    spots = place(pose, np.column_stack([at[keep], np.full(int(keep.sum()), -back + 0.75)]))
    rows = [p for p in spots if site.free(p, away=0.3)]
    if rows:
        soup.place(unit, [(*p, EARTH - 0.02, pose[2]) for p in rows], scale=np.array([[1.0, 1.0, tall]] * len(rows)))
        site.take(np.array(rows))


def _open_plot(works: _Works, plots: Plots, side: Side, s: float) -> float:
    """A car park or a small park instead of a building; gives the length used, m."""
    soup, site, look = works.soup, works.site, works.look
    rng = look.generator
    stalls = int(rng.integers(4, 9))
    front, depth = 2.6 * stalls + 1.0, 11.5
    pose = _facing(side, s + front / 2, 0.4)
    if not site.free(footprint(pose, (-front / 2, front / 2), (0.0, depth)), away=0.3):
        return 4.0
    if rng.random() < 0.55:
        if not _slab(works, pose, (-front / 2, front / 2), (-0.4, depth), material=look.asphalt):
            return 4.0
        left = -front / 2 + 0.5 + 2.6 * np.arange(stalls + 1)
        bar = np.array([[-0.05, 6.2], [0.05, 6.2], [0.05, 11.2], [-0.05, 11.2]])
        quads = np.array([place(pose, bar + np.array([x, 0.0])) for x in left])
        z = np.full((len(quads), 4, 1), FLAT + 0.008)
        soup.add(flat(np.concatenate([quads, z], axis=2), look.white, levels=NEAR | MID))
        for spot in place(pose, np.column_stack([left[:-1] + 1.3, np.full(stalls, 8.7)])).tolist():
            plots.parking.append((spot[0], spot[1], pose[2] + float(rng.choice([-1.0, 1.0])) * np.pi / 2))
        return front + 0.5
    if not _slab(works, pose, (-0.9, 0.9), (-0.4, depth), material=look.slab):
        return 4.0
    plots.parks.append((pose, front, depth))
    seat = bench(look)
    for x, turn in ((1.6, 0.0), (-1.6, np.pi)):
        spot = place(pose, np.array([[x, 4.0]]))[0]
        soup.place(seat, [(*spot, EARTH, pose[2] + turn)])
        site.take(footprint((*spot, pose[2]), (-0.6, 0.6), (-1.0, 1.0)))
    return front + 0.5


def fill_blocks(soup: TriangleBuilder, site: FreeGround, look: Look, *, tries: int) -> None:
    """Buildings behind those along the streets, at random places, turned like a grid of their own."""
    rng = look.generator
    for _ in range(tries):
        middle: F64 = rng.uniform(site.low + 6.0, site.high - 6.0)
        cell = np.round(middle - site.low).astype(int)
        if not site.ground.inner[cell[1], cell[0]] or site.ground.paved[cell[1], cell[0]] < 9.0:
            continue
        kind = _draw(look.style.back, look)
        front, depth = draw_size(kind, look)
        pose = (float(middle[0]), float(middle[1]), float(rng.integers(4)) * np.pi / 2 + float(rng.normal(0.0, 0.08)))
        pad = 2.0 if kind == "shed" else 4.0
        if not site.free(footprint(pose, (-front / 2 - pad, front / 2 + pad), (-pad, depth + pad)), away=6.0):
            continue
        soup.place(draw_building(kind, (front, depth), look), [(pose[0], pose[1], EARTH - 0.02, pose[2])])
        site.take(footprint(pose, (-front / 2, front / 2), (-0.5, depth + 0.5)))

"""Streets: nothing stands on the road, the ground has no holes, tiles cover all, equal seeds give equal bytes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from helpers.quick import others_slow

from ssad.core.errors import FormatError, MapError, UnknownNameError
from ssad.core.lane_graph import LaneGraph, load_graph
from ssad.core.types import LaneType
from ssad.rendering.meshes.mesh import Material
from ssad.rendering.street import STYLES, Street, build_street, cached_street, load_street, save_street
from ssad.rendering.street.free_ground import polygon_distance
from ssad.rendering.street.model import NEAR
from ssad.rendering.street.region import Ground, region_mesh, survey
from ssad.world.roads.query import LaneQuery

TOWNS = ("Twinford", "Crossgate", "Oldmarket", "Larkhill", "Ringmere")
QUICK = ("Twinford", "Oldmarket")  # a regular town and one of crooked streets and cobbles
GROUND = ("asphalt", "asphalt_patch", "asphalt_worn", "marking_white", "marking_yellow", "cast_iron")
WALLS = ("plaster", "brick", "boards", "cladding", "sheet", "roof_tiles", "stone")
STREETS = (LaneType.DRIVING, LaneType.PARKING)


@cache
def town(name: str) -> LaneGraph:
    return load_graph(str(files("ssad.world.roads.towns") / f"{name}.npz"))


@cache
def ground(name: str) -> Ground:
    return survey(town(name))


@cache
def street(name: str) -> Street:
    """Built in this run, by whichever test asks first."""
    return cached_street(town(name))


def corners(scene: Street) -> npt.NDArray[np.float64]:
    return scene.vertices[scene.faces].astype(np.float64)


def of(scene: Street, names: tuple[str, ...]) -> npt.NDArray[np.bool_]:
    return np.array([m.name in names for m in scene.materials])[scene.material]


def samples(p: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Points [n, 3] on triangles [F, 3, 3]: corners, and a grid on large ones."""
    long = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=-1).max(axis=1)
    found = [p.reshape(-1, 3)]
    for low, high, parts in ((0.8, 2.5, 3), (2.5, 6.0, 6), (6.0, 14.0, 11), (14.0, np.inf, 25)):
        some = p[(long > low) & (long <= high)]
        i, j = (k.reshape(-1) / parts for k in np.meshgrid(np.arange(parts + 1), np.arange(parts + 1)))
        i, j = i[i + j <= 1], j[i + j <= 1]
        weight = np.stack([1 - i - j, i, j], axis=1)
        found.append(np.einsum("wk,fki->fwi", weight, some).reshape(-1, 3))
    return np.concatenate(found)


def from_lanes(graph: LaneGraph, xy: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Distance [n] of points from driving lanes, m; 3 beyond."""
    lane, _, lateral, inside = LaneQuery(graph).nearest(xy, STREETS)
    gap = np.full(len(xy), 3.0)
    known = np.flatnonzero(lane >= 0)
    width = np.array([graph.width[graph.points(int(i))].max() for i in range(graph.lane_count)])
    gap[known] = np.abs(lateral[known]) - 0.5 * width[lane[known]]
    gap[inside] = -1.0
    return gap


@pytest.mark.parametrize("name", others_slow(["Twinford", "Oldmarket", "Crossgate", "Larkhill"], ["Oldmarket"]))
def test_nothing_stands_on_lanes_junctions_or_crosswalks(name: str) -> None:
    graph, scene = town(name), street(name)
    p = corners(scene)
    tall = (p[..., 2].max(axis=1) > 0.2) & (p[..., 2].min(axis=1) < 4.5)
    tall &= (p[..., :2].max(axis=1) - p[..., :2].min(axis=1)).max(axis=1) < 45.0  # not the hills
    # only triangles near a lane
    cell = np.zeros((80, 80), bool)
    low, block = graph.xy.min(axis=0) - 20.0, 20.0
    at = np.floor((graph.xy - low) / block).astype(int)
    for i, j in np.ndindex(3, 3):
        cell[at[:, 0] + i, at[:, 1] + j] = True
    here = np.floor((p[:, :, :2] - low) / block).astype(int).clip(-1, 78) + 1
    tall &= cell[here[..., 0], here[..., 1]].any(axis=1)
    xyz = samples(p[tall])
    low = xyz[(xyz[:, 2] > 0.2) & (xyz[:, 2] < 4.5)][:, :2]
    assert len(low) > 30_000
    gap = from_lanes(graph, low)
    assert gap.min() >= 0.5
    area = ground(name)
    low = low[gap < 3.0]
    assert area.at(area.drive, low).min() >= 0.5  # gaps between the ways of a junction too
    for k in range(len(graph.crosswalk_offset) - 1):
        crossing = graph.crosswalk(k).astype(np.float64)
        near = low[np.hypot(*(low - crossing.mean(axis=0)).T) < 12.0]
        assert polygon_distance(near, crossing).min(initial=9.0) >= 0.5
    # what hangs over a lane is a lamp or a signal
    high = tall & of(scene, WALLS)
    walls = samples(p[high])[:, :2]
    assert from_lanes(graph, walls).min() >= 1.0


@pytest.mark.parametrize("name", others_slow(TOWNS, QUICK))
def test_lanes_lie_on_one_sheet_of_road(name: str) -> None:
    graph, scene = town(name), street(name)
    rng = np.random.default_rng(7)
    driving = np.flatnonzero(graph.kind == LaneType.DRIVING)
    spots = []
    for lane in rng.choice(driving, 150):
        x, y, yaw, width = graph.at(int(lane), float(rng.uniform(0.0, graph.length[lane])))
        aside = rng.uniform(-0.45, 0.45) * width
        spots.append((x - aside * np.sin(yaw), y + aside * np.cos(yaw)))
    p = corners(scene)
    top = p[..., 2].max(axis=1)
    upright = np.abs(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2]) > 1e-6
    in_reach = upright & (p[..., 2].min(axis=1) > -0.2) & (top < 4.5)
    if name == "Ringmere":  # beside its rings grass reaches under the asphalt, 3 cm deep at most
        in_reach &= (top > -0.01) | of(scene, ("asphalt",))
    p, road, base = p[in_reach], of(scene, GROUND)[in_reach], of(scene, ("asphalt",))[in_reach]
    low, high = p[..., :2].min(axis=1), p[..., :2].max(axis=1)
    for spot in np.array(spots):
        near = np.flatnonzero(((low <= spot) & (high >= spot)).all(axis=1))
        a, b, c = (p[near, k, :2] - spot for k in range(3))
        turn = np.stack([u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] for u, v in ((a, b), (b, c), (c, a))])
        hit = near[(turn > 0).all(axis=0) | (turn < 0).all(axis=0)]
        assert road[hit].all()
        assert base[hit].sum() == 1


def test_regions_have_no_cracks() -> None:
    """Every edge within the region belongs to two triangles; the area is that of the circle less a hole."""
    y, x = np.mgrid[0:65, 0:65].astype(float)
    field = np.maximum(np.hypot(x - 32.0, y - 32.0) - 29.3, 7.7 - np.hypot(x - 30.0, y - 36.0))
    vertices, faces = region_mesh(field)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert area.min() > 0.0
    assert area.sum() == pytest.approx(np.pi * (29.3**2 - 7.7**2), rel=0.003)
    edge = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edge, axis=0, return_counts=True)
    assert count.max() == 2
    rim = vertices[unique[count == 1]].reshape(-1, 2)
    outside = np.abs(np.hypot(*(rim - 32.0).T) - 29.3)
    hole = np.abs(np.hypot(*(rim - [30.0, 36.0]).T) - 7.7)
    assert np.minimum(outside, hole).max() < 0.05


@pytest.mark.parametrize("name", others_slow(TOWNS, QUICK))
def test_arrays_tiles_and_levels(name: str) -> None:
    scene = street(name)
    scene.check()
    assert 100_000 <= len(scene.faces) <= 600_000
    assert np.abs(np.linalg.norm(scene.normals, axis=-1) - 1.0).max() < 1e-4
    sizes = [np.diff(scene.offset[k, [0, -1]])[0] for k in range(3)]
    assert sizes[0] > 1.5 * sizes[1] > 2.5 * sizes[2]
    # each level holds a face once; each face belongs to a level
    parts = [scene.order[scene.offset[k, 0] : scene.offset[k, -1]] for k in range(3)]
    for part in parts:
        assert len(np.unique(part)) == len(part)
    assert len(np.unique(np.concatenate(parts))) == len(scene.faces)
    # a tile's faces lie about it
    middle = corners(scene).mean(axis=1)[:, :2]
    for tile in range(scene.nx * scene.ny):
        mine = middle[scene.tile_faces(tile)]
        low = np.array(scene.origin) + scene.tile * np.array([tile % scene.nx, tile // scene.nx])
        assert ((mine > low - 30.0) & (mine < low + scene.tile + 30.0)).all()
    eye = (float(town(name).xy[0, 0]), float(town(name).xy[0, 1]))
    near = scene.select(eye)
    assert len(np.unique(near)) == len(near) < 0.8 * len(scene.faces)
    assert set(scene.select(eye, reach=(1e4, 1e4), max_distance=1e4).tolist()) == set(parts[0].tolist())


@pytest.mark.parametrize("name", others_slow(TOWNS, QUICK))
def test_signals_and_lamps(name: str) -> None:
    graph, scene = town(name), street(name)
    assert set(scene.head_signal.tolist()) == set(np.flatnonzero(~graph.signal_virtual).tolist())
    facing = graph.signal_yaw[scene.head_signal] + np.pi
    assert np.cos(scene.heads[:, 3] - facing).min() > 0.999
    p = corners(scene)
    names = [m.name for m in scene.materials]
    for head, lens in zip(scene.heads, scene.head_lens, strict=True):
        for k, colour in enumerate(("red", "amber", "green")):
            faces = slice(*lens[k].tolist())
            assert {names[m] for m in scene.material[faces]} == {f"signal_{colour}"}
            away = p[faces].mean(axis=(0, 1)) - head[:3]
            assert abs(away[2] - (0.31, 0.0, -0.31)[k]) < 0.02
            assert np.hypot(*away[:2]) < 0.05
            normal = scene.normals[faces].mean(axis=(0, 1))
            assert normal[:2] @ [np.cos(head[3]), np.sin(head[3])] > 0.99
    assert len(scene.lamps) > 40
    assert (scene.lamps[:, 2] > 3.0).all()
    area = ground(name)
    assert area.at(area.paved, scene.parking[:, :2]).min(initial=9.0) > 1.5


def test_bays_lie_between_the_lanes_and_a_walkway() -> None:
    """Nothing stands in a bay, it keeps off the lanes, and a strip of pavement is left beside it."""
    graph, scene, area = town("Twinford"), street("Twinford"), ground("Twinford")
    assert len(scene.bays) > 50
    assert not len(street("Oldmarket").bays), "its pavements are too narrow"
    upright = scene.vertices[(scene.vertices[:, 2] > 0.35) & (scene.vertices[:, 2] < 2.4)][:, :2].astype(np.float64)
    for x, y, yaw, depth, room in scene.bays.astype(np.float64).tolist():
        along, right = np.array([np.cos(yaw), np.sin(yaw)]), np.array([np.sin(yaw), -np.cos(yaw)])
        corners = np.array([[x, y] + s * along + d * right for s in (-3.0, 3.0) for d in (0.1, depth)])
        assert from_lanes(graph, corners).min() > -0.05
        walkway = np.array([[x, y] + (depth + 0.45) * right])
        assert area.at(area.walk, walkway)[0] < 0.0
        local = (upright - [x, y]) @ np.stack([along, right], axis=1)
        assert not ((np.abs(local[:, 0]) < 2.5) & (local[:, 1] > 0.2) & (local[:, 1] < depth - 0.5)).any()
        assert room >= 3.2


def test_foliage_is_small_and_no_street_is_one_green_to_the_horizon() -> None:
    scene = street("Twinford")
    foliage = of(scene, ("twigs", "leaves_round", "leaves_tall", "leaves_birch"))
    near = foliage & np.isin(np.arange(len(scene.faces)), scene.order[scene.offset[0, 0] : scene.offset[0, -1]])
    p = corners(scene)[near]
    areas = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    # Leaves are cut out of twigs; what is solid is the inside of crowns.
    assert areas[of(scene, ("twigs",))[near]].sum() > 0.6 * areas.sum()
    names = [material.name for material in scene.materials]
    horizon = {names[row] for row in scene.material[scene.tile_faces(scene.nx * scene.ny)]}
    assert {"field_crop", "field_stubble", "tree_line"} <= horizon


def test_buildings_face_outwards() -> None:
    """Rays from outside the town, level at 5 m, first meet walls at their outside."""
    scene = street("Oldmarket")
    p = corners(scene)[of(scene, WALLS[:5])]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    level = 4.9
    crosses = (p[..., 2].min(axis=1) < level) & (p[..., 2].max(axis=1) > level) & (np.abs(n[:, 2]) < 1e-6)
    p, n = p[crosses], n[crosses]
    seen = 0
    for y in np.arange(40.0, 220.0, 7.3):
        span = (p[..., 1].min(axis=1) < y) & (p[..., 1].max(axis=1) > y)
        x = p[span].mean(axis=1)[:, 0]
        if len(x):
            seen += 1
            assert n[span][np.argmin(x), 0] <= 1e-9
    assert seen > 15


def test_equal_seeds_give_equal_bytes_and_others_differ(tmp_path: Path) -> None:
    graph = town("Twinford")
    first, again, other = street("Twinford"), build_street(graph), build_street(graph, seed=1)
    for key, value in vars(first).items():
        assert np.array_equal(getattr(again, key), value), key
    save_street(first, tmp_path / "a.npz")
    assert other.materials != first.materials
    assert len(other.faces) != len(first.faces)
    back = load_street(tmp_path / "a.npz")
    for key, value in vars(first).items():
        assert np.array_equal(getattr(back, key), value), key
    assert all(isinstance(m, Material) for m in back.materials)


def test_styles_differ() -> None:
    graph = town("Twinford")
    changed = build_street(graph, style="outskirts")
    assert changed.style == "outskirts"
    assert "meadow" in {m.name for m in changed.materials}
    assert set(STYLES) >= {"town", "city", "old", "suburb", "outskirts"}
    with pytest.raises(UnknownNameError, match="closest"):
        build_street(graph, style="suburbs")


@pytest.mark.parametrize("name", others_slow(TOWNS, QUICK))
def test_towns_have_styles(name: str) -> None:
    scene = street(name)
    assert scene.style == dict(zip(TOWNS, ("town", "city", "old", "suburb", "town"), strict=True))[name]
    assert ("cobbles" in {m.name for m in scene.materials}) == (name == "Oldmarket")


def test_cache(ssad_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph, built = town("Twinford"), street("Twinford")
    asked: list[tuple[int, str]] = []

    def build(graph: LaneGraph, *, seed: int, style: str) -> Street:
        asked.append((seed, style))
        return built

    monkeypatch.setattr("ssad.rendering.street.build.build_street", build)
    one = cached_street(graph)
    (path,) = (ssad_home / "cache" / "streets").glob("*.npz")
    two = cached_street(graph)
    assert asked == [(0, "town")]
    assert one is built
    assert np.array_equal(one.vertices, two.vertices)
    assert one.materials == two.materials
    path.write_bytes(path.read_bytes()[:1000])  # cut short: built again
    assert np.array_equal(cached_street(graph).faces, one.faces)
    assert asked == [(0, "town")] * 2
    assert load_street(path).name == "Twinford"
    cached_street(graph, seed=1)
    cached_street(graph, style="city")
    cached_street(town("Crossgate"))
    assert asked[2:] == [(1, "town"), (0, "city"), (0, "city")], "each is another street"


def test_bad_input(tmp_path: Path) -> None:
    graph = town("Twinford")
    fields = {k: v for k, v in vars(graph).items() if k not in ("length", "pred", "pred_offset")}
    hill = LaneGraph(**(fields | {"z": np.linspace(0.0, 9.0, len(graph.z), dtype=np.float32)}))
    with pytest.raises(MapError, match="not flat"):
        build_street(hill)
    for name, data in (("none.npz", None), ("text.npz", b"text"), ("other.npz", b"")):
        path = tmp_path / name
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(FormatError):
            load_street(path)
    with pytest.raises(FormatError, match="not a street"):
        load_street(str(files("ssad.world.roads.towns") / "Twinford.npz"))
    scene = street("Twinford")
    bad = scene.vertices.copy()
    bad[5] = np.nan
    with pytest.raises(FormatError, match="vertices holds a number that is not finite"):
        replace(scene, vertices=bad).check()
    with pytest.raises(FormatError, match="faces points outside"):
        replace(scene, faces=scene.faces + 10).check()
    assert not scene.vertices.flags.writeable
    assert NEAR == 1

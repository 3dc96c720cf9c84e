"""Yards behind the pavement: free ground for parked vehicles, beside the street and with nothing in them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ssad.rendering.street import cached_street
from ssad.rendering.street.bays import SPACING
from ssad.rendering.street.free_ground import footprint
from ssad.rendering.street.paving import KERB, LOWERED
from ssad.rendering.street.region import Ground, survey
from ssad.rendering.street.yards import CELL_DEPTH, CELL_WIDTH, ROW_DEPTH, ROW_PLACES
from ssad.world.roads import load_town


@cache
def ground(name: str) -> Ground:
    return survey(load_town(name))


@pytest.mark.parametrize("name", ["Twinford", "Oldmarket"])
def test_yards_lie_beside_the_pavement_with_nothing_in_them(name: str) -> None:
    scene, area = cached_street(name), ground(name)
    is_leaf = np.array([material.name.startswith(("leaves", "twigs")) for material in scene.materials])[scene.material]
    solid = scene.vertices[np.unique(scene.faces[~is_leaf])].astype(np.float64)  # branches may hang over a yard
    upright = solid[(solid[:, 2] > 0.35) & (solid[:, 2] < 2.4), :2]
    assert len(scene.yards) > 30
    for x, y, yaw, depth, room in scene.yards.astype(np.float64).tolist():
        assert np.isclose(2.0 * room, ROW_PLACES).any()
        assert depth == pytest.approx(ROW_DEPTH)
        ground_points = footprint((x, y, yaw), (-room, room), (-depth, 0.0))
        distances = area.at(area.paved, ground_points)
        assert distances.min() > 0.1, "neither road nor pavement"
        assert distances.min() < 2.0, "beside the pavement"
        local = (upright - [x, y]) @ np.array([[np.cos(yaw), np.sin(yaw)], [np.sin(yaw), -np.cos(yaw)]]).T
        assert not ((np.abs(local[:, 0]) < room) & (local[:, 1] > 0.2) & (local[:, 1] < depth - 0.5)).any()


def test_cells_of_cars_lie_off_the_pavement_across_the_street() -> None:
    scene, area = cached_street("Oldmarket"), ground("Oldmarket")
    half = 0.5 * CELL_DEPTH, 0.5 * CELL_WIDTH
    places = scene.parking.astype(np.float64)
    assert len(places) > 100
    for x, y, yaw in places.tolist():
        corners = footprint((x, y, yaw), (-half[0], half[0]), (-half[1], half[1]))
        assert area.at(area.paved, corners).min() > 0.1
    # All places are paved: a face of the yard lies under each middle.
    names = [material.name for material in scene.materials]
    flat = scene.vertices[scene.faces[np.isin(scene.material, [names.index("parking_bay"), names.index("asphalt")])]]
    boxes = flat[..., :2].min(axis=1), flat[..., :2].max(axis=1)
    is_paved = [((boxes[0] <= place) & (place <= boxes[1])).all(axis=1).any() for place in places[:, :2]]
    assert all(is_paved)


@pytest.mark.parametrize("name", ["Twinford", "Oldmarket"])
def test_kerbs_are_lowered_at_yards_and_nowhere_else(name: str) -> None:
    scene = cached_street(name)
    names = [material.name for material in scene.materials]
    faces = scene.faces[np.isin(scene.material, [index for index, known in enumerate(names) if known == "kerb"])]
    kerbs = scene.vertices[np.unique(faces)].astype(np.float64)
    lowered = kerbs[np.abs(kerbs[:, 2] - LOWERED) < 1e-6]
    assert len(lowered) > 30
    places = np.concatenate([scene.yards[:, :2], scene.parking[:, :2]]).astype(np.float64)
    distances = np.hypot(*(lowered[:, None, :2] - places).transpose(2, 0, 1)).min(axis=1)
    assert distances.max() < 15.0, "in front of a yard"
    # A bay is as high as the pavement.
    for x, y, yaw, depth, _ in scene.bays.astype(np.float64).tolist():
        local = (lowered[:, :2] - [x, y]) @ np.array([[np.cos(yaw), np.sin(yaw)], [np.sin(yaw), -np.cos(yaw)]]).T
        assert not ((np.abs(local[:, 0]) < 0.5 * SPACING) & (local[:, 1] > -0.5) & (local[:, 1] < depth)).any()
    # Nothing stands on the lowered part.
    solid = scene.vertices[(scene.vertices[:, 2] > 0.35) & (scene.vertices[:, 2] < 2.4), :2].astype(np.float64)
    cells = {tuple(cell) for cell in np.floor(lowered[:, :2]).tolist()}
    near = solid[[tuple(cell) in cells for cell in np.floor(solid).tolist()]]
    assert not len(near) or np.hypot(*(near[:, None] - lowered[:, :2]).transpose(2, 0, 1)).min() > 0.2
    # Where the kerb is lowered, the back of the pavement keeps its height.
    assert np.isclose(kerbs[:, 2], KERB).sum() > len(lowered)

"""Dirt on the road: its greys, its controls, and the episodes that it applies to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ssad import build_episode, load_scenarios, load_town
from ssad.core.errors import ConfigError, FormatError
from ssad.scenarios.static.perturbation import EGO
from ssad.scenarios.static.physical.street.dirty_road import (
    ASPHALT_ALBEDO,
    COVERING_WIDTH,
    DIRT,
    INNER_WIDTH,
    LENGTH,
    SHIPPED_PATCHES,
    DirtyRoad,
    patch_size,
    road_decal,
)

STEP = 0.01  # albedo: what eight bits of a picture resolve


@pytest.mark.parametrize("pattern", list(SHIPPED_PATCHES))
def test_trained_patches_are_grey_within_the_limits_of_dirt(pattern: str) -> None:
    albedo = DirtyRoad(pattern).albedo()
    assert float(albedo.min()) >= DIRT[0] - STEP
    assert float(albedo.max()) <= DIRT[1] + STEP
    assert (albedo[0] == albedo[1]).all()
    assert (albedo[0] == albedo[2]).all()
    assert patch_size(albedo) == pytest.approx((LENGTH, COVERING_WIDTH if pattern == "over" else INNER_WIDTH))
    assert len(DirtyRoad(pattern).version()) == 12


def test_controls_have_the_greys_of_dirt_or_of_the_road() -> None:
    random, clean = DirtyRoad("random").albedo(), DirtyRoad("clean", width=INNER_WIDTH).albedo()
    assert random.shape == (3, 48, 52)
    assert DIRT[0] <= float(random.min()) < float(random.max()) <= DIRT[1]
    assert (DirtyRoad("random", seed=1).albedo() != random).any()
    assert clean.unique().tolist() == pytest.approx([ASPHALT_ALBEDO])
    assert DirtyRoad("clean").version() == ""


def test_the_shuffled_control_has_the_texels_of_the_attack() -> None:
    over, shuffled = DirtyRoad("over").albedo(), DirtyRoad("shuffled").albedo()
    assert (over != shuffled).any()
    np.testing.assert_array_equal(np.sort(over.numpy(), axis=None), np.sort(shuffled.numpy(), axis=None))
    assert DirtyRoad("shuffled").version() == DirtyRoad("over").version()


def test_mirrored_exchanges_left_and_right() -> None:
    plain, mirrored = DirtyRoad("random"), DirtyRoad("random", mirrored=True)
    torch.testing.assert_close(mirrored.albedo(), plain.albedo().flip(2))
    assert mirrored.name != plain.name


def test_the_top_of_the_decal_is_far_and_its_left_is_left() -> None:
    decal = road_decal((24.0, 5.0))
    assert decal.size == (5.0, 24.0)
    np.testing.assert_allclose(decal.pose[:3, :3] @ [0.0, -1.0, 0.0], (1.0, 0.0, 0.0))  # up on the texture: ahead
    np.testing.assert_allclose(decal.pose[:3, :3] @ [-1.0, 0.0, 0.0], (0.0, 1.0, 0.0))  # left on it: left
    np.testing.assert_allclose(decal.pose[:3, 2], (0.0, 0.0, -1.0))


def test_it_applies_where_the_route_goes_on_behind_it() -> None:
    (scenario,) = load_scenarios("lane-keeping/ProvingGround_straight_00")
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)
    assert DirtyRoad("clean").applies_to(episode, town) == EGO
    assert DirtyRoad("clean", distance=140.0).applies_to(episode, town) is None
    assert DirtyRoad("clean").needs_place
    assert not DirtyRoad("clean").needs_target
    assert DirtyRoad("clean", distance=60.0).place_distance == 60.0 - 0.5 * LENGTH


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="pattern 'mud'"):
        DirtyRoad("mud")
    with pytest.raises(ConfigError, match="expected m along the route"):
        DirtyRoad("clean", distance=-1.0)
    with pytest.raises(FormatError):
        DirtyRoad(str(tmp_path / "none.json"))

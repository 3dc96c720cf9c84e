"""The differentiable copy of the lane keeper's loop agrees with the lane keeper, and has gradients."""

from __future__ import annotations

import numpy as np
import torch

from ssad.drivers.lane_keeping import markings
from ssad.drivers.lane_keeping.lane import LaneFilter
from ssad.drivers.lane_keeping.markings import RoadGrid
from ssad.rendering.camera.texture import to_linear, to_srgb
from ssad.scenarios.static.physical.street.dirty_road import ASPHALT_ALBEDO, COVERING_WIDTH, DIRT
from ssad.training.road_patch import (
    LaneModel,
    RoadApproach,
    deviation,
    draw_approaches,
    marking_strength,
    road_brightness,
    start_patch,
    train_road_patch,
)

GRID = RoadGrid(half_width=4.0, row_step=2.0, far=28.0, column_step=0.1)
APPROACH = RoadApproach(15.0, 0.1, 3.5, 2.0, False, 1.0)
CLEAN = torch.full((48, 52), ASPHALT_ALBEDO)


def test_codes_are_the_inverse_of_the_linear_values() -> None:
    values = torch.linspace(0.0, 1.0, 11)
    torch.testing.assert_close(to_linear(to_srgb(values)), values, atol=1e-5, rtol=0.0)


def test_strength_and_filter_agree_with_those_of_the_lane_keeper() -> None:
    pose = torch.tensor([-60.0, 0.2, 0.02])
    brightness = road_brightness(CLEAN, GRID, APPROACH, pose)
    strength = marking_strength(brightness, GRID)
    expected = markings.marking_strength(brightness.numpy(), GRID)
    # At the edges the lane keeper knows one side alone.
    np.testing.assert_allclose(strength.numpy(), expected, atol=1e-4)
    model, lane_filter = LaneModel(GRID, width=3.4, offset=-0.2), LaneFilter(GRID)
    lane_filter.state = np.array([-0.2, 0.0, 0.0, 3.4])
    for _ in range(3):
        model.correct(strength)
        lane_filter.correct(expected)
        model.predict(torch.tensor(1.5), torch.tensor(0.01))
        lane_filter.predict(1.5, 0.01, 0.1)
    np.testing.assert_allclose(model.state.numpy(), lane_filter.state, atol=2e-3)


def test_without_dirt_it_keeps_its_lane_and_a_drifting_line_leads_it_away() -> None:
    with torch.no_grad():
        clean = deviation(CLEAN, APPROACH, GRID, seconds=1.5)
        share = start_patch(COVERING_WIDTH, shift=1.6, seed=0)
        dirty = deviation(DIRT[0] + (DIRT[1] - DIRT[0]) * share, APPROACH, GRID, seconds=1.5)
    assert float(clean.abs().max()) < 0.2
    assert float(dirty[-1]) > 0.5


def test_the_deviation_has_a_gradient_and_training_keeps_to_the_greys_of_dirt() -> None:
    patch = (DIRT[0] + (DIRT[1] - DIRT[0]) * start_patch(COVERING_WIDTH, shift=1.6, seed=0)).requires_grad_()
    deviation(patch, APPROACH, GRID, seconds=0.3)[-1].backward()
    assert patch.grad is not None
    assert float(patch.grad.abs().max()) > 0.0
    trained, history = train_road_patch(steps=1, batch=1, grid=GRID)
    assert len(history) == 1
    assert DIRT[0] <= float(trained.min()) <= float(trained.max()) <= DIRT[1]


def test_approaches_are_the_same_for_a_key() -> None:
    assert draw_approaches(2, key=(1,)) == draw_approaches(2, key=(1,)) != draw_approaches(2, key=(2,))

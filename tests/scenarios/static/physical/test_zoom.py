"""The part of a picture around its target."""

from __future__ import annotations

import pytest
import torch

from ssad.core.detections import Solids, Truth
from ssad.core.errors import ConfigError
from ssad.scenarios.static.physical import make_physical
from ssad.scenarios.static.physical.zoom import around_target


def picture(*boxes: list[float]) -> tuple[torch.Tensor, Truth]:
    """A picture that is white in its first box."""
    image = torch.zeros(1, 3, 320, 480)
    x0, y0, x1, y1 = (int(v) for v in boxes[0])
    image[..., y0:y1, x0:x1] = 1.0
    return image, Truth(
        torch.zeros(len(boxes), dtype=torch.long), torch.tensor(boxes), crowd=torch.zeros(len(boxes)) > 0
    )


@pytest.mark.parametrize("box", [[200.0, 100.0, 260.0, 150.0], [0.0, 0.0, 60.0, 40.0], [430.0, 290.0, 480.0, 320.0]])
def test_the_target_is_whole_in_the_part_and_its_box_fits(box: list[float]) -> None:
    image, truth = picture(box)
    places = set()
    for seed in range(20):
        part, own = around_target(image, truth, 128, torch.Generator().manual_seed(seed))
        assert part.shape == (1, 3, 128, 128)
        left, top, right, bottom = own.box[0].long().tolist()
        assert (right - left, bottom - top) == (box[2] - box[0], box[3] - box[1])
        assert float(part[0, 0, top:bottom, left:right].min()) == 1.0
        assert float(part.sum()) == float(image.sum()), "nothing of the target is cut off"
        places.add((left, top))
    assert (len(places) > 3) == (box[0] == 200.0), "not always at the same place, but in a corner"


def test_others_are_there_if_their_middle_is() -> None:
    image, truth = picture([200.0, 100.0, 260.0, 150.0], [205.0, 105.0, 265.0, 155.0], [10.0, 10.0, 50.0, 50.0])
    _, own = around_target(image, truth, 128, torch.Generator().manual_seed(0))
    assert len(own.box) == 2
    assert torch.equal(own.box[1] - own.box[0], torch.full((4,), 5.0)) or float(own.box[1].max()) == 128.0


def test_a_target_that_is_too_large_is_made_smaller() -> None:
    image, truth = picture([100.0, 40.0, 340.0, 240.0])
    image.requires_grad_()
    part, own = around_target(image, truth, 128, torch.Generator().manual_seed(0))
    side = 300.0  # 1.25 times 240
    assert own.box[0, 2] - own.box[0, 0] == pytest.approx(240 * 128 / side, abs=1e-3)
    assert own.box[0, 3] - own.box[0, 1] == pytest.approx(200 * 128 / side, abs=1e-3)
    area = (240 * 200) * (128 / side) ** 2
    assert float(part[0, 0].detach().sum()) == pytest.approx(area, rel=0.02)
    (slope,) = torch.autograd.grad(part.sum(), image)
    assert float(slope.sum()) == pytest.approx(3 * 128 * 128, rel=0.01)


def test_parts_of_3d_truth_and_odd_windows_are_refused() -> None:
    image, truth = picture([200.0, 100.0, 260.0, 150.0])
    none = torch.zeros(1, 3)
    solid = Solids(none, none, none[:, 0], none[:, :2], none[:, 0])
    with pytest.raises(ConfigError, match="no 3D truth"):
        around_target(image, Truth(truth.label, truth.box, solid), 128, torch.Generator())
    with pytest.raises(ConfigError, match="window=200: Input should be a multiple of 32"):
        make_physical("das", window=200)

"""Boxes as tensors: corners, areas and overlaps against NumPy's versions and by hand."""

import numpy as np
import pytest
import torch

from ssad.core.boxes import UNIT_CORNERS
from ssad.core.geometry import corners
from ssad.core.tensor_boxes import area, intersection, iou, rectangle_corners, rotate, solid_corners


def test_corners_of_rectangles_are_those_of_the_arrays() -> None:
    draws = torch.Generator().manual_seed(0)
    boxes = torch.rand(50, 5, dtype=torch.float64, generator=draws) * 6
    x, y, yaw, length, width = boxes.numpy().T
    expected = corners(x, y, yaw, length, width)
    np.testing.assert_allclose(rectangle_corners(boxes[:, :2], boxes[:, 3:], boxes[:, 2]).numpy(), expected, atol=1e-12)


def test_a_quarter_turn_is_counter_clockwise() -> None:
    turned = rotate(torch.tensor([[1.0, 0.0], [0.0, 2.0]]), torch.tensor(torch.pi / 2))
    torch.testing.assert_close(turned, torch.tensor([[0.0, 1.0], [-2.0, 0.0]]), atol=1e-6, rtol=0)


def test_corners_of_solids_come_in_the_order_of_the_unit_corners() -> None:
    size = torch.tensor([4.0, 1.5, 2.0], dtype=torch.float64)
    centre = torch.tensor([1.0, 2.0, 30.0], dtype=torch.float64)
    expected = UNIT_CORNERS * size.numpy() + centre.numpy()
    np.testing.assert_allclose(solid_corners(centre, size, torch.zeros((), dtype=torch.float64)).numpy(), expected)


def test_overlaps_by_hand() -> None:
    boxes = torch.tensor([[0.0, 0, 4, 2], [2, 1, 6, 3], [9, 9, 10, 10], [1, 1, 1, 1], [5, 5, 4, 4]])
    assert area(boxes).tolist() == [8, 8, 1, 0, 0]
    assert intersection(boxes, boxes[:1]).tolist() == [8, 2, 0, 0, 0]
    assert iou(boxes, boxes[0]).tolist() == pytest.approx([1, 2 / 14, 0, 0, 0])
    assert iou(boxes[:, None], boxes[None]).shape == (5, 5)
    assert iou(boxes[3], boxes[3]).item() == 0.0


def test_the_gradient_of_an_overlap_points_to_the_other_box() -> None:
    box = torch.tensor([0.0, 0, 2, 2], requires_grad=True)
    iou(box, torch.tensor([1.0, 0, 3, 2])).backward()
    assert box.grad is not None
    assert box.grad[2] > 0  # a wider box covers more
    assert box.grad[0] > 0  # less of it lies outside

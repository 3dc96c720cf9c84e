"""Detections: concatenated, and brought to the CPU."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch

from ssad.core.columns import concatenate
from ssad.core.detections import Detections, Solids, transform_together
from ssad.core.errors import ConfigError


def detections(count: int, *, three: bool) -> Detections:
    score, label, box = torch.rand(count), torch.arange(count), torch.rand(count, 4)
    solid = Solids(torch.rand(count, 3), torch.rand(count, 3), torch.rand(count), torch.rand(count, 2), label)
    return Detections(score, label, box, solid if three else None)


@pytest.mark.parametrize("three", [False, True])
def test_concatenated_detections_are_those_of_the_parts_in_order(three: bool) -> None:
    parts = [detections(count, three=three) for count in (2, 0, 3)]
    whole = Detections.cat(parts)
    assert whole.score.tolist() == [value for part in parts for value in part.score.tolist()]
    assert whole.box.shape == (5, 4)
    assert (whole.solid is not None) == three
    if whole.solid is not None:
        for column in fields(Solids):
            expected = torch.cat([getattr(part.solid, column.name) for part in parts])
            assert torch.equal(getattr(whole.solid, column.name), expected)


def test_detections_with_and_without_solids_are_not_concatenated() -> None:
    with pytest.raises(ValueError, match="with and without"):
        Detections.cat([detections(1, three=True), detections(1, three=False)])


def test_tables_of_tuples_and_arrays_are_concatenated() -> None:
    from ssad.core.boxes import TrackedBoxes

    boxes = [
        TrackedBoxes(np.full((n, 3), n), np.ones((n, 3)), np.ones((n, 4)), np.ones((n, 3)), ("a",) * n, np.ones(n))
        for n in (1, 2)
    ]
    both = concatenate(boxes)
    assert type(both) is TrackedBoxes
    assert both.instance == ("a", "a", "a")
    assert both.centre[:, 0].tolist() == [1, 2, 2]


def test_tensors_are_changed_together_where_they_are_of_a_kind() -> None:
    calls = []

    def twice(value: torch.Tensor) -> torch.Tensor:
        calls.append(value.shape)
        return 2 * value

    alike = [torch.rand(n, 3) for n in (2, 0, 5)]
    for before, after in zip(alike, transform_together(alike, twice), strict=True):
        assert (after == 2 * before).all()
    assert calls == [(7, 3)]
    for mixed in ([torch.rand(2, 3), torch.rand(2, 4)], [torch.rand(2), torch.arange(2)], [torch.tensor(1.0)]):
        calls.clear()
        for before, after in zip(mixed, transform_together(mixed, twice), strict=True):
            assert (after == 2 * before).all()
        assert len(calls) == len(mixed)


def test_detections_come_to_the_host_as_they_are() -> None:
    before = [
        detections(3, three=True),
        detections(0, three=True),
        detections(5, three=False),
        detections(2, three=True),
    ]
    after = Detections.cpu(before)
    assert [len(one.score) for one in after] == [3, 0, 5, 2]
    assert [one.solid is None for one in after] == [False, False, True, False]
    assert after[3].solid is not None
    assert before[3].solid is not None
    assert (after[3].solid.yaw == before[3].solid.yaw).all(), "solids stay with their detections"
    assert not Detections.cpu([])
    with pytest.raises(ConfigError, match="holds tensors"):
        Detections.cpu([Detections(np.zeros(1), torch.zeros(1), torch.zeros(1, 4))])  # type: ignore[arg-type]

"""Target assignment, and that the assigned targets decode to the ground truth."""

import math
from dataclasses import replace

import pytest
import torch
from helpers.mono3d import TINY, TINY_PGD, TINY_PGD_VECTORS, TINY_VECTORS, lens, perfect, some_truth, truth_of
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssad.core.detections import Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.tensor_boxes import solid_corners
from ssad.detectors.mono3d.config import FCOS3D, Mono3DConfig
from ssad.detectors.mono3d.decode import (
    PlaceGrid,
    global_yaw,
    places_of,
    project,
    unproject,
    vectors_of_yaw,
    yaw_of_vectors,
)
from ssad.detectors.mono3d.detector import Mono3D
from ssad.detectors.mono3d.targets import assign

SIZE = (256, 416)
K = lens(300.0, SIZE)
ONE = torch.ones(2, dtype=torch.float64)


def grid(strides: tuple[int, ...] = (8, 16, 32, 64, 128), size: tuple[int, int] = SIZE) -> PlaceGrid:
    maps = [torch.zeros(1, 1, -(-size[0] // s), -(-size[1] // s), dtype=torch.float64) for s in strides]
    return places_of(maps, strides)


def at(u: float, v: float, depth: float = 20.0) -> Tensor:
    return unproject(torch.tensor([[u, v, depth]], dtype=torch.float64), K)[0]


def solids(*centres: Tensor, velocity: float = 1.0) -> Solids:
    n = len(centres)
    return Solids(
        torch.stack(centres),
        torch.tensor([[4.0, 1.5, 2.0]], dtype=torch.float64).expand(n, 3),
        torch.linspace(-3, 3, n, dtype=torch.float64),
        torch.full((n, 2), velocity, dtype=torch.float64),
        torch.arange(n),
    )


def told(boxes: list[list[float]], centres: list[Tensor], **more: Tensor) -> Truth:
    label = torch.arange(len(boxes))
    return Truth(label, torch.tensor(boxes, dtype=torch.float64), solids(*centres), K, **more)


def test_places_are_in_the_middle_of_their_cells() -> None:
    places = grid((8, 16), (16, 24))
    assert places.xy.tolist()[:4] == [[4, 4], [12, 4], [20, 4], [4, 12]]
    assert places.xy.tolist()[6:] == [[8, 8], [24, 8]]
    assert places.stride.tolist() == [8] * 6 + [16] * 2
    assert places.level.tolist() == [0] * 6 + [1] * 2


def test_positives_lie_strictly_within_a_square_round_the_projected_centre() -> None:
    # less than 12 pixels from (100, 60) at stride 8: 92, 100 and 108 of the places 84, 92, 100, 108, 116
    truth = told([[80, 40, 120, 80]], [at(100, 60)])
    found = assign(FCOS3D, grid(), [truth], K[None], ONE)
    rows = (found.label[0] >= 0).nonzero()[:, 0]
    xy = grid().xy[rows]
    assert sorted({float(x) for x in xy[:, 0]}) == [92, 100, 108]
    assert sorted({float(y) for y in xy[:, 1]}) == [52, 60, 68]
    assert set(found.label[0, rows].tolist()) == {0}
    assert set(found.owner[0, rows].tolist()) == {0}
    on_border = told([[80, 40, 120, 80]], [at(104, 60)])  # 92 and 116 are exactly 12 away
    found = assign(FCOS3D, grid(), [on_border], K[None], ONE)
    assert sorted({float(x) for x in grid().xy[found.label[0] >= 0][:, 0]}) == [100, 108]


def test_the_place_may_lie_outside_the_2d_box() -> None:
    truth = told([[100, 60, 130, 90]], [at(96, 56)])
    assert ((assign(FCOS3D, grid(), [truth], K[None], ONE).label >= 0).sum()) > 0


def test_ranges_take_both_ends() -> None:
    places = grid()
    for side, levels in ((47.0, {0}), (48.0, {0, 1}), (49.0, {1})):
        for level, x, y in ((0, 100.0, 52.0), (1, 104.0, 56.0)):  # places of strides 8 and 16
            truth = told([[x - side, 50, x + 4, 60]], [at(x, y)])
            found = assign(FCOS3D, places, [truth], K[None], ONE)
            row = (places.xy[:, 0] == x) & (places.xy[:, 1] == y)
            assert places.level[row].tolist() == [level]
            assert bool(found.label[0, row][0] >= 0) == (level in levels)


def test_the_nearest_projected_centre_wins_not_the_smaller_box() -> None:
    small, large = [96.0, 56, 104, 64], [40.0, 0, 160, 120]
    truth = told([small, large], [at(108, 60), at(98, 60)])
    found = assign(FCOS3D, grid(), [truth], K[None], ONE)
    places = grid()
    both = (places.xy[:, 0] == 100) & (places.xy[:, 1] == 60) & (places.level == 0)
    assert found.owner[0, both].item() == 0  # the large one answers at another level: 48 is the limit
    larger = told([small, [75, 35, 125, 85]], [at(108, 60), at(98, 60)])
    assert assign(FCOS3D, places, [larger], K[None], ONE).owner[0, both].item() == 1


def test_targets_of_a_place() -> None:
    centre = at(100, 60, 25.0)
    truth = told([[80, 40, 120, 84]], [centre])
    places = grid()
    found = assign(FCOS3D, places, [truth], K[None], ONE)
    row = int(((places.xy[:, 0] == 92) & (places.xy[:, 1] == 68) & (places.level == 0)).nonzero())
    reg = found.extra["reg"][0, row]
    local = -3.0 - math.atan2(float(centre[0]), float(centre[2]))
    wanted = [(92 - 100) / 8, (68 - 60) / 8, 25, 4, 1.5, 2, local, 1, 1, 12 / 8, 28 / 8, 28 / 8, 16 / 8]
    assert reg.tolist() == pytest.approx(wanted)
    assert found.extra["attribute"][0, row] == 0
    away = math.hypot(8, 8)
    assert float(found.extra["centreness"][0, row]) == pytest.approx(math.exp(-2.5 * away / (1.414 * 12)))


def test_what_does_not_count_is_nowhere() -> None:
    crowd = told([[80, 40, 120, 80]], [at(100, 60)], crowd=torch.tensor([True]))
    assert bool((assign(FCOS3D, grid(), [crowd], K[None], ONE).label == -1).all())


def test_nothing_is_assigned_to_no_object() -> None:
    none = Truth(
        torch.zeros(0, dtype=torch.int64),
        torch.zeros(0, 4),
        Solids(
            torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 2), torch.zeros(0, dtype=torch.int64)
        ),
    )
    found = assign(FCOS3D, grid(), [none, some_truth()], torch.stack([K, K]), ONE)
    assert bool((found.label[0] == -1).all())
    assert bool((found.owner[0] == -1).all())
    assert bool((found.label[1] >= 0).any())


def test_truth_that_does_not_fit() -> None:
    flat = Truth(torch.zeros(1, dtype=torch.int64), torch.zeros(1, 4))
    with pytest.raises(ConfigError, match="truth of image 0 has no 3D boxes"):
        assign(FCOS3D, grid(), [flat], K[None], ONE)
    truth = told([[80, 40, 120, 80]], [at(100, 60)])
    wrong = replace(truth, label=torch.tensor([10]))
    with pytest.raises(ConfigError, match="label of image 1"):
        assign(FCOS3D, grid(), [truth, wrong], torch.stack([K, K]), ONE)


RESIZED = replace(TINY, input_width=600, virtual_focal=500.0)


@pytest.mark.parametrize(
    "config",
    [TINY, TINY_PGD, RESIZED, replace(TINY_PGD, input_width=300, virtual_focal=500.0), TINY_VECTORS, TINY_PGD_VECTORS],
    ids=["fcos3d", "pgd", "resized", "pgd resized", "vectors", "pgd vectors"],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_maps_that_say_the_truth_decode_to_it(config: Mono3DConfig, seed: int) -> None:
    truth = some_truth(5, seed=seed)
    detector = Mono3D(config).double()
    dense, assignment = perfect(detector, truth, (225, 400))
    (found,) = detector.select(dense, 0.1)
    assert truth.solid is not None
    assert found.solid is not None
    owners = set(assignment.owner[0].tolist()) - {-1}
    assert len(owners) >= 4
    for k in owners:
        near = (found.solid.centre - truth.solid.centre[k]).norm(dim=1).argmin()
        assert found.label[near] == truth.label[k]
        for name in ("centre", "size_lhw", "velocity"):
            assert getattr(found.solid, name)[near].tolist() == pytest.approx(
                getattr(truth.solid, name)[k].tolist(), abs=1e-6
            )
        turned = float(found.solid.yaw[near] - truth.solid.yaw[k])
        assert math.remainder(turned, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
        assert found.solid.attribute[near] == truth.solid.attribute[k]
        inside = truth.box[k]
        limit = torch.tensor([400.0, 225, 400, 225], dtype=torch.float64)
        assert found.box[near].tolist() == pytest.approx(inside.clamp_min(0).minimum(limit).tolist(), abs=1e-6)
    assert len(found.label) == len(owners)  # neighbouring places say the same, and one stays


@pytest.mark.parametrize("config", [TINY, TINY_VECTORS], ids=["bins", "vectors"])
def test_yaw_comes_back_from_all_around(config: Mono3DConfig) -> None:
    detector = Mono3D(config).double()
    size = torch.tensor([2.0, 1.5, 1.0], dtype=torch.float64).expand(3, 3)
    centre = torch.tensor([[-6.0, 0.3, 15], [0.5, 0, 15], [6, -0.3, 16]], dtype=torch.float64)
    for first in torch.linspace(-math.pi, -math.pi / 3, 5, dtype=torch.float64):
        yaw = first + torch.arange(3) * (2 * math.pi / 3)
        truth = truth_of(centre, size, yaw, label=torch.arange(3), intrinsic=lens())
        (found,) = detector.select(perfect(detector, truth, (225, 400))[0], 0.1)
        assert found.solid is not None
        assert found.label.tolist() == [0, 1, 2]
        for said, true in zip(found.solid.yaw.tolist(), yaw.tolist(), strict=True):
            assert math.remainder(said - true, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


@given(
    st.floats(-10.0, 10.0),
    st.floats(0.1, 5.0),
    st.floats(0.1, 5.0),
    st.floats(-0.9, 0.9),
    st.floats(-0.9, 0.9),
)
def test_yaw_of_vectors_has_no_border(yaw: float, length: float, length2: float, off: float, off2: float) -> None:
    """The axis errs by half of what the second pair errs, and any error below a quarter turn leaves the side."""
    true = torch.tensor(yaw, dtype=torch.float64)
    one, two = vectors_of_yaw(true + off)[:2] * length, vectors_of_yaw(true + off2 / 2)[2:] * length2
    said = float(yaw_of_vectors(torch.cat([one, two])))
    assert math.remainder(said - yaw, 2 * math.pi) == pytest.approx(off2 / 2, abs=1e-9)
    assert -math.pi / 2 <= said <= 3 * math.pi / 2
    back = vectors_of_yaw(true + math.pi)  # seen from behind, with the same axis
    assert back[2:].tolist() == pytest.approx(vectors_of_yaw(true)[2:].tolist())


def test_a_bin_turns_what_lies_beside_its_border_and_vectors_do_not() -> None:
    """A yaw 2 degrees beyond the border whose bin is told for the other side comes out turned by half a turn."""
    border, lens_here = FCOS3D.dir_offset, lens()
    true, said = border + 0.035, torch.tensor(border - 0.035, dtype=torch.float64)
    u = lens_here[0, 2]
    wrong = global_yaw(said, torch.tensor(0), u, lens_here, offset=border)
    assert abs(math.remainder(float(wrong) - true, 2 * math.pi)) > 3.0
    whole = global_yaw(yaw_of_vectors(vectors_of_yaw(said)), None, u, lens_here, offset=border)
    assert abs(math.remainder(float(whole) - true, 2 * math.pi)) < 0.08


def test_corners_are_half_the_diagonal_from_the_centre() -> None:
    solid = some_truth(4, seed=3).solid
    assert solid is not None
    away = (solid_corners(solid.centre, solid.size_lhw, solid.yaw) - solid.centre[:, None]).norm(dim=-1)
    torch.testing.assert_close(away, 0.5 * solid.size_lhw.norm(dim=1)[:, None].expand(4, 8))


def test_corners_follow_the_convention_of_yaw() -> None:
    """At yaw 0 the nose points along x, at a quarter turn against z."""
    nose = solid_corners(torch.zeros(3), torch.tensor([4.0, 1e-6, 1e-6]), torch.tensor(math.pi / 2)).round(decimals=4)
    assert nose[4:].mean(0).tolist() == pytest.approx([0, 0, -2], abs=1e-4)


def test_projection_inverts() -> None:
    points = torch.tensor([[10.0, 20.0, 5.0], [400.0, 3.0, 60.0]], dtype=torch.float64)
    back = unproject(points, K)
    assert back[:, 2].tolist() == [5, 60]
    torch.testing.assert_close(project(back, K), points[:, :2])
    behind = torch.tensor([1.0, 2.0, -4.0], dtype=torch.float64)
    assert bool((project(behind, K, near=None) == (K @ behind)[:2] / -4.0).all())


@pytest.mark.parametrize(
    ("depth", "held", "anything_but_zero"),
    [
        (0.11, 0.11, 0.11),
        (0.09, 0.1, 0.09),
        (0.0, 0.1, 1e-4),
        (-5e-5, 0.1, 1e-4),
        (-2e-4, 0.1, -2e-4),
        (-3.0, 0.1, -3.0),
    ],
)
def test_projection_near_the_camera_divides_by_a_depth_that_is_held(
    depth: float, held: float, anything_but_zero: float
) -> None:
    """A tenth of a metre for boxes; in the loss any depth but zero, as the source has it."""
    point = torch.tensor([0.2, -0.3, depth], dtype=torch.float64)
    above = torch.tensor([300 * 0.2 + 208 * depth, 300 * -0.3 + 128 * depth], dtype=torch.float64)
    torch.testing.assert_close(project(point, K), above / held)
    torch.testing.assert_close(project(point, K, near=None), above / anything_but_zero)

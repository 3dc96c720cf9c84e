"""Bodies of actors: every model of the world has one of its size and class; no trailer is without a vehicle."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.nuscenes_names import CATEGORY_TO_CLASS
from ssad.rendering.bodies import BODIES
from ssad.rendering.bodies.actor_bodies import ACTOR_BODIES, category_of, class_of, towing_vehicle
from ssad.rendering.episode_scene import body_of
from ssad.world.models import MODELS, SURROGATES

CLASSES = {
    "euroncap_adult": "pedestrian",
    "euroncap_child": "pedestrian",
    "euroncap_bicycle": "bicycle",
    "euroncap_motorcycle": "motorcycle",
    "euroncap_vehicle": "car",
}


@pytest.mark.parametrize("name", sorted(SURROGATES))
def test_a_test_target_has_a_body_of_its_own_with_its_size_and_class(name: str) -> None:
    kind, (style,) = ACTOR_BODIES[name]
    assert style.endswith("_target")
    assert class_of(kind) == CLASSES[name]
    model = MODELS[name]
    size = np.array([model.length, model.width, model.height])
    np.testing.assert_array_equal(BODIES[kind].styles[style].size, size)
    low, high = body_of(name, 0).bounds()
    assert (low >= [*(-0.5 * size[:2] - 1e-4), -1e-4]).all()
    assert (high <= [*(0.5 * size[:2] + 1e-4), size[2] + 1e-4]).all()
    assert high[2] > 0.94 * size[2]
    assert body_of(name, 0).materials == body_of(name, 3).materials, "all variants look alike"


def test_categories_belong_to_the_class_of_their_kind() -> None:
    assert category_of("pedestrian", "child_target") == "human.pedestrian.child"
    assert category_of("pedestrian", "adult_target") == "human.pedestrian.adult"
    assert category_of("car", "global_vehicle_target") == "vehicle.car"
    for kind, styles in {kind: body.styles for kind, body in BODIES.items()}.items():
        if kind in ("car", "pedestrian", "bus", "bicycle", "motorcycle", "truck", "trailer"):
            assert {CATEGORY_TO_CLASS[category_of(kind, style)] for style in styles} == {class_of(kind)}


@pytest.mark.parametrize("style", BODIES["trailer"].styles)
def test_a_vehicle_draws_a_trailer(style: str) -> None:
    size = BODIES["trailer"].styles[style].size
    vehicle = towing_vehicle(style, size)
    assert (vehicle.kind == "car") == (style == "utility")
    rear_of_vehicle = vehicle.ahead - 0.5 * vehicle.size[0]
    front_of_trailer = 0.5 * size[0]
    # A drawbar meets the car; a semi-trailer lies on its tractor.
    overlap = front_of_trailer - rear_of_vehicle
    assert 0.0 < overlap < (0.2 if style == "utility" else 0.4 * vehicle.size[0])
    ends = max(0.5 * size[0], vehicle.ahead + 0.5 * vehicle.size[0]) + 0.5 * size[0]
    assert vehicle.length == pytest.approx(ends)

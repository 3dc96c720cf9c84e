"""Models of agents and the bodies that change them."""

from __future__ import annotations

import pytest

from ssad.core.errors import UnknownNameError
from ssad.core.types import Body, Controller, EpisodeAgent, Pose
from ssad.world.models import (
    GRAVITY,
    MODELS,
    acceleration_limits,
    agent_model,
    agent_size,
    model_with_body,
    stated_size,
)


def agent(model: str = "car", **body: float) -> EpisodeAgent:
    return EpisodeAgent("a", model, Controller.NONE, Pose(0.0, 0.0), body=Body(**body))


def test_a_body_replaces_what_it_states_and_nothing_else() -> None:
    assert agent_model(agent()) is MODELS["car"]
    changed = model_with_body(MODELS["car"], Body(width=1.712, max_brake=6.0))
    assert (changed.width, changed.max_brake) == (1.712, 6.0)
    assert (changed.length, changed.wheelbase, changed.max_accel) == (4.90, MODELS["car"].wheelbase, 3.5)


def test_the_wheelbase_follows_the_length_unless_it_is_stated() -> None:
    assert model_with_body(MODELS["car"], Body(length=9.8)).wheelbase == pytest.approx(2.0 * MODELS["car"].wheelbase)
    assert model_with_body(MODELS["car"], Body(length=9.8, wheelbase=2.7)).wheelbase == 2.7


def test_an_unknown_model_is_named() -> None:
    with pytest.raises(UnknownNameError, match="'carr'"):
        agent_model(agent("carr"))


def test_limits_are_the_lower_ones_of_vehicle_and_surface() -> None:
    assert acceleration_limits(agent(), 0.9) == (3.5, 8.0)
    assert acceleration_limits(agent(), 0.2) == (0.2 * GRAVITY, 0.2 * GRAVITY)
    assert acceleration_limits(agent(max_brake=1.5), 0.2) == (0.2 * GRAVITY, 1.5)


def test_only_sizes_other_than_the_models_are_stated() -> None:
    car = MODELS["car"]
    assert stated_size("car", (car.length, car.width, car.height)) == ()
    assert agent_size("car", ()) == (car.length, car.width, car.height)
    size = stated_size("car", (4.023, 1.712, 1.427))
    assert size == pytest.approx((4.023, 1.712, 1.427))
    assert agent_size("car", size) == size

"""Models of agents and the bodies that change them."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.errors import UnknownNameError
from ssad.core.types import Body, Contact, Controller, EpisodeAgent, Pose
from ssad.simulators.carla.blueprints import MODEL_OF, nearest_model
from ssad.world.models import (
    GRAVITY,
    MODELS,
    SURROGATES,
    acceleration_limits,
    agent_model,
    agent_size,
    model_with_body,
    stated_size,
)
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode


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
    assert acceleration_limits(MODELS["car"], 0.9) == (3.5, 8.0)
    assert acceleration_limits(MODELS["car"], 0.2) == (0.2 * GRAVITY, 0.2 * GRAVITY)
    assert acceleration_limits(agent_model(agent(max_brake=1.5)), 0.2) == (0.2 * GRAVITY, 1.5)


def test_only_sizes_other_than_the_models_are_stated() -> None:
    car = MODELS["car"]
    assert stated_size("car", (car.length, car.width, car.height)) == ()
    assert agent_size("car", ()) == (car.length, car.width, car.height)
    size = stated_size("car", (4.023, 1.712, 1.427))
    assert size == pytest.approx((4.023, 1.712, 1.427))
    assert agent_size("car", size) == size


def test_surrogates_have_the_dimensions_of_euro_ncap_and_stand_for_no_other_body() -> None:
    dimensions = {
        "euroncap_adult": (0.6, 0.5),
        "euroncap_child": (0.711, 0.298),
        "euroncap_bicycle": (1.89, 0.5),
        "euroncap_motorcycle": (2.08, 0.79),
        "euroncap_vehicle": (4.023, 1.712),
    }
    assert {name: (MODELS[name].length, MODELS[name].width) for name in SURROGATES} == dimensions
    assert (MODELS["euroncap_adult"].height, MODELS["euroncap_child"].height) == (1.8, 1.154)
    assert nearest_model("car", (4.023, 1.712, 1.427)) == "coupe"
    assert nearest_model("pedestrian", (0.6, 0.5, 1.8)) == "walker"
    assert not SURROGATES & set(MODEL_OF.values())


def test_contact_with_a_surrogate_is_that_of_its_kind() -> None:
    kinds = {
        "euroncap_adult": Contact.WALKER,
        "euroncap_child": Contact.WALKER,
        "euroncap_bicycle": Contact.CYCLIST,
        "euroncap_motorcycle": Contact.VEHICLE,
        "euroncap_vehicle": Contact.VEHICLE,
    }
    others = [EpisodeAgent("dummy", name, Controller.NONE, Pose(20.0, 0.0)) for name in kinds]
    world = World([episode(ego(speed=10.0), other, key=other.model) for other in others], GRAPHS)
    for _ in range(10):
        world.step(np.zeros((world.batch, 3), np.float32))
    assert world.state().contact_agent.tolist() == [1] * 5
    assert [Contact(int(bits)) for bits in world.state().contact] == list(kinds.values())

"""Bodies and limits of agents. Bodies follow CARLA 0.9's bounding boxes of the vehicles named beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import lru_cache

import numpy as np

from ssad.core.errors import unknown_name
from ssad.core.types import DEFAULT_FRICTION, AgentKind, Body, EpisodeAgent, EpisodeTrace, Model

# CARLA's cars turn their front wheels by up to 70 degrees at steer = 1; ported controllers rely on that scale.
_STEER = math.radians(70.0)
# Yaw rate is cut so that the lateral acceleration stays below this (dry road, before sliding), m/s^2.
GRIP = 7.0
GRAVITY = 9.81  # m/s^2
# The front wheels need this long from straight to full lock, s.
STEER_TIME = 0.5
# Reverse gear: top speed, m/s.
REVERSE_SPEED = 5.0
# A walker that a driver steers turns at up to this, rad/s.
WALKER_RATE = math.pi


def _vehicle(  # noqa: PLR0917
    name: str, kind: AgentKind, size: tuple[float, float, float], accel: float, brake: float, speed: float
) -> Model:
    # The wheelbase is taken as the same share of the length for every vehicle.
    return Model(name, kind, *size, 0.58 * size[0], _STEER, accel, brake, speed)


# Dimensions and wheelbases: vectorgrp/OSC-NCAP-scenarios ee7aa11, catalogues of vehicles and pedestrians. Two-wheelers
# are as high as the world's own riders.
_SURROGATES = (
    Model("euroncap_adult", AgentKind.WALKER, 0.60, 0.50, 1.80, max_accel=20.0, max_brake=20.0, max_speed=4.0),
    Model("euroncap_child", AgentKind.WALKER, 0.711, 0.298, 1.154, max_accel=20.0, max_brake=20.0, max_speed=4.0),
    Model("euroncap_bicycle", AgentKind.BICYCLE, 1.89, 0.50, 1.75, 1.21, _STEER, 2.0, 8.0, 14.0),
    Model("euroncap_motorcycle", AgentKind.MOTORCYCLE, 2.08, 0.79, 1.60, 1.41, _STEER, 8.0, 10.0, 70.0),
    Model("euroncap_vehicle", AgentKind.CAR, 4.023, 1.712, 1.427, 2.475, _STEER, 5.0, 10.0, 70.0),
)
SURROGATES = frozenset(m.name for m in _SURROGATES)
"""Models with the dimensions of Euro NCAP's test devices; imports choose them by name alone."""

MODELS: dict[str, Model] = {
    m.name: m
    for m in (
        _vehicle("car", AgentKind.CAR, (4.90, 2.06, 1.51), 3.5, 8.0, 50.0),  # lincoln.mkz_2017
        _vehicle("suv", AgentKind.CAR, (4.60, 1.93, 1.85), 3.2, 8.0, 45.0),  # nissan.patrol
        _vehicle("coupe", AgentKind.CAR, (4.18, 1.99, 1.39), 4.0, 8.5, 60.0),  # audi.tt
        _vehicle("compact", AgentKind.CAR, (3.63, 1.85, 1.50), 3.0, 8.0, 45.0),  # nissan.micra
        _vehicle("van", AgentKind.CAR, (5.20, 2.00, 2.60), 2.5, 7.0, 40.0),
        _vehicle("truck", AgentKind.TRUCK, (8.47, 2.50, 3.40), 1.5, 6.0, 30.0),
        _vehicle("bus", AgentKind.BUS, (10.27, 2.50, 3.30), 1.3, 6.0, 28.0),
        _vehicle("motorcycle", AgentKind.MOTORCYCLE, (2.20, 0.85, 1.60), 4.5, 7.5, 55.0),
        # diamondback.century; a strong rider's start, about 1.5 m/s^2
        _vehicle("bicycle", AgentKind.BICYCLE, (1.65, 0.60, 1.75), 1.5, 4.0, 12.0),
        Model("walker", AgentKind.WALKER, 0.50, 0.50, 1.86, max_accel=20.0, max_brake=20.0, max_speed=4.0),
        Model("vending_machine", AgentKind.PROP, 1.00, 0.90, 1.90),
        Model("barrier", AgentKind.PROP, 1.50, 0.50, 1.00),
        Model("cone", AgentKind.PROP, 0.40, 0.40, 0.75),
        *_SURROGATES,
    )
}


def model(name: str) -> Model:
    """Return the model of that name. Raises UnknownNameError with the three closest names."""
    try:
        return MODELS[name]
    except KeyError:
        raise unknown_name("model", name, MODELS) from None


def agent_model(agent: EpisodeAgent, models: Mapping[str, Model] = MODELS) -> Model:
    """Return the model of an agent with the dimensions and limits that its body states.

    Args:
        agent: The agent.
        models: Models by name.

    Raises:
        UnknownNameError: There is no such model.
    """
    if agent.model not in models:
        raise unknown_name("model", agent.model, models)
    return model_with_body(models[agent.model], agent.body)


@lru_cache(maxsize=1024)
def model_with_body(base: Model, body: Body) -> Model:
    """Return a model with the dimensions and limits of a body; the wheelbase keeps its share of the length."""
    stated = {name: value for name, value in asdict(body).items() if value is not None}
    if "length" in stated:
        stated.setdefault("wheelbase", base.wheelbase * stated["length"] / base.length)
    return replace(base, **stated) if stated else base


def acceleration_limits(body: Model, friction: float) -> tuple[float, float]:
    """Return the maximum acceleration and deceleration of a model on a surface, m/s^2."""
    return min(body.max_accel, friction * GRAVITY), min(body.max_brake, friction * GRAVITY)


def lateral_grip(friction: float) -> float:
    """Return the maximum lateral acceleration of a vehicle on a surface, m/s^2."""
    return GRIP * (friction / DEFAULT_FRICTION)


def stated_size(name: str, size: tuple[float, float, float]) -> tuple[float, ...]:
    """Return the size of an agent, m, in single precision, or () if it is that of its model.

    Args:
        name: Name of the model.
        size: Length, width, height, m.

    Returns:
        Values that are the same for an episode and for its trace.
    """
    base = MODELS.get(name)
    rounded = tuple(float(np.float32(value)) for value in size)
    if base is not None and rounded == tuple(
        float(np.float32(value)) for value in (base.length, base.width, base.height)
    ):
        return ()
    return rounded


def agent_size(name: str, size: tuple[float, ...]) -> tuple[float, float, float]:
    """Return length, width and height of an agent, m.

    Args:
        name: Name of its model.
        size: What `stated_size` returns.

    Raises:
        KeyError: There is no such model.
    """
    if size:
        length, width, height = size
        return length, width, height
    base = MODELS[name]
    return base.length, base.width, base.height


def trace_sizes(trace: EpisodeTrace) -> tuple[tuple[float, float, float], ...]:
    """Return length, width and height of each agent of a trace, m."""
    if not trace.heights:
        return tuple((m.length, m.width, m.height) for m in (model(name) for name in trace.models))
    lengths, widths = trace.length.tolist(), trace.width.tolist()
    return tuple(zip(lengths, widths, trace.heights, strict=True))

"""Bodies and limits of agents. Bodies follow CARLA 0.9's bounding boxes of the vehicles named beside them."""

from __future__ import annotations

import math

from ssad.core.errors import unknown_name
from ssad.core.types import AgentKind, Model

# CARLA's cars turn their front wheels by up to 70 degrees at steer = 1; ported controllers rely on that scale.
_STEER = math.radians(70.0)
# Yaw rate is cut so that the lateral acceleration stays below this (dry road, before sliding), m/s^2.
GRIP = 7.0
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
    )
}


def model(name: str) -> Model:
    """Return the model of that name. Raises UnknownNameError with the three closest names."""
    try:
        return MODELS[name]
    except KeyError:
        raise unknown_name("model", name, MODELS) from None

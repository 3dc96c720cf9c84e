"""Which drivers accelerated estimators can branch, and why not the others."""

from __future__ import annotations

from collections.abc import Collection

from ssad.core.driving import Believer, Branching, Driver
from ssad.core.types import Controller

NO_METHODS = "has no methods snapshot() and restore(states)"


def branch_obstacle(driver: Driver, history_sensors: Collection[str] = ()) -> str:
    """Return why episodes of a driver cannot branch, in a clause that begins with its name; "" where they can.

    Args:
        driver: The driver, with its name.
        history_sensors: Names of the sensors that keep a history of each episode.
    """
    if isinstance(driver, Believer):
        return f"{driver.name} plans over a belief, which no snapshot holds"
    if driver.controller != Controller.EXTERNAL:
        return ""  # it runs inside the world, whose snapshots hold all of it
    if not isinstance(driver, Branching):
        return f"{driver.name} {NO_METHODS}"
    used_sensors = [name for name in getattr(driver, "sensors", ()) if name in history_sensors]
    return f"{driver.name} reads {used_sensors[0]}, whose history no snapshot holds" if used_sensors else ""


def refusal(obstacle: str) -> str:
    """Return the message with which accelerated estimators refuse a driver, from its `branch_obstacle`."""
    return (
        f"{obstacle}, so splitting and importance sampling cannot branch its episodes; set methods=[monte-carlo], or "
        "see ssad.core.driving.Branching"
    )

"""Sensors that a perceiver reads, as the engine renders them."""

from __future__ import annotations

from typing import Any

from ssad.core.driving import Sensor
from ssad.core.nuscenes_names import LIDAR
from ssad.drivers.perceiving.parts import Perceiver, cameras_of
from ssad.rendering.lidar import HDL32E
from ssad.rendering.onboard import Onboard
from ssad.rendering.radar import OnboardRadar
from ssad.rendering.sensor_suite import SensorSuite


def sensor_suite(perceiver: Perceiver, **settings: Any) -> SensorSuite:
    """Return the cameras, LiDARs and radars that a perceiver reads.

    Args:
        perceiver: The perceiver.
        **settings: Further fields of `SensorSuite`, such as the device.
    """
    lidars = {LIDAR: HDL32E} | dict(getattr(perceiver, "lidars", {}))
    radars = dict(getattr(perceiver, "radars", {}))
    return SensorSuite(
        cameras={name: camera for name, camera in cameras_of(perceiver).items() if name in perceiver.sensors},
        lidars={name: lidars[name] for name in perceiver.sensors if name in lidars},
        radars={name: radars[name] for name in perceiver.sensors if name in radars},
        **settings,
    )


def sensors_of(perceiver: Perceiver, onboard: Onboard) -> dict[str, Sensor]:
    """Return the cameras, LiDARs and radars that a perceiver reads, by name.

    Args:
        perceiver: The perceiver.
        onboard: Source of the sensors.
    """
    suite = sensor_suite(perceiver)
    sensors: dict[str, Sensor] = dict(onboard.group_cameras(suite.cameras))
    sensors |= {name: onboard.lidar(lidar) for name, lidar in suite.lidars.items()}
    return sensors | {name: OnboardRadar(onboard, radar) for name, radar in suite.radars.items()}

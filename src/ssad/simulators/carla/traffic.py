"""Background traffic in the hands of CARLA's Traffic Manager, along the routes that the episode has for it.

Facts: carla.readthedocs.io, 0.9.16, Traffic Manager: its ways through `set_path`, its speed through
`set_desired_speed` in km/h, one random stream a manager.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

from ssad.core.seeding import digest
from ssad.core.types import Episode

if TYPE_CHECKING:
    import carla

EVERY: Final = 5  # points of a route between the places that the manager is given
OFFSET: Final = 6000  # its port beyond that of the server: 8000 beside 2000
KMH: Final = 3.6


class Traffic:
    """The vehicles of an episode that the Traffic Manager drives.

    Args:
        client: Connection to the server.
        port: First port of the server.
    """

    def __init__(self, client: carla.Client, port: int) -> None:
        self._port = port + OFFSET if port + OFFSET < 65536 else port - OFFSET
        self._manager = client.get_trafficmanager(self._port)
        self._manager.set_synchronous_mode(True)
        self.driven: set[int] = set()

    def begin(self, episode: Episode) -> None:
        """A new episode: nobody is driven, and what the manager draws depends on the episode alone."""
        self.driven = set()
        self._manager.set_random_device_seed(int(digest("traffic manager", episode.key)[:7], 16))

    def take(self, number: int, body: carla.Actor, episode: Episode) -> None:
        """Hand an agent over; one without a route goes where the manager likes."""
        import carla

        agent = episode.agents[number]
        vehicle = cast("carla.Vehicle", body)
        vehicle.set_autopilot(True, self._port)
        self._manager.set_desired_speed(vehicle, KMH * agent.target_speed)
        self._manager.auto_lane_change(vehicle, False)
        if agent.route is not None:
            points = agent.route.xy[EVERY::EVERY].tolist()
            self._manager.set_path(vehicle, [carla.Location(x, -y, 0.0) for x, y in points])
        self.driven.add(number)

    def end(self) -> None:
        """Leave the manager as it was found."""
        self._manager.set_synchronous_mode(False)

"""Background traffic driven by CARLA's Traffic Manager, along the routes that the episode defines.

Facts: carla.readthedocs.io, 0.9.16, Traffic Manager: its paths through `set_path`, its speed through
`set_desired_speed` in km/h, one random stream per manager.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

from ssad.core.seeding import digest
from ssad.core.types import Episode

if TYPE_CHECKING:
    import carla

EVERY: Final = 5  # every fifth point of a route is passed to the manager
OFFSET: Final = 6000  # from the server's port to the manager's: 8000 for the default 2000
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
        self.driven_bodies: set[int] = set()

    def begin(self, episode: Episode) -> None:
        """Start an episode without any driven vehicle; the manager's random stream depends on the episode alone."""
        self.driven_bodies = set()
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
            # CARLA's frame is left-handed: y changes its sign.
            self._manager.set_path(vehicle, [carla.Location(x, -y, 0.0) for x, y in points])
        self.driven_bodies.add(number)

    def end(self) -> None:
        """Restore the manager's asynchronous mode."""
        self._manager.set_synchronous_mode(False)

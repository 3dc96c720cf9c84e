"""Events from CARLA's own sensors on the ego: collisions and crossed lane markings.

Facts: carla.readthedocs.io, 0.9.16, sensors reference. Both sensors report only when something happens. The lane
sensor reports the markings that the corners of the body crossed in a frame; in junctions it reports nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, cast

from ssad.core.errors import ConfigError

if TYPE_CHECKING:
    import carla

COLLISION: Final = "sensor.other.collision"
LANES: Final = "sensor.other.lane_invasion"


@dataclass
class Events:
    """The event sensors on the ego of an episode.

    Attributes:
        server_name: Name of the server, for messages.
        collisions: Bodies that the ego has touched since `begin`, or since they were last collected: id and type of
            each.
        lane_crossings: Frame and marking types, by CARLA's names, of each event of the lane sensor.
    """

    server_name: str
    collisions: list[tuple[int, str]] = field(default_factory=list)
    lane_crossings: list[tuple[int, tuple[str, ...]]] = field(default_factory=list)
    _sensors: dict[str, carla.Sensor] = field(default_factory=dict)
    _first_frame: int = 0

    def attach(self, world: carla.World, body: carla.Actor) -> None:
        """Spawn the sensors on a body."""
        import carla

        def on_collision(event: carla.CollisionEvent) -> None:
            self.collisions.append((event.other_actor.id, event.other_actor.type_id))

        def on_crossing(event: carla.LaneInvasionEvent) -> None:
            self.lane_crossings.append(
                (event.frame, tuple(str(marking.type) for marking in event.crossed_lane_markings))
            )

        library = world.get_blueprint_library()
        callbacks: dict[str, Callable[[Any], None]] = {COLLISION: on_collision, LANES: on_crossing}
        for name, callback in callbacks.items():
            sensor = cast("carla.Sensor", world.spawn_actor(library.find(name), carla.Transform(), attach_to=body))
            self._sensors[name] = sensor
            sensor.listen(callback)

    def begin(self, frame: int) -> None:
        """Start an episode: events up to this frame are discarded, as they stem from the drop onto the road."""
        self.collisions.clear()
        self.lane_crossings.clear()
        self._first_frame = frame

    def check(self) -> None:
        """Raise ConfigError if a sensor no longer exists: its missing events would pass for a clean drive."""
        for name, sensor in self._sensors.items():
            if not sensor.is_alive:
                raise ConfigError(f"{self.server_name}: the ego's {name} is gone: somebody has destroyed it")

    @property
    def measured(self) -> dict[str, Any]:
        """`lane_crossings`: events of the lane sensor so far; `lane_markings`: number of crossings of each type."""
        crossings = [markings for frame, markings in self.lane_crossings if frame > self._first_frame]
        marking_counts = Counter(marking for markings in crossings for marking in markings)
        return {"lane_crossings": len(crossings), "lane_markings": dict(sorted(marking_counts.items()))}

    def detach(self) -> None:
        """Remove the sensors."""
        sensors, self._sensors = self._sensors, {}
        self.collisions.clear()
        for sensor in sensors.values():
            stop: Callable[[], object] = sensor.stop  # the stubs do not declare its return type
            stop()
            sensor.destroy()

"""What CARLA's own event sensors tell of the ego: whom it has touched, and which lane markings it has crossed.

Facts: carla.readthedocs.io, 0.9.16, sensors reference. Both sensors speak only when something happens. The lane sensor
tells which markings the corners of the body have crossed in a frame; in junctions it tells nothing.
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
    """The sensors of events that the ego of an episode carries.

    Attributes:
        where: Which server, for messages.
        hits: Whom it has touched since `begin` or since they were taken: id and type of each body.
        crossed: Frame and types of the markings of each event of the lane sensor, by CARLA's names.
    """

    where: str
    hits: list[tuple[int, str]] = field(default_factory=list)
    crossed: list[tuple[int, tuple[str, ...]]] = field(default_factory=list)
    _sensors: dict[str, carla.Sensor] = field(default_factory=dict)
    _began: int = 0

    def attach(self, world: carla.World, body: carla.Actor) -> None:
        """Spawn them on a body."""
        import carla

        def hit(event: carla.CollisionEvent) -> None:
            self.hits.append((event.other_actor.id, event.other_actor.type_id))

        def cross(event: carla.LaneInvasionEvent) -> None:
            self.crossed.append((event.frame, tuple(str(marking.type) for marking in event.crossed_lane_markings)))

        library = world.get_blueprint_library()
        told: dict[str, Callable[[Any], None]] = {COLLISION: hit, LANES: cross}
        for name, callback in told.items():
            sensor = cast("carla.Sensor", world.spawn_actor(library.find(name), carla.Transform(), attach_to=body))
            self._sensors[name] = sensor
            sensor.listen(callback)

    def begin(self, frame: int) -> None:
        """The episode begins: what came up to this frame was the drop onto the road."""
        self.hits.clear()
        self.crossed.clear()
        self._began = frame

    def check(self) -> None:
        """ConfigError where one of them is gone: what it has not told would pass for what has not been."""
        for name, sensor in self._sensors.items():
            if not sensor.is_alive:
                raise ConfigError(f"{self.where}: the ego's {name} is gone: somebody has destroyed it")

    @property
    def measured(self) -> dict[str, Any]:
        """`lane_crossings`: events of the lane sensor so far; `lane_markings`: how many of each type were crossed."""
        own = [markings for frame, markings in self.crossed if frame > self._began]
        kinds = Counter(kind for markings in own for kind in markings)
        return {"lane_crossings": len(own), "lane_markings": dict(sorted(kinds.items()))}

    def detach(self) -> None:
        """Take them out."""
        sensors, self._sensors = self._sensors, {}
        self.hits.clear()
        for sensor in sensors.values():
            stop: Callable[[], object] = sensor.stop  # the stubs do not say what it gives
            stop()
            sensor.destroy()

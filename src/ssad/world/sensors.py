"""Sensors that drivers can request by name besides the object list, computed on the device for all rows at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ssad.core.driving import Belief, BeliefSimulator, Sensor
from ssad.core.errors import ConfigError
from ssad.core.types import F32, I32
from ssad.world.kernels.look import CHANNELS, OBSERVATION, ROAD, look, look_as_adversary, look_at_road, look_from_above
from ssad.world.kernels.look_traffic import TRAFFIC, look_at_traffic
from ssad.world.world import World

ABOVE = 64  # pixels a side of the view from above
PIXELS = 2.0  # a metre
BEHIND = 8.0  # m
# m, m, m, m, rad and m/s of the rows of the sensor `adversary`, and m, m, m, m, rad and m of the goal, which are 1
_ADVERSARY_UNITS = np.array([10.0, 10.0, 5.0, 2.0, 1.0, 10.0] * 3 + [10.0, 10.0, 2.0, 2.0, 1.0, 10.0], np.float32)


def launcher(world: World, kernel: Any, agents: I32, shape: tuple[int, ...], dim: Any, *more: Any) -> tuple[Any, Any]:
    """Record a launch of an observation kernel for `agents` [N, 2]; return it and the array that it fills."""
    agent_array = wp.array(np.ascontiguousarray(agents, np.int32), dtype=wp.vec2i, device=world.device)
    output = wp.zeros(shape, dtype=wp.float32, device=world.device)
    bank = world.bank
    return world.launch(
        kernel, dim, [bank.episodes, bank.roads, world.arrays, bank.agents, agent_array, *more, output]
    ), output


@dataclass(frozen=True)
class _Rows:
    """Sensor of columns of an observation kernel, an object so that loops with it can be pickled."""

    kernel: str
    width: int
    first: int
    end: int

    def __call__(self, simulator: Any, agents: I32) -> F32:
        table = _read(simulator, _KERNELS[self.kernel], agents, (len(agents), self.width), len(agents))
        return table[:, self.first : self.end].copy()


_KERNELS = {"look": look, "look_as_adversary": look_as_adversary, "look_at_road": look_at_road}


def _read(simulator: Any, kernel: Any, agents: I32, shape: tuple[int, ...], dim: Any, *more: Any) -> F32:
    if not isinstance(simulator, World):
        simulator = getattr(simulator, "mirror", None)
    if not isinstance(simulator, World):
        raise ConfigError("this simulator mirrors nothing in a World: give your own sensors to rollout(sensors=...)")
    # Drivers observe the same agents at every step, so the last launch is kept.
    cache_key = (kernel, shape, more)
    cache: dict[Any, Any] = simulator.__dict__.setdefault("_looks", {})
    if cache_key not in cache or not np.array_equal(cache[cache_key][0], agents):
        command, output = launcher(simulator, kernel, agents, shape, dim, *more)
        cache[cache_key] = (np.array(agents), command, output, output.numpy())
    _, command, output, values = cache[cache_key]
    command.launch()
    if simulator.device != "cpu":
        values = output.numpy()
    return np.asarray(values)


@dataclass(frozen=True)
class _RasterView:
    """Sensor of the view from above; see `from_above`."""

    side: int
    pixels: float
    behind: float

    def __call__(self, simulator: Any, agents: I32) -> F32:
        count, side = len(agents), self.side
        shape, dim = (count, CHANNELS, side, side), (count, side, side)
        return _read(simulator, look_from_above, agents, shape, dim, side, self.pixels, self.behind).copy()


def from_above(side: int = ABOVE, pixels: float = PIXELS, behind: float = BEHIND) -> Sensor:
    """A rasterised view from above, [N, 4, side, side] in the agent's frame, forward up.

    Channels: road; the agent's route, 2 m wide; agents (1, the agent itself 0.5); their speed as a share of 20 m/s.

    Args:
        side: Pixels a side.
        pixels: Pixels a metre.
        behind: Metres that are seen behind the agent's centre.
    """
    return _RasterView(side, pixels, behind)


def truth(simulator: Any, agents: I32) -> Belief:
    """Return the truth as a belief for egos [N, 2], as background traffic perceives it; `BeliefSimulator.truth`."""
    if not isinstance(simulator, BeliefSimulator):
        raise ConfigError("this simulator's Autopilot plans over no belief: it cannot tell the truth as one")
    if agents[:, 1].any():
        raise ConfigError("the sensor 'truth' is for egos, who plan over a belief; other agents have none")
    return simulator.truth().rows(agents[:, 0])


def traffic(simulator: Any, agents: I32) -> F32:
    """Return the observation of the shipped learned drivers, [N, 69], all numbers around 1; see `SENSORS`."""
    return _read(simulator, look_at_traffic, agents, (len(agents), TRAFFIC), len(agents), float(simulator.dt)).copy()


def adversary_on_road(simulator: Any, agents: I32) -> F32:
    """Return what an adversary that keeps to the law observes, [N, 45], all numbers around 1; see `SENSORS`."""
    rows = SENSORS["adversary"](simulator, agents) / _ADVERSARY_UNITS
    return np.concatenate([rows, SENSORS["road"](simulator, agents)], 1, dtype=np.float32)


SENSORS: dict[str, Sensor] = {
    "safebench": _Rows("look", OBSERVATION, 0, 4),
    "frea": _Rows("look", OBSERVATION, 4, OBSERVATION),
    "adversary": _Rows("look_as_adversary", 24, 0, 24),
    "road": _Rows("look_at_road", ROAD, 0, ROAD),
    "adversary-on-road": adversary_on_road,
    "traffic": traffic,
    "above": from_above(),
    "truth": truth,
}
"""`safebench` [N, 4]: lateral offset m, heading error rad, speed m/s, 1 if a vehicle is in the same lane within 15 m
ahead. `frea` [N, 24]: 4 rows of 6, the agent, the two nearest vehicles and the route. `adversary` [N, 24]: FREA's
adversary, the ego, the nearest other vehicle and the goal. `road` [N, 21]: cosine between the agent's course and the
lane under its centre that fits best (-2: off the road), and that of 20 points around and ahead (-1: off the road).
`adversary-on-road` [N, 45]: `adversary` scaled to numbers around 1, and `road`. `traffic` [N, 69]: speed / 10,
acceleration / 5, front-wheel angle / 0.5, target speed / 10, offset from the route / 2, heading error, metres to its
end / 50; x / 20, y / 20 of the route 4, 8, 12, 18, 26 and 34 m ahead; for now and after 1, 2, 3, 4 s, if everybody
keeps speed and rate of turn, metres along the route to the first body on it / 50 (1: none) and that body's speed along
the route / 10; for the five nearest within 50 m (those behind count as twice as far) x / 25, y / 25, cosine and sine
of the heading, speed / 10, length / 5, width / 2, and 1 for who is on two wheels or on foot. `above`: see
`from_above`. `truth`: a `Belief`, see `truth`."""

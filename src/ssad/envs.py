"""The world as Gymnasium environments over scenarios by name.

    import gymnasium
    env = gymnasium.make("ssad.envs:SSAD/Driving-v0", scenarios="precrash")
    envs = gymnasium.make_vec("ssad.envs:SSAD/Driving-v0", num_envs=64, scenarios="natural")

The vector environment runs all scenes in one batch (`ssad.world.env.VectorEnv`), not one process a scene. For
stable-baselines3 (the extra `train`):

    from stable_baselines3 import PPO
    from ssad.envs import make_sb3
    PPO("MlpPolicy", make_sb3(num_envs=64, scenarios="natural")).learn(1_000_000)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.seeding import digest
from ssad.drivers import make_system
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import LaneGraph, load_town

if TYPE_CHECKING:
    from ssad.core.types import Episode, Scenario
    from ssad.world.env import SingleEnv, VectorEnv
    from ssad.world.sb3 import SB3VecEnv

ID = "SSAD/Driving-v0"


def episodes_of(
    scenarios: str | Path | Sequence[str | Path], *, seed: int = 0
) -> tuple[list[Episode], Mapping[str, LaneGraph]]:
    """Build concrete episodes of scenario sets, and load the lane graphs of their towns.

    Args:
        scenarios: Names of sets or files.
        seed: Seed of the episodes.

    Returns:
        The episodes, and lane graphs by name of the town.

    Raises:
        UnknownNameError: A set, file or town does not exist.
        ConfigError: A scenario is not valid.
        RouteError: An episode cannot be built.
    """
    references = [scenarios] if isinstance(scenarios, (str, Path)) else list(scenarios)
    loaded = [scenario for reference in references for scenario in load_scenarios(reference)]
    graphs = {town: _cached_town(town) for town in sorted({member.town for member in loaded})}
    return [_cached_episode(member, graphs[member.town], seed) for member in loaded], graphs


MOST_EPISODES = 5000  # kept in a process
_episodes: dict[str, Episode] = {}


def _cached_episode(scenario: Scenario, graph: LaneGraph, seed: int) -> Episode:
    """Return the episode of a scenario, built once per process."""
    key = digest("episode", safeio.dump_json(asdict(scenario)), seed, id(graph))
    if key not in _episodes:
        if len(_episodes) >= MOST_EPISODES:
            _episodes.clear()
        _episodes[key] = build_episode(scenario, graph, seed=seed)
    return _episodes[key]


@lru_cache(maxsize=16)
def _cached_town(name: str) -> LaneGraph:
    return load_town(name)


def make(*, scenarios: str | Sequence[str] = "precrash", episode_seed: int = 0, **options: Any) -> SingleEnv:
    """Return a single environment; `options` go to `ssad.world.env.SingleEnv` (observation, action, device)."""
    from ssad.world.env import SingleEnv

    return SingleEnv(*episodes_of(scenarios, seed=episode_seed), **{"policies": make_system} | options)


def make_vec(
    *, num_envs: int = 1, scenarios: str | Sequence[str] = "precrash", episode_seed: int = 0, **options: Any
) -> VectorEnv:
    """Return `num_envs` scenes in one batch; `options` go to `ssad.world.env.VectorEnv`."""
    from ssad.world.env import VectorEnv

    # gymnasium.make_vec passes it; all scenes are already one batch.
    options.pop("vectorization_mode", None)
    return VectorEnv(*episodes_of(scenarios, seed=episode_seed), num_envs, **{"policies": make_system} | options)


def make_sb3(
    *, num_envs: int = 1, scenarios: str | Sequence[str] = "precrash", episode_seed: int = 0, **options: Any
) -> SB3VecEnv:
    """Return `num_envs` scenes as a stable-baselines3 `VecEnv`; `options` as for `make_vec`.

    Raises:
        ConfigError: stable-baselines3 is not installed.
    """
    try:
        from ssad.world.sb3 import SB3VecEnv
    except ImportError as error:
        raise ConfigError(f"stable-baselines3 is not installed ({error}); install the extra 'train'") from None
    return SB3VecEnv(make_vec(num_envs=num_envs, scenarios=scenarios, episode_seed=episode_seed, **options))


gymnasium.register(ID, entry_point="ssad.envs:make", vector_entry_point="ssad.envs:make_vec")

"""The world as Gymnasium environments over scenarios by name.

    import gymnasium
    env = gymnasium.make("ssad.envs:SSAD/Driving-v0", scenarios="precrash")
    envs = gymnasium.make_vec("ssad.envs:SSAD/Driving-v0", num_envs=64, scenarios="natural")

The vector environment runs all scenes in one batch (`ssad.world.env.VectorEnv`), not one process a scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from ssad.roads import LaneGraph, load_town
from ssad.scenarios.dynamic import build_episode, load_scenarios

if TYPE_CHECKING:
    from ssad.core.types import Episode
    from ssad.world.env import SingleEnv, VectorEnv

ID = "SSAD/Driving-v0"


def episodes_of(
    scenarios: str | Path | Sequence[str | Path], *, seed: int = 0
) -> tuple[list[Episode], Mapping[str, LaneGraph]]:
    """Concrete episodes of scenario sets, names or files, and the lane graphs of their towns.

    UnknownNameError, ConfigError, RouteError for what cannot be found or built.
    """
    refs = [scenarios] if isinstance(scenarios, (str, Path)) else list(scenarios)
    found = [scenario for ref in refs for scenario in load_scenarios(ref)]
    graphs = {town: load_town(town) for town in sorted({s.town for s in found})}
    return [build_episode(s, graphs[s.town], seed=seed) for s in found], graphs


def make(*, scenarios: str | Sequence[str] = "precrash", episode_seed: int = 0, **options: Any) -> SingleEnv:
    """One scene; `options` go to `ssad.world.env.SingleEnv` (observation, action, device)."""
    from ssad.world.env import SingleEnv

    return SingleEnv(*episodes_of(scenarios, seed=episode_seed), **options)


def make_vec(
    *, num_envs: int = 1, scenarios: str | Sequence[str] = "precrash", episode_seed: int = 0, **options: Any
) -> VectorEnv:
    """`num_envs` scenes in one batch; `options` go to `ssad.world.env.VectorEnv`."""
    from ssad.world.env import VectorEnv

    options.pop("vectorization_mode", None)
    return VectorEnv(*episodes_of(scenarios, seed=episode_seed), num_envs, **options)


gymnasium.register(ID, entry_point="ssad.envs:make", vector_entry_point="ssad.envs:make_vec")

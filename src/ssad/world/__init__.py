"""The embedded world. Names are loaded on first use, so that importing ssad stays light."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ssad.world.models import MODELS as MODELS
    from ssad.world.rollout import rollout as rollout
    from ssad.world.world import World as World

_WHERE = {"MODELS": "models", "World": "world", "rollout": "rollout", "check_world": "check", "VectorEnv": "env"}


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        return getattr(import_module(f"ssad.world.{_WHERE[name]}"), name)
    raise AttributeError(f"module 'ssad.world' has no attribute '{name}'")

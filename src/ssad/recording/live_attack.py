"""A physical attack on an agent of the closed loop: what it wears and what shines on it, before any camera looks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from ssad.assets.mesh import Mesh
from ssad.camera.scene import Thing
from ssad.camera.scene_edit import SceneEdit
from ssad.core.errors import ConfigError
from ssad.core.types import AgentKind
from ssad.recording.target import TargetCar
from ssad.world.models import MODELS


@dataclass(frozen=True)
class LiveAttack:
    """An attack on an agent, for `ssad.recording.loop_sensors.Onboard`.

    Attributes:
        edit: What changes around a target, given its body.
        target: The car that the attack is made for: it plays the agent, in the size that the agent has in the world.
        agent: Who is attacked; 0 is the ego.
    """

    edit: Callable[[Mesh], SceneEdit]
    target: TargetCar
    agent: int = 1

    @cached_property
    def _bodies(self) -> dict[str, tuple[Mesh, SceneEdit]]:
        return {}

    def body(self, model: str) -> tuple[Mesh, SceneEdit]:
        """The body that plays an agent of a model, and the edit for it; made once.

        Raises:
            ConfigError: The model is no car, or the attack does not fit on it.
        """
        if model not in self._bodies:
            one = MODELS[model]
            if one.kind != AgentKind.CAR:
                raise ConfigError(f"agent {self.agent} is a {model}; the attack is made for a car: name another agent")
            mesh = replace(self.target, size=(one.length, one.width, one.height)).mesh()
            self._bodies[model] = mesh, self.edit(mesh)
        return self._bodies[model]

    def attacked(self, models: tuple[str, ...], key: str) -> str:
        """The model of the agent that is attacked in an episode. ConfigError: it has no such agent."""
        if not 0 <= self.agent < len(models):
            raise ConfigError(f"{key}: has agents 0 to {len(models) - 1}; agent {self.agent} cannot be attacked")
        return models[self.agent]

    def meshes(self, model: str) -> dict[Any, Mesh]:
        """What the scene must hold, by names of their own."""
        mesh, edit = self.body(model)
        found: dict[Any, Mesh] = {("attacked", self.target, model): mesh}
        return found | {("attacked card", self.target, model, k): card for k, card in enumerate(edit.meshes())}

    def dressed(self, things: tuple[Thing, ...], mesh: int) -> tuple[Thing, ...]:
        """The things of a view with the target's body for the agent, which is number `mesh` of the scene."""
        return tuple(
            replace(one, mesh=mesh, paint=self.target.colour) if one.tag == self.agent + 1 else one for one in things
        )

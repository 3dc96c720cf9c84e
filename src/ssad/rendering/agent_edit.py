"""A physical attack in the closed loop, on an agent or on stop signs: what they wear and what shines on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

from ssad.core.errors import ConfigError
from ssad.core.types import AgentKind
from ssad.rendering.camera.scene import Thing
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.target import Target, TargetSign, TargetWalker
from ssad.world.models import MODELS

SIGN: Final = "stop_sign"
FIRST_SIGN: Final = 1 << 16  # tag of a town's sign 0: no scene has so many agents


@dataclass(frozen=True)
class LiveAttack:
    """An attack on an agent or on all stop signs, for `ssad.rendering.onboard.Onboard`.

    Attributes:
        edit: What changes around a target, given its body.
        target: What the attack is made for: a car or a walker plays the agent, in the size that the agent has in the
            world, a walker without moving its legs; a sign stands in place of every stop sign.
        agent: Who is attacked; 0 is the ego. Of no account where the target is a sign.
    """

    edit: Callable[[Mesh], SceneEdit]
    target: Target
    agent: int = 1

    @property
    def kind(self) -> AgentKind:
        """Of the agents that the target can play; of no account where it is a sign."""
        return AgentKind.WALKER if isinstance(self.target, TargetWalker) else AgentKind.CAR

    @cached_property
    def _bodies(self) -> dict[str, tuple[Mesh, SceneEdit]]:
        return {}

    def body(self, model: str) -> tuple[Mesh, SceneEdit]:
        """The body that plays an agent of a model, or a sign, and the edit for it; made once.

        Raises:
            ConfigError: The target cannot play an agent of this model, or the attack does not fit on it.
        """
        if model not in self._bodies:
            if isinstance(self.target, TargetSign):
                mesh = self.target.mesh()
            else:
                one = MODELS[model]
                if one.kind != self.kind:
                    raise ConfigError(
                        f"agent {self.agent} is a {model}; the attack is made for a {self.kind.name.lower()}: name "
                        "another agent"
                    )
                mesh = replace(self.target, size=(one.length, one.width, one.height)).mesh()
            self._bodies[model] = mesh, self.edit(mesh)
        return self._bodies[model]

    def attacked(self, models: tuple[str, ...], key: str) -> str:
        """The model of the agent that is attacked in an episode, or `SIGN`. ConfigError: it has no such agent."""
        if isinstance(self.target, TargetSign):
            return SIGN
        if not 0 <= self.agent < len(models):
            raise ConfigError(f"{key}: has agents 0 to {len(models) - 1}; agent {self.agent} cannot be attacked")
        return models[self.agent]

    def meshes(self, model: str) -> dict[Any, Mesh]:
        """What the scene must hold, by names of their own."""
        mesh, edit = self.body(model)
        found: dict[Any, Mesh] = {("attacked", self.target, model): mesh}
        return found | {("attacked card", self.target, model, k): card for k, card in enumerate(edit.meshes())}

    def dressed(self, things: tuple[Thing, ...], mesh: int, signs: Iterable[int] = ()) -> tuple[Thing, ...]:
        """The things of a view with the target's body in place of what is attacked.

        Args:
            things: Of the view.
            mesh: Number of the target's body in the scene.
            signs: Meshes of the stop signs there.
        """
        if isinstance(self.target, TargetSign):
            return tuple(
                replace(one, mesh=mesh, paint=self.target.colour, tag=FIRST_SIGN + one.mesh)
                if one.tag == 0 and one.mesh in signs
                else one
                for one in things
            )
        return tuple(
            replace(one, mesh=mesh, paint=self.target.colour) if one.tag == self.agent + 1 else one for one in things
        )

    def tags(self, things: Iterable[Thing]) -> list[int]:
        """Tags of what is attacked among the things of a view."""
        if isinstance(self.target, TargetSign):
            return [one.tag for one in things if one.tag >= FIRST_SIGN]
        return [self.agent + 1]

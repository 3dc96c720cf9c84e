"""A physical attack in the closed loop, on an agent or on stop signs: their textures and the light on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

from ssad.core.errors import ConfigError
from ssad.core.types import AgentKind
from ssad.rendering.camera.scene import SceneObject
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.target import Target, TargetSign, TargetWalker
from ssad.world.models import MODELS, agent_size

SIGN: Final = "stop_sign"
FIRST_SIGN: Final = 1 << 16  # tag of a town's sign 0: no scene has so many agents


@dataclass(frozen=True)
class AgentEdit:
    """Edit of an agent or of all stop signs, for `ssad.rendering.onboard.Onboard`.

    Attributes:
        edit: Returns the edit of a scene around a target, given its body.
        target: Target that the attack is made for: a car or a walker plays the agent, in the size that the agent
            has in the world, a walker without moving its legs; a sign replaces every stop sign.
        agent: Number of the attacked agent; 0 is the ego. Ignored if the target is a sign.
    """

    edit: Callable[[Mesh], SceneEdit]
    target: Target
    agent: int = 1

    @property
    def kind(self) -> AgentKind:
        """Kind of the agents that the target can play; ignored if it is a sign."""
        return AgentKind.WALKER if isinstance(self.target, TargetWalker) else AgentKind.CAR

    @cached_property
    def _bodies(self) -> dict[tuple[str, tuple[float, ...]], tuple[Mesh, SceneEdit]]:
        return {}

    def body(self, model: str, size: tuple[float, ...] = ()) -> tuple[Mesh, SceneEdit]:
        """Return the body that plays an agent of a model, or a sign, and the edit for it; built once.

        Args:
            model: Model of the agent, or `SIGN`.
            size: Length, width, height of the agent, m; (): those of the model.

        Raises:
            ConfigError: The target cannot play an agent of this model, or the attack does not fit on it.
        """
        if (model, size) not in self._bodies:
            if isinstance(self.target, TargetSign):
                mesh = self.target.mesh()
            else:
                model_entry = MODELS[model]
                if model_entry.kind != self.kind:
                    raise ConfigError(
                        f"agent {self.agent} is a {model}; the attack is made for a {self.kind.name.lower()}: name "
                        "another agent"
                    )
                mesh = replace(self.target, size=agent_size(model, size)).mesh()
            self._bodies[model, size] = mesh, self.edit(mesh)
        return self._bodies[model, size]

    def attacked_model(self, models: tuple[str, ...], key: str) -> str:
        """The model of the agent that is attacked in an episode, or `SIGN`. ConfigError: it has no such agent."""
        if isinstance(self.target, TargetSign):
            return SIGN
        if not 0 <= self.agent < len(models):
            raise ConfigError(f"{key}: has agents 0 to {len(models) - 1}; agent {self.agent} cannot be attacked")
        return models[self.agent]

    def attacked_size(self, sizes: tuple[tuple[float, ...], ...]) -> tuple[float, ...]:
        """Return the size of the agent that is attacked, m; () for a sign, or for that of its model."""
        return () if isinstance(self.target, TargetSign) else sizes[self.agent]

    def meshes(self, model: str, size: tuple[float, ...] = ()) -> dict[Any, Mesh]:
        """Return the meshes that the scene must hold, by their own names: the body first, then the cards."""
        mesh, edit = self.body(model, size)
        named_meshes: dict[Any, Mesh] = {("attacked", self.target, model, size): mesh}
        return named_meshes | {
            ("attacked card", self.target, model, size, index): card for index, card in enumerate(edit.meshes())
        }

    def replace_attacked(
        self, scene_objects: tuple[SceneObject, ...], mesh: int, signs: Iterable[int] = ()
    ) -> tuple[SceneObject, ...]:
        """Return the objects of a view with the target's body in place of the attacked ones.

        Args:
            scene_objects: Objects of the view.
            mesh: Number of the target's body in the scene.
            signs: Meshes of the stop signs there.
        """
        if isinstance(self.target, TargetSign):
            return tuple(
                # Signs have the tag 0 of the street; an edit needs a tag of its own for each of them.
                replace(scene_object, mesh=mesh, paint=self.target.colour, tag=FIRST_SIGN + scene_object.mesh)
                if scene_object.tag == 0 and scene_object.mesh in signs
                else scene_object
                for scene_object in scene_objects
            )
        return tuple(
            replace(scene_object, mesh=mesh, paint=self.target.colour)
            if scene_object.tag == self.agent + 1
            else scene_object
            for scene_object in scene_objects
        )

    def tags(self, scene_objects: Iterable[SceneObject]) -> list[int]:
        """Return the tags of the attacked objects of a view."""
        if isinstance(self.target, TargetSign):
            return [scene_object.tag for scene_object in scene_objects if scene_object.tag >= FIRST_SIGN]
        return [self.agent + 1]

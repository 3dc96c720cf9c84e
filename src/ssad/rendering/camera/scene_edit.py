"""Edits that a physical attack makes to a scene before rendering, both in recorded images and in the loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.types import F64, Bool
from ssad.rendering.camera.glare import with_lens_effects
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import Rendering, View, develop_radiance, render, scene_light
from ssad.rendering.camera.scene import RenderScene, SceneObject, TextureDecal, TextureLayer
from ssad.rendering.meshes.mesh import Material, Mesh, build, merge

if TYPE_CHECKING:
    from torch import Tensor

CARD = Material("card", (0.05, 0.05, 0.05))
LIFT = 1.0  # m: height of a card in its own frame, because the shadow pass skips low geometry


@dataclass(frozen=True, slots=True)
class ShadowCard:
    """Invisible flat object that blocks the sun; it hangs between the sun and its shadow.

    Attributes:
        outline: Outline of its shadow on the card's own plane [P, 3], in the target's frame, m. The card is
            parallel to that plane, so it has the size of its shadow.
        away: Distance towards the sun, m.
    """

    outline: F64
    away: float = 10.0

    def __post_init__(self) -> None:
        if np.ndim(self.outline) != 2 or np.shape(self.outline)[1] != 3 or len(self.outline) < 3:
            raise ConfigError("a card's outline is three or more points [P, 3]")
        if not np.isfinite(self.outline).all() or not 0.5 <= self.away <= 20.0:
            raise ConfigError("a card's outline is finite, and it hangs 0.5 to 20 m towards the sun")

    def mesh(self) -> Mesh:
        """Return the body of the card: convex, with faces on both sides."""
        points = self.outline + np.array([0.0, 0.0, LIFT])
        triangles = np.array([[0, index, index + 1] for index in range(1, len(points) - 1)])
        return merge([build(points, faces, materials=CARD) for faces in (triangles, triangles[:, ::-1])])


@dataclass(frozen=True, slots=True)
class SceneEdit:
    """Objects, lamps and textures around a target, and textures on it. All of them move with the target.

    Attributes:
        layers: Layers on the target.
        lamps: Lamps that light it: pose in the target's frame, power in lumen. The lamp itself is not drawn.
        decals: Textures on surfaces around it: pose in the target's frame; a tag of 1 or more becomes the
            target's.
        cards: Cards that block the sun.
        textures: Textures of layers, decals and lamps, by index: linear albedo [3, H, W] in 0 to 1; of a lamp,
            the share of its light.
        masks: Texels of a texture [H, W] that are somewhere on the target; all where no mask is given.
    """

    layers: tuple[TextureLayer, ...] = ()
    lamps: tuple[SceneLamp, ...] = ()
    decals: tuple[TextureDecal, ...] = ()
    cards: tuple[ShadowCard, ...] = ()
    textures: Mapping[int, Tensor] = field(default_factory=dict)
    masks: Mapping[int, Bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        used_textures = {entry.texture for entry in self.layers} | {entry.texture for entry in self.decals}
        used_textures |= {lamp.texture for lamp in self.lamps if lamp.texture >= 0}
        if not used_textures <= set(self.textures):
            raise ConfigError(f"no texture {min(used_textures - set(self.textures))}, which the edit of a scene shows")

    def meshes(self) -> tuple[Mesh, ...]:
        """Return the bodies that the scene must contain for the cards."""
        return tuple(card.mesh() for card in self.cards)

    def on(self, view: View, tag: int, *, cards: Sequence[int] = ()) -> View:
        """Return the view with the edit in it, or the view itself if the target is not in it.

        Args:
            view: The view.
            tag: Of the target; its first object wears the layers.
            cards: Indices of `meshes` in the scene.

        Raises:
            ConfigError: The scene lacks cards of the edit.
        """
        target_index = next((index for index, scene_object in enumerate(view.objects) if scene_object.tag == tag), None)
        if target_index is None:
            return view
        if len(cards) != len(self.cards):
            raise ConfigError(f"the scene has {len(cards)} of the {len(self.cards)} cards of the edit")
        target = view.objects[target_index]
        sun = np.array(scene_light(view.weather)[0][0])
        hung_cards = []
        # Below the horizon there is no sun to block.
        for card, mesh in zip(self.cards, cards, strict=True) if sun[2] > 0.0 else ():
            pose = target.pose.copy()
            pose[:3, 3] += card.away * sun - LIFT * target.pose[:3, 2]
            hung_cards.append(SceneObject(mesh, pose, tag=0, is_hidden=True))
        scale = per_lux(view.weather)
        lamps = (replace(entry, pose=target.pose @ entry.pose, power=entry.power * scale) for entry in self.lamps)
        decals = (
            replace(entry, pose=target.pose @ entry.pose, tag=tag if entry.tag > 0 else entry.tag)
            for entry in self.decals
        )
        objects = [*view.objects, *hung_cards]
        objects[target_index] = replace(target, layers=(*target.layers, *self.layers))
        return replace(view, objects=tuple(objects), lamps=(*view.lamps, *lamps), decals=(*view.decals, *decals))


NO_EDIT = SceneEdit()


def render_with(
    scene: RenderScene,
    views: Sequence[View],
    textures: Mapping[int, Tensor],
    masks: Mapping[int, Bool] | None = None,
    **options: Any,
) -> Rendering:
    """Render views with textures on the surfaces that show them; without such surfaces the result equals `render`.

    Args:
        scene: The scene.
        views: The views.
        textures: Index -> linear albedo [3, H, W] in 0 to 1.
        masks: See `SceneEdit`.
        **options: As for `render`.

    Returns:
        The rendering.

    Raises:
        ConfigError: A texture is missing, or has a wrong shape or range.
    """
    rendering = render(scene, views, **options)
    # torch is only imported if a texture is visible.
    texture_indices = np.unique(rendering.fragments["texture"]).tolist()
    if not texture_indices:
        return rendering
    if not set(texture_indices) <= set(textures):
        raise ConfigError(f"no texture {min(set(texture_indices) - set(textures))}, which a view shows")
    import torch  # only needed for scenes with textures

    from ssad.rendering.camera.texture import retexture, texture_taps

    radiance = torch.from_numpy(np.array(rendering.radiance))
    for texture_index in texture_indices:
        texture = textures[texture_index].detach().cpu().float()
        taps = texture_taps(
            rendering,
            (texture.shape[1], texture.shape[2]),
            texture=texture_index,
            mask=(masks or {}).get(texture_index),
        )
        radiance = retexture(taps, texture, radiance)
    developed_radiance = radiance.numpy()
    lenses = [replace(view, sensor=with_lens_effects(view.sensor, rendering.effects)) for view in views]
    image = develop_radiance(
        wp.array(developed_radiance, dtype=wp.vec3, device=scene.device), lenses, rendering.exposure.tolist()
    )
    return replace(rendering, image=image.numpy(), radiance=developed_radiance)

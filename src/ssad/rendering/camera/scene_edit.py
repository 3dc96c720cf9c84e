"""What a physical attack changes in a scene before a camera sees it: the same in recorded pictures and in the loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.types import F64, Bool
from ssad.rendering.camera.lamps import Lamp
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import Picture, View, develop_radiance, light_of, render
from ssad.rendering.camera.scene import Decal, Layer, Scene, Thing
from ssad.rendering.meshes.mesh import Material, Mesh, build, merge

if TYPE_CHECKING:
    from torch import Tensor

CARD = Material("card", (0.05, 0.05, 0.05))
LIFT = 1.0  # m: a card lies this high in its own frame, for what is low there casts no shadow


@dataclass(frozen=True, slots=True)
class Card:
    """A flat thing that is not seen and keeps the sun off: it hangs between the sun and where its shadow lies.

    Attributes:
        outline: The outline of its shadow where that falls on the card's own plane [P, 3], in the target's frame, m.
            The card is parallel to that, so it has the size of its shadow.
        away: How far towards the sun it hangs, m.
    """

    outline: F64
    away: float = 10.0

    def __post_init__(self) -> None:
        if np.ndim(self.outline) != 2 or np.shape(self.outline)[1] != 3 or len(self.outline) < 3:
            raise ConfigError("a card's outline is three or more points [P, 3]")
        if not np.isfinite(self.outline).all() or not 0.5 <= self.away <= 20.0:
            raise ConfigError("a card's outline is finite, and it hangs 0.5 to 20 m towards the sun")

    def mesh(self) -> Mesh:
        """Its body: convex, with a face to either side."""
        points = self.outline + np.array([0.0, 0.0, LIFT])
        fan = np.array([[0, k, k + 1] for k in range(1, len(points) - 1)])
        return merge([build(points, faces, materials=CARD) for faces in (fan, fan[:, ::-1])])


@dataclass(frozen=True, slots=True)
class SceneEdit:
    """What stands, hangs and shines around a target, and what it wears. Everything goes with the target.

    Attributes:
        layers: What the target wears.
        lamps: Lamps that light it: pose in the target's frame, power in lumen. The lamp itself is not drawn.
        decals: Textures on what lies around it: pose in the target's frame; a tag of 1 or more becomes the target's.
        cards: What keeps the sun off it.
        textures: What layers, decals and lamps show, by number: linear albedo [3, H, W] in 0 to 1; of a lamp, the share
            of its light.
        masks: Which texels of a texture [H, W] are somewhere on the target; all where it is not named.
    """

    layers: tuple[Layer, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    decals: tuple[Decal, ...] = ()
    cards: tuple[Card, ...] = ()
    textures: Mapping[int, Tensor] = field(default_factory=dict)
    masks: Mapping[int, Bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shown = {one.texture for one in self.layers} | {one.texture for one in self.decals}
        shown |= {lamp.texture for lamp in self.lamps if lamp.texture >= 0}
        if not shown <= set(self.textures):
            raise ConfigError(f"no texture {min(shown - set(self.textures))}, which the edit of a scene shows")

    def meshes(self) -> tuple[Mesh, ...]:
        """Bodies that the scene must have, for its cards."""
        return tuple(card.mesh() for card in self.cards)

    def on(self, view: View, tag: int, *, cards: Sequence[int] = ()) -> View:
        """A view with the edit in it; the view itself where the target is not there.

        Args:
            view: What a camera sees.
            tag: Of the target; its first thing wears the layers.
            cards: Indices of `meshes` in the scene.

        Raises:
            ConfigError: There are cards, and the scene does not have them.
        """
        at = next((k for k, thing in enumerate(view.things) if thing.tag == tag), None)
        if at is None:
            return view
        if len(cards) != len(self.cards):
            raise ConfigError(f"the scene has {len(cards)} of the {len(self.cards)} cards of the edit")
        target = view.things[at]
        sun = np.array(light_of(view.weather)[0][0])
        hung = []
        for card, mesh in zip(self.cards, cards, strict=True) if sun[2] > 0.0 else ():
            pose = target.pose.copy()
            pose[:3, 3] += card.away * sun - LIFT * target.pose[:3, 2]
            hung.append(Thing(mesh, pose, tag=0, hidden=True))
        scale = per_lux(view.weather)
        lamps = (replace(one, pose=target.pose @ one.pose, power=one.power * scale) for one in self.lamps)
        decals = (replace(one, pose=target.pose @ one.pose, tag=tag if one.tag > 0 else one.tag) for one in self.decals)
        things = [*view.things, *hung]
        things[at] = replace(target, layers=(*target.layers, *self.layers))
        return replace(view, things=tuple(things), lamps=(*view.lamps, *lamps), decals=(*view.decals, *decals))


NO_EDIT = SceneEdit()


def render_with(
    scene: Scene,
    views: Sequence[View],
    textures: Mapping[int, Tensor],
    masks: Mapping[int, Bool] | None = None,
    **options: Any,
) -> Picture:
    """Render views with textures on what shows them. Where none is seen, nothing differs from `render`.

    Args:
        scene: The scene.
        views: The views.
        textures: Number -> linear albedo [3, H, W] in 0 to 1.
        masks: See `SceneEdit`.
        **options: As for `render`.

    Raises:
        ConfigError: A texture is missing, or of a wrong shape or range.
    """
    picture = render(scene, views, **options)
    seen = np.unique(picture.fragments["texture"]).tolist()
    if not seen:
        return picture
    if not set(seen) <= set(textures):
        raise ConfigError(f"no texture {min(set(seen) - set(textures))}, which a view shows")
    import torch  # for scenes with textures alone

    from ssad.rendering.camera.texture import retexture, taps_of

    radiance = torch.from_numpy(np.array(picture.radiance))
    for number in seen:
        texture = textures[number].detach().cpu().float()
        taps = taps_of(picture, (texture.shape[1], texture.shape[2]), texture=number, mask=(masks or {}).get(number))
        radiance = retexture(taps, texture, radiance)
    whole = radiance.numpy()
    image = develop_radiance(wp.array(whole, dtype=wp.vec3, device=scene.device), views, picture.exposure.tolist())
    return replace(picture, image=image.numpy(), radiance=whole)

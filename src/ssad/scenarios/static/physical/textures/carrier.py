"""What a physical attack is printed on: a patch on a panel of the target, its whole paint, or the road behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Protocol

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.core.schema import VALUES, Above, Least, Part, Two
from ssad.core.types import F64, Bool
from ssad.rendering.camera.scene import Decal, Layer
from ssad.rendering.camera.texture import paint_mask, printable, to_linear
from ssad.rendering.meshes.mesh import Mesh, Rectangle
from ssad.rendering.street.palette import ASPHALT

Texels = Annotated[int, Field(strict=True, ge=1, le=4096)]
"""Of a side."""


@dataclass(frozen=True, slots=True)
class Surface:
    """A carrier on a certain body: all that is needed to show a texture on it.

    Attributes:
        layer: What the target wears, or what lies beside it, in its own frame (texture 0).
        size: Height and width of the texture, texels.
        mask: Texels [H, W] that are somewhere on the body; what others hold is never seen.
        metres: Width and height of what the whole texture covers, m; for a camouflage those of the whole atlas.
    """

    layer: Layer | Decal
    size: tuple[int, int]
    mask: Bool
    metres: tuple[float, float]

    @property
    def place(self) -> tuple[float, ...]:
        """Where it is, as plain numbers: u0, v0, u1, v1 on the atlas, or the pose and size of what lies beside."""
        if isinstance(self.layer, Layer):
            return self.layer.rectangle
        return (*self.layer.pose.ravel().tolist(), *self.layer.size)

    @property
    def texels_per_metre(self) -> float:
        """The finer of the two directions."""
        return max(self.size[1] / self.metres[0], self.size[0] / self.metres[1])


class Carrier(Protocol):
    """Where a texture goes, whatever the body.

    Attributes:
        name: What tables call it.
    """

    @property
    def name(self) -> str:
        """What tables call it."""

    def on(self, mesh: Mesh) -> Surface:
        """The carrier on a body.

        Args:
            mesh: The target's.

        Raises:
            ConfigError: The body has no such panel, or no room on it.
        """


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class Patch:
    """A rectangle stuck on one panel; lamps, windows and plates that it covers stay as they are.

    Attributes:
        panel: Name of the panel (`Mesh.panels`): rear, hood, roof, left_side/front_door, a sign's face, torso_front ...
        width: In m.
        height: In m.
        centre: Of the patch in the panel's rectangle, shares from its upper left corner.
        texels: Along the longer side.
        name: What tables call it.
    """

    panel: str = "rear"
    width: Above = 1.0
    height: Above = 0.5
    centre: Two[Part] = (0.5, 0.5)
    texels: Texels = 96
    name: str = "patch"

    def on(self, mesh: Mesh) -> Surface:
        """See `Carrier`."""
        u0, v0, u1, v1 = mesh.panel_rectangle(self.panel)
        across, down = metres_of(mesh, self.panel)
        wide, high = self.width / across, self.height / down
        u, v = u0 + self.centre[0] * (u1 - u0), v0 + self.centre[1] * (v1 - v0)
        rectangle = (u - wide / 2, v - high / 2, u + wide / 2, v + high / 2)
        beyond = max(u0 - rectangle[0], v0 - rectangle[1], rectangle[2] - u1, rectangle[3] - v1)
        if beyond > 1e-6:
            raise ConfigError(
                f"a patch of {self.width:g} x {self.height:g} m at {self.centre} does not fit on the panel "
                f"'{self.panel}', which is {(u1 - u0) * across:.2f} x {(v1 - v0) * down:.2f} m"
            )
        longest = max(self.width, self.height)
        size = (
            max(1, round(self.texels * self.height / longest)),
            max(1, round(self.texels * self.width / longest)),
        )
        return _surface(mesh, rectangle, size, (self.width, self.height))


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class Camouflage:
    """The whole paint of the body: all panels, but no windows, lamps, plates and tyres.

    Attributes:
        texels: Of each side of the atlas.
        name: What tables call it.
    """

    texels: Texels = 128
    name: str = "camouflage"

    def on(self, mesh: Mesh) -> Surface:
        """See `Carrier`."""
        if not (mesh.panel >= 0).any():
            raise ConfigError("this body has no panels to paint")
        return _surface(mesh, (0.0, 0.0, 1.0, 1.0), (self.texels, self.texels), metres_of(mesh))


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class Road:
    """A rectangle painted on the road behind the target, which takes it along: a stand-in for one at a place.

    Attributes:
        width: In m.
        length: Along the road, m.
        behind: From the target's rear to where it begins, m.
        texels: Along the longer side.
        name: What tables call it.
    """

    width: Above = 2.5
    length: Above = 5.0
    behind: Least = 0.3
    texels: Texels = 96
    name: str = "road"

    def on(self, mesh: Mesh) -> Surface:
        """See `Carrier`."""
        low, _ = mesh.bounds()
        pose = np.eye(4)
        # read from behind: right is the target's right, down is towards who looks, into the road
        pose[:3, 0], pose[:3, 1], pose[:3, 2] = (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
        pose[0, 3] = low[0] - self.behind - self.length / 2
        longest = max(self.width, self.length)
        size = max(1, round(self.texels * self.length / longest)), max(1, round(self.texels * self.width / longest))
        decal = Decal(0, pose, (self.width, self.length), tag=0)
        return Surface(decal, size, np.ones(size, np.bool_), (self.width, self.length))


def _surface(mesh: Mesh, rectangle: Rectangle, size: tuple[int, int], metres: tuple[float, float]) -> Surface:
    mask = paint_mask(mesh, size, rectangle)
    if not mask.any():
        raise ConfigError("no face of the body lies under the texture; choose another place")
    return Surface(Layer(0, rectangle), size, mask, metres)


def metres_of(mesh: Mesh, panel: str | None = None) -> tuple[float, float]:
    """Metres of the body for the whole width and the whole height of the atlas.

    Args:
        mesh: The body.
        panel: On this panel; None: on all of them.

    Returns:
        Along u and along v: means over the faces by their area in the atlas.

    Raises:
        ConfigError: There is no such panel, or it has no faces.
    """
    chosen = mesh.panel >= 0 if panel is None else np.isin(mesh.panel, mesh.panel_indices(panel))
    uv: F64 = mesh.uv[chosen].astype(np.float64)
    corners = mesh.corners()[chosen]
    along = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=-1)
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)
    area = np.abs(np.linalg.det(along))
    some = area > 1e-9
    if not some.any():
        raise ConfigError(f"panel '{panel}' has no faces; choose another panel")
    tangents = edges[some] @ np.linalg.inv(along[some])  # [F, 3, 2] m for the whole of u, of v
    lengths = np.linalg.norm(tangents, axis=1)
    u, v = np.average(lengths, axis=0, weights=area[some])
    return float(u), float(v)


def covered(surface: Surface, mesh: Mesh, paint: tuple[float, float, float]) -> Tensor:
    """Mean colour of what a texture covers, linear RGB [3].

    Args:
        surface: Where it is.
        mesh: Of the target.
        paint: Linear RGB of the target's paint; what takes no paint has the colour of its material.
    """
    if isinstance(surface.layer, Decal):
        return torch.tensor(ASPHALT)
    u0, v0, u1, v1 = surface.layer.rectangle
    u, v = mesh.uv.astype(np.float64).mean(1).T
    under = (mesh.panel >= 0) & (u0 <= u) & (u <= u1) & (v0 <= v) & (v <= v1)
    if not under.any():  # a patch that is smaller than the faces below it
        under = mesh.panel >= 0
    colours = np.array([paint if one.paint else one.colour for one in mesh.materials])
    return torch.from_numpy(np.average(colours[mesh.material[under]], axis=0, weights=mesh.areas()[under])).float()


def albedo_of(colour: Tensor) -> Tensor:
    """What is printed [3, H, W] or [B, 3, H, W], sRGB in 0 to 1, as linear albedo that ink and paper can have."""
    return printable(to_linear(colour))

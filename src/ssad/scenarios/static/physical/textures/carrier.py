"""Carriers of physical attacks: a patch on a panel of the target, its whole paint, or the road behind it."""

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
from ssad.rendering.camera.scene import TextureDecal, TextureLayer
from ssad.rendering.camera.texture import paint_mask, to_linear, to_printable
from ssad.rendering.meshes.mesh import Mesh, Rectangle
from ssad.rendering.street.palette import ASPHALT

Texels = Annotated[int, Field(strict=True, ge=1, le=4096)]
"""Of a side."""


@dataclass(frozen=True, slots=True)
class TextureSurface:
    """Carrier on a certain body: everything needed to show a texture on it.

    Attributes:
        layer: Layer on the target, or decal beside it, in the target's frame (texture 0).
        size: Height and width of the texture, texels.
        mask: Texels [H, W] that lie on the body; all others are never visible.
        metres: Width and height that the whole texture covers, m; for a camouflage those of the whole atlas.
    """

    layer: TextureLayer | TextureDecal
    size: tuple[int, int]
    mask: Bool
    metres: tuple[float, float]

    @property
    def place(self) -> tuple[float, ...]:
        """Position as plain numbers: u0, v0, u1, v1 on the atlas, or the pose and size of a decal."""
        if isinstance(self.layer, TextureLayer):
            return self.layer.rectangle
        return (*self.layer.pose.ravel().tolist(), *self.layer.size)

    @property
    def texels_per_metre(self) -> float:
        """Resolution of the finer of the two directions."""
        return max(self.size[1] / self.metres[0], self.size[0] / self.metres[1])


class Carrier(Protocol):
    """Place of a texture on any body.

    Attributes:
        name: Name shown in tables.
    """

    @property
    def name(self) -> str:
        """Name shown in tables."""

    def on(self, mesh: Mesh) -> TextureSurface:
        """Return the carrier on a body.

        Args:
            mesh: Mesh of the target.

        Raises:
            ConfigError: The body has no such panel, or no room on it.
        """


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class Patch:
    """Rectangle on one panel; lamps, windows and plates that it covers stay visible.

    Attributes:
        panel: Name of the panel (`Mesh.panels`): rear, hood, roof, left_side/front_door, a sign's face, torso_front
            ...
        width: In m.
        height: In m.
        centre: Centre of the patch in the panel's rectangle, shares from its upper left corner.
        texels: Texels along the longer side.
        name: Name shown in tables.
    """

    panel: str = "rear"
    width: Above = 1.0
    height: Above = 0.5
    centre: Two[Part] = (0.5, 0.5)
    texels: Texels = 96
    name: str = "patch"

    def on(self, mesh: Mesh) -> TextureSurface:
        """Return the patch on a panel of a body."""
        u0, v0, u1, v1 = mesh.panel_rectangle(self.panel)
        panel_width, panel_height = metres_of(mesh, self.panel)
        texture_width, texture_height = self.width / panel_width, self.height / panel_height
        u_centre, v_centre = u0 + self.centre[0] * (u1 - u0), v0 + self.centre[1] * (v1 - v0)
        rectangle = (
            u_centre - texture_width / 2,
            v_centre - texture_height / 2,
            u_centre + texture_width / 2,
            v_centre + texture_height / 2,
        )
        overhang = max(u0 - rectangle[0], v0 - rectangle[1], rectangle[2] - u1, rectangle[3] - v1)
        if overhang > 1e-6:
            raise ConfigError(
                f"a patch of {self.width:g} x {self.height:g} m at {self.centre} does not fit on the panel "
                f"'{self.panel}', which is {(u1 - u0) * panel_width:.2f} x {(v1 - v0) * panel_height:.2f} m"
            )
        longest = max(self.width, self.height)
        size = (
            max(1, round(self.texels * self.height / longest)),
            max(1, round(self.texels * self.width / longest)),
        )
        return _surface(mesh, rectangle, size, (self.width, self.height))


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class Camouflage:
    """Whole paint of the body: all panels, but no windows, lamps, plates and tyres.

    Attributes:
        texels: Texels of each side of the atlas.
        name: Name shown in tables.
    """

    texels: Texels = 128
    name: str = "camouflage"

    def on(self, mesh: Mesh) -> TextureSurface:
        """Return the whole paint of a body."""
        if not (mesh.panel >= 0).any():
            raise ConfigError("this body has no panels to paint")
        return _surface(mesh, (0.0, 0.0, 1.0, 1.0), (self.texels, self.texels), metres_of(mesh))


@checked_dataclass(frozen=True, slots=True, config=VALUES)
class RoadPatch:
    """Rectangle painted on the road behind the target and moving with it, a stand-in for a fixed one.

    Attributes:
        width: In m.
        length: Length along the road, m.
        behind: Distance from the target's rear to its near edge, m.
        texels: Texels along the longer side.
        name: Name shown in tables.
    """

    width: Above = 2.5
    length: Above = 5.0
    behind: Least = 0.3
    texels: Texels = 96
    name: str = "road"

    def on(self, mesh: Mesh) -> TextureSurface:
        """Return the rectangle behind a body."""
        lowest, _ = mesh.bounds()
        pose = np.eye(4)
        # seen from behind: x is the target's right, y is towards the viewer, z points into the road
        pose[:3, 0], pose[:3, 1], pose[:3, 2] = (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
        pose[0, 3] = lowest[0] - self.behind - self.length / 2
        longest = max(self.width, self.length)
        size = max(1, round(self.texels * self.length / longest)), max(1, round(self.texels * self.width / longest))
        decal = TextureDecal(0, pose, (self.width, self.length), tag=0)
        return TextureSurface(decal, size, np.ones(size, np.bool_), (self.width, self.length))


def _surface(mesh: Mesh, rectangle: Rectangle, size: tuple[int, int], metres: tuple[float, float]) -> TextureSurface:
    mask = paint_mask(mesh, size, rectangle)
    if not mask.any():
        raise ConfigError("no face of the body lies under the texture; choose another place")
    return TextureSurface(TextureLayer(0, rectangle), size, mask, metres)


def metres_of(mesh: Mesh, panel: str | None = None) -> tuple[float, float]:
    """Return the metres of a body for the whole width and the whole height of the atlas.

    Args:
        mesh: The body.
        panel: Panel to measure; None: all of them.

    Returns:
        Along u and along v: means over the faces, weighted by their area in the atlas.

    Raises:
        ConfigError: There is no such panel, or it has no faces.
    """
    is_selected = mesh.panel >= 0 if panel is None else np.isin(mesh.panel, mesh.panel_indices(panel))
    uv: F64 = mesh.uv[is_selected].astype(np.float64)
    corners = mesh.corners()[is_selected]
    uv_edges = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=-1)
    metric_edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)
    area = np.abs(np.linalg.det(uv_edges))
    # Faces of no area in the atlas have no inverse.
    is_valid = area > 1e-9
    if not is_valid.any():
        raise ConfigError(f"panel '{panel}' has no faces; choose another panel")
    tangents = metric_edges[is_valid] @ np.linalg.inv(uv_edges[is_valid])  # [F, 3, 2] m for the whole of u, of v
    lengths = np.linalg.norm(tangents, axis=1)
    u_metres, v_metres = np.average(lengths, axis=0, weights=area[is_valid])
    return float(u_metres), float(v_metres)


def covered_colour(surface: TextureSurface, mesh: Mesh, paint: tuple[float, float, float]) -> Tensor:
    """Return the mean colour of the surface under a texture, linear RGB [3].

    Args:
        surface: Surface of the texture.
        mesh: Mesh of the target.
        paint: Linear RGB of the target's paint; faces without paint have the colour of their material.
    """
    if isinstance(surface.layer, TextureDecal):
        return torch.tensor(ASPHALT)
    u0, v0, u1, v1 = surface.layer.rectangle
    u_centre, v_centre = mesh.uv.astype(np.float64).mean(1).T
    is_covered = (mesh.panel >= 0) & (u0 <= u_centre) & (u_centre <= u1) & (v0 <= v_centre) & (v_centre <= v1)
    if not is_covered.any():  # the patch is smaller than the faces below it
        is_covered = mesh.panel >= 0
    colours = np.array([paint if material.paint else material.colour for material in mesh.materials])
    return torch.from_numpy(
        np.average(colours[mesh.material[is_covered]], axis=0, weights=mesh.areas()[is_covered])
    ).float()


def albedo_of(colour: Tensor) -> Tensor:
    """Convert a texture [3, H, W] or [B, 3, H, W], sRGB in 0 to 1, to the linear albedo of its print."""
    return to_printable(to_linear(colour))

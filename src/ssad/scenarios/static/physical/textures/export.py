"""A texture for printing and for other programs: images at true size, and the target as OBJ with the texture."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from ssad.core import safeio
from ssad.core.colours import linear_to_srgb
from ssad.core.errors import ConfigError, FormatError
from ssad.core.types import U8
from ssad.rendering.agent_edit import AgentEdit
from ssad.rendering.camera.scene import TextureDecal
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.meshes.obj_writer import write_obj
from ssad.rendering.target import Target, parse_target
from ssad.scenarios.static.physical import TextureSurface, albedo_of, make_carrier
from ssad.scenarios.static.physical.textures.carrier import covered_colour, metres_of
from ssad.scenarios.static.physical.textures.inks import printable_colours, share_outside
from ssad.scenarios.static.physical.textures.printing import conspicuousness, non_printability

LARGEST = 16384  # dots of a side
ATLAS = 2048  # texels of a side of the atlas that shows a patch


@dataclass(frozen=True, slots=True)
class PrintedTexture:
    """Texture with all settings that are needed to put it on its target again.

    Attributes:
        colour: sRGB [3, H, W] in 0 to 1.
        carrier: Name of its carrier (`ssad.scenarios.static.physical.CARRIERS`).
        options: Options of the carrier.
        target: Target of the texture, as for `ssad record --target`.
        hour: Hour at which it is shown: that of the drive.
    """

    colour: Tensor
    carrier: str
    options: Mapping[str, Any]
    target: str
    hour: str = field(default="recorded", init=False)

    def on(self, mesh: Mesh) -> TextureSurface:
        """Return the surface of the texture on a body.

        Raises:
            ConfigError: It does not fit.
        """
        surface = make_carrier(self.carrier, self.options).on(mesh)
        if surface.size != tuple(self.colour.shape[1:]):
            raise ConfigError(
                f"the texture has {self.colour.shape[2]} x {self.colour.shape[1]} texels, a {self.carrier} on this "
                f"body {surface.size[1]} x {surface.size[0]}"
            )
        return surface

    def edit(self, mesh: Mesh) -> SceneEdit:
        """Return the edit of a scene in which the body has the texture."""
        surface = self.on(mesh)
        textures, masks = {0: albedo_of(self.colour)}, {0: surface.mask}
        if isinstance(surface.layer, TextureDecal):
            return SceneEdit(decals=(surface.layer,), textures=textures, masks=masks)
        return SceneEdit((surface.layer,), textures=textures, masks=masks)

    def live(self, agent: int) -> AgentEdit:
        """Return the edit in which a car or a walker of the closed loop, or every stop sign, wears it."""
        return AgentEdit(self.edit, parse_target(self.target), agent)


def load_printed_texture(folder: Path) -> PrintedTexture:
    """Read a texture that `export_texture` wrote.

    Raises:
        FormatError: A file is missing or broken, or the numbers are not those that were exported.
    """
    description, colour_bytes = safeio.read_json(folder / "texture.json"), safeio.read_bytes(folder / "texture.npz")
    try:
        check_description(description, sha256=str, carrier=str, options=dict, target=str)
        if hashlib.sha256(colour_bytes).hexdigest() != description["sha256"]:
            raise FormatError(f"{folder / 'texture.npz'}: not the texture that texture.json describes; export it again")
        colour = colour_tensor(safeio.load_npz(folder / "texture.npz")["colour"])
        return PrintedTexture(colour, description["carrier"], description["options"], description["target"])
    except (KeyError, TypeError) as error:
        raise FormatError(f"{folder / 'texture.json'}: no exported texture ({error}); export it again") from None


def check_description(description: Any, **types: type) -> None:
    """Raise KeyError or TypeError if the description of an export lacks a field, or has one of another type."""
    for name, field_type in types.items():
        if not isinstance(description[name], field_type):
            raise TypeError(f"{name} is {str(description[name])[:40]!r}")


def colour_tensor(colour: npt.NDArray[Any]) -> Tensor:
    """Return the colours [3, H, W] of an export. TypeError if they are others than finite numbers of that shape."""
    if colour.ndim != 3 or len(colour) != 3 or colour.dtype.kind != "f" or not np.isfinite(colour).all():
        raise TypeError("colour is no picture")
    return torch.from_numpy(colour.astype(np.float32))


def export_texture(out: Path, texture: PrintedTexture, *, dots: int = 1000, name: str = "") -> list[Path]:
    """Write a texture for a printer, and for programs that show meshes.

    Args:
        out: Folder: print.png, atlas.png, target.obj, target.mtl, texture.npz and texture.json.
        texture: The texture, its carrier and its target.
        dots: Dots of print.png per metre.
        name: Name in texture.json.

    Returns:
        Paths of the written files.

    Raises:
        ConfigError: The print has too many dots, or none; the texture does not fit on the target.
    """
    target, colour = parse_target(texture.target), texture.colour
    mesh = target.mesh()
    surface = texture.on(mesh)
    width, height = (round(metres * dots) for metres in surface.metres)
    if dots < 1 or not (1 <= width <= LARGEST and 1 <= height <= LARGEST):
        raise ConfigError(
            f"{surface.metres[0]:.2f} x {surface.metres[1]:.2f} m with {dots} dots per metre are {width} x {height} "
            f"dots; from 1 to {LARGEST} a side can be written"
        )
    texels = np.ascontiguousarray(colour.permute(1, 2, 0).numpy().astype(np.float32))
    safeio.make_folder(out)
    _save(out / "print.png", _resized(texels, (height, width)), dots)
    _save(out / "atlas.png", _atlas(texels, surface, target), None)
    painted_mesh = replace(
        mesh,
        materials=tuple(
            replace(material, colour=target.colour) if material.paint else material for material in mesh.materials
        ),
    )
    write_obj(out / "target.obj", painted_mesh, texture="atlas.png")
    colour_bytes = safeio.npz_bytes({"colour": colour.numpy()})
    safeio.write_atomic(out / "texture.npz", colour_bytes)
    mask = torch.from_numpy(surface.mask.copy())
    printability = float(non_printability(colour, printable_colours(), mask))
    colour_distance = float(conspicuousness(albedo_of(colour), covered_colour(surface, mesh, target.colour), mask))
    description = {
        "name": name,
        "target": texture.target,
        "carrier": texture.carrier,
        "options": dict(texture.options),
        "dots_per_metre": dots,
        "sha256": hashlib.sha256(colour_bytes).hexdigest(),
        "metres": [round(metre, 4) for metre in surface.metres],
        "texels": [colour.shape[2], colour.shape[1]],
        "rectangle": [round(coordinate, 6) for coordinate in _rectangle(surface)],
        "panels": _panels(mesh),
        "non_printability": round(printability, 4),
        "outside_gamut": round(share_outside(colour, mask), 4),
        "delta_e": round(colour_distance, 2),
    }
    safeio.write_atomic(out / "texture.json", safeio.dump_json(description, indent=1) + "\n")
    return [
        out / file_name
        for file_name in ("print.png", "atlas.png", "target.obj", "target.mtl", "texture.npz", "texture.json")
    ]


def _resized(texels: Any, size: tuple[int, int]) -> U8:
    """Enlarge a texture as the renderer interpolates it between texels, RGB."""
    enlarged = cv2.resize(texels, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray((enlarged.clip(0.0, 1.0) * 255).round(), np.uint8)


def _rectangle(surface: TextureSurface) -> tuple[float, float, float, float]:
    """Return the rectangle of a texture in the atlas; an empty one if it lies beside the target."""
    return (0.0, 0.0, 0.0, 0.0) if isinstance(surface.layer, TextureDecal) else surface.layer.rectangle


def _atlas(texels: Any, surface: TextureSurface, target: Target) -> U8:
    """Return the image of the whole atlas: paint, and the texture on it."""
    u0, v0, u1, v1 = _rectangle(surface)
    if (u0, v0, u1, v1) == (0.0, 0.0, 1.0, 1.0):
        return _resized(texels, (max(ATLAS, texels.shape[0]), max(ATLAS, texels.shape[1])))
    atlas = np.empty((ATLAS, ATLAS, 3), np.uint8)
    atlas[:] = (linear_to_srgb(np.asarray(target.colour)) * 255).round()
    left, top, right, bottom = (round(edge * ATLAS) for edge in (u0, v0, u1, v1))
    if right > left and bottom > top:  # else smaller than a texel
        atlas[top:bottom, left:right] = _resized(texels, (bottom - top, right - left))
    return atlas


def _panels(mesh: Mesh) -> dict[str, dict[str, list[float]]]:
    """Return the rectangle of each panel in the atlas, and its size in metres."""
    panels = {}
    for panel in mesh.panels:
        u0, v0, u1, v1 = mesh.panel_rectangle(panel)
        try:
            metres_per_u, metres_per_v = metres_of(mesh, panel)
        except ConfigError:  # a panel without faces at this level of detail
            continue
        size_metres = [round((u1 - u0) * metres_per_u, 3), round((v1 - v0) * metres_per_v, 3)]
        panels[panel] = {"rectangle": [round(edge, 6) for edge in (u0, v0, u1, v1)], "metres": size_metres}
    return panels


def _save(path: Path, image: U8, dots: int | None) -> None:
    """Write a PNG that declares its resolution."""
    # PNG readers print at true size from this number; an inch has 0.0254 m.
    png_options: dict[str, Any] = {} if dots is None else {"dpi": (dots * 0.0254, dots * 0.0254)}
    with safeio.atomic_path(path) as file:
        Image.fromarray(image).save(file, "PNG", **png_options)

"""A texture for printing and for other programs: pictures at true size, and the target as OBJ that wears it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ssad.assets.mesh import Mesh
from ssad.assets.obj_writer import write_obj
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.types import U8
from ssad.recording.target import TargetCar, TargetSign
from ssad.scenarios.static.physical import Surface
from ssad.scenarios.static.physical.carrier import metres_of
from ssad.scenarios.static.physical.inks import printable_colours
from ssad.scenarios.static.physical.printing import non_printability

LARGEST = 16384  # dots of a side
ATLAS = 2048  # texels of a side of the atlas that shows a patch


def export_texture(
    out: Path, colour: Tensor, surface: Surface, target: TargetCar | TargetSign, *, dots: int = 1000, name: str = ""
) -> list[Path]:
    """Write a texture for a printer, and for programs that show meshes.

    Args:
        out: Folder: print.png, atlas.png, target.obj, target.mtl and texture.json.
        colour: sRGB [3, H, W] in 0 to 1.
        surface: What it is printed on.
        target: What wears it.
        dots: Of print.png for each metre.
        name: What texture.json calls it.

    Returns:
        What was written.

    Raises:
        ConfigError: The print has too many dots, or none.
    """
    width, height = (round(metres * dots) for metres in surface.metres)
    if dots < 1 or not (1 <= width <= LARGEST and 1 <= height <= LARGEST):
        raise ConfigError(
            f"{surface.metres[0]:.2f} x {surface.metres[1]:.2f} m with {dots} dots per metre are {width} x {height} "
            f"dots; from 1 to {LARGEST} a side can be written"
        )
    mesh = target.mesh()
    texels = np.ascontiguousarray(colour.permute(1, 2, 0).numpy().astype(np.float32))
    safeio.make_folder(out)
    _save(out / "print.png", _resized(texels, (height, width)), dots)
    _save(out / "atlas.png", _atlas(texels, surface, target), None)
    painted = replace(
        mesh, materials=tuple(replace(m, colour=_paint(target)) if m.paint else m for m in mesh.materials)
    )
    write_obj(out / "target.obj", painted, texture="atlas.png")
    score = float(non_printability(colour, printable_colours(), torch.from_numpy(surface.mask.copy())))
    about = {
        "name": name, "target": type(target).__name__, "style": target.style, "dots_per_metre": dots,
        "metres": [round(one, 4) for one in surface.metres], "texels": [colour.shape[2], colour.shape[1]],
        "rectangle": [round(v, 6) for v in surface.layer.rectangle], "panels": _panels(mesh),
        "non_printability": round(score, 4),
    }  # fmt: skip
    safeio.write_atomic(out / "texture.json", safeio.dump_json(about, indent=1) + "\n")
    return [out / file for file in ("print.png", "atlas.png", "target.obj", "target.mtl", "texture.json")]


def _resized(texels: Any, size: tuple[int, int]) -> U8:
    """A texture with more texels, as the renderer looks it up between them, RGB."""
    whole = cv2.resize(texels, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray((whole.clip(0.0, 1.0) * 255).round(), np.uint8)


def _atlas(texels: Any, surface: Surface, target: TargetCar | TargetSign) -> U8:
    """The picture of the whole atlas: paint, and the texture where it is."""
    u0, v0, u1, v1 = surface.layer.rectangle
    if (u0, v0, u1, v1) == (0.0, 0.0, 1.0, 1.0):
        return _resized(texels, (max(ATLAS, texels.shape[0]), max(ATLAS, texels.shape[1])))
    paint = np.asarray(_paint(target))
    srgb = np.where(paint <= 0.0031308, 12.92 * paint, 1.055 * paint ** (1 / 2.4) - 0.055)
    whole = np.empty((ATLAS, ATLAS, 3), np.uint8)
    whole[:] = (srgb * 255).round()
    left, top, right, bottom = (round(v * ATLAS) for v in (u0, v0, u1, v1))
    if right > left and bottom > top:  # else smaller than a texel
        whole[top:bottom, left:right] = _resized(texels, (bottom - top, right - left))
    return whole


def _paint(target: TargetCar | TargetSign) -> tuple[float, float, float]:
    """Linear RGB of what the texture does not cover."""
    return target.colour if isinstance(target, TargetCar) else (0.5, 0.5, 0.5)


def _panels(mesh: Mesh) -> dict[str, dict[str, list[float]]]:
    """Where each panel is in the atlas, and how large it is."""
    found = {}
    for panel in mesh.panels:
        u0, v0, u1, v1 = mesh.panel_rectangle(panel)
        try:
            across, down = metres_of(mesh, panel)
        except ConfigError:  # a panel without faces at this level of detail
            continue
        metres = [round((u1 - u0) * across, 3), round((v1 - v0) * down, 3)]
        found[panel] = {"rectangle": [round(v, 6) for v in (u0, v0, u1, v1)], "metres": metres}
    return found


def _save(path: Path, image: U8, dots: int | None) -> None:
    """A PNG that says how many dots a metre has."""
    options: dict[str, Any] = {} if dots is None else {"dpi": (dots * 0.0254, dots * 0.0254)}
    with safeio.atomic_path(path) as file:
        Image.fromarray(image).save(file, "PNG", **options)

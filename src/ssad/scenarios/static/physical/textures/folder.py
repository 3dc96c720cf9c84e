"""Folder of textures: each is trained once and stored as numbers and as an image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.images import save_picture
from ssad.core.protocols import Detector
from ssad.scenarios.static.physical.textures.attacks import make_physical
from ssad.scenarios.static.physical.textures.card import load_texture
from ssad.scenarios.static.physical.textures.carrier import TextureSurface
from ssad.scenarios.static.physical.textures.controls import control, texture_picture
from ssad.scenarios.static.physical.textures.inks import printable_colours, project_onto_gamut
from ssad.scenarios.static.physical.textures.optimise import TextureView, train_texture
from ssad.scenarios.static.physical.textures.spec import TextureSpec


@dataclass(frozen=True, slots=True)
class TextureFolder:
    """Folder of trained textures.

    Attributes:
        path: Path of the folder.
        seed: Root seed of the trainings.
        device: Device of the trainings.
    """

    path: Path
    seed: int = 0
    device: str = "cpu"

    def colour_path(self, spec: TextureSpec) -> Path:
        """Return the path of a finished texture."""
        return self.path / f"{spec.name}.npz"

    def image_path(self, spec: TextureSpec) -> Path:
        """Return the path of a texture's image."""
        return self.path / spec.picture

    def texture(
        self,
        spec: TextureSpec,
        surface: TextureSurface,
        *,
        views: Callable[[], Sequence[TextureView]],
        detector: Callable[[], Detector],
        paint: Tensor | None = None,
    ) -> Tensor:
        """Return a texture, trained first if necessary; its image is written too.

        Args:
            spec: Specification of the texture.
            surface: Surface that carries it.
            views: Function that renders the training images.
            detector: Function that creates the detector under attack.
            paint: Linear RGB [3] of the covered surface, for attacks with `stealth`.

        Returns:
            sRGB [3, H, W] in 0 to 1.

        Raises:
            ConfigError: It cannot be trained (see `train_texture`).
        """
        if spec.source:
            is_trained = spec.file is None
            colour = self._train(spec, surface, views, detector, paint) if is_trained else _read(spec, surface)
            if spec.inks and not is_trained:
                colour = project_onto_gamut(colour)
            if spec.attack == "shuffled":
                colour = control("shuffled", surface.size, seed=spec.number, trained=colour)
        else:
            colour = control(spec.attack, surface.size, seed=spec.number)
            if spec.inks:
                colour = project_onto_gamut(colour)
        if not self.image_path(spec).is_file():
            save_picture(self.image_path(spec), texture_picture(colour, surface.mask))
        return colour

    def _train(
        self,
        spec: TextureSpec,
        surface: TextureSurface,
        views: Callable[[], Sequence[TextureView]],
        detector: Callable[[], Detector],
        paint: Tensor | None,
    ) -> Tensor:
        path = self.colour_path(spec)
        if not path.is_file():
            trained = train_texture(
                make_physical(spec.trained, **{"inks": spec.inks, **spec.settings}),
                detector(),
                surface,
                views(),
                start=control("grey", surface.size),
                printable=printable_colours(),
                paint=paint,
                device=self.device,
                key=(self.seed, spec.name),
                checkpoint=path.with_suffix(".checkpoint.npz"),
            )
            losses, gradients = np.array(trained.losses), np.array(trained.gradients)
            safeio.save_npz(path, {"colour": trained.colour.numpy(), "losses": losses, "gradients": gradients})
        # Always read from the file: a texture is the same whether or not it was just trained.
        return torch.from_numpy(safeio.load_npz(path)["colour"].copy())

    def history(self, spec: TextureSpec) -> dict[str, Any]:
        """Return the training history of a texture for records; empty without training."""
        if not spec.trained:
            return {}
        losses = safeio.load_npz(self.colour_path(spec))["losses"]
        return {"epochs": len(losses), "loss_before": float(losses[0]), "loss_after": float(losses[-1])}


def _read(spec: TextureSpec, surface: TextureSurface) -> Tensor:
    """Load a texture from its file.

    Raises:
        ConfigError: Its size differs from that of the surface.
    """
    assert spec.file is not None
    colour, _ = load_texture(spec.file)
    if tuple(colour.shape[1:]) != surface.size:
        raise ConfigError(
            f"texture {spec.file}: {colour.shape[1]} x {colour.shape[2]} texels, the {spec.carrier} has "
            f"{surface.size[0]} x {surface.size[1]}"
        )
    return colour

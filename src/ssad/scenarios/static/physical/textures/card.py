"""Trained textures as files: the printed image, and a card with its origin."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError, unknown_name
from ssad.core.images import read_image, save_picture
from ssad.core.types import U8
from ssad.core.version import __version__
from ssad.scenarios.static.physical.textures.inks import share_outside

SHIPPED = Path(__file__).parent / "trained"


@dataclass(frozen=True, slots=True)
class TextureCard:
    """Description and origin of a texture.

    Attributes:
        attack: Attack that trained it.
        carrier: Name of the carrier.
        options: Options of the carrier.
        source: Detector under attack.
        weights: Hash of that detector's weights.
        target: Target that wears it, as for `ssad record --target`.
        data: Training data.
        command: Command that reproduces it.
        epochs: Training epochs.
        metrics: Results on the town of the test, which `data` names.
        hash: SHA-256 of size and texels; set by `save_texture`.
        version: Version of SSAD; set by `save_texture`.
        inks: Characterisation of the inks in which it was trained; "": any colour.
    """

    attack: str
    carrier: str
    options: Mapping[str, Any]
    source: str
    weights: str
    target: str
    data: str
    command: str
    epochs: int
    metrics: Mapping[str, float] = field(default_factory=dict)
    hash: str = ""
    version: str = ""
    inks: str = ""


def shipped_textures() -> list[str]:
    """Return the names of the textures that SSAD ships."""
    return sorted(path.stem for path in SHIPPED.glob("*.json"))


def load_texture(name: str) -> tuple[Tensor, TextureCard]:
    """Load a texture and its card.

    Args:
        name: Name of a shipped texture, or path of a card (NAME.json, with NAME.png beside it).

    Returns:
        sRGB [3, H, W] in 0 to 1, and the card.

    Raises:
        UnknownNameError: No shipped texture has the name.
        FormatError: A file is missing or broken, or the image does not match the card.
    """
    path = Path(name).expanduser() if name.endswith(".json") else SHIPPED / f"{name}.json"
    if not name.endswith(".json") and not path.is_file():
        raise unknown_name("texture", name, shipped_textures())
    card_data = safeio.read_json(path)
    field_names = {field_info.name for field_info in fields(TextureCard)}
    if not isinstance(card_data, dict) or not field_names >= set(card_data):
        raise FormatError(f"{path}: not the card of a texture; its keys are {', '.join(sorted(field_names))}")
    try:
        card = TextureCard(**card_data)
    except TypeError as error:
        raise FormatError(f"{path}: not the card of a texture ({error})") from None
    image = read_image(path.with_suffix(".png"))
    if _hash(image) != card.hash:
        raise FormatError(f"{path.with_suffix('.png')}: not the texture that its card describes; get both anew")
    return torch.from_numpy(image.copy()).permute(2, 0, 1).float() / 255, card


def save_texture(path: Path, image: U8, card: TextureCard) -> None:
    """Write PATH.png and PATH.json.

    Args:
        path: Path without a suffix.
        image: RGB [H, W, 3].
        card: Card; its hash and version are set here.

    Raises:
        ConfigError: The card names inks that do not give all colours of the image.
    """
    colour = torch.from_numpy(image.copy()).permute(2, 0, 1).float() / 255
    if card.inks and (outside := share_outside(colour)):
        raise ConfigError(f"{path}: {outside:.1%} of the texels are no colours of {card.inks}; project it first")
    card_data = asdict(card) | {"hash": _hash(image), "version": __version__}
    save_picture(path.with_suffix(".png"), image)
    safeio.write_atomic(path.with_suffix(".json"), safeio.dump_json(card_data, indent=1) + "\n")


def _hash(image: U8) -> str:
    return hashlib.sha256(str(image.shape).encode() + np.ascontiguousarray(image).tobytes()).hexdigest()

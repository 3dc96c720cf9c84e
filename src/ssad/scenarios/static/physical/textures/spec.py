"""Texture specifications as plain data: attack or control, carrier and attacked detector."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

from ssad.core import safeio
from ssad.core.errors import unknown_name
from ssad.core.schema import build_validated
from ssad.core.seeding import digest
from ssad.core.source import plugin_version
from ssad.scenarios.static.digital.objectives import LOSSES
from ssad.scenarios.static.physical.textures.attacks import ATTACKS
from ssad.scenarios.static.physical.textures.carrier import Camouflage, Carrier, Patch, RoadPatch
from ssad.scenarios.static.physical.textures.controls import CONTROLS

CARRIERS: dict[str, Callable[..., Carrier]] = {"patch": Patch, "camouflage": Camouflage, "road": RoadPatch}


@dataclass(frozen=True, slots=True)
class TextureSpec:
    """All settings that determine a texture.

    Attributes:
        attack: Name of an attack (`ssad list attacks`) or of a control.
        carrier: Name of the carrier.
        options: Options of the carrier.
        settings: Fields of `TextureAttack` that differ from the attack's own.
        of: Attack whose texture the control `shuffled` permutes.
        source: Detector under attack; "" for controls without training.
        number: Index of a control that is drawn at random.
        pair: Training and test data, as given in the suite.
        around: Number of additional training images from all around the target.
        file: Existing texture (see `load_texture`); None: it is trained.
        inks: Whether controls have the nearest colours that inks can give, and trainings tones of inks; of a file,
            whether it is projected onto the gamut of the inks.
        approach: Whether it is trained on views at all distances of an approach.
    """

    attack: str
    carrier: str
    options: Mapping[str, Any]
    settings: Mapping[str, Any]
    of: str | None
    source: str
    number: int
    pair: Mapping[str, Any]
    around: int = 0
    file: str | None = None
    inks: bool = False
    approach: bool = False

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Self:
        """Create a specification from plain data with these keys, among others.

        Rows of older runs do not say `inks`: their textures have any colour.
        """
        return cls(**{field_info.name: row[field_info.name] for field_info in fields(cls) if field_info.name in row})

    @property
    def trained(self) -> str:
        """Attack to train, also for a texture that is shuffled afterwards; "" without training."""
        return (self.of or self.attack) if self.source and self.file is None else ""

    @property
    def version(self) -> str:
        """Versions of an attack and a loss of the user's own; "" for those of SSAD, and without training."""
        if not self.trained:
            return ""
        versions, loss = [plugin_version("physical-attack", ATTACKS, self.trained)], self.settings.get("objective")
        versions += [plugin_version("loss", LOSSES, loss)] if isinstance(loss, str) else []
        return " ".join(filter(None, versions))

    @property
    def name(self) -> str:
        """Short name of everything that the training depends on; for a file, of the file."""
        attack = self.of or self.attack
        if self.file is not None:
            return f"{attack}-{Path(self.file).stem}{'-printable' if self.inks else ''}"
        data_key = attack, self.source, self.carrier, safeio.dump_json(self.options)
        training_key = safeio.dump_json(self.settings), self.pair["train"], self.pair["train_images"]
        # Added only if used, so that the names of textures without it stay the same.
        flags = tuple(name for name in ("inks", "approach") if getattr(self, name))
        optional_key = (*((self.around,) if self.around else ()), *flags)
        return f"{attack}-{digest('texture', *data_key, *training_key, *optional_key)[:12]}"

    @property
    def picture(self) -> str:
        """File name of the texture as an image."""
        if self.attack in CONTROLS and not self.source:
            suffix = "-printable" if self.inks else ""
            return f"{self.attack}-{self.carrier}-{digest('carrier', self.surface)[:8]}-{self.number}{suffix}.png"
        return f"{self.name}{f'-shuffled-{self.number}' if self.attack == 'shuffled' else ''}.png"

    @property
    def surface(self) -> str:
        """Settings that determine the surface, as JSON."""
        return safeio.dump_json({"carrier": self.carrier, "options": self.options})


def make_carrier(name: str, options: Mapping[str, Any]) -> Carrier:
    """Create a carrier by name.

    Raises:
        ConfigError: There is no such carrier, or an option is unknown or has an invalid value.
    """
    if name not in CARRIERS:
        raise unknown_name("carrier", name, CARRIERS)
    return build_validated(CARRIERS[name], options, subject=name)

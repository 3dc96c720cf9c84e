"""A texture as plain data: which attack or control, on what, against whom; and the carrier that follows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

from ssad.core import safeio
from ssad.core.errors import unknown_name
from ssad.core.schema import checked
from ssad.core.seeding import digest
from ssad.scenarios.static.physical.textures.carrier import Camouflage, Carrier, Patch, Road
from ssad.scenarios.static.physical.textures.controls import CONTROLS

CARRIERS: dict[str, Callable[..., Carrier]] = {"patch": Patch, "camouflage": Camouflage, "road": Road}


@dataclass(frozen=True, slots=True)
class TextureSpec:
    """All that decides a texture.

    Attributes:
        attack: Name of an attack (`ssad list attacks`) or of a control.
        carrier: Name of what it is printed on.
        options: Of the carrier.
        settings: Fields of `TextureAttack` that differ from the attack's own.
        of: Of the control shuffled: the attack whose texture is shuffled.
        source: The detector that is attacked; "" for what is not trained.
        number: Of a control that is drawn at random.
        pair: What it is trained and tested on, as the suite says it.
        around: Pictures from all around the target that it is trained on too.
        file: A texture that is there already (see `load_texture`); None: it is trained.
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

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Self:
        """From plain data with these keys, among others."""
        return cls(**{one.name: row[one.name] for one in fields(cls)})

    @property
    def trained(self) -> str:
        """The attack that is trained, also for what is shuffled afterwards; "" for a control that learns nothing."""
        return (self.of or self.attack) if self.source and self.file is None else ""

    @property
    def name(self) -> str:
        """What the training of the texture depends on, in short; of a file its name."""
        attack = self.of or self.attack
        if self.file is not None:
            return f"{attack}-{Path(self.file).stem}"
        about = attack, self.source, self.carrier, safeio.dump_json(self.options)
        rest = safeio.dump_json(self.settings), self.pair["train"], self.pair["train_images"]
        more = (self.around,) if self.around else ()
        return f"{attack}-{digest('texture', *about, *rest, *more)[:12]}"

    @property
    def picture(self) -> str:
        """File name of the texture as a picture."""
        if self.attack in CONTROLS and not self.source:
            return f"{self.attack}-{self.carrier}-{digest('carrier', self.surface)[:8]}-{self.number}.png"
        return f"{self.name}{f'-shuffled-{self.number}' if self.attack == 'shuffled' else ''}.png"

    @property
    def surface(self) -> str:
        """What decides the surface, as JSON."""
        return safeio.dump_json({"carrier": self.carrier, "options": self.options})


def make_carrier(name: str, options: Mapping[str, Any]) -> Carrier:
    """A carrier by name. ConfigError: there is none, an option that it does not have, or a value that it refuses."""
    if name not in CARRIERS:
        raise unknown_name("carrier", name, CARRIERS)
    return checked(CARRIERS[name], options, what=name)

"""Digital attack with all its settings, as plain data."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

from ssad.core.registry import resolve
from ssad.core.seeding import file_name
from ssad.core.source import plugin_version
from ssad.scenarios.static.digital import ATTACKS, Aim, Attack, make_attack
from ssad.scenarios.static.digital.budget import Norm
from ssad.scenarios.static.digital.objectives import LOSSES
from ssad.scenarios.static.digital.universal import UniversalFit
from ssad.scenarios.static.digital.victim import Precision


@dataclass(frozen=True, slots=True)
class AttackSpec:
    """Attack with all its settings.

    Attributes:
        attack: name (`ssad list attacks`).
        loss: objective of the ascent.
        norm: of the budget.
        radius: of the budget, in 8-bit code values.
        options: further settings of the attack, such as ("steps", 10), in order of their names.
        classes: names of the attacked classes; empty: all.
        becomes: (class, target class of its objects); empty: any other.
        draws: draws of a random defence that the attack knows, over which it ascends the mean loss; 0: it knows
            none.
        object: attacked object of each moment (see `ssad.scenarios.static.digital.chosen_object`); "": all.
        precision: of the gradients.
    """

    attack: str
    loss: str
    norm: Norm
    radius: float
    options: tuple[tuple[str, Any], ...] = ()
    classes: tuple[str, ...] = ()
    becomes: tuple[tuple[str, str], ...] = ()
    draws: int = 0
    object: str = ""
    precision: Precision = "float32"

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Self:
        """Rebuild a spec from its `row`, in which JSON has turned tuples into lists; further keys are ignored."""
        values = {name: row[name] for name in cls.__slots__}
        pairs = {name: tuple((key, value) for key, value in values[name]) for name in ("options", "becomes")}
        return cls(**{**values, **pairs, "classes": tuple(values["classes"])})

    @property
    def row(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)

    @property
    def name(self) -> str:
        """Such as "pgd-full-linf-5-steps10"; it distinguishes specs and can be a file name."""
        name_parts = [
            self.attack,
            self.loss,
            self.norm,
            f"{self.radius:g}",
            *(f"{key}{value}" for key, value in self.options),
            *self.classes,
            *(f"{source_class}-to-{target_class}" for source_class, target_class in self.becomes),
            *([f"draws{self.draws}"] if self.draws else []),
            *([f"object-{self.object}"] if self.object else []),
            *([self.precision] if self.precision != "float32" else []),
        ]
        return file_name("-".join(name_parts))

    @property
    def steps(self) -> int:
        """Steps of gradient ascent: the option, 1 for a white-box attack without it, else 0."""
        steps_option = dict(self.options).get("steps")
        return int(steps_option) if steps_option is not None else int(self.make().access == "white-box")

    @property
    def aim(self) -> Aim:
        """Attacked objects, and their target classes."""
        return Aim(self.classes or None, (0,) if self.object else None, dict(self.becomes))

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the classes whose objects are attacked; empty: all."""
        return tuple(source_class for source_class, _ in self.becomes) or self.classes

    @property
    def target(self) -> str:
        """Attacked objects and their target classes in words: "nearest car", "car to bus"; "": all."""
        changes = [f"{source_class} to {target_class}" for source_class, target_class in self.becomes]
        return " ".join(filter(None, [self.object, ", ".join(changes or self.classes)]))

    @property
    def version(self) -> str:
        """Versions of an attack and a loss of the user's own; "" for those of SSAD."""
        versions = plugin_version("attack", ATTACKS, self.attack), plugin_version("loss", LOSSES, self.loss)
        return " ".join(filter(None, versions))

    @property
    def passes(self) -> int:
        """Forward and backward passes per image."""
        restarts = int(dict(self.options).get("restarts", 0))
        return self.steps * (1 + restarts) * max(self.draws, 1) if self.make().access == "white-box" else 0

    def passes_in(self, images: int) -> int:
        """Return the forward and backward passes for all images of a scene."""
        attack = self.make()
        return attack.passes if isinstance(attack, UniversalFit) else self.passes * images

    def make(self) -> Attack:
        """Build the attack.

        Raises:
            UnknownNameError: unknown attack.
            ConfigError: it refuses a setting.
        """
        attack: Attack = make_attack(self.attack, **dict(self.options))
        return attack


def has_option(attack: str, option: str) -> bool:
    """Return True if a built-in attack has an option.

    Args:
        attack: name.
        option: name of a setting, such as "steps".

    Raises:
        UnknownNameError: unknown attack.
    """
    factory = resolve("attack", ATTACKS, attack)
    return callable(factory) and option in inspect.signature(factory).parameters

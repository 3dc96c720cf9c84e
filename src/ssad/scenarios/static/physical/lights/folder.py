"""The light attacks of a folder: each searched once and kept, with its power and what it has asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.images import save_picture
from ssad.core.protocols import Detector
from ssad.core.schema import checked
from ssad.core.seeding import digest
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.scenarios.static.physical.lights import (
    Budget,
    Projector,
    Target,
    make_light,
    random_settings,
    search_light,
)
from ssad.scenarios.static.physical.lights.search import LitView
from ssad.scenarios.static.physical.textures.controls import control, texture_picture
from ssad.scenarios.static.physical.textures.optimise import View, train_texture


@dataclass(frozen=True, slots=True)
class LightSpec:
    """All that decides a light attack.

    Attributes:
        attack: Name of an attack (`LIGHTS`), or random.
        options: Fields of the attack that differ.
        settings: Of its search: fields of `Budget` and `search`; of a projector, of `TextureAttack`.
        of: Of random: the attack whose settings are drawn.
        hour: When it shines (see `ssad.rendering.hours.HOURS`).
        source: The detector that is attacked; "" for random.
        number: Of random.
        pair: What it is searched on, as the suite says it.
    """

    attack: str
    options: Mapping[str, Any]
    settings: Mapping[str, Any]
    of: str | None
    hour: str
    source: str
    number: int
    pair: Mapping[str, Any]

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Self:
        """From plain data with these keys, among others."""
        return cls(**{one.name: row[one.name] for one in fields(cls)})

    @property
    def device(self) -> str:
        """What shines, or casts a shadow."""
        return self.of or self.attack

    @property
    def name(self) -> str:
        """What it depends on, in short."""
        about = self.source, self.hour, self.number, *map(safeio.dump_json, (self.options, self.settings, self.pair))
        return f"{self.attack}{f'-{self.of}' if self.of else ''}-{digest('light', self.of, *about)[:12]}"


@dataclass(frozen=True, slots=True)
class LightFolder:
    """Light attacks that are kept.

    Attributes:
        path: The folder.
        seed: Root of the random numbers of searches.
        device: Where detectors are.
    """

    path: Path
    seed: int = 0
    device: str = "cpu"

    def kept(self, spec: LightSpec) -> Path:
        """Where an attack is when it is found."""
        return self.path / f"{spec.name}.json"

    def picture(self, spec: LightSpec) -> Path:
        """What a projector shows."""
        return self.path / f"{spec.name}.png"

    def edit(
        self,
        spec: LightSpec,
        target: Target,
        *,
        views: Callable[[], Sequence[LitView]],
        projected: Callable[[SceneEdit], Sequence[View]],
        detector: Callable[[], Detector],
    ) -> SceneEdit:
        """An attack as an edit of a scene; searched now if it has to be.

        Args:
            spec: Which.
            target: What it lights.
            views: Makes the pictures of the search.
            projected: Makes pictures whose target is lit by what an edit projects.
            detector: Makes the detector that is attacked.

        Raises:
            ConfigError: It cannot be searched.
        """
        attack, path = make_light(spec.device, spec.options), self.kept(spec)
        if isinstance(attack, Projector):
            return self._projected(spec, attack, target, projected, detector)
        if not path.is_file():
            if spec.source:
                budget, how = budget_of(spec.settings, attack.name)
                found = search_light(
                    attack, detector(), target, views(), budget=budget, search=how, key=(self.seed, spec.name)
                )
                about = {
                    "values": found.values,
                    "queries": found.queries,
                    "loss_before": found.before,
                    "loss_after": found.loss,
                }
            else:
                values = random_settings(attack, target, key=(self.seed, spec.number))
                about = {"values": values, "queries": 0}
            about["lumens"] = attack.power(about["values"])  # type: ignore[arg-type]
            _write(path, about)
        values, _ = self.found(spec)
        return attack.edit(values, target)

    def found(self, spec: LightSpec) -> tuple[dict[str, float], Tensor | None]:
        """The settings of an attack that was found; of a projector none, and its picture [3, H, W] in sRGB."""
        if spec.device != "projector":
            return dict(safeio.read_json(self.kept(spec))["values"]), None
        return {}, torch.from_numpy(safeio.load_npz(self.kept(spec).with_suffix(".npz"))["colour"].copy())

    def _projected(
        self,
        spec: LightSpec,
        attack: Projector,
        target: Target,
        projected: Callable[[SceneEdit], Sequence[View]],
        detector: Callable[[], Detector],
    ) -> SceneEdit:
        """A projector with its picture."""
        surface, path = attack.surface(target), self.kept(spec)
        numbers = path.with_suffix(".npz")
        if not path.is_file():
            about: dict[str, Any] = {"queries": 0}
            if spec.source:
                training = attack.training(**spec.settings)
                views = projected(attack.edit(control("grey", surface.size), target))
                trained = train_texture(
                    training,
                    detector(),
                    surface,
                    views,
                    start=control("grey", surface.size),
                    shown=attack.light_of,
                    key=(self.seed, spec.name),
                    device=self.device,
                    checkpoint=path.with_suffix(".checkpoint.npz"),
                )
                colour = trained.colour
                about = {
                    "queries": len(views) * len(trained.losses),
                    "loss_before": trained.losses[0],
                    "loss_after": trained.losses[-1],
                }
            else:
                colour = control("random", surface.size, seed=spec.number)
            safeio.save_npz(numbers, {"colour": colour.numpy()})
            save_picture(self.picture(spec), texture_picture(colour, surface.mask))
            _write(path, about | {"values": {"white": attack.lumens}, "lumens": attack.power(colour)})
        _, shown = self.found(spec)
        assert shown is not None
        return attack.edit(shown, target)

    def history(self, spec: LightSpec) -> dict[str, Any]:
        """Power, settings and queries of an attack that was found, for records."""
        kept = safeio.read_json(self.kept(spec))
        values = {name: float(f"{value:.4g}") for name, value in kept.pop("values").items()}
        return {**kept, "light": values}


def budget_of(settings: Mapping[str, Any], attack: str) -> tuple[Budget, Any]:
    """The budget of an attack's search, and its kind (None: the attack's own).

    Raises:
        ConfigError: A setting that it does not have, or a value that it refuses.
    """
    given = dict(settings)
    how = given.pop("search", None)
    if how not in (None, "swarm", "greedy", "gradient"):
        raise ConfigError(f"attack {attack}: search={how!r}: choose swarm, greedy or gradient")
    return checked(Budget, given, what=f"attack {attack}"), how


def _write(path: Path, about: Mapping[str, Any]) -> None:
    safeio.make_folder(path.parent)
    safeio.write_atomic(path, safeio.dump_json(dict(about), indent=1) + "\n")

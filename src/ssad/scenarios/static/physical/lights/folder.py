"""Folder of light attacks: each is searched once and stored with its power and its number of queries."""

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
        """Create a specification from plain data with these keys, among others."""
        return cls(**{field_info.name: row[field_info.name] for field_info in fields(cls)})

    @property
    def device(self) -> str:
        """Name of the light or card, also for random settings."""
        return self.of or self.attack

    @property
    def name(self) -> str:
        """Short name of everything that the attack depends on."""
        key_parts = (
            self.source,
            self.hour,
            self.number,
            *map(safeio.dump_json, (self.options, self.settings, self.pair)),
        )
        return f"{self.attack}{f'-{self.of}' if self.of else ''}-{digest('light', self.of, *key_parts)[:12]}"


@dataclass(frozen=True, slots=True)
class LightFolder:
    """Folder of light attacks.

    Attributes:
        path: Path of the folder.
        seed: Root seed of the searches.
        device: Device of the detectors.
    """

    path: Path
    seed: int = 0
    device: str = "cpu"

    def kept(self, spec: LightSpec) -> Path:
        """Return the path of a finished attack."""
        return self.path / f"{spec.name}.json"

    def picture(self, spec: LightSpec) -> Path:
        """Return the path of a projector's image."""
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
        """Return an attack as a scene edit, searched first if necessary.

        Args:
            spec: Specification of the attack.
            target: Target that it lights.
            views: Function that renders the images of the search.
            projected: Function that renders images whose target is lit by the projection of an edit.
            detector: Function that creates the detector under attack.

        Raises:
            ConfigError: It cannot be searched.
        """
        attack, path = make_light(spec.device, spec.options), self.kept(spec)
        if isinstance(attack, Projector):
            return self._projected(spec, attack, target, projected, detector)
        if not path.is_file():
            if spec.source:
                budget, method = budget_of(spec.settings, attack.name)
                result = search_light(
                    attack, detector(), target, views(), budget=budget, search=method, key=(self.seed, spec.name)
                )
                record = {
                    "values": result.values,
                    "queries": result.queries,
                    "loss_before": result.before,
                    "loss_after": result.loss,
                }
            else:
                values = random_settings(attack, target, key=(self.seed, spec.number))
                record = {"values": values, "queries": 0}
            record["lumens"] = attack.power(record["values"])
            _write(path, record)
        values, _ = self.found(spec)
        edit: SceneEdit = attack.edit(values, target)
        return edit

    def found(self, spec: LightSpec) -> tuple[dict[str, float], Tensor | None]:
        """Load the settings of a finished attack; for a projector none, but its image [3, H, W] in sRGB."""
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
        """Return a projector with its image, trained first if necessary."""
        surface, path = attack.surface(target), self.kept(spec)
        colour_path = path.with_suffix(".npz")
        if not path.is_file():
            record: dict[str, Any] = {"queries": 0}
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
                record = {
                    "queries": len(views) * len(trained.losses),
                    "loss_before": trained.losses[0],
                    "loss_after": trained.losses[-1],
                }
            else:
                colour = control("random", surface.size, seed=spec.number)
            safeio.save_npz(colour_path, {"colour": colour.numpy()})
            save_picture(self.picture(spec), texture_picture(colour, surface.mask))
            _write(path, record | {"values": {"white": attack.lumens}, "lumens": attack.power(colour)})
        _, image_colour = self.found(spec)
        assert image_colour is not None
        return attack.edit(image_colour, target)

    def history(self, spec: LightSpec) -> dict[str, Any]:
        """Return power, settings and queries of a finished attack for records."""
        record = safeio.read_json(self.kept(spec))
        values = {name: float(f"{value:.4g}") for name, value in record.pop("values").items()}
        return {**record, "light": values}


def budget_of(settings: Mapping[str, Any], attack: str) -> tuple[Budget, Any]:
    """Return the budget of an attack's search, and its method (None: the attack's own).

    Raises:
        ConfigError: A setting is unknown or has an invalid value.
    """
    options = dict(settings)
    method = options.pop("search", None)
    if method not in (None, "swarm", "greedy", "gradient"):
        raise ConfigError(f"attack {attack}: search={method!r}: choose swarm, greedy or gradient")
    return checked(Budget, options, subject=f"attack {attack}"), method


def _write(path: Path, about: Mapping[str, Any]) -> None:
    safeio.make_folder(path.parent)
    safeio.write_atomic(path, safeio.dump_json(dict(about), indent=1) + "\n")

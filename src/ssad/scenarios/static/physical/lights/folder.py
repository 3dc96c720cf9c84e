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
from ssad.core.schema import build_validated
from ssad.core.seeding import digest
from ssad.core.source import plugin_version
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.scenarios.static.physical.lights import (
    BUILT_IN,
    Projector,
    SearchBudget,
    TargetSize,
    make_light,
    random_settings,
    search_light,
)
from ssad.scenarios.static.physical.lights.search import SearchView
from ssad.scenarios.static.physical.textures.controls import control, texture_picture
from ssad.scenarios.static.physical.textures.optimise import TextureView, train_texture


@dataclass(frozen=True, slots=True)
class LightSpec:
    """Specification of a light attack.

    Attributes:
        attack: Name of an attack (`LIGHTS`), or random.
        options: Fields of the attack that differ from its defaults.
        settings: Settings of its search: fields of `SearchBudget` and `search`; of a projector, of `TextureAttack`.
        of: For random: attack whose settings are drawn.
        hour: Hour at which it shines (see `ssad.rendering.hours.HOURS`).
        source: Detector under attack; "" for random.
        number: Index of a random draw.
        pair: Data of the search, as given in the suite.
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
    def version(self) -> str:
        """Version of a light of the user's own; "" for one of SSAD, and for no light."""
        return plugin_version("light", BUILT_IN, self.device) if self.device else ""

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

    def record_path(self, spec: LightSpec) -> Path:
        """Return the path of a finished attack."""
        return self.path / f"{spec.name}.json"

    def image_path(self, spec: LightSpec) -> Path:
        """Return the path of a projector's image."""
        return self.path / f"{spec.name}.png"

    def edit(
        self,
        spec: LightSpec,
        target: TargetSize,
        *,
        views: Callable[[], Sequence[SearchView]],
        projected_views: Callable[[SceneEdit], Sequence[TextureView]],
        detector: Callable[[], Detector],
    ) -> SceneEdit:
        """Return an attack as a scene edit, searched first if necessary.

        Args:
            spec: Specification of the attack.
            target: Target that it lights.
            views: Function that renders the images of the search.
            projected_views: Function that renders images whose target is lit by the projection of an edit.
            detector: Function that creates the detector under attack.

        Raises:
            ConfigError: It cannot be searched.
        """
        attack, path = make_light(spec.device, spec.options), self.record_path(spec)
        if isinstance(attack, Projector):
            return self._projected_edit(spec, attack, target, projected_views, detector)
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
        values, _ = self.load_values(spec)
        edit: SceneEdit = attack.edit(values, target)
        return edit

    def load_values(self, spec: LightSpec) -> tuple[dict[str, float], Tensor | None]:
        """Load the settings of a finished attack; for a projector none, but its image [3, H, W] in sRGB."""
        if spec.device != "projector":
            return dict(safeio.read_json(self.record_path(spec))["values"]), None
        return {}, torch.from_numpy(safeio.load_npz(self.record_path(spec).with_suffix(".npz"))["colour"].copy())

    def _projected_edit(
        self,
        spec: LightSpec,
        attack: Projector,
        target: TargetSize,
        projected_views: Callable[[SceneEdit], Sequence[TextureView]],
        detector: Callable[[], Detector],
    ) -> SceneEdit:
        """Return a projector with its image, trained first if necessary."""
        surface, path = attack.surface(target), self.record_path(spec)
        colour_path = path.with_suffix(".npz")
        if not path.is_file():
            record: dict[str, Any] = {"queries": 0}
            if spec.source:
                training = attack.training(**spec.settings)
                views = projected_views(attack.edit(control("grey", surface.size), target))
                trained = train_texture(
                    training,
                    detector(),
                    surface,
                    views,
                    start=control("grey", surface.size),
                    appearance=attack.light_of,
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
            save_picture(self.image_path(spec), texture_picture(colour, surface.mask))
            _write(path, record | {"values": {"white": attack.lumens}, "lumens": attack.power(colour)})
        _, image_colour = self.load_values(spec)
        assert image_colour is not None
        return attack.edit(image_colour, target)

    def history(self, spec: LightSpec) -> dict[str, Any]:
        """Return power, settings and queries of a finished attack for records."""
        record = safeio.read_json(self.record_path(spec))
        values = {name: float(f"{value:.4g}") for name, value in record.pop("values").items()}
        return {**record, "light": values}


def budget_of(settings: Mapping[str, Any], attack: str) -> tuple[SearchBudget, Any]:
    """Return the budget of an attack's search, and its method (None: the attack's own).

    Raises:
        ConfigError: A setting is unknown or has an invalid value.
    """
    options = dict(settings)
    method = options.pop("search", None)
    if method not in (None, "swarm", "greedy", "gradient"):
        raise ConfigError(f"attack {attack}: search={method!r}: choose swarm, greedy or gradient")
    return build_validated(SearchBudget, options, subject=f"attack {attack}"), method


def _write(path: Path, record: Mapping[str, Any]) -> None:
    safeio.make_folder(path.parent)
    safeio.write_atomic(path, safeio.dump_json(dict(record), indent=1) + "\n")

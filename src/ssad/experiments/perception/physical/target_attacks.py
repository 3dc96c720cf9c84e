"""Textures and lights of a results folder: optimised on its recorded images, stored, and shown on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.detections import Truth
from ssad.core.machine import start_warp_quietly
from ssad.core.protocols import Detector
from ssad.core.types import U8
from ssad.detectors import cached_detector
from ssad.engine.pool import open_pool, run_all
from ssad.experiments.perception.physical.lit_images import RelightableTargetImages
from ssad.experiments.perception.physical.target_sheet import COLUMNS, target_sheet
from ssad.experiments.perception.physical.textured_images import cache_texture_images, uncached_parts
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.camera.scene import TextureDecal, TextureLayer
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.target import TargetCar, parse_target
from ssad.scenarios.static.perturbation import Perturbation, TargetImages
from ssad.scenarios.static.physical import TextureSpec, TextureSurface, TextureView, albedo_of, make_carrier
from ssad.scenarios.static.physical.lights import SearchView, TargetSize
from ssad.scenarios.static.physical.lights.folder import LightFolder, LightSpec
from ssad.scenarios.static.physical.textures.carrier import covered_colour
from ssad.scenarios.static.physical.textures.folder import TextureFolder
from ssad.scenarios.static.physical.textures.inks import share_outside
from ssad.scenarios.static.physical.textures.perturbation import wearing_images
from ssad.scenarios.static.physical.textures.printing import conspicuousness


@dataclass(frozen=True, slots=True)
class TargetAttacks:
    """Textures on a target and lights on it, in the recordings of a folder.

    Attributes:
        folder: Folder with recordings in data, and textures and lights beside it.
        target: Target as for `ssad record --target`; lights are for cars.
        seed: Root of the random numbers of trainings and searches.
        device: Device of renderer and detectors.
    """

    folder: Path
    target: str
    seed: int = 0
    device: str = "cpu"

    @property
    def textures(self) -> TextureFolder:
        """The stored textures."""
        return TextureFolder(self.folder / "textures", self.seed, self.device)

    @property
    def lights(self) -> LightFolder:
        """The stored lights."""
        return LightFolder(self.folder / "lights", self.seed, self.device)

    def detector(self, name: str) -> Detector:
        """Return a detector, loaded on first use."""
        detector: Detector = cached_detector(name, device=self.device)
        return detector

    def images(self, recording: str, count: int, detector: str) -> RelightableTargetImages:
        """Return the first images of a recording, clean or ready for a texture."""
        return RelightableTargetImages.of(self.folder / "data" / recording, count, self.detector(detector), self.device)

    def texture(self, spec: TextureSpec) -> TrainedTexture:
        """Return a texture as a perturbation of the target."""
        return TrainedTexture(self, spec)

    def light(self, spec: LightSpec) -> SearchedLight:
        """Return a light as a perturbation of the target."""
        return SearchedLight(self, spec)

    def sheet(
        self,
        detector: str,
        images: RelightableTargetImages,
        *,
        textures: Mapping[str, TextureSpec],
        sides: Sequence[float | None],
        clean: str,
    ) -> U8:
        """Views under textures below each other.

        Args:
            detector: Whose boxes are drawn.
            images: Of the recording.
            textures: By title.
            sides: One view from each (azimuth in degrees); None: the first view.
            clean: Title of the pictures as they were recorded.
        """
        victim = self.detector(detector)
        # A count beyond every recording counts its images.
        whole_recording = replace(images, count=len(replace(images, count=1 << 30).rows()))
        rows = whole_recording.rows()
        view_numbers = [index for side in sides for index in _from(rows, side)] or [0]

        def select(pictures: Iterator[tuple[str, Tensor, Truth]]) -> list[tuple[str, Tensor, Truth]]:
            return [
                view
                for view_index, view in enumerate(islice(pictures, max(view_numbers) + 1))
                if view_index in view_numbers
            ]

        textured_views = {
            title: select(self.texture(spec).on_target(whole_recording)) for title, spec in textures.items()
        }
        sheets = []
        for index, (_, image, truth) in enumerate(select(whole_recording.clean())):
            titled_images = [
                (clean, image),
                *((title, selected[index][1]) for title, selected in textured_views.items()),
            ]
            columns = min(len(titled_images), COLUMNS)
            sheets.append(target_sheet(victim, titled_images, truth, self.device, columns))
        return np.concatenate(sheets)

    def light_sheet(self, detector: str, recording: str, lights: Mapping[str, tuple[str, LightSpec | None]]) -> U8:
        """Draw the first image of a recording under lights: by title the hour and the light (None: none)."""
        victim, titled_images = self.detector(detector), []
        for title, (hour, spec) in lights.items():
            images = replace(self.images(recording, 1, detector), hour=hour)
            ((_, tensor, truth),) = images.clean() if spec is None else self.light(spec).on_target(images)
            titled_images.append((title, tensor))
        return target_sheet(victim, titled_images, truth, self.device)


@dataclass(frozen=True, slots=True)
class TrainedTexture(Perturbation):
    """Texture of a results folder, which is trained on first use, or a control.

    Attributes:
        attacks: Textures of the folder.
        spec: All that decides the texture.
    """

    attacks: TargetAttacks
    spec: TextureSpec
    family: str = field(default="texture", init=False)

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name of the texture."""
        return self.spec.name

    @property
    def is_missing(self) -> bool:
        """True if it is to be trained, and is not yet."""
        return bool(self.spec.trained) and not self.attacks.textures.colour_path(self.spec).is_file()

    def make(self) -> Tensor:
        """Return the texture [3, H, W], sRGB; it is trained now if necessary.

        Raises:
            ConfigError: See `TextureFolder.texture`.
        """
        attacks, spec = self.attacks, self.spec
        surface = surface_of(attacks.target, spec.surface)

        def views() -> list[TextureView]:
            recording = f"{spec.pair['train']}-approach" if spec.approach else spec.pair["train"]
            image_sets = [attacks.images(recording, spec.pair["train_images"], spec.source)]
            if spec.around:
                image_sets.append(attacks.images(f"{spec.pair['train']}-around", spec.around, spec.source))
            return [
                view
                for image_set in image_sets
                for _, view in image_set.wearing(surface, solid=image_set.whole, glow=False)
            ]

        base_paint = paint_under(attacks.target, spec.surface)
        return attacks.textures.texture(
            spec, surface, views=views, detector=lambda: attacks.detector(spec.source), paint=base_paint
        )

    def on_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image and truth of the recorded target that wears the texture."""
        return wearing_images(images, albedo_of(self.make()), surface_of(self.attacks.target, self.spec.surface))

    def about(self) -> dict[str, Any]:
        """Return the record of the texture: its file, its colours beside paint and inks, and its training."""
        textures, spec, target = self.attacks.textures, self.spec, self.attacks.target
        artefacts = {"texture": str(textures.image_path(spec).relative_to(self.attacks.folder))}
        mask = torch.from_numpy(surface_of(target, spec.surface).mask.copy())
        colour = self.make().detach()
        colour_distance = conspicuousness(albedo_of(colour), paint_under(target, spec.surface), mask)
        return {
            "artefacts": artefacts,
            "delta_e": round(float(colour_distance), 2),
            "outside_gamut": round(share_outside(colour, mask), 6),
            **textures.history(spec),
        }


@dataclass(frozen=True, slots=True)
class SearchedLight(Perturbation):
    """Light of a results folder, which is searched on first use, or drawn at random.

    Attributes:
        attacks: Lights of the folder.
        spec: All that decides the light.
    """

    attacks: TargetAttacks
    spec: LightSpec
    family: str = field(default="light", init=False)

    @property
    def name(self) -> str:  # type: ignore[override]
        """Name of the light."""
        return self.spec.name

    @property
    def is_missing(self) -> bool:
        """True if it is to be searched, and is not yet."""
        return bool(self.spec.source) and not self.attacks.lights.record_path(self.spec).is_file()

    def make(self) -> SceneEdit:
        """Return the light as an edit of a scene; it is searched now if necessary.

        Raises:
            ConfigError: See `LightFolder.edit`.
        """
        attacks, spec = self.attacks, self.spec
        car = parse_target(attacks.target)
        assert isinstance(car, TargetCar)

        def training_images() -> RelightableTargetImages:
            return attacks.images(spec.pair["train"], spec.pair["train_images"], spec.source)

        def projected(edit: SceneEdit) -> list[TextureView]:
            texture_size = edit.textures[0].shape[1], edit.textures[0].shape[2]
            images = training_images()
            return [
                TextureView(
                    clip.projected(edit).prepare({0: texture_size}, device=attacks.device), images.lit_truth(clip)
                )
                for clip in images.images_at(spec.hour)
            ]

        def views() -> list[SearchView]:
            images = training_images()
            return [
                SearchView(clip.lit(attacks.device), images.lit_truth(clip)) for clip in images.images_at(spec.hour)
            ]

        return attacks.lights.edit(
            spec,
            TargetSize(*car.full_size),
            views=views,
            projected_views=projected,
            detector=lambda: attacks.detector(spec.source),
        )

    def on_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image and truth of the recorded target in the light, at its hour."""
        return images.lit(self.spec.hour, self.make())

    def about(self) -> dict[str, Any]:
        """Return the record of the light: its file and its search."""
        lights, spec = self.attacks.lights, self.spec
        path = lights.image_path(spec)
        artefacts = {
            "light": str((path if path.is_file() else lights.record_path(spec)).relative_to(self.attacks.folder))
        }
        return {"artefacts": artefacts, **lights.history(spec)}


def render_surfaces(task: tuple[Path, int, str, Sequence[str], str]) -> None:
    """Render and store the contribution of carriers to the images of a part, in a worker.

    Args:
        task: Folder of the recording, number of the part, target, `TextureSpec.surface` of each, device.
    """
    folder, part_number, target, surfaces, device = task
    start_warp_quietly()
    cache_texture_images(folder, layers_of(target, surfaces), part=part_number, device=device)


def render_all_surfaces(
    recordings: Sequence[TargetRecording],
    target: str,
    surfaces: Sequence[str],
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> None:
    """Render the contribution of carriers to the images of recordings once, all parts side by side.

    Stored images are kept.

    Raises:
        StoreError: Some parts failed.
    """
    tasks = [
        (recording.out, part_number, target, surfaces, recording.device)
        for recording in recordings
        if surfaces
        for part_number in uncached_parts(recording.out, layers_of(target, surfaces))
    ]
    if tasks:
        pool = open_pool(len(tasks), workers=workers, ray=ray, device=recordings[0].device)
        run_all(pool, render_surfaces, tasks, progress=progress)


def layers_of(target: str, surfaces: Sequence[str]) -> list[tuple[TextureLayer | TextureDecal, ...]]:
    """Where textures go, each alone, as `cache_texture_images` takes them."""
    return [(surface_of(target, surface).layer,) for surface in surfaces]


@lru_cache(maxsize=16)
def surface_of(target: str, surface: str) -> TextureSurface:
    """Return the surface of a texture, from a target and `TextureSpec.surface`."""
    row = safeio.parse_json(surface)
    return make_carrier(row["carrier"], row["options"]).on(parse_target(target).mesh())


@lru_cache(maxsize=16)
def paint_under(target: str, surface: str) -> Tensor:
    """Return the colour that a texture covers, linear RGB [3], from a target and `TextureSpec.surface`."""
    parsed_target = parse_target(target)
    return covered_colour(surface_of(target, surface), parsed_target.mesh(), parsed_target.colour)


def _from(rows: Sequence[Mapping[str, Any]], side: float | None) -> list[int]:
    """Return the number of the first view from a side at some 10 m, by day; of the first view if no side is given."""
    if side is None:
        return [0]
    distance_error = sorted({abs(float(row["distance"]) - 10.0) for row in rows})[0]
    matches = [
        index
        for index, row in enumerate(rows)
        if float(row["azimuth"]) == side
        and abs(float(row["distance"]) - 10.0) == distance_error
        and row["weather"] != "night"
    ]
    return matches[:1]

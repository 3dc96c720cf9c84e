"""Textures and lights of a results folder: trained or searched on its recorded pictures, kept, and shown on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.detections import Truth
from ssad.core.machine import quiet_warp
from ssad.core.protocols import Detector
from ssad.core.types import U8
from ssad.detectors import make_detector
from ssad.engine.pool import open_pool, run_all
from ssad.experiments.perception.physical.lit_images import LitPictures
from ssad.experiments.perception.physical.target_sheet import COLUMNS, target_sheet
from ssad.experiments.perception.physical.target_views import TargetClips
from ssad.experiments.perception.physical.textured_images import see_clips, unseen_parts
from ssad.metrics.target_attacks import TOGETHER
from ssad.recorders.target_recording import Clips
from ssad.rendering.camera.scene import Decal, Layer
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.target import TargetCar, parse_target
from ssad.scenarios.static.physical import Surface, TextureSpec, View, albedo_of, make_carrier
from ssad.scenarios.static.physical.lights import LitView, Target
from ssad.scenarios.static.physical.lights.folder import LightFolder, LightSpec
from ssad.scenarios.static.physical.textures.carrier import covered
from ssad.scenarios.static.physical.textures.folder import TextureFolder
from ssad.scenarios.static.physical.textures.printing import conspicuousness


@dataclass(frozen=True, slots=True)
class TargetAttacks:
    """What a target wears and what shines on it, in the recordings of a folder.

    Attributes:
        folder: Recordings are in data, textures and lights beside it.
        target: As for `ssad record --target`; lights are for cars.
        seed: Root of the random numbers of trainings and searches.
        device: Where pictures are rendered and detectors are.
    """

    folder: Path
    target: str
    seed: int = 0
    device: str = "cpu"

    @property
    def textures(self) -> TextureFolder:
        """The textures that are kept."""
        return TextureFolder(self.folder / "textures", self.seed, self.device)

    @property
    def lights(self) -> LightFolder:
        """The lights that are kept."""
        return LightFolder(self.folder / "lights", self.seed, self.device)

    def detector(self, name: str) -> Detector:
        """A detector where it is needed."""
        return _detector(name, self.device)

    def clips(self, recording: str, count: int, detector: str) -> TargetClips:
        """The first pictures of a recording as they are, or with a target that waits for a texture."""
        made = self.detector(detector)
        folder = self.folder / "data" / recording
        return TargetClips(folder, count, tuple(made.classes), self.device, whole=made.task == "3d")

    def texture(self, spec: TextureSpec) -> Tensor:
        """A texture [3, H, W], sRGB; trained now if it has to be. ConfigError as for `TextureFolder.texture`."""
        surface = surface_of(self.target, spec.surface)

        def views() -> list[View]:
            clips = [self.clips(spec.pair["train"], spec.pair["train_images"], spec.source)]
            if spec.around:
                clips.append(self.clips(f"{spec.pair['train']}-around", spec.around, spec.source))
            return [view for one in clips for _, view in one.wearing(surface, solid=one.whole)]

        paint = paint_under(self.target, spec.surface)
        return self.textures.texture(
            spec, surface, views=views, detector=lambda: self.detector(spec.source), paint=paint
        )

    def worn(self, clips: TargetClips, spec: TextureSpec) -> Iterator[tuple[str, Tensor, Truth]]:
        """Drive, picture and truth of clips under a texture."""
        colour = albedo_of(self.texture(spec)).to(self.device)  # may be trained now, so gradients are on
        left = clips.wearing(surface_of(self.target, spec.surface))
        while own := list(islice(left, 1 if self.device == "cpu" else TOGETHER)):
            pictures = [view.picture for _, view in own]
            with torch.no_grad():
                images = pictures[0].together(pictures, {0: colour.expand(len(own), *colour.shape)})
            for (drive, view), image in zip(own, torch.split(images, 1), strict=True):
                yield drive, image, view.truth

    def about(self, spec: TextureSpec) -> dict[str, Any]:
        """What records say of a texture: its picture, how far its colours are from the paint, how it was trained."""
        artefacts = {"texture": str(self.textures.picture(spec).relative_to(self.folder))}
        mask = torch.from_numpy(surface_of(self.target, spec.surface).mask.copy())
        albedo = albedo_of(self.texture(spec).detach())
        away = conspicuousness(albedo, paint_under(self.target, spec.surface), mask)
        return {"artefacts": artefacts, "delta_e": round(float(away), 2), **self.textures.history(spec)}

    def light(self, spec: LightSpec) -> SceneEdit:
        """A light as an edit of a scene; searched now if it has to be. ConfigError as for `LightFolder.edit`."""
        car = parse_target(self.target)
        assert isinstance(car, TargetCar)

        def pictures() -> LitPictures:
            return LitPictures.of(self.clips(spec.pair["train"], spec.pair["train_images"], spec.source), spec.hour)

        def projected(edit: SceneEdit) -> list[View]:
            size = edit.textures[0].shape[1], edit.textures[0].shape[2]
            own = pictures()
            return [
                View(clip.projected(edit).prepare({0: size}, device=self.device), own.truth(clip))
                for clip in own.clips()
            ]

        def views() -> list[LitView]:
            own = pictures()
            return [LitView(clip.lit(self.device), own.truth(clip)) for clip in own.clips()]

        return self.lights.edit(
            spec,
            Target(*car.full_size),
            views=views,
            projected=projected,
            detector=lambda: self.detector(spec.source),
        )

    def under(self, pictures: LitPictures, spec: LightSpec) -> Iterator[tuple[str, Tensor, Truth]]:
        """Drive, picture and truth of pictures under a light."""
        return pictures.under(self.light(spec))

    def about_light(self, spec: LightSpec) -> dict[str, Any]:
        """What records say of a light: where it is, and how it was searched."""
        path = self.lights.picture(spec)
        artefacts = {"light": str((path if path.is_file() else self.lights.kept(spec)).relative_to(self.folder))}
        return {"artefacts": artefacts, **self.lights.history(spec)}

    def sheet(
        self,
        detector: str,
        clips: TargetClips,
        *,
        textures: Mapping[str, TextureSpec],
        sides: Sequence[float | None],
        clean: str,
    ) -> U8:
        """Views under textures below each other.

        Args:
            detector: Whose boxes are drawn.
            clips: Of the recording.
            textures: By title.
            sides: One view from each (azimuth in degrees); None: the first view.
            clean: Title of the pictures as they were recorded.
        """
        made = self.detector(detector)
        everything = replace(clips, count=len(replace(clips, count=1 << 30).rows()))
        rows = everything.rows()
        numbers = [k for side in sides for k in _from(rows, side)] or [0]

        def chosen(pictures: Iterator[tuple[str, Tensor, Truth]]) -> list[tuple[str, Tensor, Truth]]:
            return [one for k, one in enumerate(islice(pictures, max(numbers) + 1)) if k in numbers]

        worn = {title: chosen(self.worn(everything, spec)) for title, spec in textures.items()}
        sheets = []
        for k, (_, image, truth) in enumerate(chosen(everything.clean())):
            shown = [(clean, image), *((title, views[k][1]) for title, views in worn.items())]
            columns = min(len(shown), COLUMNS)
            sheets.append(target_sheet(made, shown, truth, self.device, columns))
        return np.concatenate(sheets)

    def light_sheet(self, detector: str, recording: str, lights: Mapping[str, tuple[str, LightSpec | None]]) -> U8:
        """The first picture of a recording under lights: by title the hour and the light (None: none)."""
        made, shown = self.detector(detector), []
        for title, (hour, spec) in lights.items():
            own = LitPictures.of(self.clips(recording, 1, detector), hour)
            ((_, image, truth),) = own.clean() if spec is None else self.under(own, spec)
            shown.append((title, image))
        return target_sheet(made, shown, truth, self.device)


def see_surfaces(task: tuple[Path, int, str, Sequence[str], str]) -> None:
    """In a worker: render what the pictures of a part of a recording see of carriers, and keep it.

    Args:
        task: Folder of the recording, number of the part, target, `TextureSpec.surface` of each, device.
    """
    folder, part, target, surfaces, device = task
    quiet_warp()
    see_clips(folder, layers_of(target, surfaces), part=part, device=device)


def see_all(
    recordings: Sequence[Clips],
    target: str,
    surfaces: Sequence[str],
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> None:
    """Render once what the pictures of recordings see of carriers, all parts side by side; what is kept stays.

    Raises:
        StoreError: Some parts failed.
    """
    tasks = [
        (clips.out, part, target, surfaces, clips.device)
        for clips in recordings
        if surfaces
        for part in unseen_parts(clips.out, layers_of(target, surfaces))
    ]
    if tasks:
        pool = open_pool(len(tasks), workers=workers, ray=ray, device=recordings[0].device)
        run_all(pool, see_surfaces, tasks, progress=progress)


def layers_of(target: str, surfaces: Sequence[str]) -> list[tuple[Layer | Decal, ...]]:
    """Where textures go, each alone, as `see_clips` takes them."""
    return [(surface_of(target, surface).layer,) for surface in surfaces]


@lru_cache(maxsize=4)
def _detector(name: str, device: str) -> Detector:
    """A detector, kept: trainings and tests leave it as it is."""
    made: Detector = make_detector(name, device=device)
    return made


@lru_cache(maxsize=16)
def surface_of(target: str, surface: str) -> Surface:
    """Where a texture goes, from a target and `TextureSpec.surface`."""
    row = safeio.parse_json(surface)
    return make_carrier(row["carrier"], row["options"]).on(parse_target(target).mesh())


@lru_cache(maxsize=16)
def paint_under(target: str, surface: str) -> Tensor:
    """What a texture covers, linear RGB [3], from a target and `TextureSpec.surface`."""
    made = parse_target(target)
    return covered(surface_of(target, surface), made.mesh(), made.colour)


def _from(rows: Sequence[Mapping[str, Any]], side: float | None) -> list[int]:
    """The number of the first view from a side at some 10 m, by day; of any view where no side is wanted."""
    if side is None:
        return [0]
    near = sorted({abs(float(row["distance"]) - 10.0) for row in rows})[0]
    own = [
        k
        for k, row in enumerate(rows)
        if float(row["azimuth"]) == side and abs(float(row["distance"]) - 10.0) == near and row["weather"] != "night"
    ]
    return own[:1]

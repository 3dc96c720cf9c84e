"""Recorded images at another hour, with lamps and shadows on their target: as functions of light, and in full."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Self

import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.images import decode_image, encode_jpeg
from ssad.core.protocols import Detector
from ssad.core.types import U8
from ssad.experiments.perception.physical.target_views import RecordedTargetImages, drive_of, target_truth
from ssad.experiments.perception.physical.textured_images import BLOCK, TexturableImage, parse_part, visible_part
from ssad.recorders.target_images import TARGET, RecordedView, image_rows, recorded_views
from ssad.rendering.camera.glare import with_lens_effects
from ssad.rendering.camera.render import SceneWeather, render
from ssad.rendering.camera.scene import RenderScene
from ssad.rendering.camera.scene_edit import NO_EDIT, SceneEdit, render_with
from ssad.rendering.hours import at_hour
from ssad.scenarios.static.physical.lights.light import TargetSize
from ssad.scenarios.static.physical.lights.lit_image import BLIND, LitImage, render_lit_image

QUALITY: Final = 92  # of JPEG, as it is recorded
ROOM: Final = 24  # px around the target that light on it can change, beyond half its box


@dataclass(frozen=True, slots=True)
class RelightableImage:
    """A recorded image at an hour.

    Attributes:
        view: The image.
        scene: Its street and bodies, and `BLIND`.
        cards: Index of `BLIND` in the scene.
    """

    view: RecordedView
    scene: RenderScene
    cards: int

    @property
    def target(self) -> TargetSize:
        """Size of the target."""
        length, width, height = self.view.row["target_size"]
        return TargetSize(length, width, height)

    def render(self, edit: SceneEdit = NO_EDIT) -> U8:
        """Return the image [H, W, 3] with an edit, as the recorder would have written it."""
        scene, first_card = self.scene, self.cards + 1
        if edit.cards:
            key = ("cards", *((card.away, card.outline.tobytes()) for card in edit.cards))
            scene = self.scene.compute_once(
                key,
                lambda: RenderScene(self.scene.street, [*self.scene.meshes, *edit.meshes()], device=self.scene.device),
            )
        view = edit.on(self.view.view, TARGET, cards=range(first_card, first_card + len(edit.cards)))
        rendering = render_with(scene, [view], edit.textures, edit.masks, quality=self.view.quality)
        # Detectors see recordings through JPEG, so edited images must pass through it as well.
        return decode_image(encode_jpeg(rendering.image[0], QUALITY, "420"))

    def projected(self, edit: SceneEdit) -> TexturableImage:
        """The picture as a function of what the lamps of an edit project; it can be prepared and shown as any other."""
        view = edit.on(self.view.view, TARGET)
        rendering = render(self.scene, [view], quality=self.view.quality)
        sensor = with_lens_effects(view.sensor, rendering.effects)
        image = decode_image(encode_jpeg(rendering.image[0], QUALITY, "420"))
        return TexturableImage(
            self.view.file,
            self.view.row,
            self.view.objects,
            image,
            sensor=sensor,
            **parse_part(visible_part(rendering, view)),
        )

    def lit(self, device: str | torch.device = "cpu") -> LitImage:
        """Return the image as a function of the light on its target."""
        rows, columns = _part(self.view)
        return render_lit_image(
            self.scene,
            self.view.view,
            TARGET,
            rows,
            columns,
            blind=self.cards,
            quality=self.view.quality,
            device=device,
        )


def _part(view: RecordedView) -> tuple[slice, slice]:
    """The rows and columns around the target that light on it can change: its box, and half as much to each side."""
    (x, y, box_width, box_height) = next(annotation["bbox"] for annotation in view.objects if annotation["target"])
    height, width = view.view.camera.height, view.view.camera.width
    half_extent = max(box_width, box_height) / 2 + ROOM
    slices = []
    for start, extent, limit in ((y, box_height, height), (x, box_width, width)):
        first_pixel = max(int(start - half_extent), 0) // BLOCK * BLOCK
        slices.append(slice(first_pixel, min(int(start + extent + half_extent) + 1, limit) // 2 * 2))
    return slices[0], slices[1]


def relightable_images(
    folder: Path,
    hour: str,
    *,
    device: str = "cpu",
    count: int | None = None,
    split: str = "all",
    stages: dict[Any, Any] | None = None,
) -> Iterator[RelightableImage]:
    """The pictures of a recording at an hour, in order.

    Args:
        folder: What `record_target_images` wrote.
        hour: See `HOURS`.
        device: Where to render.
        count: How many; None for all.
        split: train, test or all.
        stages: See `recorded_views`.

    Raises:
        FormatError: No recording of this version.
        UnknownNameError: There is no such hour.
    """
    # Reject an unknown hour before any scene is built.
    at_hour(SceneWeather(), hour)
    file_names = {row["file_name"] for row, _ in image_rows(folder, split)[:count]}
    scene_pair: tuple[RenderScene, RenderScene] | None = None
    for recorded in recorded_views(
        folder,
        split=split,
        device=device,
        selected_keys=file_names,
        hour=lambda weather, heading: at_hour(weather, hour, heading),
        stages=stages,
    ):
        # Images of one drive share a scene, so the extended copy is built once per drive.
        if scene_pair is None or scene_pair[0] is not recorded.scene:
            scene_pair = (
                recorded.scene,
                RenderScene(recorded.scene.street, [*recorded.scene.meshes, BLIND.mesh()], device=device),
            )
        yield RelightableImage(recorded, scene_pair[1], len(recorded.scene.meshes))


@lru_cache(maxsize=4)
def _cached_images(folder: Path, hour: str, count: int, device: str) -> tuple[RelightableImage, ...]:
    return tuple(relightable_images(folder, hour, count=count, device=device, stages=_stages(folder, device)))


@lru_cache(maxsize=2)
def _stages(folder: Path, device: str) -> dict[Any, Any]:
    """Return the cache of the scenes of a recording, which are the same at all hours."""
    return {}


@dataclass(frozen=True, slots=True)
class RelightableTargetImages(RecordedTargetImages):
    """Recorded images of a target that can wear textures, and be shown at another hour in any light.

    It is the `TargetImages` of `ssad.scenarios.static.perturbation`.

    Attributes:
        hour: Hour of the clean images (see `HOURS`); None: as they were recorded.
    """

    hour: str | None = None

    @classmethod
    def of(cls, folder: Path, count: int, detector: Detector, device: str, *, hour: str | None = None) -> Self:
        """Return the first images of a recording for a detector."""
        return cls(folder, count, tuple(detector.classes), device, detector.task == "3d", hour)

    def clean(self) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image [1, 3, H, W] in 0 to 1 and truth, at the hour of the images.

        Raises:
            FormatError: The folder holds no recording of this version.
        """
        return RecordedTargetImages.clean(self) if self.hour is None else self.lit(self.hour, NO_EDIT)

    def lit(self, hour: str, edit: SceneEdit) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image [1, 3, H, W] in 0 to 1 and truth, at an hour and with an edit around the target.

        Raises:
            FormatError: The folder holds no recording of this version.
            UnknownNameError: There is no such hour.
        """
        for lit_image in self.images_at(hour):
            tensor = torch.from_numpy(lit_image.render(edit)).to(self.device).permute(2, 0, 1)[None].float() / 255
            yield drive_of(lit_image.view.row), tensor, self.lit_truth(lit_image)

    def images_at(self, hour: str) -> tuple[RelightableImage, ...]:
        """Return the images at an hour; they are kept, since scenes take longer to make than images.

        Raises:
            FormatError, UnknownNameError: See `lit`.
        """
        return _cached_images(self.folder, hour, self.count, self.device)

    def lit_truth(self, image: RelightableImage) -> Truth:
        """Return the truth of an image at an hour."""
        return target_truth(image.view.row, image.view.objects, self.classes)

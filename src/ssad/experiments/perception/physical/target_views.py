"""Recorded images as input of detectors: clean, or with a target that is ready for a texture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core.boxes import camera_yaw
from ssad.core.detections import Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.images import read_image
from ssad.core.nuscenes_names import NO_ATTRIBUTE
from ssad.experiments.perception.physical.textured_images import texturable_images
from ssad.recorders.target_images import CLASSES, image_rows
from ssad.scenarios.static.physical import TextureSurface, TextureView


@dataclass(frozen=True, slots=True)
class RecordedTargetImages:
    """The first images of a recording, for a detector.

    Attributes:
        folder: Folder that `record_target_images` wrote.
        count: Number of images.
        classes: Names of the detector's classes, in its order.
        device: Device that renders and shows them.
        whole: Whether true boxes surround the whole 3D boxes, as 3D detectors give them, and not the visible parts.
    """

    folder: Path
    count: int
    classes: tuple[str, ...] = CLASSES
    device: str = "cpu"
    whole: bool = False

    def rows(self) -> list[Mapping[str, Any]]:
        """Return the annotation entry of each image.

        Raises:
            FormatError: The folder holds no recording of this version.
        """
        return [row for row, _ in image_rows(self.folder)[: self.count]]

    def clean(self) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image [1, 3, H, W] in 0 to 1 and truth, as recorded.

        Raises:
            FormatError: See `rows`.
        """
        for row, objects in image_rows(self.folder)[: self.count]:
            tensor = torch.tensor(read_image(self.folder / "images" / row["file_name"])).to(self.device)
            yield (
                drive_of(row),
                tensor.permute(2, 0, 1)[None].float() / 255,
                target_truth(row, objects, self.classes, whole=self.whole),
            )

    def wearing(
        self, surface: TextureSurface, *, solid: bool = False, glow: bool = True
    ) -> Iterator[tuple[str, TextureView]]:
        """Yield drive and image with a target that is ready for a texture, one after another.

        Args:
            surface: Surface of the texture on the target.
            solid: Whether the truth is the target alone, with its 3D box, as a training against a 3D detector
                needs.
            glow: See `TexturableImage.prepare`; trainings do without.

        Raises:
            FormatError: The folder holds no recording of this version.
            ConfigError: None of the images shows any of the texture; raised after the last.
        """
        is_visible = False
        for textured in islice(texturable_images(self.folder, (surface.layer,), device=self.device), self.count):
            prepared = textured.prepare({0: surface.size}, masks={0: surface.mask}, glow=glow, device=self.device)
            is_visible |= bool(len(prepared.taps[0].pixel))
            truth = target_truth(textured.row, textured.objects, self.classes, whole=self.whole)
            yield drive_of(textured.row), TextureView(prepared, solid_target(textured.row, truth) if solid else truth)
        if not is_visible:
            raise ConfigError(
                f"the texture is never in view in the {self.count} pictures of {self.folder.name}; choose a panel that "
                "the camera sees, or another camera"
            )


def target_truth(
    row: Mapping[str, Any], objects: Sequence[Mapping[str, Any]], classes: Sequence[str], *, whole: bool = False
) -> Truth:
    """What is annotated in a picture, the target first, in a detector's classes; what it does not know is left out.

    Args:
        row: Of the picture.
        objects: What is in it.
        classes: Names of the detector's classes.
        whole: See `RecordedTargetImages`.

    Raises:
        ConfigError: The detector does not know the target's class.
    """
    ordered = sorted(objects, key=lambda entry: not entry["target"])
    names = [CLASSES[int(entry["category_id"]) - 1] for entry in ordered]
    if names[0] not in classes:
        raise ConfigError(f"a detector without a class {names[0]} cannot find the target")
    known_rows = [row_index for row_index, name in enumerate(names) if name in classes]
    x, y, width, height = np.array(
        [ordered[row_index]["hull" if whole else "bbox"] for row_index in known_rows], np.float64
    ).T
    return Truth(
        torch.tensor([list(classes).index(names[row_index]) for row_index in known_rows]),
        torch.from_numpy(np.stack([x, y, x + width, y + height], 1)).float(),
        intrinsic=torch.tensor(row["intrinsic"], dtype=torch.float32),
        crowd=torch.tensor([bool(ordered[row_index]["iscrowd"]) for row_index in known_rows]),
    )


def solid_target(row: Mapping[str, Any], truth: Truth) -> Truth:
    """Return the target of an image alone, with its 3D box; velocity and attribute are unknown.

    Args:
        row: Annotation entry of the image: poses of camera (x right, y down, z forward) and target in the world,
            its size, m.
        truth: Truth of the image from `target_truth`.

    Returns:
        One object; its box is in the camera's frame, m and rad, centred at the middle of its height.
    """
    target_to_camera = np.linalg.inv(np.array(row["pose"])) @ np.array(row["target_pose"])
    length, width, height = row["target_size"]
    centre = (
        target_to_camera[:3, 3] + 0.5 * height * target_to_camera[:3, 2]
    )  # a pose is that of the middle of the bottom
    solid = Solids(
        torch.tensor(centre[None], dtype=torch.float32),
        torch.tensor([[length, height, width]], dtype=torch.float32),
        torch.tensor(camera_yaw(target_to_camera[None, :3, 0]), dtype=torch.float32),
        torch.full((1, 2), torch.nan),
        torch.tensor([NO_ATTRIBUTE]),
    )
    return Truth(truth.label[:1], truth.box[:1], solid, truth.intrinsic)


def drive_of(row: Mapping[str, Any]) -> str:
    """Return the name of the drive of an image."""
    return f"{row['part']}/{row['attempt']}"

"""Recorded clips as detectors are shown them: clean, or with a target that waits for a texture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.images import read_image
from ssad.recording.clip_recorder import clip_rows
from ssad.recording.textured_clips import textured_clips
from ssad.scenarios.static.physical import Surface, View


def target_views(folder: Path, surface: Surface, count: int, *, device: str = "cpu") -> list[tuple[str, View]]:
    """Pictures of a recording whose target wears a surface, each with the name of its drive.

    Args:
        folder: What `record_clips` wrote.
        surface: What the target wears.
        count: Number of pictures, from the first.
        device: Where they are rendered and shown.

    Raises:
        FormatError: No recording of this version.
    """
    found = []
    for clip in islice(textured_clips(folder, (surface.layer,), device=device), count):
        wearing = clip.prepare({0: surface.size}, masks={0: surface.mask}, device=device)
        found.append((_drive(clip.row), View(wearing, target_truth(clip.objects))))
    return found


def clean_images(folder: Path, count: int, *, device: str = "cpu") -> Iterator[tuple[str, Tensor, Truth]]:
    """Drive, picture [1, 3, H, W] in 0 to 1 and truth of the first pictures of a recording, as they were recorded."""
    for row, objects in clip_rows(folder)[:count]:
        image = torch.tensor(read_image(folder / "images" / row["file_name"])).to(device)
        yield _drive(row), image.permute(2, 0, 1)[None].float() / 255, target_truth(objects)


def target_truth(objects: Sequence[Mapping[str, Any]]) -> Truth:
    """What is annotated in a picture, the target first."""
    ordered = sorted(objects, key=lambda one: not one["target"])
    x, y, width, height = np.array([one["bbox"] for one in ordered], np.float64).T
    return Truth(
        torch.tensor([int(one["category_id"]) - 1 for one in ordered]),
        torch.from_numpy(np.stack([x, y, x + width, y + height], 1)).float(),
        crowd=torch.tensor([bool(one["iscrowd"]) for one in ordered]),
    )


def _drive(row: Mapping[str, Any]) -> str:
    """Name of the drive that a picture is of."""
    return f"{row['part']}/{row['attempt']}"

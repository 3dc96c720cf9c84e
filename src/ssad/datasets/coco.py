"""COCO annotations of a folder of pictures: written in a fixed order, read with checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.core.types import F64, I32, Bool

LARGEST: Final = 1 << 30  # bytes of an annotation file


@dataclass(frozen=True, slots=True)
class CocoImage:
    """One picture with its N boxes.

    Attributes:
        file: The picture.
        width: Pixels.
        height: Pixels.
        about: Everything else that the file says about the picture.
        box: x1, y1, x2, y2 in pixels [N, 4].
        label: Index into the set's classes [N].
        crowd: Boxes that count neither as found nor as missed [N].
        target: Boxes of the object that the set is about [N].
    """

    file: Path
    width: int
    height: int
    about: Mapping[str, Any]
    box: F64
    label: I32
    crowd: Bool
    target: Bool


@dataclass(frozen=True, slots=True)
class CocoSet:
    """Pictures of an annotation file and the names of its classes, in the order of their ids."""

    classes: tuple[str, ...]
    images: tuple[CocoImage, ...]


def coco_data(classes: Sequence[str], images: Sequence[Mapping[str, Any]], about: Mapping[str, Any]) -> dict[str, Any]:
    """The content of an annotation file.

    Args:
        classes: Names, in the order of the labels.
        images: For each image file_name, width, height, anything else, and `objects`, each with label (index), box
            (x1, y1, x2, y2), pixels (area), crowd and anything else.
        about: The `info` of the file.

    Returns:
        What is to be written as JSON; ids start at 1.
    """
    rows: list[dict[str, Any]] = []
    boxes: list[dict[str, Any]] = []
    for number, image in enumerate(images, 1):
        rows.append({"id": number} | {k: v for k, v in image.items() if k != "objects"})
        for thing in image["objects"]:
            x1, y1, x2, y2 = thing["box"]
            extra = {k: v for k, v in thing.items() if k not in ("label", "box", "pixels", "crowd")}
            boxes.append(
                {
                    "id": len(boxes) + 1,
                    "image_id": number,
                    "category_id": thing["label"] + 1,
                    "bbox": [x1, y1, x2 - x1, y2 - y1],
                    "area": thing["pixels"],
                    "iscrowd": int(thing["crowd"]),
                }
                | extra
            )
    kinds = [{"id": k + 1, "name": name, "supercategory": "road"} for k, name in enumerate(classes)]
    return {"info": dict(about), "images": rows, "annotations": boxes, "categories": kinds}


def read_coco(path: Path, *, images: Path | None = None) -> CocoSet:
    """Read an annotation file.

    Args:
        path: The file.
        images: Folder of the pictures; by default `images` beside the file's folder if there is one, else the file's
            own folder.

    Returns:
        The pictures with their boxes.

    Raises:
        FormatError: Something is missing, malformed, or refers to an image or category that does not exist.
    """
    data = safeio.read_json(path, limit=LARGEST)
    lists = ("images", "annotations", "categories")
    if not isinstance(data, dict) or any(not isinstance(data.get(k), list) for k in lists):
        raise FormatError(f"{path}: no COCO annotations (lists `images`, `annotations` and `categories`)")
    beside = path.parent.parent / "images"
    folder = images or (beside if beside.is_dir() else path.parent)
    try:
        names = {int(c["id"]): str(c["name"]) for c in data["categories"]}
        own: dict[int, list[Mapping[str, Any]]] = {int(row["id"]): [] for row in data["images"]}
        if len(names) < len(data["categories"]) or len(own) < len(data["images"]):
            raise FormatError(f"{path}: two images or two categories of one id")
        for n, row in enumerate(data["annotations"]):
            if row["image_id"] not in own or row["category_id"] not in names:
                raise FormatError(f"{path}: annotation {n} belongs to no image or category of the file")
            own[row["image_id"]].append(row)
        label_of = {number: k for k, number in enumerate(sorted(names))}
        pictures = tuple(_image(row, own[int(row["id"])], label_of, folder) for row in data["images"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path}: broken COCO annotations ({type(error).__name__}: {error})") from None
    return CocoSet(tuple(names[number] for number in sorted(names)), pictures)


def _image(
    row: Mapping[str, Any], own: Sequence[Mapping[str, Any]], label_of: Mapping[int, int], folder: Path
) -> CocoImage:
    """One picture with its annotations. ValueError, KeyError or TypeError: broken."""
    what, file = f"image {row['id']}", str(row["file_name"])
    width, height = int(row["width"]), int(row["height"])
    if width < 1 or height < 1:
        raise ValueError(f"{what}: {width} x {height} pixels")
    if Path(file).is_absolute() or ".." in Path(file).parts or not file:
        raise ValueError(f"{what}: file name '{file}' points out of the folder of images")
    box = np.zeros((len(own), 4))
    for n, thing in enumerate(own):
        if not isinstance(thing["bbox"], list) or len(thing["bbox"]) != 4:
            raise ValueError(f"{what}: a bbox that is no list of four numbers")
        x, y, w, h = (float(v) for v in thing["bbox"])
        box[n] = x, y, x + w, y + h
    if not np.isfinite(box).all() or (box[:, 2:] <= box[:, :2]).any():
        raise ValueError(f"{what}: a box without width or height, or not finite")
    about = {k: v for k, v in row.items() if k not in ("id", "file_name", "width", "height")}
    return CocoImage(
        folder / file,
        width,
        height,
        about,
        box,
        np.array([label_of[r["category_id"]] for r in own], np.int32),
        np.array([bool(r.get("iscrowd", 0)) for r in own], bool),
        np.array([bool(r.get("target", False)) for r in own], bool),
    )

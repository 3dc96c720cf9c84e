"""COCO annotations of a folder of pictures: written in a fixed order, read with checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.core.folders import data_path
from ssad.core.import_report import ImportReport
from ssad.core.types import F64, I32, Bool
from ssad.core.wording import counted

MAX_FILE_BYTES: Final = 1 << 30  # size limit of an annotation file


@dataclass(frozen=True, slots=True)
class CocoImage:
    """One picture with its N boxes.

    Attributes:
        file: Path of the picture.
        width: Width in pixels.
        height: Height in pixels.
        metadata: All further keys of the picture in the file.
        box: x1, y1, x2, y2 in pixels [N, 4].
        label: Index into the set's classes [N].
        crowd: Boxes that count neither as detected nor as missed [N].
        target: Boxes of the object that the set is about [N].
    """

    file: Path
    width: int
    height: int
    metadata: Mapping[str, Any]
    box: F64
    label: I32
    crowd: Bool
    target: Bool


@dataclass(frozen=True, slots=True)
class CocoSet:
    """Pictures of an annotation file and the names of its classes, in the order of their ids."""

    classes: tuple[str, ...]
    images: tuple[CocoImage, ...]


def coco_data(
    classes: Sequence[str], images: Sequence[Mapping[str, Any]], metadata: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of an annotation file.

    Args:
        classes: Names, in the order of the labels.
        images: For each image file_name, width, height, anything else, and `objects`, each with label (index), box
            (x1, y1, x2, y2), pixels (area), crowd and anything else.
        metadata: The `info` of the file.

    Returns:
        What is to be written as JSON; ids start at 1.
    """
    image_rows: list[dict[str, Any]] = []
    annotation_rows: list[dict[str, Any]] = []
    for number, image in enumerate(images, 1):
        image_rows.append({"id": number} | {key: value for key, value in image.items() if key != "objects"})
        for scene_object in image["objects"]:
            x1, y1, x2, y2 = scene_object["box"]
            extra = {
                key: value for key, value in scene_object.items() if key not in ("label", "box", "pixels", "crowd")
            }
            annotation_rows.append(
                {
                    "id": len(annotation_rows) + 1,
                    "image_id": number,
                    "category_id": scene_object["label"] + 1,
                    "bbox": [x1, y1, x2 - x1, y2 - y1],
                    "area": scene_object["pixels"],
                    "iscrowd": int(scene_object["crowd"]),
                }
                | extra
            )
    categories = [{"id": key + 1, "name": name, "supercategory": "road"} for key, name in enumerate(classes)]
    return {"info": dict(metadata), "images": image_rows, "annotations": annotation_rows, "categories": categories}


def read_coco(path: Path, *, images: Path | None = None, report: ImportReport | None = None) -> CocoSet:
    """Read an annotation file.

    Args:
        path: The file.
        images: Folder of the pictures; by default `images` beside the file's folder if it exists, else the
            file's own folder.
        report: Filled with what came in, what is not read, and what is doubtful: annotations of no image or category,
            and boxes without width or height, as COCO's own files have them, which are left out; None: they raise.

    Returns:
        The pictures with their boxes.

    Raises:
        FormatError: A part is missing, malformed, or refers to an image or category that does not exist.
        StoreError: A picture leads out of the folder (`ssad.core.folders.data_path`).
    """
    content = safeio.read_json(path, limit=MAX_FILE_BYTES)
    required_lists = ("images", "annotations", "categories")
    if not isinstance(content, dict) or any(not isinstance(content.get(key), list) for key in required_lists):
        raise FormatError(f"{path}: no COCO annotations (lists `images`, `annotations` and `categories`)")
    default_folder = path.parent.parent / "images"
    if images is None and default_folder.is_dir():
        data_path(path.parent.parent, "images")
        images = default_folder
    folder = images or path.parent
    try:
        class_names = {int(category["id"]): str(category["name"]) for category in content["categories"]}
        annotations_by_image: dict[int, list[Mapping[str, Any]]] = {
            int(record["id"]): [] for record in content["images"]
        }
        if len(class_names) < len(content["categories"]) or len(annotations_by_image) < len(content["images"]):
            raise FormatError(f"{path}: two images or two categories of one id")
        for index, record in enumerate(content["annotations"]):
            if record["image_id"] not in annotations_by_image or record["category_id"] not in class_names:
                if report is None:
                    raise FormatError(f"{path}: annotation {index} belongs to no image or category of the file")
                report.doubt("annotations of no image or category are left out", f"annotation {index}")
            elif report is not None and _is_empty(record):
                report.doubt("boxes without width or height are left out", f"annotation {index}")
            else:
                annotations_by_image[record["image_id"]].append(record)
        # COCO ids may have gaps; labels count from 0 in the order of the ids.
        label_by_category = {category_id: key for key, category_id in enumerate(sorted(class_names))}
        pictures = tuple(
            _parse_image(record, annotations_by_image[int(record["id"])], label_by_category, folder)
            for record in content["images"]
        )
        _check_links(folder, pictures)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path}: broken COCO annotations ({type(error).__name__}: {error})") from None
    if report is not None:
        box_count = sum(len(picture.box) for picture in pictures)
        report.contents.append(
            f"{counted(len(pictures), 'picture')} with {counted(box_count, 'box')} of "
            f"{counted(len(class_names), 'class')}"
        )
        for key in ("segmentation", "keypoints", "caption"):
            if count := sum(bool(record.get(key)) for record in content["annotations"]):
                report.omit(f"{key} of annotations", count=count)
    return CocoSet(tuple(class_names[category_id] for category_id in sorted(class_names)), pictures)


def _is_empty(annotation: Mapping[str, Any]) -> bool:
    """Return whether the box of an annotation, as far as it is one, has no width or no height."""
    box = annotation["bbox"]
    return isinstance(box, list) and len(box) == 4 and min(float(box[2]), float(box[3])) <= 0.0


def _check_links(folder: Path, pictures: Sequence[CocoImage]) -> None:
    """Raise StoreError if a picture, or a folder of pictures, leads out of their folder."""
    for parent in {picture.file.parent for picture in pictures} - {folder}:
        data_path(folder, parent.relative_to(folder))
    for picture in pictures:
        if picture.file.is_symlink():
            data_path(folder, picture.file.relative_to(folder))


def _parse_image(
    row: Mapping[str, Any], image_annotations: Sequence[Mapping[str, Any]], label_of: Mapping[int, int], folder: Path
) -> CocoImage:
    """One picture with its annotations. ValueError, KeyError or TypeError: broken."""
    image_name, file_name = f"image {row['id']}", str(row["file_name"])
    width, height = int(row["width"]), int(row["height"])
    if width < 1 or height < 1:
        raise ValueError(f"{image_name}: {width} x {height} pixels")
    if Path(file_name).is_absolute() or ".." in Path(file_name).parts or not file_name:
        raise ValueError(f"{image_name}: file name '{file_name}' points out of the folder of images")
    box = np.zeros((len(image_annotations), 4))
    for index, annotation in enumerate(image_annotations):
        if not isinstance(annotation["bbox"], list) or len(annotation["bbox"]) != 4:
            raise ValueError(f"{image_name}: a bbox that is no list of four numbers")
        x, y, box_width, box_height = (float(value) for value in annotation["bbox"])
        box[index] = x, y, x + box_width, y + box_height
    if not np.isfinite(box).all() or (box[:, 2:] <= box[:, :2]).any():
        raise ValueError(f"{image_name}: a box without width or height, or not finite")
    extra = {key: value for key, value in row.items() if key not in ("id", "file_name", "width", "height")}
    return CocoImage(
        folder / file_name,
        width,
        height,
        extra,
        box,
        np.array([label_of[entry["category_id"]] for entry in image_annotations], np.int32),
        np.array([bool(entry.get("iscrowd", 0)) for entry in image_annotations], bool),
        np.array([bool(entry.get("target", False)) for entry in image_annotations], bool),
    )

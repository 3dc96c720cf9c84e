"""`ssad show` on pictures that are no data set of the nuScenes schema: a page with each of them, upright and whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import jinja2
import numpy as np

from ssad.core.errors import SSADError
from ssad.core.image_files import GREY_NOTE, read_image_file
from ssad.core.images import save_picture
from ssad.core.safeio import make_folder, write_atomic
from ssad.core.types import U8
from ssad.core.wording import counted
from ssad.datasets.browse import GROUND, STYLE, VIEW_RANGE, VIEW_SIZE, WIDTH, draw_points
from ssad.datasets.picture_folders import FolderFile, list_folder
from ssad.datasets.point_files import read_point_file

MAX_FILES: Final = 200  # on a page
LIDAR_HEIGHT: Final = 1.75  # m above the road: about that of KITTI and nuScenes

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ name }}</title><style>{{ style }}</style></head><body>
<h1>{{ name }}</h1>
<p>{{ total }} pictures and point clouds, of which {{ figures|length }} are shown. Pictures are upright by their EXIF
orientation. Points are seen from above, {{ reach }} m to each side, x upwards, coloured by their height.</p>
<div class="grid">{% for f in figures %}<figure>{% if f.file %}<img loading="lazy" src="pictures/{{ f.file }}" alt="{{ f.key }}" width="{{ f.size[0] }}" height="{{ f.size[1] }}">{% endif %}<figcaption>{{ f.key }}: {{ f.text }}</figcaption></figure>{% endfor %}</div>
</body></html>
"""  # noqa: E501


@dataclass(frozen=True, slots=True)
class PicturePage:
    """A written page.

    Attributes:
        path: Path of the page.
        shown: Number of pictures and point clouds on it.
        total: Number of those that there are.
        problems: A line for each that cannot be shown; it stands on the page too.
    """

    path: Path
    shown: int
    total: int
    problems: tuple[str, ...]


def pictures_of(source: Path) -> list[FolderFile]:
    """Return what `write_picture_page` shows: a picture, or the pictures and point clouds of a folder.

    Raises:
        StoreError: A folder cannot be read.
    """
    if source.is_file():
        return [file for file in list_folder(source.parent) if file.key == source.name] or [
            FolderFile(source.name, source, "image")
        ]
    return [file for file in list_folder(source) if file.kind in ("image", "points", "refused")]


def write_picture_page(
    name: str,
    files: Sequence[FolderFile],
    out: Path,
    *,
    progress: Callable[[int, int], None] = lambda completed, total: None,
) -> PicturePage:
    """Write OUT/index.html and its pictures.

    Args:
        name: Title of the page.
        files: Pictures and point clouds; of more than `MAX_FILES`, some are shown, spread evenly.
        out: Output folder.
        progress: Called with the number of finished files and of all.

    Raises:
        StoreError: A file cannot be written. An unreadable picture is named on the page instead.
    """
    make_folder(out / "pictures")
    indices = np.unique(np.linspace(0, len(files) - 1, min(MAX_FILES, len(files))).round().astype(int))
    figures, problems = [], []
    for index in indices.tolist():
        file = files[index]
        target = f"{index:06d}.jpg"
        try:
            image, text = _draw(file)
            save_picture(out / "pictures" / target, image)
            figures.append({"file": target, "key": file.key, "text": text, "size": image.shape[1::-1]})
        except SSADError as error:
            reason = str(error).removeprefix(f"{file.path}: ")
            problems.append(f"{file.key}: {reason}")
            figures.append({"file": "", "key": file.key, "text": reason, "size": (0, 0)})
        progress(len(figures), len(indices))
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    values: dict[str, Any] = {
        "name": name,
        "style": STYLE,
        "total": len(files),
        "figures": figures,
        "reach": f"{VIEW_RANGE:.0f}",
    }
    write_atomic(out / "index.html", environment.from_string(PAGE).render(**values))
    return PicturePage(out / "index.html", len(figures) - len(problems), len(files), tuple(problems))


def _draw(file: FolderFile) -> tuple[U8, str]:
    """Return a picture of a file and a text about it."""
    if file.kind == "refused":
        raise SSADError(file.target)
    if file.kind == "points":
        point_file = read_point_file(file.path, columns=file.point_columns)
        canvas: U8 = np.full((VIEW_SIZE, VIEW_SIZE, 3), GROUND, np.uint8)
        draw_points(canvas, point_file.points[:, :3].astype(np.float64), road_height=-LIDAR_HEIGHT)
        return canvas, f"{counted(len(point_file.points), 'point')}"
    image_file = read_image_file(file.path)
    image = image_file.rgb
    height, width = image.shape[:2]
    notes = [*image_file.notes, *([GREY_NOTE] if image_file.model == "grey" else [])]
    size = (WIDTH, max(round(height * WIDTH / width), 1))
    interpolation = cv2.INTER_AREA if width > WIDTH else cv2.INTER_LINEAR
    resized: U8 = np.asarray(cv2.resize(image, size, interpolation=interpolation))
    return resized, "; ".join([f"{width} x {height}", *notes])

"""Pictures of a run on photographs: boxes in the photographs, and cars with and without textures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ssad.core import safeio
from ssad.core.errors import SSADError
from ssad.core.images import add_caption, save_picture
from ssad.core.registry import label_of
from ssad.core.types import F64, U8
from ssad.datasets.photographs import Photograph
from ssad.detectors.drawing import FOUND, TRUE, write_beside
from ssad.engine.kind import Cell, Plan
from ssad.experiments.perception.reality.photograph_boxes import (
    ROAD_CLASSES,
    PhotographBoxes,
    boxes_file,
    cached_boxes,
)
from ssad.experiments.perception.reality.worn_textures import (
    TRAINED,
    WornCar,
    car_scores,
    drawn_colour,
    worn_images,
)
from ssad.scenarios.static.physical.textures.photographs import face_print

PHOTOGRAPHS_ON_SHEET: Final = 6
CARS_ON_SHEET: Final = 3
WIDTH, CAR_WIDTH, COLUMNS = 800, 320, 2
CROP_SIDE: Final = 2.5  # side of the part around a car, in longer sides of its box


def write_sheets(plan: Plan, folder: Path, photographs: Sequence[Photograph], cars: Sequence[WornCar]) -> None:
    """Write the pictures of all detectors and textures, and their captions, from the boxes of a results folder.

    Args:
        plan: The plan of the run.
        folder: The results folder.
        photographs: The photographs.
        cars: The cars that wear textures.
    """
    captions: dict[str, str] = {}
    for number, system in enumerate(plan.details):
        cells = [cell for cell in plan.cells if cell.system == system]
        clean_path = folder / cells[0].spec["clean_boxes"]
        if not clean_path.is_file():
            continue
        try:
            clean = cached_boxes(clean_path, _absent)
            path = folder / "pictures" / f"{number + 1}-photographs.jpg"
            save_picture(path, photograph_sheet(photographs, clean, plan.suite.score))
            captions[path.name] = (
                f"{label_of(system)} on photographs: boxes of at least {plan.suite.score:g} (orange) and annotated "
                "objects (white; grey: ignored)."
            )
            for position, texture in enumerate(plan.suite.textures):
                worn_cells = [cell for cell in cells if cell.spec["texture"] == texture]
                sheet = worn_sheet(worn_cells, folder, photographs, cars, clean)
                if sheet is not None:
                    path = folder / "pictures" / f"{number + 1}-{position + 1}-worn.jpg"
                    save_picture(path, sheet)
                    captions[path.name] = (
                        f"{worn_cells[0].fields['texture']} on cars in photographs, and its controls; the scores are "
                        f"those with which {label_of(system)} finds the car (0: not at all)."
                    )
        except SSADError:  # a photograph that cannot be read has failed its cells, which say so
            continue
    if captions:
        safeio.write_atomic(folder / "pictures" / "pictures.json", safeio.dump_json(captions, indent=1) + "\n")


def _absent() -> PhotographBoxes:
    raise AssertionError


def photograph_sheet(photographs: Sequence[Photograph], boxes: PhotographBoxes, score: float) -> U8:
    """Return the photographs with the most objects, with annotated objects and boxes drawn.

    Args:
        photographs: The photographs.
        boxes: Boxes in them.
        score: Least score of a box that is drawn.
    """
    by_objects = sorted(range(len(photographs)), key=lambda number: -int((~photographs[number].ignored).sum()))
    sheet_tiles = []
    for number in sorted(by_objects[:PHOTOGRAPHS_ON_SHEET]):
        photograph = photographs[number]
        photograph_image = photograph.read()
        scale = WIDTH / photograph_image.shape[1]
        canvas = cv2.resize(
            photograph_image, (WIDTH, round(scale * photograph_image.shape[0])), interpolation=cv2.INTER_AREA
        )
        for object_box, is_ignored in zip(photograph.box * scale, photograph.ignored.tolist(), strict=True):
            _rectangle(canvas, object_box, (128, 128, 128) if is_ignored else TRUE, 1)
        rows = (boxes.image == number) & (boxes.score >= score)
        for object_box, label, value in zip(boxes.box[rows] * scale, boxes.label[rows], boxes.score[rows], strict=True):
            _rectangle(canvas, object_box, FOUND, 2)
            write_beside(canvas, f"{ROAD_CLASSES[label]} {value:.2f}", object_box)
        sheet_tiles.append(add_caption(canvas, photograph.name, WIDTH))
    return _grid(sheet_tiles, COLUMNS)


def worn_sheet(
    cells: Sequence[Cell],
    folder: Path,
    photographs: Sequence[Photograph],
    cars: Sequence[WornCar],
    clean: PhotographBoxes,
) -> U8 | None:
    """Return the highest cars clean, with a texture, and with the first draw of each control.

    Args:
        cells: Cells of one detector and one texture.
        folder: The results folder.
        photographs: The photographs.
        cars: The cars that wear textures.
        clean: Boxes in the clean photographs.

    Returns:
        The sheet; None without cars or finished cells.
    """
    highest = sorted(cars, key=lambda wearing_car: -float(_height(photographs, wearing_car)))[:CARS_ON_SHEET]
    finished = [cell for cell in cells if (folder / boxes_file(cell.system, f"{cell.key} 0")).is_file()]
    if not highest or not finished:
        return None
    variants: list[tuple[str, dict[int, U8], F64]] = [
        (
            "clean",
            {wearing_car.image: photographs[wearing_car.image].read() for wearing_car in highest},
            car_scores(photographs, highest, clean),
        )
    ]
    for cell in finished:
        worn = face_print(cell.spec["texture"])
        colour = drawn_colour(worn, cell.fields["pasted"], 0)
        chosen = [wearing_car for wearing_car in cars if wearing_car.image in variants[0][1]]
        images = {
            number: photograph_image for number, photograph_image, _ in worn_images(photographs, chosen, worn, colour)
        }
        boxes = cached_boxes(folder / boxes_file(cell.system, f"{cell.key} 0"), _absent)
        title = cell.fields["texture"] if cell.fields["pasted"] == TRAINED else cell.fields["pasted"]
        variants.append((title, images, car_scores(photographs, highest, boxes)))
    sheet_tiles = []
    for position, wearing_car in enumerate(highest):
        for title, images, scores in variants:
            crop = _crop(images[wearing_car.image], photographs[wearing_car.image].box[wearing_car.row])
            sheet_tiles.append(add_caption(crop, f"{title}: {scores[position]:.2f}", CAR_WIDTH))
    return _grid(sheet_tiles, len(variants))


def _height(photographs: Sequence[Photograph], wearing_car: WornCar) -> Any:
    object_box = photographs[wearing_car.image].box[wearing_car.row]
    return object_box[3] - object_box[1]


def _crop(photograph_image: U8, object_box: F64) -> U8:
    height, width = photograph_image.shape[:2]
    side = int(min(CROP_SIDE * (object_box[2:] - object_box[:2]).max(), height, width))
    left = int(np.clip((object_box[0] + object_box[2] - side) / 2, 0, width - side))
    top = int(np.clip((object_box[1] + object_box[3] - side) / 2, 0, height - side))
    part = np.ascontiguousarray(photograph_image[top : top + side, left : left + side])
    return np.asarray(cv2.resize(part, (CAR_WIDTH, CAR_WIDTH), interpolation=cv2.INTER_CUBIC), np.uint8)


def _grid(sheet_tiles: list[U8], columns: int) -> U8:
    """Return tiles side by side in rows; tiles of a row are padded to one height, rows to one width."""
    rows = []
    for start in range(0, len(sheet_tiles), columns):
        row_tiles = sheet_tiles[start : start + columns]
        height = max(sheet_tile.shape[0] for sheet_tile in row_tiles)
        padded = [
            np.pad(sheet_tile, ((0, height - len(sheet_tile)), (0, 0), (0, 0)), constant_values=255)
            for sheet_tile in row_tiles
        ]
        rows.append(np.concatenate(padded, 1))
    sheet_width = max(sheet_row.shape[1] for sheet_row in rows)
    return np.concatenate(
        [
            np.pad(sheet_row, ((0, 0), (0, sheet_width - sheet_row.shape[1]), (0, 0)), constant_values=255)
            for sheet_row in rows
        ]
    )


def _rectangle(canvas: U8, object_box: F64, colour: tuple[int, int, int], thickness: int) -> None:
    left, top, right, bottom = (round(float(edge)) for edge in object_box)
    cv2.rectangle(canvas, (left, top), (right, bottom), colour, thickness, cv2.LINE_AA)

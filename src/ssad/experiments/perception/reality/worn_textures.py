"""Cars in photographs that wear a texture: their choice, and the scores with which a detector finds them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from torch import Tensor

from ssad.core.seeding import seed32
from ssad.core.types import F64, U8
from ssad.datasets.photographs import CLASSES, Photograph
from ssad.experiments.perception.reality.photograph_boxes import CAR, PhotographBoxes, road_label
from ssad.metrics.target_attacks import TargetSighting
from ssad.scenarios.static.physical.textures.controls import control
from ssad.scenarios.static.physical.textures.photographs import FacePrint, face_quad, light_on, paste

CLEAN: Final = "clean"
TRAINED: Final = "trained"
WHOLE_FACE: Final = (0.0, 0.0, 1.0, 1.0)
BORDER: Final = 2.0  # pixels from the border within which a box counts as cut
MAX_COVERED: Final = 0.25  # share of a car's box that a nearer object may cover


@dataclass(frozen=True, slots=True)
class WornCar:
    """A car that can wear a texture.

    Attributes:
        image: Index of its photograph.
        row: Row of the car among the objects of the photograph.
    """

    image: int
    row: int


def wearing_cars(photographs: Sequence[Photograph], min_height: float) -> list[WornCar]:
    """Return the cars whose rear or front is visible: high enough, not cut, not behind another object.

    Args:
        photographs: The photographs.
        min_height: Least height of a car, pixels.
    """
    cars = []
    for number, photograph in enumerate(photographs):
        height, width = (0, 0) if not len(photograph.label) else photograph.read().shape[:2]
        for object_row in range(len(photograph.label)):
            if _is_car(photograph, object_row) and _is_clear(photograph, object_row, (width, height), min_height):
                cars.append(WornCar(number, object_row))
    return cars


def _is_car(photograph: Photograph, object_row: int) -> bool:
    label = int(photograph.label[object_row])
    return label >= 0 and road_label(CLASSES[label]) == CAR


def _is_clear(photograph: Photograph, object_row: int, size: tuple[int, int], min_height: float) -> bool:
    box = photograph.box[object_row]
    limits = np.array([BORDER, BORDER, size[0] - BORDER, size[1] - BORDER])
    if box[3] - box[1] < min_height or (box[:2] < limits[:2]).any() or (box[2:] > limits[2:]).any():
        return False
    if face_quad(WHOLE_FACE, box, photograph.solid[object_row], photograph.intrinsic) is None:
        return False
    others = np.delete(photograph.box, object_row, 0)
    nearer = others[others[:, 3] > box[3]]
    sides = np.minimum(nearer[:, 2:], box[2:]) - np.maximum(nearer[:, :2], box[:2])
    covered = np.where((sides > 0).all(1), sides.prod(1), 0.0) / (box[2:] - box[:2]).prod()
    return not (covered > MAX_COVERED).any()


def drawn_colour(worn: FacePrint, name: str, draw: int) -> Tensor:
    """Return the colours of a print: the trained ones, or those of a draw of a control.

    Args:
        worn: The trained print.
        name: `TRAINED`, or the name of a control.
        draw: Number of the draw.
    """
    if name == TRAINED:
        return worn.colour
    _, height, width = worn.colour.shape
    return control(name, (height, width), seed=seed32("reality", name, draw), trained=worn.colour)


def worn_images(
    photographs: Sequence[Photograph], cars: Sequence[WornCar], worn: FacePrint, colour: Tensor
) -> Iterator[tuple[int, U8, Photograph]]:
    """Yield index, pixels and photograph of each photograph with cars, all of which wear a print."""
    for number in dict.fromkeys(wearing_car.image for wearing_car in cars):
        photograph = photographs[number]
        clean = image = photograph.read()
        for object_row in (wearing_car.row for wearing_car in cars if wearing_car.image == number):
            box = photograph.box[object_row]
            quad = face_quad(worn.rectangle, box, photograph.solid[object_row], photograph.intrinsic)
            if quad is not None:
                image = paste(image, colour, worn.mask, quad, light=light_on(clean, box))
        yield number, image, photograph


def car_scores(photographs: Sequence[Photograph], cars: Sequence[WornCar], boxes: PhotographBoxes) -> F64:
    """Return the score with which each car is found [N], 0 if it is missed. Each box finds one car at most."""
    scores_by_car: dict[tuple[int, int], float] = {}
    for number in dict.fromkeys(wearing_car.image for wearing_car in cars):
        photograph = photographs[number]
        rows = [object_row for object_row in range(len(photograph.label)) if _is_car(photograph, object_row)]
        found_boxes, scores = boxes.of(number, CAR)
        sighting = TargetSighting("", found_boxes, scores, photograph.box[rows], np.zeros(len(rows), np.bool_))
        scores_by_car |= {
            (number, object_row): score for object_row, score in zip(rows, sighting.confidences().tolist(), strict=True)
        }
    return np.array([scores_by_car[wearing_car.image, wearing_car.row] for wearing_car in cars])

"""Scores of a physical attack over a grid of views: distance, azimuth, elevation, weather; and its worst cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ssad.metrics.target_attacks import TargetSighting, precision

AXES = ("distance", "azimuth", "elevation", "weather")


def grid_scores(
    rows: Sequence[Mapping[str, Any]],
    clean_sightings: Sequence[TargetSighting],
    attacked_sightings: Sequence[TargetSighting] | None,
    *,
    floor: float,
) -> dict[str, Any]:
    """Return the remaining AP50 in each cell of distance and azimuth, over all elevations and weathers.

    Args:
        rows: The keys of `AXES` for each image.
        clean_sightings: Detections in the images without the attack.
        attacked_sightings: Detections with it; None for the clean images alone.
        floor: Minimum AP50 of the clean images of a cell; below it, the attack has no score there.

    Returns:
        views: a row for each image: the four axes, the score of the target clean, and attacked (None without an
            attack);
        cells: a row for each: distance, azimuth, images, AP50 clean, AP50 attacked (None below the floor, or
            without an
        attack); worst: distance, azimuth and AP50 of the cell with the weakest attack (without an attack: the
        weakest detector), None without one.
    """
    view_keys = [tuple(row[axis] for axis in AXES) for row in rows]
    clean_confidences = [float(entry.confidences()[0]) for entry in clean_sightings]
    attacked_confidences = (
        [None] * len(clean_confidences)
        if attacked_sightings is None
        else [float(entry.confidences()[0]) for entry in attacked_sightings]
    )
    views = [
        [*view_key, round(clean_value, 4), None if attacked_value is None else round(attacked_value, 4)]
        for view_key, clean_value, attacked_value in zip(
            view_keys, clean_confidences, attacked_confidences, strict=True
        )
    ]
    cells: list[list[Any]] = []
    for cell_key in sorted({view_key[:2] for view_key in view_keys}):
        indices = [index for index, view_key in enumerate(view_keys) if view_key[:2] == cell_key]
        clean_ap = precision([clean_sightings[index] for index in indices])
        attacked_ap = None
        if attacked_sightings is not None and clean_ap is not None and clean_ap >= floor:
            attacked_ap = precision([attacked_sightings[index] for index in indices])
        cells.append([*cell_key, len(indices), _rounded(clean_ap), _rounded(attacked_ap)])
    scored_cells = [(cell[3 if attacked_sightings is None else 4], cell) for cell in cells]
    valid_cells = [(cell_ap, cell) for cell_ap, cell in scored_cells if cell_ap is not None]
    worst_cell = None
    if valid_cells:
        cell_ap, cell = (min if attacked_sightings is None else max)(valid_cells, key=lambda entry: entry[0])
        worst_cell = [*cell[:2], cell_ap]
    return {"views": views, "cells": cells, "worst": worst_cell}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 6)

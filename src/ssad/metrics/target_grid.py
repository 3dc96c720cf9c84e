"""Scores of a physical attack over a grid of views: distance, azimuth, elevation, weather; and its worst cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ssad.metrics.target_attacks import Sighting, precision

AXES = ("distance", "azimuth", "elevation", "weather")


def grid_scores(
    rows: Sequence[Mapping[str, Any]], clean: Sequence[Sighting], attacked: Sequence[Sighting] | None, *, floor: float
) -> dict[str, Any]:
    """What is left of AP50 in each cell of distance and azimuth, over all elevations and weathers.

    Args:
        rows: Of each picture the keys of `AXES`.
        clean: What was found in the pictures without the attack.
        attacked: With it; None for the clean pictures alone.
        floor: Least AP50 of the clean pictures of a cell; where it is less, the attack has no score there.

    Returns:
        views: a row for each picture: the four axes, the score with which the target is found clean, and attacked (None
        without an attack); cells: a row for each: distance, azimuth, pictures, AP50 clean, AP50 attacked (None below
        the floor, or without an attack); worst: distance, azimuth and AP50 of the cell in which the attack does least
        (without an attack: the detector), None if there is none.
    """
    names = [tuple(row[axis] for axis in AXES) for row in rows]
    before = [float(one.confidences()[0]) for one in clean]
    after = [None] * len(before) if attacked is None else [float(one.confidences()[0]) for one in attacked]
    views = [
        [*name, round(b, 4), None if a is None else round(a, 4)]
        for name, b, a in zip(names, before, after, strict=True)
    ]
    cells: list[list[Any]] = []
    for place in sorted({name[:2] for name in names}):
        own = [k for k, name in enumerate(names) if name[:2] == place]
        have = precision([clean[k] for k in own])
        left = None
        if attacked is not None and have is not None and have >= floor:
            left = precision([attacked[k] for k in own])
        cells.append([*place, len(own), _rounded(have), _rounded(left)])
    scored = [(cell[3 if attacked is None else 4], cell) for cell in cells]
    counted = [(value, cell) for value, cell in scored if value is not None]
    worst = None
    if counted:
        value, cell = (min if attacked is None else max)(counted, key=lambda one: one[0])
        worst = [*cell[:2], value]
    return {"views": views, "cells": cells, "worst": worst}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 6)

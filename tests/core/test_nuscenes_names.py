"""Names of nuScenes against what the official toolkit and mmdetection3d wrote."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ssad.core.nuscenes_names import (
    ATTRIBUTES,
    CATEGORIES,
    CATEGORY_TO_CLASS,
    CLASSES,
    MMDET3D_ATTRIBUTES,
    MMDET3D_CLASSES,
    NO_ATTRIBUTE,
    RANGES,
    USUAL_ATTRIBUTE,
    VISIBILITY,
    visibility_token,
)

STORED = Path(__file__).parent.parent / "data"


def test_classes_and_ranges_are_those_of_the_official_settings() -> None:
    settings = json.loads((STORED / "devkit" / "plain.json").read_text())["cfg"]["class_range"]
    assert settings == dict(RANGES)
    assert CLASSES[:5] == ("car", "truck", "bus", "trailer", "construction_vehicle")  # the file is sorted by name


def test_labels_and_attributes_of_mmdetection3d_go_together() -> None:
    """Its export writes attributes that fit the class of a label in its order, the usual one where ours would not."""
    with np.load(STORED / "mmdet3d" / "export.npz") as stored:
        labels, attributes = stored["label"].tolist(), stored["attribute"].tolist()
    assert set(labels) == set(range(9))
    for label, name in zip(labels, attributes, strict=True):
        usual = USUAL_ATTRIBUTE[MMDET3D_CLASSES[label]]
        assert name.split(".")[0] == usual.split(".")[0]
        assert name in (*ATTRIBUTES, "")


def test_both_orders_hold_the_same_names() -> None:
    assert [MMDET3D_CLASSES.index(name) for name in CLASSES] == [0, 1, 3, 2, 4, 7, 6, 5, 8, 9]
    assert sorted(MMDET3D_ATTRIBUTES) == sorted((*ATTRIBUTES, "none"))
    assert MMDET3D_ATTRIBUTES[NO_ATTRIBUTE] == "none"
    assert set(USUAL_ATTRIBUTE) == set(CLASSES) == set(CATEGORY_TO_CLASS.values())
    assert set(USUAL_ATTRIBUTE.values()) <= {*ATTRIBUTES, ""}


def test_categories_are_the_23_of_the_schema() -> None:
    assert len(CATEGORIES) == len(set(CATEGORIES)) == 23


@pytest.mark.parametrize("token", VISIBILITY)
def test_a_visibility_holds_above_its_share_and_up_to_the_next(token: str) -> None:
    least = VISIBILITY[token]
    most = min((v for v in VISIBILITY.values() if v > least), default=1.0)
    assert visibility_token(np.nextafter(least, 1.0)) == token
    assert visibility_token(most) == token
    assert visibility_token(0.0) == "1"

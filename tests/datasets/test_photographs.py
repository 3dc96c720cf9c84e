"""Annotated photographs of all forms, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.photographs import CARS, SIZES, write_bdd100k, write_coco, write_kitti, write_list

from ssad.core.errors import ConfigError, FormatError, SSADError, StoreError
from ssad.datasets.photographs import CLASSES, read_photographs

CAR = CLASSES.index("car")


@pytest.mark.parametrize(
    ("write", "split", "form", "ignored"),
    [
        (write_coco, "val2017", "coco", 1),
        (write_kitti, "", "kitti", 2),
        (write_bdd100k, "val", "bdd100k", 1),
        (write_list, "", "list", 0),
    ],
)
def test_every_form_gives_the_same_cars(
    write: Callable[[Path], Path], split: str, form: str, ignored: int, tmp_path: Path
) -> None:
    photographs = read_photographs(write(tmp_path), split)
    assert photographs.form == form
    assert "car" in photographs.classes
    assert len(photographs.photographs) == len(CARS)
    for photograph, car, size in zip(photographs.photographs, CARS, SIZES, strict=True):
        assert photograph.label.tolist().count(CAR) == 1
        assert tuple(photograph.box[photograph.label == CAR][0]) == car
        assert photograph.ignored.sum() == ignored
        assert photograph.read().shape == (size[1], size[0], 3)


def test_3d_boxes_are_centres_in_the_frame_of_the_camera(tmp_path: Path) -> None:
    kitti = read_photographs(write_kitti(tmp_path / "kitti")).photographs[0]
    listed = read_photographs(write_list(tmp_path / "list")).photographs[0]
    assert kitti.solid[0] == pytest.approx([-1.44, 1.08, 6.0, 4.2, 1.6, 1.92, -1.5708])
    assert listed.solid[0] == pytest.approx(kitti.solid[0])
    assert kitti.intrinsic is not None
    assert np.array_equal(kitti.intrinsic, listed.intrinsic)
    assert np.isnan(read_photographs(tmp_path / "list").photographs[1].solid).all()


def test_nuscenes_is_read_with_all_cameras(tiny_set: Path) -> None:
    photographs = read_photographs(tiny_set)
    assert photographs.form == "nuscenes"
    cameras = {photograph.name.split("/")[1] for photograph in photographs.photographs}
    assert len(cameras) == 6
    assert all(photograph.intrinsic is not None for photograph in photographs.photographs)
    assert sum(len(photograph.label) for photograph in photographs.photographs) > 0
    assert all(len(photograph.solid) == len(photograph.box) for photograph in photographs.photographs)


def test_splits_files_and_thinning(tmp_path: Path) -> None:
    kitti = write_kitti(tmp_path / "kitti")
    assert [photograph.name for photograph in read_photographs(kitti, "val").photographs] == ["000001.png"]
    coco = write_coco(tmp_path / "coco")
    file = coco / "annotations" / "instances_val2017.json"
    assert len(read_photographs(file).photographs) == 2
    assert [photograph.name for photograph in read_photographs(file).thinned(1).photographs] == ["000000000000.png"]


def test_what_is_missing_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    coco, kitti = write_coco(tmp_path / "coco"), write_kitti(tmp_path / "kitti")
    for path, split, words in (
        (tmp_path / "nowhere", "", "no such folder"),
        (tmp_path / "empty", "", "no annotated photographs"),
        (coco, "", "several files of annotations"),
        (coco, "test", "no split 'test'"),
        (kitti, "test", "no ImageSets/test.txt"),
        (coco / "annotations" / "instances_val2017.json", "test", "split .test. with a single file"),
    ):
        with pytest.raises(ConfigError, match=words) as error:
            read_photographs(path, split)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("objects", "words"),
    [
        ([{"name": "car", "bbox": [5, 5, 5, 9]}], "without width or height"),
        ([{"name": "car", "bbox": [5, 5, 9]}], "broken annotations"),
        ([{"bbox": [1, 2, 3, 4]}], "broken annotations"),
        ("none", "broken annotations"),
    ],
)
def test_broken_lists_are_one_line(objects: object, words: str, tmp_path: Path) -> None:
    write_list(tmp_path, objects=objects)
    with pytest.raises(FormatError, match=words) as error:
        read_photographs(tmp_path)
    assert "\n" not in str(error.value)


def test_foreign_files_are_one_line(tmp_path: Path) -> None:
    kitti = write_kitti(tmp_path / "kitti")
    (kitti / "training" / "label_2" / "000000.txt").write_text("Car 1 2\n")
    with pytest.raises(FormatError, match=r"000000.txt, line 1: no object of KITTI"):
        read_photographs(kitti)
    (kitti / "training" / "label_2" / "000000.txt").write_text("")
    (kitti / "training" / "calib" / "000000.txt").write_text("P2: 1 2 3")
    with pytest.raises(FormatError, match="no projection P2"):
        read_photographs(kitti)
    for number, text in enumerate(
        ("[3]", '[{"name": "a.png", "labels": [{"category": "car", "box2d": {}}]}]', "{", "{}")
    ):
        path = tmp_path / f"{number}.json"
        path.write_text(text)
        with pytest.raises(SSADError) as error:
            read_photographs(path)
        assert "\n" not in str(error.value)


def test_photographs_do_not_lead_out_of_their_folder(tmp_path: Path) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    (folder / "list.json").write_text(json.dumps({"images": {"../secret.png": {"objects": []}}}))
    with pytest.raises(StoreError):
        read_photographs(folder)

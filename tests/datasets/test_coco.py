"""COCO annotations: written in order, read with checks."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import FormatError, StoreError
from ssad.core.import_report import ImportReport
from ssad.datasets.coco import coco_data, read_coco

CLASSES = ("car", "bus")
ROWS: list[dict[str, Any]] = [
    {
        "file_name": "a.jpg",
        "width": 64,
        "height": 48,
        "town": "Twinford",
        "objects": [
            {"label": 0, "box": [1.0, 2.0, 11.0, 22.0], "pixels": 150, "crowd": False, "target": True, "visible": 0.9},
            {"label": 1, "box": [5.0, 5.0, 7.0, 9.0], "pixels": 8, "crowd": True, "target": False, "visible": 0.2},
        ],
    },
    {"file_name": "sub/b.jpg", "width": 32, "height": 32, "town": "Oldmarket", "objects": []},
]


def write(folder: Path, data: Any) -> Path:
    page = folder / "annotations" / "all.json"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(data if isinstance(data, str) else json.dumps(data))
    return page


def test_what_is_written_is_read(tmp_path: Path) -> None:
    data = coco_data(CLASSES, ROWS, {"seed": 3})
    assert data["info"] == {"seed": 3}
    assert [c["id"] for c in data["categories"]] == [1, 2]
    assert data["annotations"][0] == {
        "id": 1,
        "image_id": 1,
        "category_id": 1,
        "bbox": [1.0, 2.0, 10.0, 20.0],
        "area": 150,
        "iscrowd": 0,
        "target": True,
        "visible": 0.9,
    }
    page = write(tmp_path, data)
    found = read_coco(page)
    assert found.classes == CLASSES
    first, second = found.images
    assert first.file == page.parent / "a.jpg", "no folder `images` beside the page's"
    assert (first.width, first.height, dict(first.metadata)) == (64, 48, {"town": "Twinford"})
    assert np.array_equal(first.box, [[1, 2, 11, 22], [5, 5, 7, 9]])
    assert first.label.tolist() == [0, 1]
    assert first.crowd.tolist() == [False, True]
    assert first.target.tolist() == [True, False]
    assert second.box.shape == (0, 4)
    assert (len(second.label), len(second.crowd), len(second.target)) == (0, 0, 0)


def test_pictures_are_found_beside_the_page_or_where_one_says(tmp_path: Path) -> None:
    page = write(tmp_path, coco_data(CLASSES, ROWS, {}))
    (tmp_path / "images").mkdir()
    assert read_coco(page).images[1].file == tmp_path / "images" / "sub" / "b.jpg"
    assert read_coco(page, images=tmp_path / "else").images[0].file == tmp_path / "else" / "a.jpg"


def test_pictures_do_not_lead_out_of_their_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "set"
    page = write(folder, coco_data(CLASSES, ROWS, {}))
    (folder / "images").mkdir()
    outside.mkdir()
    for name in ("images/a.jpg", "images/sub", "images"):
        path = folder / name
        if path.is_dir():
            path.rename(tmp_path / "images")
        path.symlink_to(outside)
        with pytest.raises(StoreError, match=f"{name}: leads out of|{name}/b.jpg: leads out of"):
            read_coco(page)
        with monkeypatch.context() as patch:
            patch.setenv("SSAD_DATA_LINKS", str(outside))
            assert len(read_coco(page).images) == 2
        path.unlink()
    (folder / "images" / "sub").mkdir(parents=True)
    (folder / "images" / "a.jpg").symlink_to("sub/c.jpg")
    assert len(read_coco(page).images) == 2


def test_ids_with_gaps_and_in_any_order_as_in_coco_itself(tmp_path: Path) -> None:
    data = {
        "images": [{"id": 90, "file_name": "x.jpg", "width": 8, "height": 8}],
        "annotations": [
            {"id": 7, "image_id": 90, "category_id": 44, "bbox": [0, 0, 4, 4]},
            {"id": 3, "image_id": 90, "category_id": 3, "bbox": [1, 1, 2, 2]},
        ],
        "categories": [{"id": 44, "name": "bottle"}, {"id": 3, "name": "car"}],
    }
    found = read_coco(write(tmp_path, data))
    assert found.classes == ("car", "bottle")
    assert found.images[0].label.tolist() == [1, 0]
    assert not found.images[0].crowd.any()
    assert not found.images[0].target.any()


def change(*path: str | int, to: Any) -> Callable[[dict[str, Any]], None]:
    """Sets what lies at a path."""

    def apply(data: dict[str, Any]) -> None:
        place: Any = data
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = to

    return apply


def drop(*path: str | int) -> Callable[[dict[str, Any]], None]:
    """Takes away what lies at a path."""

    def apply(data: dict[str, Any]) -> None:
        place: Any = data
        for key in path[:-1]:
            place = place[key]
        del place[path[-1]]

    return apply


@pytest.mark.parametrize(
    ("breaks", "said"),
    [
        (drop("images"), "no COCO annotations"),
        (drop("annotations"), "no COCO annotations"),
        (change("categories", to={}), "no COCO annotations"),
        (drop("images", 0, "file_name"), "KeyError"),
        (drop("images", 0, "id"), "KeyError"),
        (drop("annotations", 0, "bbox"), "KeyError"),
        (drop("annotations", 0, "image_id"), "KeyError"),
        (drop("categories", 0, "name"), "KeyError"),
        (change("images", 0, to=5), "TypeError"),
        (change("annotations", 0, to=None), "TypeError"),
        (change("annotations", 0, to=[]), "TypeError"),
        (change("categories", 1, "id", to=1), "one id"),
        (change("images", 1, "id", to=1), "one id"),
        (change("images", 0, "id", to="first"), "ValueError"),
        (change("images", 0, "id", to=[1]), "TypeError"),
        (change("annotations", 0, "image_id", to=99), "annotation 0 belongs to no image"),
        (change("annotations", 1, "category_id", to=99), "annotation 1 belongs to no image or category"),
        (change("annotations", 0, "image_id", to=[1]), "TypeError"),
        (change("annotations", 0, "bbox", to=[1, 2, 3]), "ValueError"),
        (change("annotations", 0, "bbox", to=[1, 2, 3, 4, 5]), "ValueError"),
        (change("annotations", 0, "bbox", to=[1, 2, "w", 4]), "ValueError"),
        (change("annotations", 0, "bbox", to=[1, 2, 0, 4]), "without width or height"),
        (change("annotations", 0, "bbox", to=[1, 2, 3, -4]), "without width or height"),
        (change("annotations", 0, "bbox", to=None), "no list of four numbers"),
        (change("annotations", 0, "bbox", to="1234"), "no list of four numbers"),
        (change("annotations", 0, "bbox", to={"1": 0, "2": 0, "3": 0, "4": 0}), "no list of four numbers"),
        (change("annotations", 0, "bbox", to=[None, 2, 3, 4]), "TypeError"),
        (change("images", 0, "width", to=0), "image 1: 0 x 48 pixels"),
        (change("images", 0, "height", to=None), "TypeError"),
        (change("images", 0, "file_name", to="../../secret.jpg"), "points out of the folder"),
        (change("images", 0, "file_name", to="/etc/passwd"), "points out of the folder"),
        (change("images", 0, "file_name", to=""), "points out of the folder"),
    ],
)
def test_a_broken_page_is_refused_in_one_line(
    tmp_path: Path, breaks: Callable[[dict[str, Any]], None], said: str
) -> None:
    data = copy.deepcopy(coco_data(CLASSES, ROWS, {}))
    breaks(data)
    page = write(tmp_path, data)
    with pytest.raises(FormatError, match=said) as error:
        read_coco(page)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(page))


def test_a_report_names_what_is_left_out_of_annotations(tmp_path: Path) -> None:
    """Boxes without height, as in COCO's own files, and annotations of no image are left out of the others."""
    data = copy.deepcopy(coco_data(CLASSES, ROWS, {}))
    count = len(data["annotations"])
    data["annotations"][0] |= {"bbox": [1, 2, 3, 0], "segmentation": [[1, 2, 3, 4, 5, 6]]}
    data["annotations"][1] |= {"image_id": 99}
    report = ImportReport("page")
    found = read_coco(write(tmp_path, data), report=report)
    assert sum(len(image.box) for image in found.images) == count - 2
    assert report.doubts == {
        "boxes without width or height are left out": ["annotation 0"],
        "annotations of no image or category are left out": ["annotation 1"],
    }
    assert report.omissions == {"segmentation of annotations": [""]}
    assert report.contents == [f"{len(ROWS)} pictures with {count - 2} boxes of {len(CLASSES)} classes"]


@pytest.mark.parametrize("text", ["", "[]", "null", "{", '{"images": 1}', "\x00", '{"images": [NaN'])
def test_a_page_that_is_no_json_or_something_else(tmp_path: Path, text: str) -> None:
    with pytest.raises(FormatError) as error:
        read_coco(write(tmp_path, text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("number", ["1e400", "NaN", "Infinity", "-Infinity"])
@pytest.mark.parametrize(
    ("before", "keep"), [('"bbox": [1.0', '"bbox": ['), ('"width": 64', '"width": '), ('"id": 1', '"id": ')]
)
def test_numbers_that_are_none(tmp_path: Path, before: str, keep: str, number: str) -> None:
    text = json.dumps(coco_data(CLASSES, ROWS, {}))
    assert before in text
    with pytest.raises(FormatError) as error:
        read_coco(write(tmp_path, text.replace(before, keep + number)))
    assert "\n" not in str(error.value)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_coco(tmp_path / "all.json")
    with pytest.raises(FormatError):
        read_coco(tmp_path)

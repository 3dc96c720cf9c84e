"""ssad shift and ssad score on the command line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.command import ssad

from ssad.core.nuscenes_names import CATEGORY_TO_CLASS
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.recorders.shifted.contact_sheet import pick_frame


def perfect(root: Path, file: Path, **meta: str) -> Path:
    """A results file that says exactly what the tables say."""
    data = NuScenes(root)
    results = {}
    for record in data.scenes():
        scene = data.scene(record.name)
        for sample in scene.samples:
            found = scene.annotations(sample.token)
            results[sample.token] = [
                {
                    "sample_token": sample.token,
                    "translation": found.centre[n].tolist(),
                    "size": found.size_wlh[n].tolist(),
                    "rotation": found.rotation[n].tolist(),
                    "velocity": found.velocity[n, :2].tolist(),
                    "detection_name": CATEGORY_TO_CLASS[found.category[n]],
                    "detection_score": 0.5,
                    "attribute_name": (found.attributes[n] or ("",))[0],
                }
                for n in range(len(found))
                if found.category[n] in CATEGORY_TO_CLASS
            ]
    kinds = {f"use_{k}": k == "camera" for k in ("camera", "lidar", "radar", "map", "external")}
    file.write_text(json.dumps({"meta": kinds | meta, "results": results}))
    return file


def test_a_folder_is_shifted_scored_and_verified(tiny_set: Path, tmp_path: Path) -> None:
    def go(*words: str | Path) -> tuple[int, str, str]:
        done = ssad(*words)
        return done.returncode, done.stdout, done.stderr

    out = tmp_path / "n"
    words = ("--shifts", "gaussian,scale", "--severity", "2", "--workers", "1", "--labels", "transformed")
    code, text, _ = go("shift", tiny_set, out, *words)
    assert code == 0
    assert text.count("files shifted") == 2
    assert go("shift", out, out, "--verify")[0] == 0
    results = perfect(tiny_set, tmp_path / "results.json")
    score = ("--version", "v1.0-mini", "--split", "mini_val", "--json", tmp_path / "score.json")
    code, text, _ = go("score", results, "--dataroot", tiny_set, *score)
    assert code == 0
    assert "data: clean" in text
    clean = json.loads((tmp_path / "score.json").read_text())
    assert {"mean_ap", "nd_score", "tp_errors", "mean_dist_aps", "label_aps", "label_tp_errors"} <= set(clean)
    assert clean["mean_dist_aps"]["car"] == pytest.approx(1.0)
    code, text, _ = go("score", results, "--dataroot", out / "scale-2", *score)
    assert code == 0
    assert "scale, severity 2" in text
    scaled = json.loads((tmp_path / "score.json").read_text())
    assert scaled["label_tp_errors"]["car"]["scale_err"] > 0.2, "the truth grew, the boxes did not"
    assert scaled["ssad"]["data"] == "shifted"

    # a results file that says which data it saw is believed only for those
    named = perfect(tiny_set, tmp_path / "named.json", ssad_manifest=scaled["ssad"]["manifest"])
    assert go("score", named, "--dataroot", out / "scale-2", *score)[0] == 0
    for root in (out / "gaussian-2", tiny_set):
        code, _, err = go("score", named, "--dataroot", root, *score)
        assert code == 2
        assert "the results were made on" in err

    # clean files in the place of shifted ones
    victim = next((out / "gaussian-2" / "samples" / "CAM_FRONT").iterdir())
    shutil.copy(tiny_set / "samples" / "CAM_FRONT" / victim.name, victim)
    code, _, err = go("score", results, "--dataroot", out / "gaussian-2", *score)
    assert code == 2
    assert victim.name in err
    code, text, _ = go("shift", out, out, "--verify")
    assert code == 1
    assert victim.name in text


def test_contact_sheets(tiny_set: Path, tmp_path: Path) -> None:
    assert ssad("shift", tiny_set, tmp_path / "sheet.png").returncode == 0
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    rows, columns = 4, 3
    tall, wide = sheet.shape[0] // rows, sheet.shape[1] // columns
    panels = [
        sheet[r * tall : (r + 1) * tall - 30, c * wide : (c + 1) * wide] for r in range(rows) for c in range(columns)
    ]
    for panel in panels[1:]:
        assert np.abs(panel.astype(int) - panels[0]).mean() > 0.05, "every panel differs from the clean one"
    assert (tmp_path / "sheet-severities.png").is_file()
    with NuScenes(tiny_set) as data:
        other = data.scenes()[1].name
        suns = [pick_frame(data, seed=seed)[2].sun for seed in (0, 1, 0)]
    assert suns[0] == suns[2] != suns[1], "the seed moves the sun"
    assert ssad("shift", tiny_set, tmp_path / "two.png", "--scenes", other).returncode == 0
    assert (cv2.imread(str(tmp_path / "two.png")) != sheet).any(), "the scene that was named"
    picture = next((tiny_set / "samples" / "CAM_BACK").iterdir())
    own = tmp_path / "own.jpg"
    done = ssad("shift", picture, own, "--box", "120,80,200,130", "--severity", "5")
    assert done.returncode == 0
    assert str(own) in done.stdout


def test_a_contact_sheet_shows_the_shifts_that_are_named(tiny_set: Path, tmp_path: Path) -> None:
    """Clean, fog and noise in a row of three, and a row of five severities for each. Snow begins a second row."""
    picture = next((tiny_set / "samples" / "CAM_BACK").iterdir())
    heights: dict[int, tuple[int, int]] = {}
    for names, rows in (("fog,uniform", 1), ("fog,uniform,snow", 2)):
        out = tmp_path / f"{rows}.png"
        done = ssad("shift", picture, out, "--shifts", names)
        assert done.returncode == 0, done.stderr
        sheet, severities = (cv2.imread(str(path)) for path in (out, tmp_path / f"{rows}-severities.png"))
        assert sheet.shape[1] % 3 == severities.shape[1] % 5 == 0, "columns"
        heights[rows] = sheet.shape[0], severities.shape[0]
    assert heights[2] == (2 * heights[1][0], 1.5 * heights[1][1])
    assert ssad("shift", picture, tmp_path / "no.png", "--shifts", "fgo").returncode == 2


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("shift", "nowhere", "out"), ("nowhere", "no such file or folder")),
        (("shift", "{tiny}", "{tmp}/o", "--shifts", "fgo"), ("unknown shift 'fgo'", "closest: fog")),
        (("shift", "{tiny}", "{tmp}/o", "--severity", "6"), ("from 1 to 5",)),
        (("shift", "{tiny}", "{tmp}/o", "--calibration", "real"), ("calibration",)),
        (("shift", "{tiny}", "{tmp}/o", "--labels", "moved"), ("labels 'moved'",)),
        (("shift", "{tiny}", "{tmp}/o", "--version", "v1.0-test"), ("v1.0-test", "v1.0-mini")),
        (("shift", "{tiny}", "{tmp}/o", "--scenes", "scene-9"), ("scene-9",)),
        (("shift", "{tiny}", "{tmp}/o", "--split", "vall"), ("vall",)),
        (("shift", "{tiny}", "{tiny}/o"), ("outside of the dataset",)),
        (("shift", "{tmp}", "{tmp}/x", "--verify"), ("not written by ssad shift",)),
        (("shift", "{picture}", "{tmp}/x.png", "--box", "1,2,3"), ("--box 1,2,3", "x0,y0,x1,y1")),
        (("shift", "{picture}", "{tmp}/x.png", "--box", "1,2,90,20"), ("horizon",)),
        (("shift", "{picture}", "{tmp}/x.gif"), ("x.gif",)),
        (("shift", "{tiny}", "{tmp}/x.png", "--scenes", "scene-9"), ("scene-9",)),
        (("shift", "{tiny}", "{tmp}/x.png", "--scenes", "a,b"), ("shows one scene",)),
        (("shift", "{tiny}", "{tmp}/x.png", "--split", "mini_val"), ("--split cannot be used",)),
        (("shift", "{picture}", "{tmp}/x.png", "--scenes", "scene-9"), ("--scenes cannot be used",)),
        (
            ("score", "none.json", "--dataroot", "{tiny}", "--version", "v1.0-mini", "--split", "mini_val"),
            ("none.json",),
        ),
        (("score", "none.json", "--dataroot", "{tiny}", "--version", "v1.0-x", "--split", "mini_val"), ("v1.0-x",)),
    ],
)
def test_wrong_use_ends_in_one_line(
    arguments: tuple[str, ...],
    parts: tuple[str, ...],
    tiny_set: Path,
    tmp_path: Path,
) -> None:
    picture = next((tiny_set / "samples" / "CAM_BACK").iterdir())
    done = ssad(*(a.format(tiny=tiny_set, tmp=tmp_path, picture=picture) for a in arguments))
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.strip().splitlines()) == 1
    for part in parts:
        assert part in done.stderr

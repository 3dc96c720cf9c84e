"""Equality with mmdetection3d 1.4: its stored answers, and itself where SSAD_MMDET3D_PYTHON names an interpreter.

The stored answers are made by `helpers/mmdet3d_reference.py` for a narrow trunk and head; the weights are drawn again.
"""

import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from helpers import mono3d_case as case
from torch.nn import functional

from ssad.core.detections import Detections, Solids, Truth
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.detectors.mono3d.config import FCOS3D, PGD_DET
from ssad.detectors.mono3d.detector import Mono3D
from ssad.detectors.mono3d.multi_camera import merge_cameras
from ssad.detectors.official import infer, load

TESTS = Path(__file__).resolve().parents[1]
STORED = TESTS / "data" / "mmdet3d"
PYTHON = os.environ.get("SSAD_MMDET3D_PYTHON")
SMALL = (160, 96)
SEEDS = {"fcos3d": (3, 14), "pgd": (3, 12)}  # of the stored answers; with an even seed fewer boxes pass the threshold
RELATIVE = 1e-4

Reference = dict[str, npt.NDArray[Any]]


def small(kind: str, seed: int) -> Mono3D:
    """The detector of the stored answers: every part and class of the full one, but narrow, and in double precision:
    what differs is then the rounding of the stored answers alone, on any processor."""
    config = PGD_DET if kind == "pgd" else FCOS3D
    detector = Mono3D(replace(config, trunk=50, width=8, channels=32))
    shapes = {name: tuple(value.shape) for name, value in detector.state_dict().items()}
    drawn = case.weights(shapes, seed=seed)
    detector.load_state_dict({name: torch.from_numpy(value) for name, value in drawn.items()}, strict=True)
    return detector.double()


def read(path: Path) -> Reference:
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def truth_of(reference: Reference, k: int, intrinsic: torch.Tensor) -> Truth:
    t = {name.split("/")[2]: torch.from_numpy(v) for name, v in reference.items() if name.startswith(f"truth/{k}/")}
    solid = Solids(t["centre"], t["size"], t["yaw"], t["velocity"], t["attribute"])
    return Truth(t["label"], t["box"], solid, intrinsic)


def check_maps(found: dict[str, list[torch.Tensor]], reference: Reference) -> None:
    """Each channel within 1e-4 of its values and of its spread; on the last level 2e-3, for maps of one or two places
    leave a group norm next to nothing to divide by, and single precision (the answers') loses digits there."""
    stored = {name for name in reference if name.startswith("maps/")}
    assert stored == {f"maps/{name}/{k}" for name, levels in found.items() for k in range(len(levels))}
    for name in stored:
        _, kind, level = name.split("/")
        value = found[kind][int(level)].numpy()
        wanted = reference[name]
        assert value.shape == wanted.shape, name
        spread = np.concatenate([reference[f"maps/{kind}/{k}"].reshape(wanted.shape[1], -1) for k in range(5)], 1)
        slack = (RELATIVE if level != "4" else 20 * RELATIVE) * (np.abs(wanted) + spread.std(1)[None, :, None, None])
        assert (np.abs(value - wanted) <= slack).all(), (name, np.abs(value - wanted).max())


def check_boxes(found: dict[str, torch.Tensor], reference: Reference) -> None:
    """One to one: same class and attribute, score and box within 1e-3; in the same order but for equal scores."""
    ours = {name: value.numpy() for name, value in found.items()}
    wanted = {name.split("/")[1]: value for name, value in reference.items() if name.startswith("boxes/")}
    count = len(wanted["scores_3d"])
    assert len(ours["scores_3d"]) == count
    np.testing.assert_allclose(ours["scores_3d"], wanted["scores_3d"], rtol=1e-3)
    taken: set[int] = set()
    for k in range(count):
        off = np.abs(ours["bboxes_3d"] - wanted["bboxes_3d"][k])
        off[:, 6] = np.abs((off[:, 6] + np.pi) % (2 * np.pi) - np.pi)
        fits = (off <= 1e-3 * np.maximum(1.0, np.abs(wanted["bboxes_3d"][k]))).all(1)
        fits &= (ours["labels_3d"] == wanted["labels_3d"][k]) & (ours["attr_labels"] == wanted["attr_labels"][k])
        fits &= np.abs(ours["scores_3d"] - wanted["scores_3d"][k]) <= 1e-3 * wanted["scores_3d"][k]
        rows = set(np.flatnonzero(fits).tolist()) - taken
        assert rows, f"box {k} is missing"
        nearest = min(rows, key=lambda row: abs(row - k))
        assert abs(nearest - k) <= 1, f"box {k} is at {nearest}"
        taken.add(nearest)


def check_training(detector: Mono3D, reference: Reference, *, seed: int, size: tuple[int, int]) -> None:
    """Targets, losses of the batch and of each picture, gradient to the pictures; both sides in double precision."""
    detector = detector.double()
    width, height = size
    pictures = np.stack([case.picture(width, height, seed=seed + k) for k in range(3)])
    images = torch.from_numpy(pictures[..., ::-1].copy()).permute(0, 3, 1, 2).double() / 255
    images.requires_grad_(True)
    lens = torch.from_numpy(case.cam2img(width, height)[:3, :3]).double().expand(3, 3, 3)
    dense = detector.dense(images, lens)
    truths = [truth_of(reference, k, lens[k]) for k in range(3)]
    assignment = detector.assign(dense, truths)
    label = reference["targets/label"]
    np.testing.assert_array_equal(assignment.label.numpy(), np.where(label == len(MMDET3D_CLASSES), -1, label))
    found = label < len(MMDET3D_CLASSES)
    assert found[:2].any(1).all()
    assert not found[2].any()
    reg = assignment.extra["reg"].numpy()[found][:, : reference["targets/reg"].shape[2]]
    np.testing.assert_allclose(reg, reference["targets/reg"][found], rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(assignment.extra["attribute"].numpy()[found], reference["targets/attribute"][found])
    centreness = assignment.extra["centreness"].numpy()[found]
    np.testing.assert_allclose(centreness, reference["targets/centreness"][found], rtol=1e-5, atol=1e-6)
    losses = detector.losses(dense, assignment)
    assert {f"losses/{name}" for name in losses} == {name for name in reference if name.startswith("losses/")}
    for name, value in losses.items():
        np.testing.assert_allclose(value.item(), reference[f"losses/{name}"], rtol=RELATIVE, err_msg=name)
    for name, value in detector.losses(dense, assignment, reduction="image").items():
        np.testing.assert_allclose(value.detach(), reference[f"alone/{name}"], rtol=RELATIVE, atol=1e-7, err_msg=name)
    torch.stack(list(losses.values())).sum().backward()
    assert images.grad is not None
    gradient = images.grad.flip(1).numpy() / 255  # to the normalised BGR picture
    wanted = reference["gradient"]
    cell = gradient.shape[2] // wanted.shape[2]
    gradient = gradient.reshape(*gradient.shape[:2], wanted.shape[2], cell, wanted.shape[3], cell).sum((3, 5))
    assert np.abs(gradient - wanted).max() <= 1e-5 * np.abs(wanted).max()  # single precision in the file


@pytest.mark.parametrize(("kind", "seed"), [(kind, seed) for kind, seeds in SEEDS.items() for seed in seeds])
def test_equals_the_stored_answer(kind: str, seed: int) -> None:
    reference = read(STORED / f"{kind}_{seed}.npz")
    detector = small(kind, seed)
    maps, boxes = infer(detector, case.picture(*SMALL, seed=seed), case.cam2img(*SMALL))
    check_maps(maps, reference)
    check_boxes(boxes, reference)
    check_training(detector, reference, seed=seed, size=SMALL)


@pytest.mark.parametrize(("kind", "seed"), [(kind, seed) for kind, seeds in SEEDS.items() for seed in seeds])
def test_no_rounding_decides_a_stored_answer(kind: str, seed: int) -> None:
    """The largest value of a window of the max pooling lies well above the others, whatever computes the convolution:
    in double precision convolutions differ by 1e-14."""
    detector = small(kind, seed)
    pictures = np.stack([case.picture(*SMALL, seed=seed + k) for k in range(3)])
    images = torch.from_numpy(pictures).permute(0, 3, 1, 2).double().contiguous() - detector.get_buffer("mean")
    trunk = detector.backbone
    windows = functional.unfold(functional.pad(trunk.bn1(trunk.conv1(images)).relu(), (1, 1, 1, 1)), 3, stride=2)
    best, second = windows.unflatten(1, (-1, 9)).topk(2, 2)[0].unbind(2)
    live = best > 0  # where nothing passes the ReLU, no gradient does
    assert int(live.sum()) > 10_000
    assert float((best - second)[live].min()) > 1e-9


def test_the_stored_answers_show_what_they_are_for() -> None:
    for kind, seeds in SEEDS.items():
        many, few = (read(STORED / f"{kind}_{seed}.npz") for seed in seeds)
        assert len(many["boxes/scores_3d"]) == 200
        assert (np.diff(many["boxes/scores_3d"]) <= 0).all()
        assert 20 <= len(few["boxes/scores_3d"]) < 200
        assert (np.diff(few["boxes/labels_3d"]) >= 0).all()
        assert (np.diff(few["boxes/scores_3d"]) > 0).any()


def check_export(reference: Reference, *, seed: int) -> None:
    """Boxes in the world from six cameras, in order."""
    to_ego, to_world = case.rig(seed=seed)
    seen = []
    for one in case.sightings(seed=seed):
        t = {name: torch.from_numpy(value) for name, value in one.items()}
        solid = Solids(t["centre"], t["size"], t["yaw"], t["velocity"], t["attribute"])
        seen.append(Detections(t["score"], t["label"], torch.zeros(len(t["label"]), 4), solid))
    found = merge_cameras(seen, list(to_ego), [to_world] * 6)
    assert len(found) == len(reference["score"]) < sum(len(one.score) for one in seen)
    np.testing.assert_array_equal(found.label, reference["label"])
    assert list(found.attribute) == reference["attribute"].tolist()
    mine = {"score": found.score, "translation": found.centre, "size": found.size_wlh, "velocity": found.velocity}
    for name, value in mine.items():
        np.testing.assert_allclose(value, reference[name], rtol=1e-6, atol=2e-5, err_msg=name)
    sign = np.sign((found.rotation * reference["rotation"]).sum(1, keepdims=True))
    np.testing.assert_allclose(found.rotation * sign, reference["rotation"], atol=2e-6)


def test_export_equals_the_stored_answer() -> None:
    check_export(read(STORED / "export.npz"), seed=3)


def run(out: Path, *arguments: str) -> Reference:
    script = TESTS / "helpers" / "mmdet3d_reference.py"
    done = subprocess.run(
        [str(PYTHON), "-W", "ignore", str(script), *arguments], check=False, capture_output=True, text=True
    )
    assert not done.returncode, done.stderr[-2000:]
    return read(out / "reference.npz")


@pytest.mark.skipif(PYTHON is None, reason="set SSAD_MMDET3D_PYTHON to an interpreter with mmdet3d 1.4.0")
@pytest.mark.parametrize(
    ("kind", "seed", "size"),
    [("fcos3d", 1, (416, 256)), ("fcos3d", 2, (333, 205)), ("pgd", 1, (416, 256)), ("pgd", 2, (333, 205))],
)
def test_equals_mmdet3d_itself(kind: str, seed: int, size: tuple[int, int], tmp_path: Path) -> None:
    width, height = size
    reference = run(tmp_path, kind, str(tmp_path), "--seed", str(seed), "--size", str(width), str(height))
    detector = load(kind, tmp_path / "weights.safetensors")
    maps, boxes = infer(detector, case.picture(width, height, seed=seed), case.cam2img(width, height))
    check_maps(maps, reference)
    check_boxes(boxes, reference)
    check_training(detector, reference, seed=seed, size=size)


@pytest.mark.skipif(PYTHON is None, reason="set SSAD_MMDET3D_PYTHON to an interpreter with mmdet3d 1.4.0")
@pytest.mark.parametrize("seed", range(5, 11))
def test_export_equals_mmdet3d_itself(seed: int, tmp_path: Path) -> None:
    check_export(run(tmp_path, "export", str(tmp_path), "--seed", str(seed)), seed=seed)

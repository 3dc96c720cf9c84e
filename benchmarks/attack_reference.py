"""Our attacks beside those of other libraries, and beside bare forward and backward passes, in one run.

    pip install --no-deps adversarial-robustness-toolbox torchattacks scikit-learn joblib threadpoolctl narwhals six
    python benchmarks/attack_reference.py art CLIPS [--images 8] [--steps 10] [--json FILE]
    python benchmarks/attack_reference.py torchattacks [--steps 10] [--json FILE]
    python benchmarks/attack_reference.py overhead CLIPS [--images 2] [--repeats 9] [--json FILE]
    python benchmarks/attack_reference.py precision DRIVES [--images 24] [--repeats 3] [--device cuda] [--json FILE]

art: PGD of adversarial-robustness-toolbox on YOLOv5n, wrapped as its estimator of object detectors, and ours, on the
same pictures, loss, budget and number of steps. torchattacks: its APGD and ours on a small network trained on the
handwritten digits of scikit-learn. precision: PGD with gradients in float32 and in bfloat16, on the light 3D detectors.
CLIPS: a folder that `ssad record --clips` wrote; DRIVES: one that `ssad record` wrote. FILE, such as
benchmarks/results/attacks.json, keeps the figures of the four side by side; benchmarks/page.py shows them.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections import defaultdict
from collections.abc import Sequence
from importlib import metadata
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.machine import retain_freed_memory
from ssad.detectors import make_detector
from ssad.detectors.on_scenes import score_2d
from ssad.scenarios.static.digital import Budget, make_attack, px, run_attack
from ssad.scenarios.static.digital.victim import Victim, steady
from ssad.training.batches import ImageSet, move
from ssad.training.data import nuscenes_items
from ssad.training.detector import coco_items

RADIUS = 5


def pictures(folder: Path, count: int) -> tuple[Tensor, list[Truth]]:
    """Some pictures of held-out towns with at least four objects, and their truth."""
    items = [item for item in coco_items(folder, "test")[1] if len(item.truth.label) >= 4]
    items = items[:: max(1, len(items) // count)][:count]
    images = torch.stack([torch.from_numpy(np.ascontiguousarray(item.read())) for item in items])
    return images.permute(0, 3, 1, 2).float() / 255, [item.truth for item in items]


class ForArt(nn.Module):
    """A detector as torchvision's are called: losses while it trains, detections else; the assignment is frozen."""

    def __init__(self, detector: Any, images: Tensor, truth: Sequence[Truth]) -> None:
        super().__init__()
        self.inner = [detector]
        self.anchor = nn.Parameter(torch.zeros(()))
        with torch.no_grad():
            self.assignment = detector.assign(detector.dense(images), truth)

    def forward(self, images: Any, targets: Any = None) -> Any:
        """Sum of the losses of each image, by name."""
        detector = self.inner[0]
        stacked = images if isinstance(images, Tensor) else torch.stack(list(images))
        if targets is None:
            found = detector.predict(stacked)
            return [{"boxes": one.box, "labels": one.label, "scores": one.score} for one in found]
        found = detector.losses(detector.dense(stacked), self.assignment, reduction="image")
        return {name: value.sum() for name, value in found.items()}


def score(detector: Any, images: Tensor, truth: Sequence[Truth]) -> float:
    """AP50 of a batch, after an 8-bit round trip."""
    stored = (images * 255).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1)
    return score_2d(detector, ImageSet(stored, tuple(truth)))["AP50"]


def beside_art(folder: Path, count: int, steps: int) -> dict[str, Any]:
    """AP50 and loss after PGD of the toolbox and after ours."""
    from art.attacks.evasion import ProjectedGradientDescent
    from art.estimators.object_detection import PyTorchObjectDetector

    images, truth = pictures(folder, count)
    detector = make_detector("yolov5n")
    rows = [{"attack": "clean", "AP50": score(detector, images, truth)}]
    with steady(detector):
        wrapped = ForArt(detector, images, truth)
        estimator = PyTorchObjectDetector(
            model=wrapped,
            input_shape=tuple(images.shape[1:]),
            clip_values=(0.0, 1.0),
            channels_first=True,
            attack_losses=("box", "obj", "cls"),
            device_type="cpu",
        )
        labels = [
            {"boxes": t.box.numpy(), "labels": t.label.numpy(), "scores": np.ones(len(t.label), np.float32)}
            for t in truth
        ]
        full = detector.losses(detector.dense(images), wrapped.assignment, reduction="image")
        rows[0]["loss"] = sum(float(v.mean()) for v in full.values())
        for share in (0.1, 0.2, 0.25):
            began = time.process_time()
            attack = ProjectedGradientDescent(
                estimator, eps=px(RADIUS), eps_step=share * px(RADIUS), max_iter=steps, batch_size=count, verbose=False
            )
            found = torch.from_numpy(attack.generate(images.numpy(), y=labels))
            used = time.process_time() - began
            with torch.no_grad():
                loss = detector.losses(detector.dense(found), wrapped.assignment, reduction="image")
            value = sum(float(v.mean()) for v in loss.values())
            name = f"PGD of adversarial-robustness-toolbox, step {share} of the radius"
            rows.append({"attack": name, "loss": value, "AP50": score(detector, found, truth), "cpu_s": used})
    for name in ("pgd", "apgd"):
        began = time.process_time()
        found = run_attack(
            make_attack(name, steps=steps), detector, images, truth, Budget(px(RADIUS)), objective="full", check=False
        )
        used = time.process_time() - began
        value = float(found.after.mean())
        left = score(detector, found.images, truth)
        rows.append({"attack": f"{name.upper()} of SSAD", "loss": value, "AP50": left, "cpu_s": used})
    return {"images": len(images), "radius_px": RADIUS, "steps": steps, "rows": rows, "versions": _versions()}


class Classifier(nn.Module):
    """A classifier as a detector with one location."""

    name, task = "digits", "2d"
    classes = tuple("0123456789")

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.net = nn.Sequential(
            nn.Conv2d(3, 24, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(24, 48, 3, 2, 1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(48 * 16, 10),
        )

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """One location, no objectness."""
        logit = self.net(images)[:, None]
        size = (images.shape[2], images.shape[3])
        box = images.new_tensor([0, 0, size[1], size[0]]).expand(len(images), 1, 4)
        one = torch.ones(1, device=images.device)
        return Dense(logit, None, box, one[:, None].expand(1, 2) * size[0] / 2, one, one.long(), {}, size=size)

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """The best class of each image."""
        best = self.net(images).softmax(1).max(1)
        whole = images.new_tensor([[0, 0, images.shape[3], images.shape[2]]])
        return [Detections(s[None], k[None], whole) for s, k in zip(best.values, best.indices, strict=True)]

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """The one location has the one label."""
        label = torch.stack([t.label[:1] for t in truth])
        return Assignment(label, torch.zeros_like(label), tuple(truth))

    def losses(self, dense: Dense, assignment: Assignment, *, reduction: str = "batch") -> dict[str, Tensor]:
        """Cross-entropy."""
        found = functional.cross_entropy(dense.logit[:, 0], assignment.label[:, 0], reduction="none")
        return {"cls": found if reduction == "image" else found.mean()}


def digits() -> tuple[Tensor, Tensor]:
    """Handwritten digits [N, 3, 8, 8] of 8 bits, and their labels."""
    from sklearn.datasets import load_digits

    data = load_digits()
    grey = torch.from_numpy((data.images / 16 * 255).round() / 255).float()
    return grey[:, None].expand(-1, 3, -1, -1).contiguous(), torch.from_numpy(data.target)


def beside_torchattacks(steps: int) -> dict[str, Any]:
    """Accuracy that is left after APGD of torchattacks and after ours, with both losses."""
    import torchattacks

    images, labels = digits()
    model = Classifier()
    optimizer = torch.optim.Adam(model.parameters(), lr=2e-3)
    learn, test = slice(0, 1400), slice(1400, None)
    for _ in range(200):
        optimizer.zero_grad()
        loss = functional.cross_entropy(model.net(images[learn]), labels[learn])
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    model.requires_grad_(False).eval()
    images, labels = images[test], labels[test]
    truth = [Truth(k[None], torch.tensor([[0.0, 0.0, 8.0, 8.0]])) for k in labels]

    def accuracy(found: Tensor) -> float:
        with torch.no_grad():
            return float((model.net((found * 255).round() / 255).argmax(1) == labels).float().mean())

    rows = []
    for radius in (10, 20, 30, 40):
        row: dict[str, float] = {"radius_px": radius}
        for loss_name in ("ce", "dlr"):
            attack = torchattacks.APGD(model.net, eps=px(radius), steps=steps, loss=loss_name)
            row[f"APGD of torchattacks, {loss_name}"] = accuracy(attack(images, labels))
        for name, objective in (("apgd", "full"), ("apgd", "mislabel"), ("pgd", "mislabel")):
            found = run_attack(
                make_attack(name, steps=steps), model, images, truth, Budget(px(radius)), objective=objective
            )
            row[f"{name.upper()} of SSAD, {objective}"] = accuracy(found.images)
        rows.append(row)
    clean = accuracy(images)
    return {"images": len(images), "steps": steps, "clean": clean, "rows": rows, "versions": _versions()}


def overhead(folder: Path, count: int, repeats: int) -> dict[str, Any]:
    """Time of PGD over that of its forward and backward passes alone, in turn."""
    images, truth = pictures(folder, count)
    detector = make_detector("yolov5n")
    attack = make_attack("pgd", schedule="constant")
    victim = Victim(detector, images, truth, _objective())

    def bare() -> None:
        for _ in range(10):
            asked = images.detach().requires_grad_()
            loss = victim.objective(detector.dense(asked), victim.situation)
            torch.autograd.grad(loss.sum(), asked)
        with torch.no_grad():
            detector.dense(images)  # for the target assignment
            for _ in range(3):  # the losses before, at the end and after rounding
                victim.objective(detector.dense(images), victim.situation)

    def whole() -> None:
        run_attack(attack, detector, images, truth, Budget(px(RADIUS)), objective=_objective(), check=False)

    ratios = []
    for number in range(repeats):
        seconds = {}
        for name, function in (("bare", bare), ("whole", whole))[:: 1 if number % 2 else -1]:
            began = time.process_time()
            function()
            seconds[name] = time.process_time() - began
        ratios.append(seconds["whole"] / seconds["bare"])
    ratios.sort()
    return {
        "images": len(images),
        "repeats": repeats,
        "ratio": statistics.median(ratios),
        "ratios": ratios,
        "interval": [ratios[1], ratios[-2]],
    }


def precisions(folder: Path, count: int, steps: int, device: str, repeats: int) -> dict[str, Any]:
    """How long PGD takes with gradients in float32 and in bfloat16, in turn, and which loss it reaches."""
    items = [item for item in nuscenes_items(folder, None, "val") if len(item.truth.label) >= 4]
    items = items[:: max(1, len(items) // count)][:count]
    images = torch.stack([torch.from_numpy(np.ascontiguousarray(item.read())) for item in items]).to(device)
    images = images.permute(0, 3, 1, 2).float() / 255
    truth = move([item.truth for item in items], torch.device(device))
    lens = torch.stack([one.intrinsic for one in truth if one.intrinsic is not None])
    rows: list[dict[str, Any]] = []
    for name, loss in product(("fcos3d-light", "pgd-det-light"), ("full", "margin")):
        detector = make_detector(name, device=device)
        reached, seconds = {}, defaultdict(list)
        for number, precision in product(range(repeats + 1), ("float32", "bfloat16")):
            began = time.perf_counter()
            found = run_attack(
                make_attack("pgd", steps=steps),
                detector,
                images,
                truth,
                Budget(px(RADIUS)),
                objective=loss,
                intrinsic=lens,
                precision=precision,
                check=False,
            )
            reached[precision] = [float(found.before.mean()), float(found.after.mean())]
            if number:  # the first warms up
                seconds[precision].append(time.perf_counter() - began)
        rows += [
            {
                "detector": name,
                "loss": loss,
                "precision": precision,
                "before": reached[precision][0],
                "after": reached[precision][1],
                "s": statistics.median(seconds[precision]),
            }
            for precision in seconds
        ]
    return {
        "images": len(images),
        "radius_px": RADIUS,
        "steps": steps,
        "repeats": repeats,
        "rows": rows,
        "device": torch.cuda.get_device_name() if device == "cuda" else device,
        "versions": _versions(),
    }


def _versions() -> dict[str, str]:
    wanted = ("torch", "adversarial-robustness-toolbox", "torchattacks")
    there = {one.metadata["Name"]: one.version for one in metadata.distributions()}
    return {name: there[name] for name in wanted if name in there}


def _objective() -> Any:
    from ssad.scenarios.static.digital import make_objective

    return make_objective("full")


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("art", "torchattacks", "overhead", "precision"))
    parser.add_argument("clips", type=Path, nargs="?")
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    retain_freed_memory()  # as workers do
    if chosen.what == "torchattacks":
        found = beside_torchattacks(chosen.steps)
    elif chosen.what == "art":
        found = beside_art(chosen.clips, chosen.images, chosen.steps)
    elif chosen.what == "precision":
        found = precisions(chosen.clips, chosen.images, chosen.steps, chosen.device, chosen.repeats)
    else:
        found = overhead(chosen.clips, chosen.images, chosen.repeats)
    print(json.dumps(found, indent=1))
    if chosen.json:
        kept = json.loads(chosen.json.read_text()) if chosen.json.is_file() else {}
        chosen.json.write_text(json.dumps({**kept, chosen.what: found}, indent=2) + "\n")


if __name__ == "__main__":
    main()

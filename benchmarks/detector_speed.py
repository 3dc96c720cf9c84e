"""Images a second of the detectors: python benchmarks/detector_speed.py [--device cpu|cuda] [--batch N] [--out FILE]

Each with fresh weights: forward (to dense outputs), forward and backward to the image (what an attack step costs), and
a training step (assignment, losses, backward, AdamW), in turns with torchvision's FCOS (ResNet-50) on pictures of the
same size; medians, and the ratio to it. With ultralytics installed, its YOLOv5nu and YOLOv5su too.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from ssad.core.detections import Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.detectors import make_detector
from ssad.detectors.adapters.torchvision_models import torchvision_detector

CASES = {  # name -> height, width
    "fcos3d-light": (450, 800),
    "pgd-det-light": (450, 800),
    "fcos3d": (450, 800),
    "pgd-det": (450, 800),
    "yolov3-tiny": (640, 640),
    "yolov5n": (640, 640),
    "yolov5s": (640, 640),
    "yolov3": (640, 640),
}
BESIDE = "torchvision:fcos_resnet50_fpn"


def truth_of(task: str, size: tuple[int, int], device: str) -> Truth:
    """Eight objects side by side."""
    h, w = size
    x = (torch.arange(8) + 0.5) * w / 8
    box = torch.stack([x - w / 20, torch.full((8,), 0.4 * h), x + w / 20, torch.full((8,), 0.7 * h)], 1).to(device)
    label = torch.arange(8, device=device) % 8
    if task == "2d":
        return Truth(label, box)
    focal = 0.79 * w
    lens = torch.tensor([[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1]], device=device)
    depth = torch.linspace(6, 40, 8)
    centre = torch.stack([(x - w / 2) / focal * depth, torch.full((8,), 0.5), depth], 1).to(device)
    size3 = torch.tensor([[4.5, 1.6, 1.9]], device=device).expand(8, 3)
    solid = Solids(centre, size3, torch.linspace(-3, 3, 8, device=device), torch.zeros(8, 2, device=device), label)
    return Truth(label, box, solid, lens)


def steps_of(detector: Any, size: tuple[int, int], batch: int, device: str) -> dict[str, Callable[[], object]]:
    """The three things that are timed."""
    images = torch.rand((batch, 3, *size), device=device)
    truth = [truth_of(detector.task, size, device)] * batch
    lens = torch.stack([t.intrinsic for t in truth if t.intrinsic is not None]) if detector.task == "3d" else None
    mixed = torch.autocast("cuda", torch.bfloat16) if device == "cuda" else nullcontext()

    def forward() -> None:
        with torch.no_grad():
            detector.dense(images, lens)

    def attack() -> torch.Tensor:
        free = images.clone().requires_grad_()
        dense = detector.dense(free, lens)
        losses = detector.losses(dense, detector.assign(dense, truth))
        return torch.autograd.grad(torch.stack(list(losses.values())).sum(), free)[0]

    optimizer = torch.optim.AdamW(detector.parameters(), lr=1e-6)

    def train() -> None:
        with mixed:
            dense = detector.dense(images, lens)
        losses = detector.losses(dense, detector.assign(dense, truth))
        optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        optimizer.step()

    def training() -> None:
        detector.requires_grad_(True).train()
        try:
            train()
        finally:
            detector.requires_grad_(False).eval()

    return {"forward": forward, "attack": attack, "training": training}


def seconds(run: Callable[[], object], device: str) -> float:
    """Wall time of a call."""
    if device == "cuda":
        torch.cuda.synchronize()
    begin = time.perf_counter()
    run()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - begin


def compare(pair: dict[str, Any], size: tuple[int, int], batch: int, device: str, repeats: int) -> dict[str, Any]:
    """Images a second of detectors, their steps run in turns."""
    ready = {name: steps_of(one, size, batch, device) for name, one in pair.items()}
    found: dict[str, Any] = {}
    for step in ("forward", "attack", "training"):
        times: dict[str, list[float]] = {name: [] for name in pair}
        for number in range(repeats + 2):
            for name, steps in ready.items():
                spent = seconds(steps[step], device)
                if number >= 2:
                    times[name].append(spent)
        for name, values in times.items():
            found.setdefault(name, {})[step] = round(batch / statistics.median(values), 2)
    return found


def main() -> None:
    """Measure and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=list(CASES))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    batch = args.batch or (32 if args.device == "cuda" else 2)
    repeats = args.repeats or (10 if args.device == "cuda" else 3)
    name = torch.cuda.get_device_name() if args.device == "cuda" else f"{torch.get_num_threads()} threads"
    result: dict[str, Any] = {"device": name, "machine": platform.machine(), "torch": torch.__version__, "batch": batch}
    rows = []
    for case in args.only:
        h, w = CASES[case]
        options = {} if "fcos3d" in case or "pgd" in case else {"classes": MMDET3D_CLASSES}
        ours = make_detector(case, weights="random", device=args.device, **options)
        beside = torchvision_detector(
            "fcos_resnet50_fpn", classes=MMDET3D_CLASSES, min_size=min(h, w), max_size=max(h, w)
        ).to(args.device)
        pair = {case: ours, BESIDE: beside}
        if case.startswith("yolov5"):
            try:
                from ssad.detectors.adapters.ultralytics import ultralytics_detector

                pair[f"ultralytics:{case}u"] = ultralytics_detector(f"{case}u", classes=MMDET3D_CLASSES).to(args.device)
            except ConfigError:
                pass
        speed = compare(pair, (h, w), batch, args.device, repeats)
        rows += [
            {"detector": n, "beside": case, "size": [w, h], "parameters": sum(p.numel() for p in pair[n].parameters())}
            | {"images_s": speed[n]}
            | {"ratio": {k: round(v / speed[BESIDE][k], 2) for k, v in speed[n].items()}}
            for n in pair
        ]
        print(json.dumps(rows[-len(pair) :]), flush=True)
    result["rows"] = rows
    text = json.dumps(result, indent=1)
    if args.out:
        args.out.write_text(text + "\n")


if __name__ == "__main__":
    main()

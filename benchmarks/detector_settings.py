"""How the light 3D detectors turn maps into boxes best: thresholds of suppression, votes, and how scores fade.

    python -m benchmarks.detector_settings DETECTOR DRIVES --out FILE [--weights FILE] [--device cuda] [--workers 8]
    python -m benchmarks.detector_settings DETECTOR DRIVES --out FILE --split val --try fade=0.02,vote=0.8 --try ...

DRIVES: a folder that `ssad record` wrote of TRAINING towns that this detector was not trained on (another seed); the
towns that are reported on must not decide. The maps of all its pictures are computed once; then one setting after the
other is changed, and the value with the largest sum of mAP and NDS is kept, until nothing gets better. FILE gets all
that was tried, the best last. With --try nothing is searched: these settings are scored, all others as they are.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.detector_accuracy import pairs
from ssad.core.detections import to_images
from ssad.core.errors import ConfigError
from ssad.core.images import read_image
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.truth import read_truth
from ssad.detectors import make_detector
from ssad.detectors.mono3d.multi_camera import merge_cameras
from ssad.detectors.on_scenes import SampleBoxes, box_table, score_figures
from ssad.metrics.detection import filter_boxes, match
from ssad.training.detector import parse_changes

SETTINGS: Mapping[str, tuple[float | None, ...]] = {
    "fade": (0.0, 0.01, 0.02, 0.03, 0.04),
    "vote": (None, 0.5, 0.6, 0.7, 0.8),
    "image_nms": (0.4, 0.5, 0.6, 0.7),
    "sure": (0.0, 0.5, 1.0),
    "nms": (0.1, 0.2, 0.3),
}
SEEN: list[Any] = []  # of each sample: token, poses, maps; the workers are forks and share it and the detector
DETECTOR: list[Any] = []


def look(detector: Any, root: Path, split: str, device: str) -> tuple[str, tuple[str, ...]]:
    """Fill SEEN with the maps of all samples; version and scenes."""
    with NuScenes(root) as data, torch.no_grad():
        scenes = scenes_of(data, split)
        for name in scenes:
            scene = data.scene(name)
            frames = [f for f in scene.frames if f.modality == "camera" and f.key_frame]
            for sample in scene.samples:
                own = [f for f in frames if f.sample_token == sample.token]
                lens = torch.from_numpy(np.stack([np.asarray(f.intrinsic, np.float32) for f in own])).to(device)
                dense = detector.dense(to_images([read_image(root / f.filename) for f in own], device), lens)
                maps = {key: [m.cpu().clone() for m in value] for key, value in dense.maps.items()}
                small = replace(dense, maps=maps, features=(), logit=dense.logit[:, :1].cpu())
                SEEN.append((sample.token, [(f.sensor_to_ego, f.ego_to_world) for f in own], small))
        return data.version, scenes


def boxes_of(task: tuple[Any, int, int]) -> list[SampleBoxes]:
    """Boxes of every n-th sample with a configuration."""
    config, first, step = task
    detector = DETECTOR[0]
    detector.config = config
    torch.set_num_threads(1)
    found = []
    for token, poses, dense in SEEN[first::step]:
        chosen = detector.select(dense, detector.config.threshold)
        found.append(SampleBoxes(token, merge_cameras(chosen, [a for a, _ in poses], [b for _, b in poses])))
    return found


def main() -> None:
    """Search, and write what was tried."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("detector")
    parser.add_argument("drives", type=Path)
    parser.add_argument("--split", default="train")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--try", dest="tries", action="append", default=[], metavar="KEY=VALUE,...")
    given = parser.parse_args()
    try:
        tries = [dict(parse_changes(text.split(","))) for text in given.tries]
    except ConfigError as error:
        parser.error(str(error).replace("--set", "--try", 1))
    for text, chosen in zip(given.tries, tries, strict=True):
        if not chosen.keys() <= SETTINGS.keys():
            parser.error(f"--try {text}: the settings are {', '.join(SETTINGS)}")
    detector = make_detector(given.detector, weights=given.weights, device=given.device)
    version, scenes = look(detector, given.drives, given.split, given.device)
    DETECTOR.append(detector.to("cpu"))
    truth = read_truth(given.drives, version, scenes=frozenset(scenes))
    real = filter_boxes(truth.boxes, points=truth.points, racks=truth.racks)
    usual = detector.config
    tried: dict[tuple[float | None, ...], dict[str, float]] = {}
    best = tuple(getattr(usual, name) for name in SETTINGS)
    with multiprocessing.get_context("fork").Pool(given.workers) as pool:

        def score(values: tuple[float | None, ...]) -> float:
            if values not in tried:
                config = replace(usual, **dict(zip(SETTINGS, values, strict=True)))
                parts = pool.map(boxes_of, [(config, k, given.workers) for k in range(given.workers)], chunksize=1)
                seen = box_table([one for part in parts for one in part], truth)
                seen = filter_boxes(seen, racks=truth.racks)
                tried[values] = score_figures(match(real, seen, samples=len(truth.samples)).scores())
                tried[values]["duplicates"] = pairs(real, seen)["duplicates a sample"]
            return tried[values]["mAP"] + tried[values]["NDS"]

        for chosen in tries:
            score(best := tuple(chosen.get(name, getattr(usual, name)) for name in SETTINGS))
        before = best if tries else None
        while best != before:
            before = best
            for k, (name, choices) in enumerate(SETTINGS.items()):
                if name == "sure" and not usual.pgd:
                    continue
                best = max([best, *((*best[:k], value, *best[k + 1 :]) for value in choices)], key=score)
    rows = [{**dict(zip(SETTINGS, v, strict=True)), **tried[v]} for v in (*(v for v in tried if v != best), best)]
    given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

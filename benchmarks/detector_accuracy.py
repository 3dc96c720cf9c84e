"""How well the shipped detectors see, by class, size, distance and light, in towns that they never saw.

    python benchmarks/detector_accuracy.py [--clips CLIPS ...] [--drives DRIVES] [--device cuda] [--out FILE]
        [--weights FOLDER]
    python benchmarks/detector_accuracy.py --page      # docs/results/accuracy.md from benchmarks/results/accuracy.json

CLIPS: folders that `ssad record --clips` wrote; DRIVES: a folder that `ssad record` wrote. Only pictures of held-out
towns count (splits test and val). What is not named stays as it was measured before. FOLDER: weights named as the
shipped ones, which are measured in their place.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ssad.core import safeio
from ssad.core.checkpoints import state_hash
from ssad.core.images import read_image
from ssad.core.nuscenes_names import ALIKE, CLASSES
from ssad.core.rotations import quaternion_to_yaw, wrap_angle
from ssad.core.seeding import generator
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.truth import read_truth
from ssad.detectors import make_detector
from ssad.detectors.on_scenes import box_table, detect, detect_2d, score_figures
from ssad.metrics.detection import BoxTable, filter_boxes, match, scene_intervals
from ssad.metrics.detection2d import Boxes2D, average_precision, match_2d
from ssad.recorders.target_images import recorded_views
from ssad.recorders.viewpoints import weather_name
from ssad.rendering.camera.labels import label_image
from ssad.rendering.camera.render import SceneWeather, render
from ssad.rendering.camera.sensor import BRIGHTEST, noise_levels
from ssad.training.detector import describe_data

ROOT = Path(__file__).parents[1]
RESULT, PAGE = ROOT / "benchmarks" / "results" / "accuracy.json", ROOT / "docs" / "results" / "accuracy.md"
EFFECTS = ROOT / "benchmarks" / "results" / "accuracy-effects.json"  # shipped weights on images with all effects
FLAT, SOLID = ("yolov3-tiny", "yolov5n"), ("fcos3d-light", "pgd-det-light")
CLEAR = 0.25  # least score of a detection that counts for recall
SIZES, DISTANCES = (8.0, 16.0, 24.0, 32.0, 64.0, 1e9), (0.0, 10.0, 20.0, 30.0, 50.0, 1e9)
RINGS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0)
REPLICATES = 400  # of the bootstrap over drives
FEW = 20  # objects: groups with fewer are left out
SMALL = 24.0  # px
FAINT = 4.0  # contrast-to-noise ratio below which a thing hardly stands out
WIDTHS = (960, 1280)  # px to which pictures of 640 px are enlarged inside 2D detectors
SCORES = (0.5, 0.25, 0.15, 0.1, 0.05, 0.01, 0.001)  # the last: all that a detector says


def commit() -> str:
    """Return the commit of this version and its date; without the repository: unknown."""
    words = ["git", "-C", str(ROOT), "log", "-1", "--format=%h (%cs)", "--abbrev=7"]
    finished = subprocess.run(words, capture_output=True, text=True, check=False)
    return finished.stdout.strip() or "unknown"


def weather_of(description: str) -> str:
    """Day, night, wet ... of a scene, from the words that `ssad.recorders.nuscenes.describe_weather` writes."""
    parts = re.search(r"sun (\d+) degrees (above|below) the horizon, clouds (\d+) %", description)
    if parts is None:
        raise SystemExit(f"a scene tells no weather: {description}")
    height = np.radians(float(parts[1])) * (1 if parts[2] == "above" else -1)
    fog, wet = (re.search(rf"{name} ([\d.]+)", description) for name in ("fog of", "wet road"))
    return weather_name(
        SceneWeather(
            height,
            clouds=float(parts[3]) / 100,
            fog=float(fog[1]) if fog else 0.0,
            wet=float(wet[1]) / 100 if wet else 0.0,
        )
    )


class TargetRecording:
    """The test pictures of some folders and what is in them, one row an object."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self.files: list[Path] = []
        self.weather: list[str] = []
        self.folders: list[str] = []
        self.classes: tuple[str, ...] = ()
        rows: list[tuple[Any, ...]] = []
        for folder in folders:
            data = safeio.read_json(folder / "annotations" / "test.json", limit=1 << 30)
            place = {row["id"]: len(self.files) + k for k, row in enumerate(data["images"])}
            self.files += [folder / "images" / row["file_name"] for row in data["images"]]
            self.weather += [row["weather"] for row in data["images"]]
            self.folders += [folder.name] * len(data["images"])
            self.classes = tuple(c["name"] for c in sorted(data["categories"], key=lambda c: c["id"]))
            rows += [
                (
                    place[one["image_id"]],
                    one["category_id"] - 1,
                    *one["bbox"],
                    one["iscrowd"],
                    one["target"],
                    one["distance"],
                )
                for one in data["annotations"]
            ]
        table = np.array(rows, np.float64)
        self.image, self.label = table[:, 0].astype(np.int32), table[:, 1].astype(np.int32)
        self.box = np.concatenate([table[:, 2:4], table[:, 2:4] + table[:, 4:6]], 1)
        self.side = np.sqrt(table[:, 4] * table[:, 5])
        self.crowd, self.target, self.distance = table[:, 6] > 0, table[:, 7] > 0, table[:, 8]

    def small(self, kind: str) -> np.ndarray[Any, Any]:
        """Which objects of this class are below 24 px and count."""
        return ~self.crowd & (self.label == self.classes.index(kind)) & (self.side < SMALL)

    @cached_property
    def contrast(self) -> np.ndarray[Any, Any]:
        """Contrast-to-noise ratio of small cars [N]; NaN for other objects.

        RMS difference of exposed light over their pixels, rendered with and without all bodies, over the standard
        deviation of the sensor's noise there.
        """
        contrasts = np.full(len(self.image), np.nan)
        shown = {file: number for number, file in enumerate(self.files)}
        small = self.small("car")
        wanted = {self.files[number] for number in np.unique(self.image[small])}
        for folder in dict.fromkeys(file.parents[1] for file in self.files):
            names = {file.name for file in wanted if file.parents[1] == folder}
            for one in recorded_views(folder, split="test", selected_keys=names):
                picture, street = (
                    render(one.scene, [view], quality=one.quality) for view in (one.view, replace(one.view, objects=()))
                )
                light, behind = (
                    np.minimum(p.radiance[0] * p.exposure[0], BRIGHTEST).mean(-1) for p in (picture, street)
                )
                photons, dark = noise_levels(one.view.sensor.noise, float(picture.exposure[0]))
                labels = label_image(one.scene, one.view, picture)
                for row in np.flatnonzero(small & (self.image == shown[folder / "images" / one.file])):
                    own = picture.tag[0] == labels.tag[np.abs(labels.box - self.box[row]).max(1).argmin()]
                    noise = np.sqrt(np.mean(photons * behind[own] + dark**2))
                    contrasts[row] = np.sqrt(np.mean((light[own] - behind[own]) ** 2)) / noise
        return contrasts

    def truth(self, counts: np.ndarray[Any, Any]) -> Boxes2D:
        """Objects of which only some count; the others take detections as crowds do."""
        return Boxes2D(self.image, self.label, self.box, ignore=self.crowd | ~counts)


def load_detector(name: str, device: str, folder: Path | None, **options: Any) -> Any:
    """Return a detector with the weights of a folder, or with the shipped ones."""
    return make_detector(
        name, weights=None if folder is None else folder / f"{name}.safetensors", device=device, **options
    )


def detections_of(name: str, clips: TargetRecording, device: str, folder: Path | None, **options: Any) -> Boxes2D:
    """All detections of a detector with these options, with the labels of the clips."""
    detector = load_detector(name, device, folder, **options)
    starts = range(0, len(clips.files), 16)
    batches = (np.stack([read_image(file) for file in clips.files[start : start + 16]]) for start in starts)
    detections = detect_2d(detector, map(torch.from_numpy, batches), device=device)
    assert detections.score is not None
    own = [clips.classes.index(c) if c in clips.classes else -1 for c in detector.classes]
    label = np.array(own, np.int32)[detections.label]
    known = label >= 0
    return Boxes2D(detections.image[known], label[known], detections.box[known], detections.score[known])


def recall(
    clips: TargetRecording,
    detections: Boxes2D,
    counts: np.ndarray[Any, Any],
    labels: int,
    *,
    least: float = CLEAR,
    iou: float = 0.5,
) -> float:
    """Share of the objects that count which a detection with this score and IoU finds."""
    assert detections.score is not None
    clear = detections.score >= least
    sure = Boxes2D(detections.image[clear], detections.label[clear], detections.box[clear], detections.score[clear])
    matched = match_2d(clips.truth(counts), sure, labels=labels, threshold=iou)
    return float((matched.hit & ~matched.ignored).sum() / matched.truth.sum())


def of_target(clips: TargetRecording, detections: Boxes2D, labels: int) -> dict[str, float]:
    """AP50 of what each recording is about, a car or a sign."""
    folder, scores = np.array(clips.folders)[clips.image], {}
    for recording in dict.fromkeys(clips.folders):
        aimed = clips.target & (folder == recording)
        kind = int(clips.label[aimed][0])
        scores[recording] = float(average_precision(clips.truth(aimed), detections, labels=labels)[kind])
    return scores


def small_cars(clips: TargetRecording, detections: Boxes2D, labels: int) -> dict[str, Any]:
    """Cars below 24 px: how many are found from each score on, and how often a score of so much is right."""
    car, weather, small = clips.classes.index("car"), np.array(clips.weather)[clips.image], clips.small("car")
    matched = match_2d(clips.truth(~clips.crowd), detections, labels=labels)
    assert detections.score is not None
    assert matched.row is not None
    box, score = detections.box[matched.row], detections.score[matched.row]
    tiny = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1]) < SMALL**2
    tiny &= (matched.label == car) & ~matched.ignored
    by_score = {}
    for low, high in zip(SCORES, (1.01, *SCORES), strict=False):
        own = tiny & (score >= low) & (score < high)
        part = {"boxes": int(own.sum()), "right": float(matched.hit[own].mean()) if own.any() else float("nan")}
        by_score[f"{low:g}-{high:g}"] = part | {"recall": recall(clips, detections, small, labels, least=low)}
    groups = {"all": small} | {light: small & (weather == light) for light in sorted(set(clips.weather))}
    by_light = {
        light: {
            "objects": int(own.sum()),
            "clear": recall(clips, detections, own, labels),
            "any": recall(clips, detections, own, labels, least=SCORES[-1]),
            "any, IoU 0.3": recall(clips, detections, own, labels, least=SCORES[-1], iou=0.3),
        }
        for light, own in groups.items()
        if own.any()
    }
    return {"by score": by_score, "by light": by_light, "by contrast": by_contrast(clips, detections, labels)}


def by_contrast(clips: TargetRecording, detections: Boxes2D, labels: int) -> dict[str, dict[str, float]]:
    """How many small cars are found of those with a low contrast-to-noise ratio, and of the others."""
    small, faint = clips.small("car"), clips.contrast < FAINT
    return {
        name: {"objects": int(own.sum()), "clear": recall(clips, detections, own, labels)}
        for name, own in (("faint", small & faint), ("others", small & ~faint))
    }


def flat_tables(name: str, clips: TargetRecording, device: str, folder: Path | None) -> dict[str, Any]:
    """One 2D detector: AP50 by class and light, recall by size and distance."""
    detections, labels = detections_of(name, clips, device, folder), len(clips.classes)
    every = ~clips.crowd
    ap = average_precision(clips.truth(every), detections, labels=labels)
    car = clips.classes.index("car")
    result: dict[str, Any] = {
        "AP50": {c: float(v) for c, v in zip(clips.classes, ap, strict=True) if np.isfinite(v)},
        "target": of_target(clips, detections, labels),
        "objects": {c: int((every & (clips.label == k)).sum()) for k, c in enumerate(clips.classes)},
    }
    weather = np.array(clips.weather)
    for light in sorted(set(clips.weather)):
        own, seen = weather[clips.image] == light, weather[detections.image] == light
        assert detections.score is not None
        part = Boxes2D(detections.image[seen], detections.label[seen], detections.box[seen], detections.score[seen])
        truth = Boxes2D(clips.image[own], clips.label[own], clips.box[own], ignore=clips.crowd[own])
        enough = [k for k in range(labels) if (every & own & (clips.label == k)).sum() >= FEW]
        values = average_precision(truth, part, labels=labels)
        result.setdefault("by light", {})[light] = {
            "mean": float(np.mean(values[enough])),
            "car": float(values[car]),
            "pictures": int((weather == light).sum()),
        }
    for what, values, edges in (("size", clips.side, SIZES), ("distance", clips.distance, DISTANCES)):
        for kind in ("car", "pedestrian", "stop_sign"):
            if kind not in clips.classes:
                continue
            for low, high in pairwise(edges):
                counts = every & (clips.label == clips.classes.index(kind)) & (values >= low) & (values < high)
                if counts.sum() >= FEW:
                    row = {"recall": recall(clips, detections, counts, labels), "objects": int(counts.sum())}
                    result.setdefault(f"by {what}", {}).setdefault(kind, {})[f"{low:g}-{high:g}"] = row
    result["recall below 24 px"] = {
        kind: recall(clips, detections, clips.small(kind), labels) for kind in ("car", "pedestrian")
    }
    result["small cars"] = small_cars(clips, detections, labels)
    enlarged = ((width, detections_of(name, clips, device, folder, input_width=width)) for width in WIDTHS)
    for width, width_detections in ((None, detections), *enlarged):
        values = average_precision(clips.truth(every), width_detections, labels=labels)
        result.setdefault("enlarged", {})[str(width or "as they are")] = {
            "mean": float(np.nanmean(values)),
            "target": of_target(clips, width_detections, labels),
            "small": recall(clips, width_detections, clips.small("car"), labels),
            "small, any": recall(clips, width_detections, clips.small("car"), labels, least=SCORES[-1]),
            "people": recall(clips, width_detections, clips.small("pedestrian"), labels),
        }
    return result


def between(boxes: BoxTable, low: float, high: float) -> BoxTable:
    """Boxes in a ring around the ego, m."""
    return boxes.take(np.flatnonzero((boxes.ego_distance >= low) & (boxes.ego_distance < high)))


def solid_tables(name: str, root: Path, device: str, folder: Path | None) -> dict[str, Any]:
    """One 3D detector: scores by class, light and distance, errors by class, duplicates."""
    detector = load_detector(name, device, folder)
    with NuScenes(root) as data:
        version, scenes = data.version, scenes_of(data, "val")
        light = {scene.name: weather_of(scene.description) for scene in data.scenes() if scene.name in scenes}
    result: dict[str, Any] = {}
    kinds = sorted(set(light.values()))
    groups = {"all": scenes} | {kind: tuple(s for s in scenes if light[s] == kind) for kind in kinds}
    boxes = detect(detector, root, version, scenes, device=device)
    for group, members in groups.items():
        truth = read_truth(root, version, scenes=frozenset(members))
        real = filter_boxes(truth.boxes, points=truth.points, racks=truth.racks)
        seen = filter_boxes(box_table(boxes, truth), racks=truth.racks)
        matches = match(real, seen, samples=len(truth.samples))
        scores = matches.scores()
        result.setdefault("by light", {})[group] = score_figures(scores, summary_only=True) | {"scenes": len(members)}
        if group != "all":
            continue
        result |= score_figures(scores) | {
            "errors": scores.label_tp_errors,
            "truth": dict(Counter(CLASSES[int(k)] for k in real.label)),
        }
        result["pairs"] = pairs(real, seen)
        limits = scene_intervals(matches, truth.scene, generator=generator("accuracy", name), replicates=REPLICATES)
        result["intervals"] = {"mAP": limits["mean_ap"], "NDS": limits["nd_score"]}
        for low, high in pairwise(RINGS):
            near, close = between(real, low, high), between(seen, low, high)
            own = match(near, close, samples=len(truth.samples)).scores()
            kept = [k for k, count in enumerate(own.truth) if count >= FEW]
            values = list(own.mean_dist_aps.values())
            result.setdefault("by distance", {})[f"{low:g}-{high:g}"] = {
                "mAP": float(np.mean([values[k] for k in kept])),
                "AP_car": own.mean_dist_aps["car"],
                "objects": len(near.label),
            }
    return result


def pairs(real: BoxTable, seen: BoxTable) -> dict[str, Any]:
    """Boxes that repeat what another one has found, by sample; and how often those that found it face the other way.

    They lie within 2 m of a true box of their class, but each true box there has been taken by a better one: the best
    box takes the nearest true one, and so on. People who walk side by side are no duplicates of each other.
    """
    assert seen.score is not None
    seen = seen.take(np.flatnonzero(seen.score >= 0.15))
    more = 0
    off: list[tuple[str, float, float]] = []  # class, distance, error of the yaw
    for sample in np.unique(real.sample):
        a, b = np.flatnonzero(real.sample == sample), np.flatnonzero(seen.sample == sample)
        b = b[np.argsort(-seen.score[b], kind="stable")]
        apart = np.linalg.norm(real.centre[a][:, None, :2] - seen.centre[b][None, :, :2], axis=-1)
        apart[(apart >= 2.0) | (real.label[a][:, None] != seen.label[b][None])] = np.inf
        free = np.ones(len(a), bool)
        for box, column in zip(b, apart.T, strict=True):
            own = np.where(free, column, np.inf)
            if np.isfinite(own).any():
                free[own.argmin()] = False
                true = a[own.argmin()]
                error = wrap_angle(np.subtract(*quaternion_to_yaw(np.stack([seen.rotation[box], real.rotation[true]]))))
                off.append((CLASSES[real.label[true]], float(real.ego_distance[true]), abs(float(error))))
            else:
                more += int(np.isfinite(column).any())
    return {"duplicates a sample": more / max(len(np.unique(real.sample)), 1), "turned": turned(off)}


def turned(off: Sequence[tuple[str, float, float]]) -> dict[str, dict[str, dict[str, float]]]:
    """By class (without those that look alike from both ends) and distance: how many, and the share turned round."""
    shares: dict[str, dict[str, dict[str, float]]] = {}
    for name in dict.fromkeys(c for c in CLASSES if c not in ALIKE):
        for low, high in ((0.0, RINGS[-1]), *pairwise(RINGS)):
            errors = np.array([e for c, d, e in off if c == name and low <= d < high])
            if len(errors) >= FEW:
                row = {"boxes": len(errors), "turned": float((errors > np.pi / 2).mean())}
                shares.setdefault(name, {})["all" if high - low > 10.0 else f"{low:g}-{high:g}"] = row
    return shares


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table."""
    line = "|---|" + "---:|" * (len(head) - 1)
    return ["| " + " | ".join(head) + " |", line, *("| " + " | ".join(row) + " |" for row in rows), ""]


def _with_all_but_night(lights: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Shares by light, with those of all but the night after those of all."""
    own = [row for light, row in lights.items() if light not in {"all", "night"}]
    many = sum(row["objects"] for row in own)
    rest = {key: sum(row[key] * row["objects"] for row in own) / many for key in own[0]} | {"objects": many}
    return {"all": lights["all"], "all but night": rest, **lights}


def small_lines(flat: dict[str, Any]) -> list[str]:
    """The part of the page on small cars."""
    parts = {name: dict(one["small cars"]) for name, one in flat.items()}
    for one in parts.values():
        one["by light"] = _with_all_but_night(one["by light"])
    scores, lights = (list(next(iter(parts.values()))[key].items()) for key in ("by score", "by light"))
    rows = [
        [
            key.replace("-", " to ").replace("1.01", "1"),
            *(f"{100 * one['by score'][key][what]:.0f}" for one in parts.values() for what in ("right", "recall")),
        ]
        for key, _ in scores
    ]
    lines = [
        f"### Cars below {SMALL:g} px",
        f"In percent. *Right*: share of the car boxes below {SMALL:g} px with a score in this range that lie on a car",
        "(IoU 0.5). *Found*: share of these cars that a box with such a score or a higher one finds.",
        "",
        *table(["score", *(f"{n}: {what}" for n in parts for what in ("right", "found"))], rows),
        "Below 0.5, scores of small cars are higher than the share that is right, so calibrated scores would not find",
        "more of them. The last row is the most that any threshold finds. Of the rest, most lie in the dark, or have a",
        "box that lies a little beside them: an IoU of 0.3 is reached far more often. Found, by light:",
        "",
    ]
    least = f"score {SCORES[-1]:g}"
    what = {"clear": f"score {CLEAR:g}", "any": least, "any, IoU 0.3": f"{least}, IoU 0.3"}
    rows = [
        [
            light,
            *(f"{100 * one['by light'][light][key]:.0f}" for one in parts.values() for key in what),
            str(row["objects"]),
        ]
        for light, row in lights
    ]
    lines += table(["light", *(f"{n}: {text}" for n in parts for text in what.values()), "cars"], rows)
    faint, others = (next(iter(parts.values()))["by contrast"][key]["objects"] for key in ("faint", "others"))
    shares = [
        " and ".join(f"{100 * one['by contrast'][key]['clear']:.0f} by {n}" for n, one in parts.items())
        for key in ("faint", "others")
    ]
    lines += [
        f"{faint} of these cars have a contrast-to-noise ratio below {FAINT:g} (RMS difference of light over their",
        "pixels, rendered with and without all bodies, over the standard deviation of the sensor's noise). Found of",
        f"100 of them, at a score of {CLEAR:g}: {shares[0]}; of 100 of the {others} others: {shares[1]}.",
        "",
    ]
    first = next(iter(next(iter(flat.values()))["target"]))  # of the recordings
    rows = [
        [
            name,
            width,
            *(f"{100 * score:.1f}" for score in (row["mean"], row["target"][first])),
            *(f"{100 * row[key]:.0f}" for key in ("small", "small, any", "people")),
        ]
        for name, one in flat.items()
        for width, row in one["enlarged"].items()
    ]
    columns = (
        "mean AP50",
        f"target of {first}",
        f"cars, score {CLEAR:g}",
        f"cars, {least}",
        f"people, score {CLEAR:g}",
    )
    return [
        *lines,
        "Pixels are part of it: with the same weights a detector can enlarge the pictures before it looks",
        "(`make_detector(NAME, input_width=960)`, in suites `NAME?input_width=960`; 2.25 times the pixels). At",
        "twice the width near objects are larger than those that were learned. In percent; cars and people: found of",
        f"those below {SMALL:g} px.",
        "",
        *table(["detector", "width inside, px", *columns], rows),
    ]


def effects_section(data: dict[str, Any]) -> list[str]:
    """Return the passage that compares these images with those of today, which have all effects of the rendering."""
    if not EFFECTS.is_file():
        return []
    effects = json.loads(EFFECTS.read_text())
    parts = [
        f"`{name}` {100 * float(np.mean(list(data['flat'][name]['AP50'].values()))):.1f} and "
        f"{100 * figures['AP50']:.1f} mean AP50"
        for name, figures in effects["flat"].items()
    ]
    parts += [
        f"`{name}` {100 * data['solid'][name]['mAP']:.1f} and {100 * figures['mAP']:.1f} mAP, "
        f"{100 * data['solid'][name]['NDS']:.1f} and {100 * figures['NDS']:.1f} NDS"
        for name, figures in effects["solid"].items()
    ]
    return [
        "The images of this page are older than the effects of the rendering and the streets of today. The shipped "
        f"weights on images of commit {effects['commit'].split()[0]}, recorded by the same commands with all effects "
        f"(first: this page; second: today's images): {'; '.join(parts)}.",
        "",
    ]


def page() -> str:
    """docs/results/accuracy.md, from what was measured."""
    data = json.loads(RESULT.read_text())
    flat, solid = data["flat"], data["solid"]
    weights = ", ".join(f"`{name}` {digits}" for name, digits in sorted(data["weights"].items()))
    weights = weights or "not recorded"
    lines = [
        "# Accuracy of the shipped detectors",
        "",
        f"> **Stored result.** Commit: {data['commit']}. Weights: {weights}. Torch: {data['torch']}. Make it anew: "
        "`python benchmarks/detector_accuracy.py --clips e_drive e_orbit e_sign --drives val3d2`, then the same with "
        "`--page`.",
        "",
        "`benchmarks/detector_accuracy.py` measures it and makes this page. All images show towns that were not used",
        "for training (Oldmarket and Larkhill):",
        "```",
        *data["clips"],
        *data["drives"],
        "```",
        "",
        *effects_section(data),
        "## 2D detectors",
        "AP50 in percent. *Target*: only the car or sign that each image is about counts. *Objects*: how many there",
        "are (8 px and more on each side, a quarter visible).",
        "",
    ]
    names = list(flat)
    first = flat[names[0]]
    rows = [
        [f"target of {folder}", *(f"{100 * flat[n]['target'][folder]:.1f}" for n in names), ""]
        for folder in first["target"]
    ]
    rows += [
        [c.replace("_", " "), *(f"{100 * flat[n]['AP50'].get(c, float('nan')):.1f}" for n in names), f"{count:,}"]
        for c, count in first["objects"].items()
        if c in first["AP50"]
    ]
    mean = [f"**{100 * np.mean(list(flat[n]['AP50'].values())):.1f}**" for n in names]
    lines += table(["class", *names, "objects"], [*rows, ["**mean of the classes**", *mean, ""]])
    lines += table(
        ["light", *(f"{n}, {what}" for n in names for what in ("mean", "car")), "pictures"],
        [
            [
                light,
                *(f"{100 * flat[n]['by light'][light][w]:.1f}" for n in names for w in ("mean", "car")),
                str(row["pictures"]),
            ]
            for light, row in first["by light"].items()
        ],
    )
    lines += [
        "Recall in percent: share of the objects that a detection with a score of 0.25 and an IoU of 0.5 finds. Size:",
        "the root of the box's area.",
        "",
    ]
    for what, unit in (("size", "px"), ("distance", "m")):
        kinds = [k for k in ("car", "pedestrian", "stop_sign") if k in first[f"by {what}"]]
        bins = list(dict.fromkeys(b for k in kinds for b in first[f"by {what}"][k]))
        rows = []
        for part in sorted(bins, key=lambda text: float(text.split("-")[0])):
            low, high = part.split("-")
            cells = [
                f"{100 * flat[n][f'by {what}'][k][part]['recall']:.0f}" if part in flat[n][f"by {what}"][k] else ""
                for k in kinds
                for n in names
            ]
            rows.append([f"{low} to {high} {unit}" if float(high) < 1e8 else f"{low} {unit} and more", *cells])
        lines += table([what, *(f"{k.replace('_', ' ')}, {n}" for k in kinds for n in names)], rows)
    lines += small_lines(flat)
    lines += [
        "## 3D detectors",
        "AP in percent, errors as nuScenes defines them (`-`: not defined for the class). *Duplicates*: boxes (score",
        "0.15 and more) within 2 m of true boxes of their class that better boxes have all found, a sample of six",
        "images, after the merge of the cameras. In brackets: 95 % intervals over drives.",
        "",
    ]
    names = list(solid)
    keys = ("mAP", "NDS", "mATE", "mASE", "mAOE", "mAVE", "mAAE")
    rows = [[k, *(score_of(solid[n], k) if k in keys[:2] else f"{solid[n][k]:.2f}" for n in names)] for k in keys]
    rows.append(["duplicates a sample", *(f"{solid[n]['pairs']['duplicates a sample']:.2f}" for n in names)])
    lines += table(["", *names], rows)
    shown = ("trans_err", "orient_err", "vel_err")
    lines += table(
        ["class", *(f"{n}: {what}" for n in names for what in ("AP", "m", "rad", "m/s")), "objects"],
        [
            [
                c.replace("_", " "),
                *(
                    text
                    for n in names
                    for text in (f"{100 * solid[n][f'AP_{c}']:.1f}", *(number(solid[n]["errors"][c][e]) for e in shown))
                ),
                f"{solid[names[0]]['truth'].get(c, 0):,}",
            ]
            for c in CLASSES
        ],
    )
    lines += turned_lines(solid)
    for what in ("light", "distance"):
        size = "scenes" if what == "light" else "objects"
        scores = ("mAP", "NDS") if what == "light" else ("mAP", "AP_car")
        lines += table(
            [what, *(f"{n}: {s.replace('AP_car', 'AP of cars')}" for n in names for s in scores), size],
            [
                [
                    f"{group} m" if what == "distance" else group,
                    *(f"{100 * solid[n][f'by {what}'][group][s]:.1f}" for n in names for s in scores),
                    f"{row[size]:,}",
                ]
                for group, row in solid[names[0]][f"by {what}"].items()
            ],
        )
    return "\n".join(lines).rstrip() + "\n"


def turned_lines(solid: dict[str, Any]) -> list[str]:
    """The part of the page on boxes that face the other way."""
    parts = {name: one["pairs"]["turned"] for name, one in solid.items()}
    rings = ["all", *(f"{low:g}-{high:g}" for low, high in pairwise(RINGS))]

    def cell(one: dict[str, float] | None) -> str:
        return f"{100 * one['turned']:.0f} % of {one['boxes']:,}" if one else ""

    rows = [
        [f"{kind.replace('_', ' ')}, {name}", *(cell(own[kind].get(ring)) for ring in rings)]
        for kind in next(iter(parts.values()))
        for name, own in parts.items()
        if kind in own
    ]
    return [
        "Turned round: share of the boxes (score 0.15 and more, each with the true box that it found) whose yaw errs",
        f"by more than a quarter turn, by distance. Groups with fewer than {FEW} are left out; 50 % is a guess.",
        "",
        *table(["boxes turned round", *(r if r == "all" else f"{r} m" for r in rings)], rows),
    ]


def score_of(one: dict[str, Any], name: str) -> str:
    """A score in percent with its interval."""
    low, high = one["intervals"][name]
    return f"{100 * one[name]:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def number(value: float | None) -> str:
    """An error with two digits, or a dash."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.2f}"


def main() -> None:
    """Measure, or write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", type=Path, nargs="*", default=[])
    parser.add_argument("--drives", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--weights", type=Path, help="folder of weights to measure in place of the shipped ones")
    parser.add_argument("--page", action="store_true", help="write docs/results/accuracy.md from what was measured")
    given = parser.parse_args()
    if given.page:
        PAGE.write_text(page())
        return
    result = json.loads(given.out.read_text()) if given.out.is_file() else {}
    folder = given.weights

    def measured_names(names: Sequence[str]) -> list[str]:
        return [name for name in names if folder is None or (folder / f"{name}.json").is_file()]

    measured: list[str] = []
    if given.clips:
        clips = TargetRecording(given.clips)
        result["clips"] = [describe_data(clip_folder) for clip_folder in given.clips]
        result["flat"] = {name: flat_tables(name, clips, given.device, folder) for name in measured_names(FLAT)}
        measured += measured_names(FLAT)
    if given.drives is not None:
        result["drives"] = [describe_data(given.drives)]
        result["solid"] = {
            name: solid_tables(name, given.drives, given.device, folder) for name in measured_names(SOLID)
        }
        measured += measured_names(SOLID)
    hashes = {name: state_hash(load_detector(name, "cpu", folder))[:12] for name in measured}
    result["weights"] = result.get("weights", {}) | hashes
    result |= {"commit": commit(), "torch": torch.__version__.partition("+")[0]}
    given.out.write_text(json.dumps(result, indent=1, default=float) + "\n")


if __name__ == "__main__":
    main()

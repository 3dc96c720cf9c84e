"""Score a results file of the nuScenes detection task against the ground truth of a dataset.

The numbers, and the keys under which they stand, are those of the official evaluation (nuscenes-devkit 1.2.0).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from ssad.core.errors import FormatError
from ssad.core.safeio import write_atomic
from ssad.core.seeding import generator
from ssad.datasets.nuscenes.results import read_results, with_ego
from ssad.datasets.nuscenes.splits import official_splits, scenes_of_split
from ssad.datasets.nuscenes.truth import GroundTruth, read_truth
from ssad.metrics.detection import CVPR_2019, DetectionConfig, check_counts, filter_boxes, match, scene_intervals

Check = Callable[[dict[str, Any], GroundTruth], dict[str, Any]]


def score_results(
    results: str | Path,
    *,
    dataroot: str | Path,
    version: str,
    split: str,
    config: DetectionConfig = CVPR_2019,
    replicates: int = 0,
    check: Check | None = None,
) -> dict[str, Any]:
    """Score a results file as the devkit does.

    Args:
        results: The file.
        dataroot: The nuScenes root.
        version: Its version.
        split: The split that the results are of.
        config: Settings of the task.
        replicates: Number of bootstrap replicates; 0: no intervals.
        check: Called with the meta of the file and the ground truth before anything is computed; it raises what it does
            not accept, and what it returns is added to `ssad`.

    Returns:
        The devkit's metrics_summary (label_aps ... meta), and under `ssad` what that does not have: AP by threshold,
        number of boxes that count by class, samples, scenes, wall time in seconds, and with replicates > 0 the limits
        of mAP and NDS (95 %, bootstrap over scenes). Values that have no meaning are NaN, as in the devkit.

    Raises:
        FormatError: The results or the tables are broken.
        ConfigError: There is no such version or split.
    """
    began = time.perf_counter()
    root = Path(dataroot)
    truth = read_truth(root, version, scenes=frozenset(scenes_of_split(root, version, split)))
    read = time.perf_counter()
    # for a split that it does not know the devkit picks the samples of the split from the file
    found = read_results(
        results, truth.samples, subset=split not in {*official_splits(), "all"}, max_boxes=config.max_boxes_per_sample
    )
    about = check(found.meta, truth) if check is not None else {}
    loaded = time.perf_counter()
    boxes = with_ego(found.boxes, truth.ego)
    try:
        check_counts(boxes, config=config, names=truth.samples)
        matches = match(
            filter_boxes(truth.boxes, config=config, points=truth.points, racks=truth.racks),
            filter_boxes(boxes, config=config, points=found.points, racks=truth.racks),
            samples=len(truth.samples),
            config=config,
            names=truth.samples,
        )
        scores = matches.scores()
    except FormatError as error:
        raise FormatError(f"{results}: {error}") from None
    done = time.perf_counter()
    own: dict[str, Any] = about | {
        "dist_aps": {str(t): float(np.mean(column)) for t, column in zip(config.dist_ths, scores.ap.T, strict=True)},
        "truth": dict(zip(config.classes, scores.truth.tolist(), strict=True)),
        "predictions": dict(zip(config.classes, scores.predictions.tolist(), strict=True)),
        "samples": len(truth.samples),
        "scenes": len(truth.scenes),
    }
    if replicates:
        random = generator("scene bootstrap", len(truth.scenes))
        limits = scene_intervals(matches, truth.scene, generator=random, replicates=replicates)
        own["intervals"] = {name: list(pair) for name, pair in limits.items()}
    own["wall_s"] = {"truth": read - began, "results": loaded - read, "evaluation": done - loaded}
    return scores.summary(eval_time=done - loaded, meta=found.meta) | {"ssad": own}


def write_summary(path: Path, summary: dict[str, Any]) -> None:
    """The numbers as JSON; NaN as the devkit writes it."""
    write_atomic(path, json.dumps(summary, indent=2) + "\n")


def tables(summary: dict[str, Any]) -> list[Table]:
    """What a reader wants to see first: the means, then a row a class."""
    own = summary["ssad"]
    limits = own.get("intervals", {})
    about = "clean" if own.get("data") != "shifted" else f"{own['shift']}, severity {own['severity']}"
    title = f"{own['samples']} samples of {own['scenes']} scenes, data: {about}"
    head = Table(title=title, title_justify="left", box=box.SIMPLE, pad_edge=False)
    for name in ("", "mAP", "NDS", "mATE", "mASE", "mAOE", "mAVE", "mAAE"):
        head.add_column(name, justify="right")
    kinds = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
    means = (summary["mean_ap"], summary["nd_score"], *(summary["tp_errors"][kind] for kind in kinds))
    head.add_row("", *(f"{value:.4f}" for value in means))
    for which, place in (("from", 0), ("to (95 %)", 1)):
        if limits:
            ends = (limits[key][place] for key in ("mean_ap", "nd_score"))
            head.add_row(which, *("n/a" if np.isnan(end) else f"{end:.4f}" for end in ends))
    rows = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
    rows.add_column("class", no_wrap=True)
    for name in ("AP", "ATE", "ASE", "AOE", "AVE", "AAE", "truth", "found"):
        rows.add_column(name, justify="right")
    for label, value in summary["mean_dist_aps"].items():
        mine = summary["label_tp_errors"][label]
        cells = (mine[key] for key in kinds)
        counts = (str(own["truth"][label]), str(own["predictions"][label]))
        rows.add_row(label, f"{value:.3f}", *("-" if np.isnan(c) else f"{c:.3f}" for c in cells), *counts)
    return [head, rows]

"""Score a results file of the nuScenes detection task against the ground truth of a dataset.

The numbers and their keys are those of the official evaluation (nuscenes-devkit 1.2.0).
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
from ssad.datasets.nuscenes.results import add_ego_distance, read_results
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
        split: The split of the results.
        config: Settings of the task.
        replicates: Number of bootstrap replicates; 0: no intervals.
        check: Called with the meta of the file and the ground truth before the evaluation; it raises to reject
            them, and its result is added to `ssad`.

    Returns:
        The devkit's metrics_summary (label_aps ... meta), and under `ssad` further values: AP by threshold, number
        of counted boxes by class, samples, scenes, wall time in seconds, and with replicates > 0 the limits of mAP
        and NDS (95 %, bootstrap over scenes). Undefined values are NaN, as in the devkit.

    Raises:
        FormatError: The results or the tables are broken.
        ConfigError: Unknown version or split.
    """
    start_time = time.perf_counter()
    root = Path(dataroot)
    truth = read_truth(root, version, scenes=frozenset(scenes_of_split(root, version, split)))
    truth_time = time.perf_counter()
    # for an unknown split the devkit picks the samples of the split from the file
    predictions = read_results(
        results, truth.samples, subset=split not in {*official_splits(), "all"}, max_boxes=config.max_boxes_per_sample
    )
    check_fields = check(predictions.meta, truth) if check is not None else {}
    results_time = time.perf_counter()
    boxes = add_ego_distance(predictions.boxes, truth.ego)
    try:
        check_counts(boxes, config=config, names=truth.samples)
        matches = match(
            filter_boxes(truth.boxes, config=config, points=truth.points, racks=truth.racks),
            filter_boxes(boxes, config=config, points=predictions.points, racks=truth.racks),
            samples=len(truth.samples),
            config=config,
            names=truth.samples,
        )
        scores = matches.scores()
    except FormatError as error:
        raise FormatError(f"{results}: {error}") from None
    end_time = time.perf_counter()
    ssad_fields: dict[str, Any] = check_fields | {
        "dist_aps": {
            str(threshold): float(np.mean(class_aps))
            for threshold, class_aps in zip(config.dist_ths, scores.ap.T, strict=True)
        },
        "truth": dict(zip(config.classes, scores.truth.tolist(), strict=True)),
        "predictions": dict(zip(config.classes, scores.predictions.tolist(), strict=True)),
        "samples": len(truth.samples),
        "scenes": len(truth.scenes),
    }
    if replicates:
        rng = generator("scene bootstrap", len(truth.scenes))
        limits = scene_intervals(matches, truth.scene, generator=rng, replicates=replicates)
        ssad_fields["intervals"] = {name: list(pair) for name, pair in limits.items()}
    ssad_fields["wall_s"] = {
        "truth": truth_time - start_time,
        "results": results_time - truth_time,
        "evaluation": end_time - results_time,
    }
    return scores.summary(eval_time=end_time - results_time, meta=predictions.meta) | {"ssad": ssad_fields}


def write_summary(path: Path, summary: dict[str, Any]) -> None:
    """Write the numbers as JSON; NaN as the devkit writes it."""
    write_atomic(path, json.dumps(summary, indent=2) + "\n")


def tables(summary: dict[str, Any]) -> list[Table]:
    """Return the means as a table, and a table with a row per class."""
    ssad_fields = summary["ssad"]
    limits = ssad_fields.get("intervals", {})
    data_description = (
        "clean"
        if ssad_fields.get("data") != "shifted"
        else f"{ssad_fields['shift']}, severity {ssad_fields['severity']}"
    )
    title = f"{ssad_fields['samples']} samples of {ssad_fields['scenes']} scenes, data: {data_description}"
    means_table = Table(title=title, title_justify="left", box=box.SIMPLE, pad_edge=False)
    for name in ("", "mAP", "NDS", "mATE", "mASE", "mAOE", "mAVE", "mAAE"):
        means_table.add_column(name, justify="right")
    error_names = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
    means = (summary["mean_ap"], summary["nd_score"], *(summary["tp_errors"][kind] for kind in error_names))
    means_table.add_row("", *(f"{value:.4f}" for value in means))
    for limit_name, limit_index in (("from", 0), ("to (95 %)", 1)):
        if limits:
            limits_of_means = (limits[key][limit_index] for key in ("mean_ap", "nd_score"))
            means_table.add_row(
                limit_name, *("n/a" if np.isnan(limit) else f"{limit:.4f}" for limit in limits_of_means)
            )
    class_table = Table(box=box.SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
    class_table.add_column("class", no_wrap=True)
    for name in ("AP", "ATE", "ASE", "AOE", "AVE", "AAE", "truth", "found"):
        class_table.add_column(name, justify="right")
    for label, value in summary["mean_dist_aps"].items():
        class_errors = summary["label_tp_errors"][label]
        cells = (class_errors[key] for key in error_names)
        counts = (str(ssad_fields["truth"][label]), str(ssad_fields["predictions"][label]))
        class_table.add_row(
            label, f"{value:.3f}", *("-" if np.isnan(cell) else f"{cell:.3f}" for cell in cells), *counts
        )
    return [means_table, class_table]

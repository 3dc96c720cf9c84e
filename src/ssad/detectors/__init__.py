"""Detectors: the AI components under test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ssad.registry import names, resolve

DETECTORS: dict[str, str] = {
    "fcos3d-light": "ssad.detectors.builders:fcos3d_light",
    "pgd-det-light": "ssad.detectors.builders:pgd_det_light",
    "fcos3d": "ssad.detectors.fcos3d:fcos3d",
    "pgd-det": "ssad.detectors.pgd_det:pgd_det",
    "yolov3": "ssad.detectors.yolov3:yolov3",
    "yolov3-tiny": "ssad.detectors.yolov3:yolov3_tiny",
    "yolov5n": "ssad.detectors.yolov5:yolov5n",
    "yolov5s": "ssad.detectors.yolov5:yolov5s",
}
SHIPPED = Path(__file__).parent / "weights"


def detector_names() -> dict[str, str]:
    """All names -> where they come from."""
    return names("detector", DETECTORS)


def make_detector(
    name: str, *, weights: str | Path | None = None, device: str = "cpu", seed: int = 0, **options: Any
) -> Any:
    """A detector by name, frozen and in eval mode on a device.

    weights: None: the shipped ones if there are any, else fresh ones; "random": fresh ones from `seed`; else a file
    (see `ssad.detectors.checkpoints.load_weights`; darknet's .weights for YOLOv3). options: what its builder takes.
    UnknownNameError, ConfigError, FormatError.
    """
    build = resolve("detector", DETECTORS, name)
    if name not in DETECTORS:
        made = build(**options) if callable(build) else build
        return made.to(device) if hasattr(made, "to") else made
    from ssad.detectors.checkpoints import fit_state, load_card, load_weights

    page = SHIPPED / f"{name}.json"
    if weights is None and page.is_file():
        card, state = load_card(page)
        if name.startswith("yolo"):
            options.setdefault("classes", card.classes)
        made = build(seed=seed, **options)
        fit_state(made, state, str(page))
    elif weights is None or str(weights) == "random":
        made = build(seed=seed, **options)
    elif str(weights).endswith(".weights"):
        from ssad.detectors.yolo.darknet import read_darknet

        made = build(seed=seed, **options)
        read_darknet(made, Path(weights))
    else:
        beside = Path(weights).with_suffix(".json")
        if name.startswith("yolo") and "classes" not in options and beside.is_file():
            from ssad.detectors.checkpoints import read_card

            options["classes"] = read_card(beside)[0].classes
        made = build(seed=seed, **options)
        fit_state(made, load_weights(weights), str(weights))
    return made.to(device)

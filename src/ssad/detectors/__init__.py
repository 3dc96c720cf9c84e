"""Detectors: the AI components under test."""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from ssad.core.errors import ConfigError, FormatError
from ssad.core.registry import Reference, check_arguments, make, names, resolve

DETECTORS: dict[str, str] = {
    "fcos3d-light": "ssad.detectors.builders:fcos3d_light",
    "fcos3d-light-robust": "ssad.detectors.builders:fcos3d_light",
    "pgd-det-light": "ssad.detectors.builders:pgd_det_light",
    "fcos3d": "ssad.detectors.fcos3d:fcos3d",
    "pgd-det": "ssad.detectors.pgd_det:pgd_det",
    "yolov3": "ssad.detectors.yolov3:yolov3",
    "yolov3-tiny": "ssad.detectors.yolov3:yolov3_tiny",
    "yolov5n": "ssad.detectors.yolov5:yolov5n",
    "yolov5s": "ssad.detectors.yolov5:yolov5s",
}
ONNX = "onnx:"
"""Before the name of a file: an exported detector (`ssad.detectors.adapters.onnx_detector`)."""
CENTERNET = "centernet:"
"""Before the archive of an npm package: a detector that saw photographs (`ssad.detectors.adapters.centernet`)."""
FILES: dict[str, str] = {
    ONNX: "ssad.detectors.adapters.onnx_detector:onnx_detector",
    CENTERNET: "ssad.detectors.adapters.centernet:centernet_detector",
}
"""Prefix of a name that goes on with a file -> builder that takes the file, which holds the weights."""
SHIPPED = Path(__file__).parent / "weights"


def detector_names() -> dict[str, str]:
    """Return the origin of every detector, by name."""
    return names("detector", DETECTORS)


def resolve_detector(name: str) -> Any:
    """Return the builder of a detector; that of "onnx:FILE" or "centernet:FILE" takes what follows the file's name.

    Args:
        name: Name of the detector, without arguments.

    Raises:
        SSADError: See `ssad.core.registry.resolve`; the packages of `onnx:FILE` are not installed.
        FormatError: There is no such file.
    """
    prefix = file_prefix(name)
    if not prefix:
        return resolve("detector", DETECTORS, name)
    path = Path(name.removeprefix(prefix)).expanduser()
    if not path.is_file() and not (prefix == CENTERNET and path.is_dir()):
        example = "FILE.onnx" if prefix == ONNX else "FILE.tgz (npm pack @vladmandic/human writes it)"
        raise FormatError(f"detector '{name}': no file {path}; name one that exists: {prefix}{example}")
    return partial(resolve("detector", {name: FILES[prefix]}, name), path)


def file_prefix(name: str) -> str:
    """Return the prefix of `FILES` that a name of a detector begins with; "" for none."""
    return next((prefix for prefix in FILES if name.startswith(prefix)), "")


def make_detector(
    name: str, *, weights: str | Path | None = None, device: str = "cpu", seed: int = 0, **options: Any
) -> Any:
    """Return a detector by name, frozen and in eval mode.

    Args:
        name: Name of the detector; arguments for its builder may follow, as in "mine:make?checkpoint=a.pt".
        weights: None for the shipped weights if there are any, else fresh ones; "random" for fresh weights from
            `seed`; else a file (see `ssad.core.checkpoints.load_weights`; darknet's .weights for YOLOv3).
        device: Device of the detector.
        seed: Seed of fresh weights.
        **options: Options of the detector's builder.

    Raises:
        UnknownNameError: There is no such detector.
        ConfigError: The builder refuses an option.
        FormatError: The weights cannot be read, or do not fit.
    """
    reference = Reference.parse(name)
    builder = resolve_detector(reference.name)
    check_arguments("detector", name, builder, extra_arguments=options)
    name, options = reference.name, {**reference.options, **options}
    if file_prefix(name) and weights is not None:
        raise ConfigError(f"detector '{name}': the file holds its weights; it takes no others")
    if name not in DETECTORS:
        detector = make("detector", name, builder, options, ("task", "classes", "predict"))
        return detector.to(device) if hasattr(detector, "to") else detector
    # Imported late: listing detectors must not load torch.
    from ssad.core.checkpoints import copy_state, load_weights

    if weights is None and (SHIPPED / f"{name}.json").is_file():
        weights = SHIPPED / f"{name}.safetensors"
    if weights is None or str(weights) == "random":
        return builder(seed=seed, **options).to(device)
    path = Path(weights).expanduser()
    state = {} if path.suffix == ".weights" else load_weights(path)
    if name.startswith("yolo"):
        options = (_classes_of(path) if "classes" not in options else {}) | options
    else:
        # The file decides the form of the yaw branch, so weights of both forms load by one name.
        options = {"heading": "vectors" if any(".heading_convs." in key for key in state) else "bins"} | options
    detector = builder(seed=seed, **options)
    if path.suffix == ".weights":
        from ssad.detectors.yolo.darknet import read_darknet

        read_darknet(detector, path)
        return detector.to(device)
    if path.parent == SHIPPED:
        _check_hash(path, state)
    copy_state(detector, state, path)
    return detector.to(device)


@lru_cache(maxsize=8)
def cached_detector(
    name: str, *, weights: str | None = None, device: str = "cpu", input_width: int | None = None
) -> Any:
    """Return a detector by name, built once per process and shared: do not change it.

    Args:
        name: See `make_detector`.
        weights: See `make_detector`.
        device: Device of the detector.
        input_width: Width of its input, px; None for the builder's default.

    Raises:
        SSADError: See `make_detector`.
    """
    options: dict[str, Any] = {} if input_width is None else {"input_width": input_width}
    return make_detector(name, weights=weights, device=device, **options)


def _classes_of(path: Path) -> dict[str, Any]:
    """Return the classes named by the card beside the weights, or nothing without a card."""
    from ssad.core.checkpoints import read_card

    return {"classes": read_card(path).classes} if path.with_suffix(".json").is_file() else {}


def _check_hash(path: Path, state: dict[str, Any]) -> None:
    """Raise FormatError unless shipped weights have the hash of their card."""
    from ssad.core.checkpoints import hash_state, read_card

    if hash_state(state) != read_card(path).hash:
        raise FormatError(f"{path}: not the weights that their card describes (another hash); install SSAD anew")

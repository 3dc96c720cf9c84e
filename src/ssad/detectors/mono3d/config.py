"""Configuration of monocular 3D detectors, and the presets.

Sources: Wang et al., FCOS3D (ICCVW 2021); Wang et al., PGD (CoRL 2021); mmdetection3d 1.4, nuScenes configurations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from ssad.core.errors import ConfigError

# mean and deviation of depth (m), and mean length, height, width (m), in the order of MMDET3D_CLASSES. The bicycle
# has the size of the construction vehicle: the published weights were trained with these numbers.
BASE_DEPTHS = (
    (31.99, 21.12),
    (37.15, 24.63),
    (39.69, 23.97),
    (40.91, 26.34),
    (34.16, 20.11),
    (22.35, 13.70),
    (24.28, 16.05),
    (27.26, 15.50),
    (20.61, 13.68),
    (22.74, 15.01),
)
BASE_DIMS = (
    (4.62, 1.73, 1.96),
    (6.93, 2.83, 2.51),
    (12.56, 3.89, 2.94),
    (11.22, 3.50, 2.95),
    (6.68, 3.21, 2.85),
    (6.68, 3.21, 2.85),
    (2.11, 1.46, 0.78),
    (0.73, 1.77, 0.67),
    (0.41, 1.08, 0.41),
    (0.50, 0.99, 2.52),
)


@dataclass(frozen=True, slots=True)
class Mono3DConfig:
    """Configuration of a monocular 3D detector.

    Attributes:
        name: Name of the detector.
        trunk: Depth of the ResNet: 101 or 50 (caffe style, deformable in its last two stages), or 18 for the
            light one of basic blocks.
        width: Channels of the first stage of the light trunk.
        channels: Channels of neck and heads.
        strides: Stride of each level.
        ranges: Largest distance from a place to a side of its box (pixels) that each level predicts.
        deformable: Whether the second convolutions of the heads are deformable.
        pgd: Whether to predict 2D boxes and depth bins, and to fuse the bins with the regressed depth (PGD).
        code_weights: Loss weights of offset, depth, size, yaw, velocity (and 2D box).
        threshold: Minimum score of a detection.
        nms: IoU on the ground above which the worse of two boxes of a class is dropped.
        image_nms: IoU in the image above which the worse of two boxes of a class is also dropped: two estimates
            of one object's depth do not overlap on the ground. None: not used, as in the source.
        vote: IoU in the image from which a dropped box contributes, by its score, to the place, size, velocity
            and yaw vectors of the surviving box of its class: neighbouring places estimate one object's distance,
            and their mean errs less (Gidaris and Komodakis, ICCV 2015). None: not used, as in the source.
        fade: Decay of scores with depth, 1/m: exp(-fade depth). Far boxes are misplaced more often, but without
            it score as high as near ones. 0: not used, as in the source.
        sure: Power of PGD's confidence of depth in the score; 1 as in the source.
        before: Places kept of each level before suppression.
        most: Maximum number of detections in an image.
        input_width: Width to which images are resized inside; None to keep their size.
        trained_width: `input_width` during training. The trunk halves the rows five times, and its output depends
            on the phase of the horizon among the remaining rows; cameras that look level always show the horizon
            at one height, so training covers a single phase. Images of another width get rows above them that
            restore the phase of training. None: no rows are added.
        horizon: Height of the horizon in the training images, as a share from their top.
        virtual_focal: Focal length (pixels, after resizing) of the camera for which depth is predicted; the depth
            is then scaled to the real one. None: no scaling.
        mean: Mean of B, G and R in 0..255.
        std: Standard deviation of B, G and R.
        start: Depth, length, height and width that fresh weights predict; None: 1, as in the source.
        rays: Whether the regression also receives the viewing direction of each place (tangents to the right of
            and below the optical axis), so that the line where an object meets the ground gives its distance for
            any lens.
        radius: Radius of centre sampling, in strides.
        dir_offset: Offset of the yaw's direction bins, rad.
        heading: Encoding of the yaw. "bins": a number within half a turn, and a bin that selects the half, as in
            the source. At the border of the bins (at `dir_offset` and half a turn on) the bin is a guess that
            flips the box, and the number has a discontinuity. "vectors": two vectors, which have neither: one
            with the direction of twice the yaw, which gives the axis, even of objects that look alike from both
            ends, and one whose component along the axis gives the direction (see `yaw_of_vectors`).
    """

    name: str
    trunk: int = 101
    width: int = 64
    channels: int = 256
    strides: tuple[int, ...] = (8, 16, 32, 64, 128)
    ranges: tuple[float, ...] = (48.0, 96.0, 192.0, 384.0, 1e8)
    deformable: bool = True
    pgd: bool = False
    code_weights: tuple[float, ...] = (1, 1, 0.2, 1, 1, 1, 1, 0.05, 0.05)
    threshold: float = 0.05
    nms: float = 0.8
    image_nms: float | None = None
    vote: float | None = None
    fade: float = 0.0
    sure: float = 1.0
    before: int = 1000
    most: int = 200
    input_width: int | None = None
    trained_width: int | None = None
    horizon: float = 492.0 / 900.0
    virtual_focal: float | None = None
    mean: tuple[float, float, float] = (103.530, 116.280, 123.675)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    start: tuple[float, float, float, float] | None = None
    rays: bool = False
    radius: float = 1.5
    dir_offset: float = 0.7854
    heading: Literal["bins", "vectors"] = "bins"

    def __post_init__(self) -> None:
        if self.trunk not in (18, 50, 101):
            raise ConfigError(f"{self.name}: trunk {self.trunk}; choose 18 (light), 50 or 101")
        if self.channels % 32 or len(self.ranges) != len(self.strides):
            raise ConfigError(f"{self.name}: channels must be a multiple of 32, and each stride needs a range")
        if any(stride != 8 << level for level, stride in enumerate(self.strides)) or not 3 <= len(self.strides) <= 5:
            raise ConfigError(f"{self.name}: strides are 8, 16, 32 and may go on to 64 and 128, not {self.strides}")
        if self.pgd and self.start is not None:
            raise ConfigError(f"{self.name}: PGD starts from its own mean depth and sizes; leave start out")
        if self.heading not in {"bins", "vectors"}:
            raise ConfigError(f"{self.name}: heading '{self.heading}'; choose bins or vectors")
        if self.input_width is not None and self.input_width < 64:
            raise ConfigError(f"{self.name}: input_width {self.input_width} is too small; it takes 64 or more")

    def with_changes(self, options: Mapping[str, Any]) -> Mono3DConfig:
        """Return a copy with other values; raise ConfigError for an unknown option."""
        option_names = {option.name for option in fields(self)}
        for name in options:
            if name not in option_names:
                raise ConfigError(
                    f"{self.name}: no option '{name}'; there are {', '.join(sorted(option_names - {'name'}))}"
                )
        return replace(self, **options)

    @property
    def regression_channels(self) -> tuple[int, ...]:
        """Channels of each part of the regression: offset, depth, size, yaw, velocity (, 2D box)."""
        yaw = 1 if self.heading == "bins" else 4
        return (2, 1, 3, yaw, 2, 4) if self.pgd else (2, 1, 3, yaw, 2)


_PGD_WEIGHTS = (1, 1, 0.2, 1, 1, 1, 1, 0.05, 0.05, 0.2, 0.2, 0.2, 0.2)
# With a weight of 0.05 the velocity is hardly learned in a short training: all objects appear to stand still.
_LIGHT_WEIGHTS = (1, 1, 0.2, 1, 1, 1, 1, 0.2, 0.2)
FCOS3D = Mono3DConfig("fcos3d")
PGD_DET = replace(FCOS3D, name="pgd-det", pgd=True, threshold=0.01, code_weights=_PGD_WEIGHTS)
FCOS3D_LIGHT = Mono3DConfig(
    "fcos3d-light",
    trunk=18,
    width=40,
    channels=128,
    strides=(8, 16, 32, 64),
    ranges=(32.0, 64.0, 128.0, 1e8),
    deformable=False,
    input_width=800,
    trained_width=800,
    virtual_focal=632.0,
    std=(57.375, 57.12, 58.395),
    start=(20.0, 4.0, 1.7, 1.8),
    rays=True,
    code_weights=_LIGHT_WEIGHTS,
    nms=0.3,
    image_nms=0.7,
    threshold=0.02,
    vote=0.7,
    fade=0.01,
    heading="vectors",
)
PGD_DET_LIGHT = replace(
    FCOS3D_LIGHT,
    name="pgd-det-light",
    pgd=True,
    threshold=0.01,
    start=None,
    sure=0.5,
    vote=0.8,
    fade=0.02,
    code_weights=(*_LIGHT_WEIGHTS, *_PGD_WEIGHTS[9:]),
)

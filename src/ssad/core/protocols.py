"""Protocol of detectors. Those of drivers and simulators are in `ssad.core.driving`.

A class need not inherit from a protocol: having its attributes and methods is enough. A package offers its detectors
by name through entry points, and `ssad list` shows them; without a package, a name of the form "module:object" is
imported from the working folder:

    [project.entry-points."ssad.detectors"]
    my-yolo = "my_package.detector:make"

Shape letters: B images of a batch, P places of a detector. Units are metres, seconds and radians.

Requirements on every implementation: a result must not depend on the images that share its batch, nor on the order of
batches; all randomness comes from `ssad.core.seeding`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

from ssad.core.detections import Assignment, Dense, Detections, Truth

if TYPE_CHECKING:
    from torch import Tensor


@runtime_checkable
class Detector(Protocol):
    """Finds objects in camera images; what is attacked, trained and scored.

    images are [B, 3, H, W] float32 (or float64), RGB in [0, 1], of any H and W; intrinsic is [B, 3, 3], in pixels of
    these images from their corner, and needed where `task` is "3d". All that the detector's source does to a picture
    (order of channels, mean, padding, size) happens inside and is differentiable. No call changes the detector's state
    or mode; its parameters are frozen (`requires_grad` is False) unless it is being trained.
    `ssad.detectors.check.check_detector` holds an implementation to this.

    An attack calls `dense` on the clean image and `assign` once, then `dense` and `losses` at every step: the
    assignment stays fixed, so that the loss is smooth.

    Attributes:
        name: What tables call it.
        task: "2d": boxes in the image. "3d": boxes in the camera's frame as well.
        classes: Names of what it finds; a label is an index into them.
    """

    name: str
    task: Literal["2d", "3d"]
    classes: tuple[str, ...]

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Detect objects, without gradient.

        Args:
            images: [B, 3, H, W].
            intrinsic: [B, 3, 3], for 3D.
            threshold: Minimum score of the result; None: the detector's own.

        Returns:
            The detections of each image, best first, overlaps suppressed as in the detector's source.

        Raises:
            ConfigError: Images or intrinsics are not of the shape, type or range above.
        """

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Compute the raw outputs, differentiable with respect to the images.

        Args:
            images: [B, 3, H, W].
            intrinsic: [B, 3, 3], for 3D.

        Returns:
            Outputs at all P places, before any threshold or suppression.

        Raises:
            ConfigError: As for `predict`.
        """

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Assign an object to each place, as in training (target assignment); not differentiable.

        Args:
            dense: Outputs for B images.
            truth: True objects of each of these images.

        Returns:
            Class and object of each place.
        """

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Compute the training losses.

        Args:
            dense: Outputs for B images.
            assignment: The target assignment for these outputs.
            reduction: "batch": normalised over the batch, as in training. "image": each image as if it were alone.

        Returns:
            The losses by name, weighted so that their sum is the loss of the detector's source: scalars for "batch",
            [B] for "image".

        Raises:
            ConfigError: The detector has no training losses; then its attribute `has_training_losses` is False.
        """

"""The seams of SSAD: what a part must offer so that others can use it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.types import F32, I32, Bool, Controller, Episode

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Observation:
    """What a driving system sees at one step: B egos, each in its own scene. Arrays are read-only copies.

    time [B] s; speed [B] m/s; accel [B] m/s^2; pose [B, 3] x, y, yaw in the world frame; target_speed [B] m/s;
    route [B, 40, 2]: the next 40 m of the route in the ego's frame (x forward, y left), one point a metre, the last
    one repeated past the end; lane_offset [B] m (left of the route is positive) and heading_error [B] rad;
    others [B, K, 7]: nearest other agents first, in the ego's frame: x, y, yaw, speed (along their own heading),
    length, width, kind (0 = empty row), within 60 m; signal [B, 2]: state (`SignalState`) of the next signal on the
    route and distance to its stop line in m; done [B]: episodes that have ended (their control is ignored).
    """

    time: F32
    speed: F32
    accel: F32
    pose: F32
    target_speed: F32
    route: F32
    lane_offset: F32
    heading_error: F32
    others: F32
    signal: F32
    done: Bool


@runtime_checkable
class DrivingSystem(Protocol):
    """What drives the ego.

    controller: EXTERNAL calls `act` each step (10 Hz); AUTOPILOT and FOLLOW run inside the world and `act` is never
    called. `reset` is called once before a batch of episodes. A result must not depend on which episodes share the
    batch. A system that has an attribute `target_speed` (m/s) drives at that speed instead of the episode's.
    """

    name: str
    controller: Controller

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget the past; B = len(episodes)."""

    def act(self, view: Observation) -> F32:
        """Controls [B, 3]: throttle in [0, 1], brake in [0, 1], steer in [-1, 1] (left positive).

        A fourth column above 0.5 drives the throttle in reverse.
        """


@runtime_checkable
class Simulator(Protocol):
    """A place where episodes run, B scenes at once; `ssad.world.check.check_world` holds an implementation to it.

    A scene's bits depend on its episode and its actions alone. `dt` s a step. `array(name)` gives at least `pose`
    [B, A, 3] (x, y, yaw), `speed` [B, A], `active` [B, A], `step` [B] and `end` [B].
    """

    dt: float
    batch: int
    agents: int
    episodes: tuple[Episode, ...]

    def reset(
        self,
        scenes: Sequence[int] | npt.NDArray[np.integer[Any]] | None = None,
        *,
        episodes: Sequence[int] | npt.NDArray[np.integer[Any]] | None = None,
    ) -> None:
        """Start scenes again (default: all), with other episodes if given."""

    def step(self, actions: npt.ArrayLike | None = None) -> None:
        """Advance every running scene by dt; actions [B, 3|4] for the egos or [B, A, 3|4] for all."""

    def ended(self) -> I32:
        """[B] 0 while an episode runs, else why it ended."""

    def array(self, name: str) -> npt.NDArray[Any]:
        """A state array by name."""

    def snapshot(self) -> Any:
        """All that changes, to be given back to `restore`."""

    def restore(self, snapshot: Any) -> None:
        """Continue from a snapshot."""

    def hashes(self) -> list[str]:
        """One hash a scene over all that changes."""


@runtime_checkable
class Detector(Protocol):
    """Finds objects in camera images; `ssad.detectors.check.check_detector` holds an implementation to it.

    images [B, 3, H, W] float32 (or float64) in [0, 1], RGB, any H and W; intrinsic [B, 3, 3] is needed where `task` is
    "3d". Everything that the detector's source does to a picture (order of channels, mean, padding, resizing) happens
    inside, differentiably. A result does not depend on the other images of the batch. No call changes the detector's
    state or mode; parameters are frozen (`requires_grad` False) unless it is being trained.
    """

    name: str
    task: Literal["2d", "3d"]
    classes: tuple[str, ...]

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Detections of each image, best first, without gradient; threshold: least score, default the detector's."""

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs, differentiable to the images."""

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Target assignment as in training: which object each location should predict. Not differentiable."""

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """The training losses by name, weighted so that their sum is the source's loss. "batch": scalars, normalised
        over the batch as in training; "image": [B], each image as if it were alone."""

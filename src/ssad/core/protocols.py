"""What a part must offer so that others can use it: driving systems, simulators and detectors.

A class need not inherit from a protocol: it is enough that it has these attributes and methods. A package offers its
classes by name through entry points, and `ssad list` shows them; without a package, a name of the form
"module:object" is imported from the working folder:

    [project.entry-points."ssad.systems"]
    careful = "my_package.driver:Careful"

    [project.entry-points."ssad.detectors"]
    my-yolo = "my_package.detector:make"

    ssad run quick --set systems=[careful,my_driver:Driver]

Shape letters: B scenes or images of a batch, A agents of a scene, K rows of a table of fixed length, N objects,
P places of a detector. Units are metres, seconds and radians. The world frame is right-handed (x east, y north, z up);
an agent's frame is x forward, y left.

What every implementation owes its callers: a result must not depend on which scenes or images share its batch, nor on
the order in which batches come; and what is random comes from `ssad.core.seeding` alone.
"""

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
    """What a driving system sees at one step: B egos, each in a scene of its own.

    The arrays are copies; to change them changes nothing in the world.

    Attributes:
        time: [B] s since the episode began.
        speed: [B] m/s along the ego's heading, negative in reverse.
        accel: [B] m/s^2 along the ego's heading.
        pose: [B, 3] x, y, yaw of the ego in the world frame.
        target_speed: [B] m/s that the ego should drive at where nothing hinders it.
        route: [B, 40, 2] the next 40 m of the route in the ego's frame, a point a metre; past its end the last point
            is repeated.
        lane_offset: [B] m from the route to the ego, positive to the left.
        heading_error: [B] rad from the route's heading to the ego's, positive where the ego points further left.
        others: [B, 16, 7] the agents within 60 m, nearest first, in the ego's frame: x, y, yaw, speed along their own
            heading, length, width, and kind (`ssad.core.types.AgentKind`). Rows that are not needed are 0, kind too.
        signal: [B, 2] state of the next signal on the route (`ssad.core.types.SignalState`) and metres to its stop
            line. Without a signal: 0 (off) and 1e6.
        done: [B] whether the episode has ended; its control is then ignored.
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
    """What drives the ego, ten times a second.

    A system that has an attribute `target_speed` (m/s) drives at that speed instead of the episode's. A short class may
    leave out `name` and `controller`: `ssad.drivers.make_system` fills them in.

    Attributes:
        name: What tables call it.
        controller: EXTERNAL: `act` is called at each step. AUTOPILOT and FOLLOW run inside the world, and `act` is
            never called.

    Example:
        A driver that brakes for what is ahead and steers for a point 6 m down its route::

            class Careful:
                def reset(self, episodes): ...

                def act(self, view):
                    x, y, kind = (view.others[..., k] for k in (0, 1, 6))
                    brake = ((kind > 0) & (x > 0) & (x < 15) & (abs(y) < 2)).any(1)
                    throttle = (view.speed < view.target_speed) & ~brake
                    steer = np.arctan2(view.route[:, 6, 1], view.route[:, 6, 0])
                    return np.stack([throttle, brake, np.clip(1.5 * steer, -1, 1)], 1).astype(np.float32)
    """

    name: str
    controller: Controller

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget the past; called once before each batch.

        Args:
            episodes: The B episodes that are driven next, in the order of the rows of `act`.
        """

    def act(self, view: Observation) -> F32:
        """Choose the controls of all egos for the next step.

        Args:
            view: What the B egos see now.

        Returns:
            [B, 3] throttle in [0, 1], brake in [0, 1] and steer in [-1, 1] (left positive, 1: wheels at full lock).
            With a fourth column, the throttle drives in reverse where that is above 0.5. A value that is not finite in
            a running episode fails the episode.
        """


@runtime_checkable
class Simulator(Protocol):
    """A place where episodes run, B scenes at once.

    What happens in a scene depends on its episode and its actions alone, to the bit.
    `ssad.world.check.check_world` holds an implementation to that.

    Attributes:
        dt: Seconds of a step.
        batch: Number of scenes B.
        agents: Number of agents A that a scene has room for; agent 0 is the ego.
        episodes: The episodes that scenes can run.
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
        """Start scenes again.

        Args:
            scenes: Numbers of the scenes; None: all of them.
            episodes: For each of these scenes the number of the episode that it runs from now on; None: the same again.

        Raises:
            ConfigError: There is no such episode.
        """

    def step(self, actions: npt.ArrayLike | None = None) -> None:
        """Advance every running scene by `dt`; those that have ended stay as they are.

        Args:
            actions: [B, 3] or [B, 4] controls of the egos, or [B, A, 3] or [B, A, 4] of all agents, as
                `DrivingSystem.act` returns them; agents that others drive ignore theirs. None: the last ones again.
        """

    def ended(self) -> I32:
        """Tell which scenes have ended.

        Returns:
            [B] 0 while an episode runs, else a number that says why it ended.
        """

    def array(self, name: str) -> npt.NDArray[Any]:
        """Read the state.

        Args:
            name: At least "pose", "speed", "active", "step" and "end" are there.

        Returns:
            The array: pose [B, A, 3] x, y, yaw; speed [B, A] m/s; active [B, A], 0 where nobody is; step [B], steps
            since the start; end [B], as `ended`.
        """

    def snapshot(self) -> Any:
        """Keep all that changes.

        Returns:
            What `restore` of the same simulator takes.
        """

    def restore(self, snapshot: Any) -> None:
        """Go on from an earlier moment, to the bit.

        Args:
            snapshot: What `snapshot` returned.

        Raises:
            ConfigError: The snapshot is of a simulator of another size.
        """

    def hashes(self) -> list[str]:
        """Sum up the state.

        Returns:
            B texts over all that changes in a scene, whatever its place in the batch: equal where scenes are equal to
            the bit.
        """


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
        """Find objects, without gradient.

        Args:
            images: [B, 3, H, W].
            intrinsic: [B, 3, 3], for 3D.
            threshold: Least score of what is returned; None: the detector's own.

        Returns:
            For each image what was found in it, best first, overlaps suppressed as the detector's source does.

        Raises:
            ConfigError: Images or intrinsics are not of the shape, type or range above.
        """

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Compute the raw outputs, differentiable to the images.

        Args:
            images: [B, 3, H, W].
            intrinsic: [B, 3, 3], for 3D.

        Returns:
            Outputs at all P places, before any threshold or suppression.

        Raises:
            ConfigError: As for `predict`.
        """

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Decide which object each location should predict, as in training (target assignment); not differentiable.

        Args:
            dense: Outputs for B images.
            truth: What is in each of these images.

        Returns:
            Class and object of each location.
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
        """

"""One type for all that stands between the world and a driving system: shifts, attacks, lights, faults, your own.

A perturbation acts in three places through the same object: on the recorded scenes of a data set (`on_scene`), on
recorded images of a target that can wear textures and be lit (`on_target`), and in the closed loop (`in_loop`). An
implementation derives from `Perturbation` and overrides those that make sense for it; the others say why they do not.

    for perturbation in perturbations_of(parse_perturbation({"fog": 3})):
        suite = perturbation.in_loop(SensorSuite(cameras=driver.cameras), target=0, victim=None, seed=0)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import file_name
from ssad.core.source import source_version
from ssad.core.types import F64, U8, Episode
from ssad.datasets.nuscenes.scene import SceneData, SensorFrame

if TYPE_CHECKING:  # torch and Warp are not needed to name and parse perturbations
    from torch import Tensor

    from ssad.core.detections import Truth
    from ssad.core.protocols import Detector
    from ssad.rendering.camera.scene_edit import SceneEdit
    from ssad.rendering.sensor_suite import SensorSuite
    from ssad.scenarios.static.physical import TextureSurface, TextureView

EGO = 0
"""Number of the ego: the target of a perturbation of its sensors, its own state or its commands."""


@dataclass(frozen=True, slots=True)
class RecordedScene:
    """A recorded scene of a data set in the nuScenes schema.

    Attributes:
        root: Folder of the data set.
        version: Version of its tables.
        data: Samples, frames and boxes of the scene.
        seed: Root of the random numbers.
        device: Device of the computation.
        batch: Camera images that may be computed at once on a GPU.
        folder: Folder for work that a stopped run continues from; None: nothing is kept.
        inputs: Further data that identify the run, for caches.
    """

    root: Path
    version: str
    data: SceneData
    seed: int = 0
    device: str = "cpu"
    batch: int = 12
    folder: Path | None = None
    inputs: tuple[Any, ...] = ()


@dataclass(frozen=True, slots=True)
class RecordedMoment:
    """Time of recorded readings, in place of a `WorldState`: [N] s since the scene began."""

    time: F64


ImageLoader = Callable[[Sequence[SensorFrame]], Sequence[U8]]
"""From camera frames of one scene, in order of time, to their images uint8 RGB [H, W, 3]."""


@dataclass(slots=True)
class PerturbedScene:
    """A recorded scene as detectors receive it.

    Attributes:
        load_images: Returns the images of camera frames; None: the unmodified files.
        notes: Returns counts for the record by name, complete after the last image; a digital attack returns its tally.
        ahead: Whether the next images may be made while a detector processes these.
        images_at_once: Camera images that should be asked for together; 0: any number.
        done: Called when the detections are stored.
    """

    load_images: ImageLoader | None = None
    notes: Callable[[], Mapping[str, Any]] = field(default=dict)
    ahead: bool = True
    images_at_once: int = 0
    done: Callable[[], None] = lambda: None


class SceneVictim(Protocol):
    """The detector that recorded images are perturbed for.

    Attributes:
        name: Name of the system.
        detector: The detector.
        reason: Reason of its failure; "" while it works.
    """

    name: str
    detector: Detector
    reason: str

    @property
    def task(self) -> str:
        """Task of the detector: 2d or 3d."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of the detector."""

    def failed(self, error: Exception) -> None:
        """Record an error of the detector; raise it if memory is exhausted or the device is lost."""


class TargetImages(Protocol):
    """Recorded images of a target that can wear textures and be lit."""

    @property
    def device(self) -> str:
        """Device of the images."""

    def clean(self) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image [1, 3, H, W] in 0 to 1, and truth, as recorded."""

    def wearing(self, surface: TextureSurface) -> Iterator[tuple[str, TextureView]]:
        """Yield drive and image with a target that is ready for a texture on a surface."""

    def lit(self, hour: str, edit: SceneEdit) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image [1, 3, H, W] in 0 to 1, and truth, at an hour and with an edit around the target."""


class Perturbation:
    """Base of all perturbations (paper III.A): one object for recordings and for the closed loop.

    Attributes:
        name: Name in tables and slices, such as "fog" or "pgd?steps=2"; it says everything but the severity.
        family: shift, digital, texture, light, fault, or a family of your own.
        severity: 1 to 5; 1 for a perturbation without severities; for shifts of recorded scenes also "random".
    """

    name: str
    family: str
    severity: Any = 1

    @property
    def folder(self) -> str:
        """Name of the folder below which detections under it are stored."""
        return file_name(f"{self.name}-{self.severity}")

    def version(self) -> str:
        """Return a hash of what decides the result besides SSAD's source: weights, textures, a module of yours.

        By default 12 hex digits over the source of the module of its class; "" for a class of SSAD.
        """
        module = type(self).__module__
        return "" if module.startswith("ssad.") else source_version(module)

    def applies_to(self, episode: Episode, town: LaneGraph) -> int | None:  # of the interface
        """Return the agent of an episode that the perturbation is on; None: it has none, and is left out.

        Args:
            episode: The episode.
            town: Lane graph of its town.

        Returns:
            `EGO` for the ego's sensors, state and commands, and for the signs of the town; else an agent's number.
        """
        return EGO

    @property
    def needs_target(self) -> bool:
        """True if it needs something to be on: recordings of a target, or another agent than the ego."""
        return False

    @property
    def needs_place(self) -> bool:
        """True if it is on something along the route of the ego: episodes to which it does not apply are left out."""
        return False

    @property
    def target(self) -> str:
        """Target that it is made for, as for `ssad record --target`; "" for a perturbation of sensors."""
        return ""

    @property
    def needs_victim(self) -> bool:
        """True if recorded images are made against one detector, and are not the same for all."""
        return False

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the sensors of a driver in the closed loop under the perturbation.

        Args:
            suite: The sensors without it.
            target: Result of `applies_to`.
            victim: Detector of the driver, which attacks are made against; None: it has none.
            seed: Root of the random numbers.

        Raises:
            ConfigError: It cannot act in the loop, or not on these sensors.
        """
        raise ConfigError(f"{self.family} '{self.name}' does not act in the closed loop")

    def on_scene(self, scene: RecordedScene, victim: SceneVictim | None) -> PerturbedScene:
        """Return a recorded scene under the perturbation.

        Args:
            scene: The scene.
            victim: Detector that attacks are made against; None for a perturbation that needs none.

        Raises:
            ConfigError: It cannot act on recorded scenes.
        """
        advice = "it needs a recorded target (ssad record --target)" if self.needs_target else "it acts in the loop"
        raise ConfigError(f"{self.family} '{self.name}' does not act on recorded scenes: {advice}")

    def clean_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield the images of a recorded target that those under the perturbation are compared with."""
        return images.clean()

    def on_target(self, images: TargetImages) -> Iterator[tuple[str, Tensor, Truth]]:
        """Yield drive, image [1, 3, H, W] in 0 to 1, and truth of a recorded target under the perturbation.

        Raises:
            ConfigError: It cannot act on a recorded target.
        """
        raise ConfigError(f"{self.family} '{self.name}' does not act on a recorded target; give it recorded scenes")

"""Digital attacks as perturbations: of recorded scenes, and of every image of a driver in the loop."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ssad.core.errors import ConfigError
from ssad.core.seeding import file_name
from ssad.scenarios.static.digital.budget import Budget, px
from ssad.scenarios.static.digital.live import LiveAttack
from ssad.scenarios.static.digital.live_universal import universal_change
from ssad.scenarios.static.digital.saved_images import FOLDER, SavedImages
from ssad.scenarios.static.digital.scene_attacker import SceneAttacker
from ssad.scenarios.static.digital.spec import AttackSpec
from ssad.scenarios.static.digital.universal import UniversalFit
from ssad.scenarios.static.perturbation import Perturbation, PerturbedScene, RecordedScene, SceneVictim

if TYPE_CHECKING:
    from ssad.rendering.sensor_suite import SensorSuite

BATCH_CPU, BATCH_GPU = 8, 24  # images that are attacked at once in the loop; other processes may share the GPU


@dataclass(frozen=True, slots=True)
class DigitalAttack(Perturbation):
    """Digital attack with all its settings (paper III.A.1).

    Attributes:
        spec: The attack, its loss, its budget and its aim.
        name: Name in tables and slices.
        severity: Severity that set the radius; 1 if the radius was given.
        reference_images: Number of images of a recorded scene on which the attack is compared with the reference
            ensemble.
    """

    spec: AttackSpec
    name: str = ""
    severity: int = 1
    reference_images: int = 0
    family: str = field(default="digital", init=False)

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.spec.attack)

    @property
    def folder(self) -> str:
        """Name of the folder of its detections: it tells all settings apart."""
        return self.spec.name

    @property
    def needs_victim(self) -> bool:
        """True, but for random noise, which attacks no detector."""
        return self.spec.make().access != "none"

    def version(self) -> str:
        """Return the versions of an attack and a loss of the user's own; "" for those of SSAD."""
        return self.spec.version

    def on_scene(self, scene: RecordedScene, victim: SceneVictim | None) -> PerturbedScene:
        """Return attacked images, made once against the victim; the notes are the cost of the attack.

        A missing or wrong gradient is recorded as a failure of the victim.

        Raises:
            ConfigError: There is no victim.
        """
        if victim is None:
            raise ConfigError(f"attack '{self.name}' needs a detector to attack")
        saved_images = None
        if scene.folder is not None:
            scene_folder = (
                f"{self.spec.name}{f'@{file_name(victim.name)}' if victim.name else ''}/{scene.data.record.name}"
            )
            saved_images = SavedImages(scene.folder / FOLDER / scene_folder)
        attacker = SceneAttacker(self.spec, scene, victim, victim.name, saved_images, self.reference_images)
        return PerturbedScene(
            attacker.look,
            attacker.tally.notes,
            ahead=False,
            images_at_once=scene.batch,
            done=saved_images.forget if saved_images else _do_nothing,
        )

    def in_loop(self, suite: SensorSuite, *, target: int, victim: Any, seed: int) -> SensorSuite:
        """Return the suite with every image of its cameras attacked by itself.

        Raises:
            ConfigError: The attack is about one object of a recording, or the universal attack has no other drives.
        """
        spec = self.spec
        if spec.object or spec.draws:
            raise ConfigError(f"attack '{self.name}': an object or the draws of a defence are of recorded scenes only")
        if not suite.cameras:
            raise ConfigError(f"attack '{self.name}' changes camera images, and this system has no camera")
        budget, batch = Budget(px(spec.radius), spec.norm), BATCH_CPU if suite.device == "cpu" else BATCH_GPU
        for channel, camera in suite.cameras.items():
            attack: Any = spec.make()
            if isinstance(attack, UniversalFit):
                attack = universal_change(attack, victim, camera, budget, suite=suite, batch=batch, loss=spec.loss)
            change = LiveAttack(
                attack,
                budget,
                objective=spec.loss,
                aim=spec.aim,
                detector=victim,
                intrinsic=camera.intrinsic,
                batch=batch,
            )
            suite = suite.with_reading_change(channel, change)
        return suite


def _do_nothing() -> None:
    """Do nothing: no images were saved."""

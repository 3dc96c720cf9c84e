"""Perceiving systems of suites of kind `gap`: the keys that describe one, and the driver that they make."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from pydantic import Field

from ssad.core.checkpoints import state_hash
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import CAMERAS
from ssad.core.schema import Schema
from ssad.drivers.perceiving.driver import Known, Perceiving, Sighting
from ssad.drivers.perceiving.eyes import CameraEyes, PerfectEyes, front
from ssad.drivers.perceiving.repair import Repair
from ssad.drivers.perceiving.signs import SignReading, sign_labels
from ssad.drivers.perceiving.tracker import Tracking, tracking_of

Share = Field(default=0.0, ge=0, lt=1, allow_inf_nan=False)


class PerceivingSystem(Schema):
    """Perceiving system of a suite.

    Attributes:
        name: name in tables.
        detector: `ssad list detectors`; truth: a perfect detector, which is given the truth.
        weights: a file of weights; none: the shipped ones.
        cameras: cameras of the nuScenes rig.
        width: width of their images, pixels.
        input_width: width to which a 3D detector resizes them; none: its own.
        rate: images a second.
        latency: time from an image to its detections, s.
        confirm: hits after which an object is believed (H).
        reserve: images without a hit after which it is dropped (R).
        high, low: scores of the tracker's two stages; none: those that suit the detector.
        reads_signs: true: stop signs are read by the detector; false: they are known from the map.
        sign_memory: time that a sign is remembered after its last reading, s; none: until it has been passed.
        missed, burst, noise, phantoms: errors of a perfect detector (`ssad.drivers.perceiving.eyes.PerfectEyes`).
    """

    name: str = Field(min_length=1)
    detector: str = "fcos3d-light"
    weights: str | None = None
    cameras: list[Literal[CAMERAS]] = Field(default=["CAM_FRONT"], min_length=1)  # type: ignore[valid-type]
    width: int = Field(default=640, ge=64, le=1600)
    input_width: int | None = Field(default=None, ge=64, le=3200)
    rate: float = Field(default=5.0, gt=0, le=100, allow_inf_nan=False)
    latency: float = Field(default=0.1, ge=0, le=10, allow_inf_nan=False)
    confirm: int = Field(default=2, ge=1)
    reserve: int = Field(default=6, ge=0)
    high: float | None = Field(default=None, ge=0, le=1)
    low: float | None = Field(default=None, ge=0, le=1)
    reads_signs: bool = False
    sign_memory: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    missed: float = Share
    burst: float = Field(default=3.0, ge=1, allow_inf_nan=False)
    noise: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    phantoms: float = Field(default=0.0, ge=0, allow_inf_nan=False)

    @property
    def version(self) -> str:
        """Hash of the weights of its detector; "" without one."""
        return "" if self.perfect else state_hash(_detector(self.detector, self.weights, self.input_width))

    @property
    def perfect(self) -> bool:
        """True if the detector is given the truth."""
        return self.detector == "truth"

    @property
    def tracking(self) -> Tracking:
        """Settings of the tracker, with the scores that suit the detector unless the suite sets them."""
        return tracking_of(self.detector, high=self.high, low=self.low, confirm=self.confirm, reserve=self.reserve)

    def check(self) -> None:
        """Validate the settings.

        Raises:
            ConfigError: Scores cross, settings of stop signs do not fit, or the detector knows no stop signs.
        """
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ConfigError(f"system {self.name}: low {self.low:g} is above high {self.high:g}")
        if self.sign_memory is not None and not self.reads_signs:
            raise ConfigError(f"system {self.name}: sign_memory can only be used with reads_signs: true")
        if self.reads_signs:
            try:
                sign_labels(self.make().eyes.classes)
            except ConfigError as error:
                raise ConfigError(f"system {self.name}, detector {self.detector}: {error}") from None

    def make(
        self,
        watch: Callable[[Sighting | Known], None] | None = None,
        *,
        repair: Repair | None = None,
        device: str = "cpu",
    ) -> Perceiving:
        """Build the driver.

        Args:
            watch: Called with everything that the driver perceives.
            repair: Corrects one kind of error of its perception.
            device: Device of the detector.
        """
        cameras, tracking = front(self.width, self.cameras), self.tracking
        eyes: CameraEyes | PerfectEyes
        if self.perfect:
            eyes = PerfectEyes(cameras, missed=self.missed, burst=self.burst, noise=self.noise, phantoms=self.phantoms)
        else:
            detector = _detector(self.detector, self.weights, self.input_width, device)
            eyes = CameraEyes(detector, cameras, threshold=tracking.low, device=device)
        memory_seconds = float("inf") if self.sign_memory is None else self.sign_memory
        sign_reading = (
            SignReading(confirm=self.confirm, memory=memory_seconds, score=tracking.high) if self.reads_signs else None
        )
        return Perceiving(
            eyes,
            rate=self.rate,
            latency=self.latency,
            tracking=tracking,
            watch=watch,
            repair=repair,
            signs=sign_reading,
        )


def _detector(name: str, weights: str | None, width: int | None, device: str = "cpu") -> Any:
    from ssad.detectors import loaded_detector

    return loaded_detector(name, weights=weights, device=device, input_width=width)

"""Perceiving systems of suites of kind `gap`: the keys that describe one, and the driver that they make."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, SerializerFunctionWrapHandler, model_serializer

from ssad.core.checkpoints import state_hash
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.frames import Camera
from ssad.core.nuscenes_names import CAMERAS
from ssad.core.safeio import dump_json, parse_json
from ssad.core.schema import Schema
from ssad.core.source import plugin_version
from ssad.detectors import DETECTORS
from ssad.drivers.lane_keeping.driver import CHANNEL, LaneKeeper
from ssad.drivers.perceiving.driver import PerceivedEvent, PerceivingDriver
from ssad.drivers.perceiving.parts import (
    Perceiver,
    cameras_of,
    make_perceiver,
    make_planner,
    make_tracker,
    part_version,
)
from ssad.drivers.perceiving.perceivers import CameraPerceiver, PerfectPerceiver, nuscenes_cameras
from ssad.drivers.perceiving.repair import RepairedAgents
from ssad.drivers.perceiving.signs import SignReading, sign_labels
from ssad.drivers.perceiving.tracker import TrackerSettings, tracking_settings

Share = Field(default=0.0, ge=0, lt=1, allow_inf_nan=False)
KEYS_OF_PERCEIVER: Final = (
    "detector",
    "weights",
    "cameras",
    "width",
    "input_width",
    "missed",
    "burst",
    "noise",
    "phantoms",
)
KEYS_OF_TRACKER: Final = ("confirm", "reserve")
NAMED: Final = ("perceiver", "tracker", "planner")
ROUTE: Final = "route"


def _single_name(part: str | dict[str, Any]) -> str | dict[str, Any]:
    if isinstance(part, dict) and len(part) != 1:
        raise ValueError("expected a name, or one name with its arguments, as in {my_package.eyes:Eyes: {reach: 40}}")
    return part


Part = Annotated[str | dict[str, dict[str, Any] | None], AfterValidator(_single_name)]
"""Name of a part (built-in, entry point or "module:object"), alone or as {NAME: {ARGUMENT: VALUE}}."""


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
        missed, burst, noise, phantoms: errors of a perfect detector (`PerfectPerceiver`).
        perceiver: source of detections in place of the one that the keys detector, weights, cameras, width,
            input_width, missed, burst, noise and phantoms describe (`ssad list perceivers`).
        tracker: tracker in place of the one that confirm, reserve, high and low describe (`ssad list trackers`).
        planner: planner in place of the Autopilot's (`ssad list planners`).
        steers_by: route: it follows its given route; markings: a lane keeper, which steers by the lane markings that it
            detects in its front camera (`ssad.drivers.lane_keeping`), and stops where it loses them.
        set_speed: of a lane keeper that reads speed-limit signs in its front camera, m/s: it drives at the limit of
            the last sign that it has read, and at this speed before the first; none: the speed limit is given to it.
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
    perceiver: Part | None = None
    tracker: Part | None = None
    planner: Part | None = None
    steers_by: Literal["route", "markings"] = ROUTE
    set_speed: float | None = Field(default=None, gt=0, le=70, allow_inf_nan=False)

    @model_serializer(mode="wrap")
    def _without_unnamed_parts(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave parts out that are not named: the dump enters the keys of cells, which must not change by them."""
        values: dict[str, Any] = dump(self)
        values = {key: value for key, value in values.items() if key not in NAMED or value is not None}
        return {
            key: value
            for key, value in values.items()
            if (key, value) not in (("steers_by", ROUTE), ("set_speed", None))
        }

    @property
    def version(self) -> str:
        """Hashes of the weights and source of its detector, and versions of the parts that are named; "" without."""
        built_in_detector = self.perceiver is None and not self._has_perfect_perceiver
        versions = []
        if built_in_detector:
            versions.append(state_hash(self._make_perceiver().detector))
            versions.append(plugin_version("detector", DETECTORS, self.detector))
        for kind in NAMED:
            name, options = self._part(kind)
            if name:
                part = self._make_perceiver() if kind == "perceiver" else self._make_part(kind)
                versions.append(part_version(kind, name, part, options))
        return " ".join(filter(None, versions))

    @property
    def is_perfect(self) -> bool:
        """True if no perturbation of images reaches it: it is given the truth, or reads no camera."""
        if self.keeps_lane:
            return False
        return self._has_perfect_perceiver

    @property
    def keeps_lane(self) -> bool:
        """True for a lane keeper."""
        return self.steers_by != ROUTE

    @property
    def _has_perfect_perceiver(self) -> bool:
        """True if no perturbation of images reaches its perceiver."""
        if self.perceiver is None:
            return self.detector == "truth"
        perceiver = self._make_perceiver()
        return not set(cameras_of(perceiver)) & set(perceiver.sensors)

    @property
    def view_cameras(self) -> Mapping[str, Camera]:
        """Cameras in whose images objects count as in view; none of a perceiver without cameras."""
        return cameras_of(self._make_perceiver()) if self.perceiver else nuscenes_cameras(self.width, self.cameras)

    @property
    def tracking(self) -> TrackerSettings:
        """Settings of the built-in tracker, with the scores that suit the detector unless the suite sets them."""
        name, options = self._part("perceiver")
        detector = (options.get("detector", self.detector) if name == "camera" else "") if name else self.detector
        tracker, settings = self._part("tracker")
        given_settings: dict[str, Any] = {
            "confirm": self.confirm,
            "reserve": self.reserve,
            "high": self.high,
            "low": self.low,
        }
        return tracking_settings(detector, **(given_settings | settings if tracker == "kalman" else given_settings))

    def check(self) -> None:
        """Validate the settings, and make the parts that are named.

        Raises:
            ConfigError: Scores cross, settings of stop signs do not fit, or the detector knows no stop signs. A part
                cannot be made, or a key describes a part that another key names.
        """
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ConfigError(f"system {self.name}: low {self.low:g} is above high {self.high:g}")
        if self.keeps_lane and self.planner is not None:
            raise ConfigError(f"system {self.name}: steers_by: markings has no planner; remove the key planner")
        if self.set_speed is not None and not self.keeps_lane:
            raise ConfigError(f"system {self.name}: set_speed can only be used with steers_by: markings")
        if self.sign_memory is not None and not self.reads_signs:
            raise ConfigError(f"system {self.name}: sign_memory can only be used with reads_signs: true")
        for kind, keys in (("perceiver", KEYS_OF_PERCEIVER), ("tracker", KEYS_OF_TRACKER)):
            # By value: the dump of a suite writes out defaults.
            defaults = {key: type(self).model_fields[key].default for key in keys}
            changed = [key for key, default in defaults.items() if getattr(self, key) != default]
            if getattr(self, kind) is not None and changed:
                raise ConfigError(
                    f"system {self.name}: {', '.join(changed)} would describe the built-in {kind}, but {kind} names "
                    f"another; give it as an argument there, {kind}: {{NAME: {{{changed[0]}: ...}}}}"
                )
        if any(getattr(self, kind) is not None for kind in NAMED):
            try:
                self.make()
            except UnknownNameError as error:
                raise UnknownNameError(f"system {self.name}: {error}") from None
            except ConfigError as error:
                raise ConfigError(f"system {self.name}: {error}") from None
        if self.reads_signs:
            try:
                sign_labels(self.make().perceiver.classes)
            except ConfigError as error:
                source = f"detector {self.detector}" if self.perceiver is None else f"perceiver {self.perceiver}"
                raise ConfigError(f"system {self.name}, {source}: {error}") from None

    def make(
        self,
        watch: Callable[[PerceivedEvent], None] | None = None,
        *,
        repair: RepairedAgents | None = None,
        device: str = "cpu",
    ) -> PerceivingDriver:
        """Build the driver.

        Args:
            watch: Called with everything that the driver perceives.
            repair: Corrects one kind of error of its perception.
            device: Device of the detector.

        Raises:
            UnknownNameError: A named part does not exist.
            ConfigError: A named part cannot be made.
        """
        tracking, tracker_name = self.tracking, self._part("tracker")[0]
        memory_seconds = float("inf") if self.sign_memory is None else self.sign_memory
        sign_reading = (
            SignReading(confirm=self.confirm, memory=memory_seconds, score=tracking.high) if self.reads_signs else None
        )
        built_in = tracker_name in ("", "kalman")
        make_driver: Callable[..., PerceivingDriver] = PerceivingDriver
        planner: dict[str, Any] = {"planner": None if self.planner is None else self._make_part("planner")}
        if self.keeps_lane:
            make_driver, planner = LaneKeeper, {"camera": nuscenes_cameras(self.width)[CHANNEL]}
            planner |= {"set_speed": self.set_speed}
        driver = make_driver(
            self._make_perceiver(device),
            tracker=None if built_in else self._make_part("tracker"),
            **planner,
            rate=self.rate,
            latency=self.latency,
            tracking=tracking if built_in else None,
            watch=watch,
            repair=repair,
            signs=sign_reading,
        )
        if any(getattr(self, kind) is not None for kind in NAMED):
            driver.to(device)
        return driver

    def _part(self, kind: str) -> tuple[str, dict[str, Any]]:
        """Return the name and the arguments of a part; "" if the suite names none."""
        part = getattr(self, kind)
        if part is None or isinstance(part, str):
            return part or "", {}
        ((name, options),) = part.items()
        return name, dict(options or {})

    def _make_part(self, kind: str) -> Any:
        """Return the tracker or the planner that the suite names."""
        name, options = self._part(kind)
        return (make_tracker if kind == "tracker" else make_planner)(name, **options)

    def _make_perceiver(self, device: str = "cpu") -> Any:
        """Return the perceiver."""
        tracking = self.tracking
        name, options = self._part("perceiver")
        if name:
            if name == "camera":
                options = {"threshold": tracking.low} | options
            return _perceiver(name, dump_json(options), device)
        cameras = nuscenes_cameras(self.width, self.cameras)
        if self._has_perfect_perceiver:
            return PerfectPerceiver(
                cameras, missed=self.missed, burst=self.burst, noise=self.noise, phantoms=self.phantoms
            )
        detector = _detector(self.detector, self.weights, self.input_width, device)
        return CameraPerceiver(detector, cameras, threshold=tracking.low, device=device)


def _detector(name: str, weights: str | None, width: int | None, device: str = "cpu") -> Any:
    from ssad.detectors import cached_detector

    return cached_detector(name, weights=weights, device=device, input_width=width)


@lru_cache(maxsize=4)
def _perceiver(name: str, options: str, device: str) -> Perceiver:
    """Return a perceiver that a suite names, built once per process: it may load weights; `reset` clears its memory."""
    return make_perceiver(name, **parse_json(options))

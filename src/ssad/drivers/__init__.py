"""Driving systems: the systems under test."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from ssad.core.driving import Believer, Branching, Driver
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.registry import Reference, check_arguments, label_of, resolve
from ssad.core.safeio import read_bytes
from ssad.core.seeding import digest
from ssad.core.types import Controller

if TYPE_CHECKING:
    from ssad.rendering.lidar import Lidar

SYSTEMS: dict[str, str] = {
    "autopilot": "ssad.drivers.builtin:Autopilot",
    "blind": "ssad.drivers.builtin:Blind",
    "careful-cc": "ssad.drivers.careful.driver:CarefulCC",
    "careful-fsm": "ssad.drivers.careful.driver:CarefulFSM",
    "careful-reg157": "ssad.drivers.careful.driver:CarefulReg157",
    "careful-rss": "ssad.drivers.careful.driver:CarefulRSS",
    "lane-keeper": "ssad.drivers.lane_keeping.driver:LaneKeeper",
    "line-of-sight": "ssad.drivers.belief:LineOfSight",
    "no-action": "ssad.drivers.builtin:NoAction",
    "perceiving": "ssad.drivers.perceiving.systems:ComposedSystem",
    "perceiving-perfect": "ssad.drivers.perceiving.systems:PerfectSystem",
    "perceiving-fcos3d": "ssad.drivers.perceiving.systems:Fcos3d",
    "perceiving-pgd-det": "ssad.drivers.perceiving.systems:PgdDet",
    "perceiving-yolov5n": "ssad.drivers.perceiving.systems:Yolov5n",
    "ppo": "ssad.drivers.learned.policies:PPO",
    "sac": "ssad.drivers.learned.policies:SAC",
    "td3": "ssad.drivers.learned.policies:TD3",
}
LEARNED = ("ppo", "sac", "td3")
"""Systems with weights: NAME has the shipped ones if there are any, NAME:FILE.safetensors others."""

LARGEST = 8 << 30
"""Bytes of a file that an argument may name."""

LEADERBOARD = "leaderboard"
"""leaderboard:FILE.py is an agent of the CARLA leaderboard; ?share=true shares its networks among a batch."""


def find_system(name: str) -> Any:
    """Return the class or object of a system name, entry point or "module:object", without arguments and label.

    Raises UnknownNameError; ConfigError if it does not import; FormatError for weights that cannot be used.
    """
    full_name, name = name, Reference.parse(name).name
    base_name, _, weights = name.partition(":")
    if base_name in LEARNED and weights:
        return resolve("system", SYSTEMS, base_name)(weights)
    if base_name == LEADERBOARD and weights:
        from ssad.drivers.leaderboard import Leaderboard

        check_arguments("system", full_name, Leaderboard, extra_arguments={"path": weights})
        return Leaderboard(weights, **Reference.parse(full_name).options)
    resolved = resolve("system", SYSTEMS, name)
    check_arguments("system", full_name, resolved, is_instantiated=True)
    return resolved


def weights_version(name: str) -> str:
    """Return the hash of a learned system's weights, of a leaderboard agent's file, or of files in arguments.

    "" for a system without files. Raises FormatError for weights that cannot be used.
    """
    reference = Reference.parse(name)
    files = [Path(value) for value in reference.options.values() if isinstance(value, str) and Path(value).is_file()]
    if files:
        return digest("files", *[hashlib.blake2b(read_bytes(file, limit=LARGEST)).hexdigest() for file in files])
    name = reference.name
    return str(make_system(name).version) if name.partition(":")[0] in (*LEARNED, LEADERBOARD) else ""  # type: ignore[attr-defined]


def make_system(name: str) -> Driver:
    """Make a driving system by name, entry point or "module:object"; a class gets the arguments after "?".

    "mine:Mine?checkpoint=a.pt@first" is `Mine(checkpoint="a.pt")` of mine.py, and tables call it "first".
    Raises UnknownNameError, or ConfigError if the object is not a Driver.
    """
    resolved, options = find_system(name), Reference.parse(name).options
    is_agent = name.partition(":")[0] == LEADERBOARD  # found with its arguments
    system = resolved(**options) if (isinstance(resolved, type) or options) and not is_agent else resolved
    controller = getattr(system, "controller", Controller.EXTERNAL)
    if not callable(getattr(system, "act", None)) or not callable(getattr(system, "reset", None)):
        raise ConfigError(f"system '{name}' needs the methods reset(episodes) and act(view); see README")
    if not isinstance(controller, Controller):
        raise ConfigError(f"system '{name}': controller must be a ssad.core.types.Controller, not {controller!r}")
    return _NamedDriver(label_of(name), controller, cast(Driver, system))


class _NamedDriver:
    """Driver under its requested name; fills in the optional attributes that a short user class omits."""

    def __init__(self, name: str, controller: Controller, system: Driver) -> None:
        self.name = name
        self.controller = controller
        self.target_speed: float | None = getattr(system, "target_speed", None)
        self.period: float = getattr(system, "period", 0.1)
        self.version: str = getattr(system, "version", "")
        self.sensors: tuple[str, ...] = tuple(getattr(system, "sensors", ()))
        self.reset = system.reset
        self.act = system.act
        self.cameras: Mapping[str, Camera] = getattr(system, "cameras", {})
        self.depth_cameras: Mapping[str, Camera] = getattr(system, "depth_cameras", {})
        self.semantic_cameras: Mapping[str, Camera] = getattr(system, "semantic_cameras", {})
        self.lidars: Mapping[str, Lidar] = getattr(system, "lidars", {})
        self.radars: Mapping[str, Lidar] = getattr(system, "radars", {})
        if isinstance(system, Believer):
            self.believe = system.believe
        if isinstance(system, Branching):
            self.snapshot, self.restore = system.snapshot, system.restore
        if callable(getattr(system, "to", None)):
            self.to = system.to  # type: ignore[attr-defined]

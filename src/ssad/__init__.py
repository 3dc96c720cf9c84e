"""SSAD: how safe and robust is an autonomous-driving system in safety-critical scenarios?

The public names. They are loaded on first use, so that `import ssad` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ssad.core.errors import missing_extra
from ssad.core.version import __version__

if TYPE_CHECKING:
    from ssad.camera.render import View as View
    from ssad.camera.render import render as render
    from ssad.camera.scene import Scene as Scene
    from ssad.core.driving import Driver as Driver
    from ssad.core.driving import Observation as Observation
    from ssad.core.errors import SSADError as SSADError
    from ssad.core.types import Controller as Controller
    from ssad.core.types import Episode as Episode
    from ssad.core.types import EpisodeTrace as EpisodeTrace
    from ssad.core.types import Scenario as Scenario
    from ssad.detectors import make_detector as make_detector
    from ssad.detectors.check import check_detector as check_detector
    from ssad.drivers import make_system as make_system
    from ssad.drivers.careful.grade import grade_collision as grade_collision
    from ssad.evaluation.score import score_results as score_results
    from ssad.metrics import aggregate as aggregate
    from ssad.metrics import episode_metrics as episode_metrics
    from ssad.report import write_report as write_report
    from ssad.report.compare import compare_runs as compare_runs
    from ssad.results import Results as Results
    from ssad.results import load_results as load_results
    from ssad.results import run as run
    from ssad.roads import load_town as load_town
    from ssad.scenarios.dynamic import build_episode as build_episode
    from ssad.scenarios.dynamic import load_scenarios as load_scenarios
    from ssad.scenarios.dynamic import save_scenarios as save_scenarios
    from ssad.scenarios.static.shifts import ShiftSpec as ShiftSpec
    from ssad.scenarios.static.shifts import shift_images as shift_images
    from ssad.world.check import check_driver as check_driver
    from ssad.world.check import check_simulator as check_simulator
    from ssad.world.env import VectorEnv as VectorEnv
    from ssad.world.rollout import rollout as rollout
    from ssad.world.world import World as World

_WHERE = {
    "run": "results",
    "load_results": "results",
    "Results": "results",
    "compare_runs": "report.compare",
    "write_report": "report",
    "make_detector": "detectors",
    "check_detector": "detectors.check",
    "shift_images": "scenarios.static.shifts",
    "ShiftSpec": "scenarios.static.shifts",
    "score_results": "evaluation.score",
    "Scene": "camera.scene",
    "View": "camera.render",
    "render": "camera.render",
    "make_system": "drivers",
    "SSADError": "core.errors",
    "aggregate": "metrics",
    "episode_metrics": "metrics",
    "Driver": "core.driving",
    "Observation": "core.driving",
    "load_town": "roads",
    "build_episode": "scenarios.dynamic",
    "load_scenarios": "scenarios.dynamic",
    "save_scenarios": "scenarios.dynamic",
    "Controller": "core.types",
    "Episode": "core.types",
    "EpisodeTrace": "core.types",
    "Scenario": "core.types",
    "check_driver": "world.check",
    "check_simulator": "world.check",
    "VectorEnv": "world.env",
    "rollout": "world.rollout",
    "grade_collision": "drivers.careful.grade",
    "World": "world.world",
}
__all__ = ["__version__", *_WHERE]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name in _WHERE:
        try:
            return getattr(import_module(f"ssad.{_WHERE[name]}"), name)
        except ModuleNotFoundError as error:
            raise missing_extra(error, f"ssad.{name}") or error from None
    raise AttributeError(f"module 'ssad' has no attribute '{name}'")


def __dir__() -> list[str]:
    """Name what is public."""
    return sorted(__all__)

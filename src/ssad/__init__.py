"""SSAD: a testbed for the safety and robustness of autonomous-driving systems in safety-critical scenarios.

The public names are loaded on first use, so that `import ssad` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ssad.core.version import __version__

if TYPE_CHECKING:
    from ssad.core.errors import SSADError as SSADError
    from ssad.datasets.nuscenes.score import score_results as score_results
    from ssad.detectors import make_detector as make_detector
    from ssad.drivers import make_system as make_system
    from ssad.experiments.runs import write_report as write_report
    from ssad.metrics import episode_metrics as episode_metrics
    from ssad.rendering.camera.render import View as View
    from ssad.rendering.camera.render import render as render
    from ssad.report.compare import compare_runs as compare_runs
    from ssad.results import Results as Results
    from ssad.results import load_results as load_results
    from ssad.results import run as run
    from ssad.scenarios.dynamic import build_episode as build_episode
    from ssad.scenarios.dynamic import load_scenarios as load_scenarios
    from ssad.scenarios.dynamic import save_scenarios as save_scenarios
    from ssad.scenarios.static.shifts import ShiftSpec as ShiftSpec
    from ssad.scenarios.static.shifts import shift_images as shift_images
    from ssad.world.roads import load_town as load_town
    from ssad.world.rollout import rollout as rollout
    from ssad.world.world import World as World

_WHERE = {
    "run": "results",
    "load_results": "results",
    "Results": "results",
    "compare_runs": "report.compare",
    "write_report": "experiments.runs",
    "make_detector": "detectors",
    "shift_images": "scenarios.static.shifts",
    "ShiftSpec": "scenarios.static.shifts",
    "score_results": "datasets.nuscenes.score",
    "View": "rendering.camera.render",
    "render": "rendering.camera.render",
    "make_system": "drivers",
    "SSADError": "core.errors",
    "episode_metrics": "metrics",
    "load_town": "world.roads",
    "build_episode": "scenarios.dynamic",
    "load_scenarios": "scenarios.dynamic",
    "save_scenarios": "scenarios.dynamic",
    "rollout": "world.rollout",
    "World": "world.world",
}
__all__ = ["__version__", *_WHERE]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name in _WHERE:
        return getattr(import_module(f"ssad.{_WHERE[name]}"), name)
    raise AttributeError(f"module 'ssad' has no attribute '{name}'")


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)

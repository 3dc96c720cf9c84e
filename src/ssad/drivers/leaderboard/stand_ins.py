"""Stand-ins for packages that hosted agents import: put in place where these are not installed.

Agents import much that they never use. So any further name of such a package can be imported; only its use is refused.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Sequence
from typing import Any

from ssad.drivers.leaderboard import navigation
from ssad.drivers.leaderboard.basic_agent import BasicAgent
from ssad.drivers.leaderboard.carla_types import CARLA_TYPES, AutonomousAgent, RoadOption, Track, downsample_route
from ssad.drivers.leaderboard.road_map import GlobalRoutePlanner, GlobalRoutePlannerDAO
from ssad.drivers.leaderboard.scene import CarlaDataProvider, GameTime, NoServerError

_MISC = (
    *("get_speed", "compute_distance", "vector", "positive", "distance_vehicle", "is_within_distance"),
    *("compute_magnitude_angle", "draw_waypoints"),
)
_ROUTES = ("interpolate_trajectory", "location_route_to_gps")


def install_stand_ins() -> None:
    """Put our names where packages that agents import are not installed."""
    if not any(isinstance(finder, _StandInFinder) for finder in sys.meta_path):
        sys.meta_path.append(_StandInFinder())
    _offer("leaderboard.autoagents.autonomous_agent", AutonomousAgent=AutonomousAgent, Track=Track)
    routes = {name: getattr(navigation, name) for name in _ROUTES}
    _offer("leaderboard.utils.route_manipulation", downsample_route=downsample_route, **routes)
    _offer("agents.navigation.local_planner", RoadOption=RoadOption, LocalPlanner=navigation.LocalPlanner)
    _offer("agents.navigation.global_route_planner", GlobalRoutePlanner=GlobalRoutePlanner)
    _offer("agents.navigation.global_route_planner_dao", GlobalRoutePlannerDAO=GlobalRoutePlannerDAO)
    _offer("agents.navigation.basic_agent", BasicAgent=BasicAgent)
    _offer("agents.navigation.behavior_agent", BehaviorAgent=navigation.BehaviorAgent)
    _offer("agents.navigation.controller", VehiclePIDController=navigation.VehiclePIDController)
    _offer("agents.tools.misc", **{name: getattr(navigation, name) for name in _MISC})
    _offer("srunner.scenariomanager.carla_data_provider", CarlaDataProvider=CarlaDataProvider)
    _offer("srunner.scenariomanager.timer", GameTime=GameTime)
    _offer("carla", **CARLA_TYPES)


def _offer(name: str, **content: Any) -> None:
    try:
        module = importlib.import_module(name)
    except ImportError:
        parts = name.split(".")
        for k in range(1, len(parts) + 1):
            part = ".".join(parts[:k])
            module = sys.modules.setdefault(part, StandIn(part))
            if k > 1:
                setattr(sys.modules[".".join(parts[: k - 1])], parts[k - 1], module)
        module = sys.modules[name]
    if getattr(module, "__file__", None) is None:  # a stand-in, or a folder of that name beside the agent
        vars(module).update(content)


class StandIn(types.ModuleType):
    """Module in the place of one that is not installed: it has every name, and refuses the use of those it lacks."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__path__: list[str] = []  # a package, so that any module below it can be imported

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Refused(name, (Exception,), {"__module__": self.__name__})


class _Refused(type):
    """Type of a name without stand-in; it is an exception, as agents may catch it, and may be derived from."""

    def __call__(cls, *arguments: Any, **options: Any) -> Any:
        raise NoServerError(cls._reason(""))

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise NoServerError(cls._reason(f".{name}"))

    def _reason(cls, part: str) -> str:
        base = next(base for base in cls.__mro__[::-1] if isinstance(base, _Refused))
        package = base.__module__.partition(".")[0]
        return (
            f"{base.__module__}.{base.__name__}{part} has no stand-in; leave it out, or put the package '{package}' on "
            "PYTHONPATH"
        )


class _StandInFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finder of modules below a `StandIn` that nothing else finds."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the specification of a stand-in, or None for a module of other packages."""
        parent = sys.modules.get(fullname.rpartition(".")[0])
        return importlib.machinery.ModuleSpec(fullname, self) if isinstance(parent, StandIn) else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        """Return an empty stand-in."""
        return StandIn(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        """Do nothing: a stand-in has no code."""

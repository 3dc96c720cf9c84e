"""Stand-ins for packages that hosted agents import: put in place where these are not installed."""

from __future__ import annotations

import importlib
import sys
import types
from typing import Any

from ssad.drivers.leaderboard.basic_agent import BasicAgent
from ssad.drivers.leaderboard.carla_types import CARLA_TYPES, AutonomousAgent, RoadOption, Track, downsample_route
from ssad.drivers.leaderboard.road_map import GlobalRoutePlanner, GlobalRoutePlannerDAO
from ssad.drivers.leaderboard.scene import CarlaDataProvider, GameTime


def install_stand_ins() -> None:
    """Put our names where packages that agents import are not installed."""
    _offer("leaderboard.autoagents.autonomous_agent", AutonomousAgent=AutonomousAgent, Track=Track)
    _offer("leaderboard.utils.route_manipulation", downsample_route=downsample_route)
    _offer("agents.navigation.local_planner", RoadOption=RoadOption)
    _offer("agents.navigation.global_route_planner", GlobalRoutePlanner=GlobalRoutePlanner)
    _offer("agents.navigation.global_route_planner_dao", GlobalRoutePlannerDAO=GlobalRoutePlannerDAO)
    _offer("agents.navigation.basic_agent", BasicAgent=BasicAgent)
    _offer("srunner.scenariomanager.carla_data_provider", CarlaDataProvider=CarlaDataProvider)
    _offer("srunner.scenariomanager.timer", GameTime=GameTime)
    _offer("carla", **CARLA_TYPES)


def _offer(name: str, **content: Any) -> None:
    try:
        importlib.import_module(name)
    except ImportError:
        parts = name.split(".")
        for k in range(1, len(parts) + 1):
            module = sys.modules.setdefault(".".join(parts[:k]), types.ModuleType(".".join(parts[:k])))
            if k > 1:
                setattr(sys.modules[".".join(parts[: k - 1])], parts[k - 1], module)
        vars(sys.modules[name]).update(content)

"""CARLA leaderboard agents as driving systems, without CARLA."""

from ssad.drivers.leaderboard.driver import Leaderboard

__all__ = ["Leaderboard"]

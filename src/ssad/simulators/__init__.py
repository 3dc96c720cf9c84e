"""Simulators that run episodes: the embedded world, highway-env and CARLA."""

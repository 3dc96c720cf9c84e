"""CARLA as a simulator of episodes."""

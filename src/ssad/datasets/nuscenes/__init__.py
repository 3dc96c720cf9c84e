"""Recorded drives in the nuScenes schema."""

"""Recorded data: the nuScenes schema, readers and writers."""

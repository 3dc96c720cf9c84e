"""Recorded drives in the nuScenes schema: reader, writer and index."""

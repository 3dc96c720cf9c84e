"""Recorded data: the nuScenes schema, its readers and writers, and COCO annotations."""

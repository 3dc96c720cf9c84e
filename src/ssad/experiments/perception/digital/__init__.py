"""Preset `digital`: 3D detectors under digital attacks."""

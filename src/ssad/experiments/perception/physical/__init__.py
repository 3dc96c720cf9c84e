"""Preset `physical`: detectors under textures and lights on a target."""

"""Preset `detection`: 3D detectors under distribution shifts."""

"""Suites on AI components: detectors under distribution shifts, over a data set in the nuScenes schema."""

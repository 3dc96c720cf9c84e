"""Drives and clips from the world into data sets."""

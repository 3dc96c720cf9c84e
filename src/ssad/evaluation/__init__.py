"""Detectors on data sets: from pictures to boxes in the world and their scores."""

"""Detectors: the AI components under test."""

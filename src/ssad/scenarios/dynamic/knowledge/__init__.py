"""Scenario classes, one module each, and their shared helpers."""

"""Faults of sensors, of the ego's knowledge of itself and of its commands."""

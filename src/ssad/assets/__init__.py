"""Procedural bodies and streets: what the camera sees."""

"""Driving system that knows traffic only through its cameras; each component can be replaced."""

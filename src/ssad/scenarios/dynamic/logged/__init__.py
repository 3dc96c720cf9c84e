"""Generators that begin with what was recorded."""

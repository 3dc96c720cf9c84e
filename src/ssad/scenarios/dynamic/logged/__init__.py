"""Generators that start from recorded drives."""

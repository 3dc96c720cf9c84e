"""Experiment `driving`: driving systems in scenarios."""

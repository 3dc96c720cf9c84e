"""Searches over a scenario's parameter box: what every other generator must beat."""

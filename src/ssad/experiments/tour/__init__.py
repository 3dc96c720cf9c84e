"""Experiment `tour`: several suites, one after the other."""

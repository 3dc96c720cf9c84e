"""Evaluation suites: what is run on which systems, in cells that can be resumed and joined into one record."""

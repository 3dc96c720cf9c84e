"""Recorders of simulated drives as datasets, and of shifted copies of datasets."""

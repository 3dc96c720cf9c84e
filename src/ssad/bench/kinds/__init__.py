"""Kinds of experiments, a file each."""

"""Experiment `gap`: the same perturbation measured on the component and on the whole driving system."""

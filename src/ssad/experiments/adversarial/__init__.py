"""Experiment `adversarial`: search for scenarios in which a driving system fails."""

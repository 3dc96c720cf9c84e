"""Experiment `how-often`: failure rates of driving systems in random traffic."""

"""How likely is it that a driver fails? Estimators of small probabilities over any batched simulation with chance."""

"""Estimators of small failure probabilities of a driver, over any batched simulation with randomness."""

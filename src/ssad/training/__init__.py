"""Training of detectors, drivers and adversaries: recipes, batches and training loops."""

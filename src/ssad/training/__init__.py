"""Training of detectors: recipes, batches, the loop."""

"""Open-loop experiments: detectors on recorded data under perturbations."""

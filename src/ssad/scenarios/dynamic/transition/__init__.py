"""Generators that change how others move from step to step: in their kinematic states, or as whole trajectories."""

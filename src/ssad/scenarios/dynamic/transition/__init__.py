"""Generators that change the motion of other agents: step by step in their kinematic states, or as trajectories."""

"""Driving systems trained by reinforcement learning: PPO, SAC and TD3."""

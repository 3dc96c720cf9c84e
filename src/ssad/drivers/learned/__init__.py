"""Driving systems that were trained by reinforcement learning: PPO, SAC and TD3."""

"""Simulated sensors: cameras, LiDAR and radar, and the streets and bodies that they observe."""

"""Baked towns that ship with SSAD (*.npz); `ssad.roads.designs` gives their OpenDRIVE."""

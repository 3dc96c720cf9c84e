"""Baked towns that ship with SSAD (*.npz); `ssad.roads.generate` writes their OpenDRIVE."""

"""Baked towns that ship with SSAD (*.npz); `ssad.world.roads.designs` gives their OpenDRIVE."""

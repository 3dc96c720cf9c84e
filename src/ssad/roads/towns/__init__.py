"""Baked towns that ship with SSAD (*.npz); `benchmarks/make_towns.py` writes their OpenDRIVE."""

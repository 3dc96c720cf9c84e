"""Invasive physical attacks: patches and camouflages, printed and stuck on a target (paper III.A.1)."""

"""Monocular 3D detection as FCOS3D and PGD-Det do it (mmdetection3d 1.4)."""

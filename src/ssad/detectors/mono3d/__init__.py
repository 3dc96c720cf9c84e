"""Monocular 3D detection by FCOS3D and PGD-Det, as in mmdetection3d 1.4."""

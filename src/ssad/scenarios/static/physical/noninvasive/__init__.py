"""Physical attacks that leave their target as it is: what falls on it, shadow and light (paper III.A.1)."""

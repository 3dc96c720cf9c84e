"""Physical attacks that touch their target: patches and camouflages, printed and stuck on (paper III.A.1)."""

"""Policy-based generators: adversaries driven by a learned policy."""

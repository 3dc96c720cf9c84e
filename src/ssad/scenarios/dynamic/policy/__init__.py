"""Policy-based generators: adversaries that drive by a learned policy."""

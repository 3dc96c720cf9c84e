"""Attacks that stay in their place on the street: dirt, phantoms, light into the lens, signs and signal heads."""

"""Attacks on the street that stays where it is: dirt on the road, projections, signs and signal heads."""

"""Finds where simulation and measurement disagree, and names the effect that lacks."""

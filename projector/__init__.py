"""Shapes (shapely geometry in cm) and the light that throws them on the arena."""

"""Cameras, the track of the robot's LED, true crossings, and whether the lines are isotropic."""

"""The little that two rooms share: the root of the errors, pinhole optics. Imports nothing of ours."""

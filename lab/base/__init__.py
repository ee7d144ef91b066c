"""The little that two rooms share: the root of the errors, pinhole optics, whole files. Imports nothing of ours."""

"""A stored session taken up again: mended, gone on with, rolled or read once more."""

"""A stored session examined: its film, its recognition, its errors."""

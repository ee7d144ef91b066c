"""A stored session in other programs' formats: CSV tables, MCAP for Foxglove, one mp4 of the film."""

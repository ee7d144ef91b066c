"""Many stored sessions, analysed into one table."""

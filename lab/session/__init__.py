"""A session as it runs: preflight, rolling, the sums, the reason to stop."""

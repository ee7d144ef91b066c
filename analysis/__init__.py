"""Statistical geometry: invariants, exact moments, Monte Carlo, recognition, figures and the report."""

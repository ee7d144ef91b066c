"""What this machine has and what it lacks for a session, each finding with its cure; and bundles for bug reports."""

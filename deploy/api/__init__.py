"""Prior-SG for Python programs: the names that `prior_sg` itself exports."""

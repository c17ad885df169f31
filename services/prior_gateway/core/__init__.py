"""From a task to a prior graph (pure)."""

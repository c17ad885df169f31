"""Whether two maps show the same place, and how they lie to each other; pure."""

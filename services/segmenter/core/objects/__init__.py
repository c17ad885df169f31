"""Objects of the map (pure)."""

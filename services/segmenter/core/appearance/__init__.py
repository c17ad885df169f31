"""What labels look like in this map (pure)."""

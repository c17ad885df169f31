"""Other methods on the same places and features, for comparison only; written from their descriptions."""

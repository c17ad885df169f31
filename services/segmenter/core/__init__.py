"""From places, pyramids and priors to regions (pure)."""

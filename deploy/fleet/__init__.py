"""Several robots' maps as one, under a name of its own."""

"""The six services, the runtime they share, and the registry that lists them."""

"""The place graph as received, and what is known of each place (pure)."""

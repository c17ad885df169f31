"""Regions: components that last, and what followers know of them (pure)."""

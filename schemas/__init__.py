"""Typed, versioned messages and the one topic table."""

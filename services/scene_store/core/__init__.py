"""The scene graph as a whole (pure)."""

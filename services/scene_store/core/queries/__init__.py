"""Questions about one scene, answered (pure)."""

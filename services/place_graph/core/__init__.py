"""From keyframes to places (pure)."""

"""Keyframe selection and archive (pure)."""

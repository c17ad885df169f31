"""The pool that keyframes are encoded by."""

"""Where maps fit together, and what they make when they do; pure."""

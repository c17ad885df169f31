"""Task-driven hierarchical scene graphs from posed RGB-D streams."""

"""The voxel map and what depth images do to it (pure)."""

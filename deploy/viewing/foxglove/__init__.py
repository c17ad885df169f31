"""What the live page shows, for Foxglove: its message types, a layout, a server on loopback."""

"""Depth of sources that have none, seen in their pictures by a network of the user's."""

"""Levels above regions: storeys by geometry, zones, buildings and districts by the prior; with ids that last (pure)."""

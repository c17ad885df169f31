"""Pictures and exports of a scene."""

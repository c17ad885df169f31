"""Labels places with the prior's regions and keeps the regions."""

"""How well regions beyond frontiers are foreseen: events of walks, predictors, and searches on true floor plans."""

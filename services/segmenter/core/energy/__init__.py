"""The Markov random field and its minimisation (pure)."""

"""How well parameters are known: profiles, posteriors, and whether these are calibrated."""

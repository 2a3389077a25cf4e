"""Ways down the misfit, in stages, and what a Jacobian tells."""

"""Materials from measurements and from the literature."""

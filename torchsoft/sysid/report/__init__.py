"""An answer on one page, with its figures."""

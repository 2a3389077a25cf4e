"""The hostile trial: misuse and damage of every kind, counted. Being a package, its modules may
bear any names."""

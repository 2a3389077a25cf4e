"""Programs that show that torchsoft is right: `python -m experiments.validation.NAME`."""

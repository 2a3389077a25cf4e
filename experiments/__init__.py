"""Programs that measure what torchsoft does: `python -m experiments.NAME`."""

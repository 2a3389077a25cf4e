"""Programs that measure what torchsoft does; run one by `python -m experiments.NAME`."""

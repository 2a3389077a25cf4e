"""Programs that show that torchsoft is right; run one by `python -m experiments.validation.NAME`."""

"""The compiled inside of the stepper and of its derivatives: plain arrays in, plain arrays out."""

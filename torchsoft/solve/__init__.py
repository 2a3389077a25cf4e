"""Solving a rig: the implicit stepper, its compiled inside, and the routes to a derivative."""

"""Figures, the video and the multibond graph of a simulated run."""

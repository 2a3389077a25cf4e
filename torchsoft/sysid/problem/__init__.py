"""Recordings, what is unknown, sensors and noise: the residuals of a least-squares problem, and the runs that they take."""

"""Derivatives of a step: the transposed sweeps as autograd functions, and other routes to compare with."""

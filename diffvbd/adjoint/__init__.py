"""How a step is differentiated: the transposed sweeps as autograd functions, and other routes to compare with."""

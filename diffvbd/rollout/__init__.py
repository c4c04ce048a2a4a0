"""Many steps: trajectories, checkpoints, memory, and steps that sweep until they have converged."""

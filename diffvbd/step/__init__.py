"""One step: arguments, predictor and start, sweeps, correction; with contact, in parts."""

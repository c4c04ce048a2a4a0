"""Questions about a result: is it right, how far off, what is in contact."""

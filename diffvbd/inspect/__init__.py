"""What a user asks about a result: is it right, how far off, what is in contact."""

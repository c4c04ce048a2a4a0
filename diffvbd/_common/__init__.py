"""Checks, messages, constants and context that all packages share."""

"""Measurements: cases as data, one runner (`python -m bench`), results as JSON in bench/results."""

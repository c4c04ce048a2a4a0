"""Elastic laws that are given as an energy density."""

from .law import Law, law

__all__ = ["Law", "law"]

"""Colliders of a Model's ``colliders=``: planes, spheres, capsules and triangle meshes, fixed or moving."""

from ._contact.colliders import Capsule, Obstacle, Plane, Sphere

__all__ = ["Capsule", "Obstacle", "Plane", "Sphere"]

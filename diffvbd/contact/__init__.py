"""Contact between surfaces: potentials, colliders, detection, starts. Knows no Model (dv.contact is inspect.contact)."""

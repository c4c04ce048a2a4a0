"""Contact between surfaces: potentials, colliders, detection, starts. Knows no Model; users ask inspect.contact."""

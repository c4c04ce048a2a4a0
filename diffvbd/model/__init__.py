"""A scene: bodies, energies, what is worked out of the rest shape once, and checks of what it is given."""

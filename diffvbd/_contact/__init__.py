"""Contact between surfaces, from potentials to starts; knows no Model."""

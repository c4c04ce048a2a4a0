"""Tetrahedral meshes: files, procedural shapes, refinement. Needs numpy and meshio only."""

from diffvbd.mesh.implicit import fill
from diffvbd.mesh.io import Fields, load, load_fields
from diffvbd.mesh.motions import write_series
from diffvbd.mesh.shapes import beam, blob, box, bunny, capsule, cube, disk, dress, sheet, shell
from diffvbd.mesh.surfaces import Repair, cavities, repair, tetrahedralize
from diffvbd.mesh.tet_mesh import TetMesh, join, replicate, subdivide
from diffvbd.mesh.write import save

__all__ = ["Fields", "Repair", "TetMesh", "beam", "blob", "box", "bunny", "capsule", "cavities", "cube", "disk",
           "dress", "fill", "join", "load", "load_fields", "repair", "replicate", "save", "sheet", "shell", "subdivide",
           "tetrahedralize", "write_series"]  # fmt: skip

"""Tetrahedral meshes: files, procedural shapes, refinement. Needs numpy and meshio only."""

from diffvbd.mesh.bodies import blob, bunny, capsule
from diffvbd.mesh.compose import join, replicate, subdivide
from diffvbd.mesh.implicit import fill
from diffvbd.mesh.io import load
from diffvbd.mesh.shapes import beam, box, cube, disk, dress, sheet, shell
from diffvbd.mesh.tet_mesh import TetMesh
from diffvbd.mesh.tetrahedralize import tetrahedralize
from diffvbd.mesh.write import save, write_series

__all__ = [
    "TetMesh",
    "beam",
    "blob",
    "box",
    "bunny",
    "capsule",
    "cube",
    "disk",
    "dress",
    "fill",
    "join",
    "load",
    "replicate",
    "save",
    "sheet",
    "shell",
    "subdivide",
    "tetrahedralize",
    "write_series",
]

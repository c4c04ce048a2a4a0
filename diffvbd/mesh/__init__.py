"""Tetrahedral meshes: files, procedural shapes, refinement. Needs numpy and meshio only."""

from diffvbd.mesh.bodies import blob, bunny, capsule
from diffvbd.mesh.compose import join, replicate, subdivide
from diffvbd.mesh.implicit import fill
from diffvbd.mesh.io import Fields, load, load_fields
from diffvbd.mesh.repair import Repair, repair
from diffvbd.mesh.series import write_series
from diffvbd.mesh.shapes import beam, box, cube, disk, dress, sheet, shell
from diffvbd.mesh.tet_mesh import TetMesh
from diffvbd.mesh.tetrahedralize import tetrahedralize
from diffvbd.mesh.write import save

__all__ = [
    "Fields",
    "Repair",
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
    "load_fields",
    "repair",
    "replicate",
    "save",
    "sheet",
    "shell",
    "subdivide",
    "tetrahedralize",
    "write_series",
]

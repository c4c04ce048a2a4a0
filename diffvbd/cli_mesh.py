"""`diffvbd mesh`: a scan or a CAD surface to tets."""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from diffvbd import mesh as dm


def add(commands: Any) -> None:
    """Add the command to those of `diffvbd`."""
    parser = commands.add_parser(
        "mesh", help="repair a surface (.ply, .stl, .obj, ...) and fill it with tets; needs the extra [mesh]"
    )
    parser.add_argument("surface", type=Path, metavar="SURFACE", help="a file with triangles")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="PART.msh", help="the file to write")
    parser.add_argument("--force", action="store_true", help="overwrite it if it is there")
    unit = parser.add_mutually_exclusive_group()
    unit.add_argument("--size", type=float, help="the largest extent that it shall have [m]")
    unit.add_argument("--scale", type=float, help="metres per unit of the file, 0.001 for mm (default 1)")
    parser.add_argument(
        "--up",
        default="y",
        choices=["x", "y", "z", "-x", "-y", "-z"],
        help="the file's axis that points up, for example z; --up=-z for a minus (default y)",
    )
    parser.add_argument("--edge", type=float, help="wanted edge length [m] (default: 1/20 of the diagonal)")
    parser.add_argument("--epsilon", type=float, help="tets may miss the surface by so much [m] (default: edge / 20)")
    parser.add_argument(
        "--max-triangles", type=int, default=3000, help="larger surfaces are decimated to so many first (default 3000)"
    )
    parser.set_defaults(command=run)


def run(options: argparse.Namespace) -> None:
    """Repair, fill, write, and show what each of them found."""
    out = options.out
    if out.exists() and out.resolve() == options.surface.resolve():
        raise ValueError(f"--out: expected another file than {options.surface}")
    if out.exists() and not options.force:
        raise ValueError(f"--out: {out} would be overwritten; give --force, or another name")
    if out.suffix.lower() not in WRITTEN:
        raise ValueError(f"--out: expected a name that ends in {', '.join(WRITTEN)}, got {out}")
    if not out.parent.is_dir():
        raise FileNotFoundError(f"directory {out.parent} does not exist")
    repaired = dm.repair(options.surface, options.size, options.scale, options.up)
    print(repaired)
    if len(repaired.triangles) > options.max_triangles:
        print(f"{'decimated':9} to {options.max_triangles} triangles; --max-triangles keeps more, and takes longer")
    start = time.perf_counter()
    mesh = dm.tetrahedralize(repaired.surface, options.edge, options.epsilon, options.max_triangles)
    print(report(mesh, repaired.volume, time.perf_counter() - start))
    mesh.save(out)
    print(f"wrote {out}")


# Formats of meshio that hold tets and need no further package.
WRITTEN = (".msh", ".vtu", ".vtk", ".mesh", ".inp")
POOR = 0.1  # a mean ratio below which a tet is stiffer than its material


def report(mesh: dm.TetMesh, enclosed: float, seconds: float) -> str:
    """Size, volume beside that of the surface [m^3] and quality of tets, as rows of text."""
    quality, extent = mesh.quality, np.ptp(mesh.points, axis=0)
    volume = mesh.volume.sum()
    beside = f" ({volume / enclosed - 1:+.2%} of the surface's)" if enclosed > 0 else ""
    shares = np.quantile(quality, [0.0, 0.05, 0.5])
    rows = {
        "mesh": f"{mesh.num_vertices} vertices, {mesh.num_tets} tets, in {seconds:.1f} s",
        "extent": " x ".join(f"{length:.4g}" for length in extent) + " m",
        "volume": f"{volume:.6g} m^3{beside}",
        "quality": "mean ratio (1 is regular, 0 is flat): "
        + ", ".join(f"{name} {share:.3f}" for name, share in zip(("least", "5 %", "median"), shares, strict=True))
        + f"; {int((quality < POOR).sum())} tets below {POOR}",
    }
    return "\n".join(f"{name:9} {text}" for name, text in rows.items())

"""Index tensors and small array helpers of the reference.

Inside the reference, arrays are component-major ([..., 3, V]: one contiguous row per coordinate), which is what plain
torch runs fastest: every operation of a color is then elementwise on rows as long as its list of (vertex, tet) pairs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Color:
    """One color: its n vertices and the P (vertex, tet) pairs of their stars, sorted by vertex, then by tet."""

    vertices: Tensor  # [n] vertex of each block
    tet: Tensor  # [P] tet of each pair
    local: Tensor  # [P] which of the tet's four corners the vertex is
    owner: Tensor  # [P] position of the vertex within `vertices`
    corners: Tensor  # [4 P] the tets' vertices, corner by corner


@dataclass(frozen=True)
class Layout:
    """Everything about a model that is an index: tets [4, T] in summation order, colors in sweep order. After those
    that are swept come the vertices of rigid bodies, as one color."""

    tets: Tensor
    colors: tuple[Color, ...]
    swept: int
    order: Tensor | None


def build_layout(model: Any, tet_order: Tensor | None = None) -> Layout:
    """Index tensors of `model`; `tet_order` [T] permutes the tets and with them only the order of summation."""
    tets = model.tets if tet_order is None else model.tets[tet_order]
    ends, swept, rigid = model.color_ptr, model.color_vertices, getattr(model, "rigid_bodies", None)
    count = len(ends) - 1
    if rigid is not None:
        swept = torch.cat([swept, rigid.order.to(swept)])
        ends = torch.cat([ends, ends.new_tensor([len(swept)])])
    ptr = ends.tolist()
    position = torch.full((model.rest_points.shape[-2],), -1, dtype=torch.int64, device=tets.device)
    position[swept] = torch.arange(swept.numel(), device=tets.device)

    # Pairs in the order of the sweep; the stable sort keeps each star in the order of `tets`. Pinned vertices drop out.
    key, pair = torch.sort(position[tets].flatten(), stable=True)
    key, pair = key[key >= 0], pair[key >= 0]
    bounds = torch.searchsorted(key, ends.to(key.device)).tolist()
    colors = []
    for start, stop, first, last in zip(ptr[:-1], ptr[1:], bounds[:-1], bounds[1:], strict=True):
        tet = pair[first:last] // 4
        colors.append(
            Color(swept[start:stop], tet, pair[first:last] % 4, key[first:last] - start, tets[tet].T.reshape(-1))
        )
    return Layout(tets.T.contiguous(), tuple(colors), count, tet_order)


def take(a: Tensor, index: Tensor) -> Tensor:
    """Columns of a [..., R, V] -> [..., R, len(index)]. Gather, because its backward is the cheapest on the CPU."""
    return a.gather(-1, index.expand(*a.shape[:-1], -1))


def put(a: Tensor, index: Tensor, columns: Tensor) -> Tensor:
    """A copy of a [..., R, V] with `columns` [..., R, n] written at `index`."""
    return a.scatter(-1, index.expand(*a.shape[:-1], -1), columns)


def add_at(a: Tensor, index: Tensor, columns: Tensor) -> Tensor:
    """A copy of a [..., R, n] with `columns` [..., R, P] added at `index`, in the order of the columns."""
    return a.expand(*columns.shape[:-1], -1).scatter_add(-1, index.expand(*columns.shape[:-1], -1), columns)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product over components: [..., 3, n] x [..., 3, n] -> [..., n]."""
    return (a * b).sum(-2)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product over components, [..., 3, n]."""
    return torch.linalg.cross(a, b, dim=-2)


def outer6(a: Tensor) -> Tensor:
    """Upper triangle (xx, xy, xz, yy, yz, zz) of a a^T: [..., 3, n] -> [..., 6, n]."""
    x, y, z = a.unbind(-2)
    return torch.stack((x * x, x * y, x * z, y * y, y * z, z * z), -2)


def solve6(matrix: Tensor, rhs: Tensor) -> Tensor:
    """Solve a symmetric positive definite 3x3 system per column: [..., 6, n], [..., 3, n] -> [..., 3, n].

    L D L^T without pivoting: backward stable here, where the adjugate loses twice the digits on stiff blocks.
    """
    xx, xy, xz, yy, yz, zz = matrix.unbind(-2)
    b0, b1, b2 = rhs.unbind(-2)
    l10, l20 = xy / xx, xz / xx
    d1 = torch.addcmul(yy, l10, xy, value=-1)
    e21 = torch.addcmul(yz, l20, xy, value=-1)
    l21 = e21 / d1
    d2 = torch.addcmul(torch.addcmul(zz, l20, xz, value=-1), l21, e21, value=-1)
    b1 = torch.addcmul(b1, l10, b0, value=-1)
    b2 = torch.addcmul(torch.addcmul(b2, l20, b0, value=-1), l21, b1, value=-1)
    x2 = b2 / d2
    x1 = torch.addcmul(b1 / d1, l21, x2, value=-1)
    x0 = torch.addcmul(torch.addcmul(b0 / xx, l10, x1, value=-1), l20, x2, value=-1)
    return torch.stack((x0, x1, x2), -2)


@dataclass(frozen=True)
class Scene:
    """Constants of the steps of one run. Component-major; leading dimensions are scenes."""

    model: Any
    layout: Layout
    like: Tensor  # decides dtype and device
    time_step: float
    mu: Tensor  # [..., T]
    lam: Tensor  # [..., T]
    rest_points: Tensor  # [..., 3, V]
    shape_gradients: Tensor  # [..., 4, 3, T] grad N_a
    volume: Tensor  # [..., T]
    mass: Tensor  # [..., V]
    parameters: dict[str, Any]
    viscosity: Tensor | None = None  # [..., T] [Pa s]
    volume_viscosity: Tensor | None = None
    patches: Tensor | None = None  # [T] patch of each tet, whose volumes lam averages
    slowing: Tensor | None = None  # [..., V, 1] of velocities and accelerations by drag [-]; the mass is larger by it

    def per_tet(self, value: Any) -> Tensor:
        """[..., T] of a value that broadcasts to it, in the layout's order."""
        return of_tets(value, self.layout, self.like)

    def parameter(self, energy: Any, key: str) -> Tensor:
        """An energy parameter as a tensor: the caller's if one is given, else the energy's own constant."""
        name = energy.name if key in ("coefficient", energy.name) else f"{energy.name}_{key}"
        return self.tensor(self.parameters.get(name, getattr(energy, key)))

    def tensor(self, value: Any) -> Tensor:
        return torch.as_tensor(value, dtype=self.like.dtype, device=self.like.device)


def of_tets(value: Any, layout: Layout, like: Tensor) -> Tensor:
    value = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    value = value.expand(*value.shape[:-1], layout.tets.shape[1])
    return value if layout.order is None else value[..., layout.order]


def law_values(law: Any, parameters: dict[str, Any], per_tet: Callable[[Any], Tensor]) -> list[Tensor]:
    """Parameters of a law in their order, [..., T]: those given, else its own."""
    return [per_tet(parameters.get(name, law.values[name])) for name in law.density.parameters]


def build_scene(
    model: Any,
    layout: Layout,
    like: Tensor,
    *,
    mu: Any,
    lam: Any,
    time_step: float,
    rest_points: Tensor | None,
    density: Any,
    parameters: dict[str, Any] | None,
    stress_free: Tensor | None = None,
    viscosity: Any = None,
    volume_viscosity: Any = None,
    drag: Any = None,
) -> Scene:
    """Resolve the inputs of a run (shapes as in `step`) for the dtype and device of `like`."""

    def per_tet(value: Any) -> Tensor:
        return of_tets(value, layout, like)

    own = next((e for e in getattr(model, "energies", ()) if getattr(e, "name", None) == "law"), None)
    if own is not None:  # its parameters may have the names of moduli
        moduli = {k: v for k, v in (("mu", mu), ("lam", lam)) if k in own.values and v is not None}
        parameters = {**moduli, **(parameters or {})}
        mu, lam, _ = own.at_rest(law_values(own, parameters, per_tet))
    mu, lam = (0.0 if modulus is None else modulus for modulus in (mu, lam))
    points = torch.as_tensor(model.rest_points if rest_points is None else rest_points, device=like.device)
    points = points.to(like).transpose(-1, -2)
    gradients, volume = shape_functions(points, layout.tets)
    corner_mass = per_tet(model.density if density is None else density) * volume / 4
    mass = corner_mass.new_zeros(*corner_mass.shape[:-1], points.shape[-1])
    for corner in layout.tets:
        mass = mass.index_add(-1, corner, corner_mass)
    if getattr(model, "rigid_bodies", None) is not None:  # masses of their inertia
        own = 4 * corner_mass if layout.order is None else 4 * corner_mass[..., layout.order.argsort()]
        rows = (a.reshape(-1, a.shape[-1]) for a in (mass, own))
        mass = model.rigid_bodies.masses(*rows).reshape(mass.shape)
    if stress_free is not None:  # dN/dX = grad N G^-1, and the volume is that of the grown tet
        by = torch.as_tensor(stress_free, dtype=like.dtype, device=like.device).movedim(-3, -1)  # [..., 3, 3, T]
        by = by if layout.order is None or by.shape[-1] == 1 else by[..., layout.order]
        by = by.movedim(-1, -3).expand(*by.shape[:-3], volume.shape[-1], 3, 3)
        inverse = torch.linalg.inv(by).movedim(-3, -1)  # [..., 3, 3, T]
        gradients = (gradients[..., :, :, None, :] * inverse[..., None, :, :, :]).sum(-3)
        volume = volume * torch.linalg.det(by)
    rates = [None if value is None else per_tet(value) for value in (viscosity, volume_viscosity)]
    slowing = None
    if drag is not None:
        slowing = 1 / (1 + time_step * torch.as_tensor(drag, dtype=like.dtype, device=like.device))
        slowing = slowing.expand(*slowing.shape[:-1], points.shape[-1])
        mass, slowing = mass / slowing, slowing.unsqueeze(-1)
    lam, patches = per_tet(lam), getattr(model, "patches", None)
    if patches is not None:
        patches = patches.label if layout.order is None else patches.label[layout.order]
        lam = patch_means(patches, lam, volume)
    return Scene(
        model=model,
        layout=layout,
        like=like,
        time_step=time_step,
        mu=per_tet(mu),
        lam=lam,
        rest_points=points,
        shape_gradients=gradients,
        volume=volume,
        mass=mass,
        parameters=dict(parameters or {}),
        viscosity=rates[0],
        volume_viscosity=rates[1],
        slowing=slowing,
        patches=patches,
    )


def patch_means(patches: Tensor, values: Tensor, volume: Tensor) -> Tensor:
    """Means by volume of values [..., T] over each patch [T], for each tet [..., T]."""
    parts = torch.stack(torch.broadcast_tensors(values * volume, volume))
    sums = parts.new_zeros(*parts.shape[:-1], int(patches.max()) + 1 if len(patches) else 0)
    total, whole = sums.index_add(-1, patches, parts)[..., patches]
    return total / whole


def shape_functions(points: Tensor, tets: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the shape functions [..., 4, 3, T] and volumes [..., T] of tets [4, T] at points [..., 3, V]."""
    a, b, c, d = (points[..., corner] for corner in tets)
    # Rows of Dm^-1, Dm = [b-a, c-a, d-a], are the gradients of the shape functions of b, c, d.
    b, c, d = b - a, c - a, d - a
    area_b, area_c, area_d = cross(c, d), cross(d, b), cross(b, c)
    det = dot(b, area_b).unsqueeze(-2)
    of_b, of_c, of_d = area_b / det, area_c / det, area_d / det
    return torch.stack((-(of_b + of_c + of_d), of_b, of_c, of_d), -3), det.squeeze(-2) / 6

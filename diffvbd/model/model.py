"""Model: everything that does not change while a scene is simulated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.checks import (
    check_count,
    check_dtype,
    check_held,
    check_kind,
    check_tensor,
    fail,
    init_names_checked,
    input_name,
    name_value,
    real_array,
    vertex_mask,
    where_it_is,
)
from .._common.constants import CONTACT, ELASTIC
from .._common.context import is_captured, lasting, lasting_tensors, looks_at
from .._contact.barrier import Friction, PairBarrier
from .._contact.colliders import Collider
from .._contact.surface import ContactSurface, build_surface, check_colliders
from ..couplings import Coupling
from ..energies import VERTEX_ENERGIES, Anchor, FloorBarrier, StableNeoHookean, VertexEnergy
from ..laws import Law
from ..mesh import TetMesh
from .arguments import ELASTIC_LAWS, Energy, check_isolated, checked_device, checked_energies, per_tet_density, warn_of
from .bodies import Bodies, OtherBodies, connected, find_bodies, first_of_body
from .inputs import Inputs, inputs_of
from .material import lumped_mass, rest_metric
from .moving import moving_bodies
from .patches import Patches, patches_of
from .rigid import RigidBodies, inertias, rigid_bodies
from .solver import VBD

PLACED = (VertexEnergy, Coupling)  # energies that hold tensors
DEFAULT = VBD(1.0, 1)  # of solvers without options of their own


def _copy(name: str, text: str) -> Any:
    """A property that hands out copies of a tensor: what is done to one in place does not reach the Model."""
    return property(lambda self: getattr(self, name).clone(), doc=text)


@init_names_checked
class Model:
    """A scene: a mesh with its masses, pins, energies and colliders, colored and laid out for the sweeps.

    A Model holds constants and refuses tensors that require grad; what is differentiated is an input of
    :func:`diffvbd.step`, the rest shape too. How it is stepped is said by a :class:`diffvbd.VBD`.

    Args:
        mesh: Tetrahedra with positive rest volume.
        density: [kg/m^3], a number or one for each tet, shape [T].
        pinned: Vertices that sweeps do not move: a bool mask [V] or indices.
        energies: At most one of each kind.
        colliders: What the bodies touch and do not move (:mod:`diffvbd.colliders`); they need a PairBarrier.
        rigid: Numbers of bodies, as in ``body``, that do not deform: they move by six unknowns each, their mass and
            inertia are those of their tets, and their material plays no part. No vertex of theirs may be pinned.
        dtype, device: torch.float64 or torch.float32; where the tensors live.

    Attributes (torch tensors in the user's numbering, a copy at each access):
        rest_points [V, 3] [m]; tets [T, 4]; density [T]; mass [V] [kg]; pinned [V] bool; surface [F, 3];
        color_vertices [active]: the vertices in sweep order, color c being
        ``color_vertices[color_ptr[c]:color_ptr[c + 1]]``; color_ptr [colors + 1]; collider_points [Vc, 3]: where the
        colliders' corner points are unless a step is told otherwise, those of collider k being ``collider_rows[k]``.

    Raises:
        ValueError, TypeError: naming the argument, what was expected and what came.
    """

    _executed_by: Any  # (solver) -> System; system.py adds it

    rest_points: Tensor = _copy("_rest_points", "Rest positions [m], shape [V, 3].")
    density: Tensor = _copy("_density", "[kg/m^3], shape [T].")
    mass: Tensor = _copy("_mass", "Masses of the vertices [kg], shape [V].")
    pinned: Tensor = _copy("_pinned", "Which vertices sweeps do not move, bool [V].")
    color_ptr: Tensor = _copy("_color_ptr", "Where each color begins in color_vertices, int [colors + 1].")
    color_vertices: Tensor = _copy("_color_vertices", "Vertices in sweep order, int [active].")

    @lasting_tensors()
    def __init__(
        self,
        mesh: TetMesh,
        density: float | Tensor = 1000.0,
        pinned: Any = None,
        energies: Sequence[Energy] = (StableNeoHookean(),),
        colliders: Sequence[Collider] = (),
        *,
        rigid: Sequence[int] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        check_kind("mesh", mesh, TetMesh)
        check_dtype(dtype)
        self.mesh = mesh
        self._derived: dict[str, Any] = {}
        self._set_energies(checked_energies(energies, mesh.num_vertices))
        device = checked_device(device)
        self.energy_mask = self._mask(dtype, device)
        kinds = {type(e): e for e in self.vertex_energies}
        self._data_count = tuple(kinds[k].count() if k in kinds else 0 for k in VERTEX_ENERGIES)

        points = torch.from_numpy(mesh.points.copy())
        tets = torch.from_numpy(mesh.tets.copy())
        mask = vertex_mask(pinned, mesh.num_vertices)
        check_isolated(tets, mask)
        self._set_energies(tuple(e.of_mesh(mesh, mask) if isinstance(e, Coupling) else e for e in self.energies))
        self._density = per_tet_density(density, mesh.num_tets)
        self.rigid_bodies: RigidBodies | None = rigid_bodies(rigid, mesh, mask, self._density)
        self._given_contact = self.contact
        if self.contact is not None:  # defaults that follow from mesh and mass
            fitted = self.contact.of_scene(mesh, self._density.numpy(), mask.numpy())
            self._set_energies(tuple(fitted if e is self.contact else e for e in self.energies))
        self._pinned = mask
        given = next((e.patches for e in self.energies if isinstance(e, StableNeoHookean)), None)
        self.patches: Patches | None = patches_of(mesh, given)
        body = torch.from_numpy(mesh.body.copy())
        self._first_of_body = first_of_body(body)
        # those of the default solver: other solvers derive theirs (system.py)
        self._bodies, self._other_bodies = self._find_bodies(points, tets, mask, self.may_correct)
        self.surface_of_contact = self._build_surface(check_colliders(colliders))
        self._check_friction()
        self._arrange(points, tets, device)
        self._measure(points)
        warn_of(mesh, pinned, mask, self._unswept, self.energies)
        self._place(dtype, device)
        self._executed_by(DEFAULT)  # now, since compiled code can look it up and not build it

    def _mask(self, dtype: torch.dtype, device: torch.device) -> int:
        mask = 0
        for energy in (*self.energies, *self.vertex_energies):
            mask |= energy.bit
        if self.law is not None:
            self.law.check_mesh(self.mesh.num_tets)
            others = {input_name(e, key) for e in self.parametric_energies for key in e.parameters}
            if both := sorted(others & set(self.law.inputs)):
                fail("energies", "a law whose parameters have names of their own",
                     f"{both[0]!r}, which is an input of another energy")  # fmt: skip
            mask |= ops.bits_of_law(self.law.density, dtype, device)
        return mask

    def _set_energies(self, energies: tuple[Energy, ...]) -> None:
        self.energies = energies
        # the energies of single vertices, in the order in which kernels and data keep them
        present = [e for e in energies if isinstance(e, VertexEnergy)]
        self.couplings = tuple(e for e in energies if isinstance(e, Coupling))
        if self.couplings and not any(isinstance(e, Anchor) for e in present):
            # their record, where a step reads it
            present.append(Anchor(0.0).placed(self.mesh.num_vertices, getattr(self, "device", torch.device("cpu"))))
        self.vertex_energies: tuple[VertexEnergy, ...] = tuple(sorted(present, key=lambda e: e.bit))
        self.law = next((e for e in energies if isinstance(e, Law)), None)
        self.floor = next((e for e in energies if isinstance(e, FloorBarrier)), None)
        self.contact = next((e for e in energies if isinstance(e, PairBarrier)), None)
        self.friction = next((e for e in energies if isinstance(e, Friction)), None)
        self._constants: dict[str, dict[str, Tensor]] = {}

    def _build_surface(self, colliders: tuple[Collider, ...]) -> ContactSurface | None:
        self.colliders = colliders
        if self.contact is None:
            if colliders:
                fail("colliders", "a PairBarrier among the energies, which they act through", "none")
            if self.friction is not None and self.floor is None:
                fail("energies", "a FloorBarrier or a PairBarrier for Friction to act on", "none")
            return None
        return build_surface(self.mesh, self._pinned, self.contact, colliders)

    def _check_friction(self) -> None:
        """Raises where a matrix of friction has another size than there are bodies, colliders and floors."""
        given = None if self.friction is None else np.shape(self.friction.coefficient)
        wanted = self.mesh.num_bodies + len(self.colliders) + (self.floor is not None)
        if given and given[0] != wanted:
            fail("energies: Friction: coefficient", f"a matrix [{wanted}, {wanted}] of {self.mesh.num_bodies} bodies, "
                 f"{len(self.colliders)} colliders{' and a floor' if self.floor is not None else ''}",
                 f"shape {list(given)}")  # fmt: skip

    @property
    def may_correct(self) -> bool:
        """Whether bodies can have a rigid correction of their own. Pairs and friction have another one."""
        return not self.touches and (self._is_elastic or self.rigid_bodies is not None)

    @property
    def _is_elastic(self) -> bool:
        return any(isinstance(e, ELASTIC_LAWS) for e in self.energies)

    def _find_bodies(self, points: Tensor, tets: Tensor, pinned: Tensor, correct: bool) -> tuple[Bodies, OtherBodies]:
        """Those that are corrected, and the others; on the CPU."""
        if self.rigid_bodies is not None and not self._is_elastic:  # tets without stiffness are no body
            pinned = pinned | ~self.rigid_bodies.mask.cpu()
        return find_bodies(points, tets, pinned, correct, self.floor is not None)

    @property
    def inputs(self) -> Inputs:
        """The keywords that steps and rollouts take, with shapes, units and defaults; prints as a table."""
        return inputs_of(self)

    @property
    def _unswept(self) -> Tensor:
        """Vertices that no sweep moves, bool [V]: those that are pinned or of rigid bodies."""
        return self._pinned if self.rigid_bodies is None else self._pinned | self.rigid_bodies.mask

    @property
    def rest_scalars(self) -> Tensor:
        """Stiffness weights and inverse volume of each tet at rest [1, T, 7], rounded once from float64."""
        return self.derived("rest", self._find_rest_scalars)

    def _find_rest_scalars(self) -> Tensor:
        points = torch.from_numpy(self.mesh.points.copy())[None].to(self.device)
        return rest_metric(ops.tet_gather(points, *self._topology))[0].to(self.dtype)

    @property
    def joined(self) -> Tensor:
        """Group of each vertex, of connected bodies that couplings join, counted from 0, int64 [V] on the CPU."""
        label = connected(self.tets.cpu(), self.num_vertices)
        if self.couplings:
            pairs = torch.cat([energy.joins()[0] for energy in self.couplings])
            label = connected(label[pairs], self.num_vertices)[label]
        return torch.unique(label, return_inverse=True)[1]

    @property
    def touches(self) -> bool:
        """Whether steps go through contact, with pairs or friction."""
        return bool(self.energy_mask & CONTACT)

    @property
    def _renews(self) -> bool:
        """Whether each sweep begins with bounds of couplings or patches about its own start."""
        return bool(self.couplings) or self.patches is not None

    @property
    def collider_points(self) -> Tensor:
        """Corner points of the colliders [m], shape [Vc, 3]; a copy."""
        surface = self.surface_of_contact
        return self._mass.new_zeros((0, 3)) if surface is None else surface.collider_points.clone()

    @property
    def collider_rows(self) -> tuple[slice, ...]:
        """Rows of collider_points of each collider."""
        return () if self.surface_of_contact is None else self.surface_of_contact.rows

    @property
    def body(self) -> Tensor:
        """Body of each vertex, counted from 0, int64 [V]."""
        if self.surface_of_contact is None:
            return self.derived("bodies of vertices", lambda: torch.from_numpy(
                np.unique(self.mesh.body, return_inverse=True)[1].reshape(-1)).to(self.device)).clone()  # fmt: skip
        return self.surface_of_contact.body[: self.num_vertices].to(torch.int64)

    @property
    def plane_points(self) -> Tensor:
        """Rows of collider_points that span planes, bool [Vc]."""
        surface = self.surface_of_contact
        return self._pinned.new_zeros((0,)) if surface is None else surface.plane_points[self.num_vertices :].clone()

    @property
    def collider_radius(self) -> Tensor:
        """Distance of a collider's surface from its corner points [m], shape [Vc]."""
        surface = self.surface_of_contact
        return self._mass.new_zeros((0,)) if surface is None else surface.radius[self.num_vertices :].clone()

    @property
    def max_trust_radius(self) -> float:
        """Largest displacement of a vertex relative to its island between two detections of the PairBarrier [m]."""
        surface, barrier = self.surface_of_contact, self.contact
        if surface is None or barrier is None:
            fail("model", "a PairBarrier among its energies", "none")
        return float(surface.max_trust_radius.max())

    @property
    def parametric_energies(self) -> tuple[VertexEnergy | Coupling | PairBarrier | Friction, ...]:
        """The energies whose parameters are inputs of a step."""
        contact = [e for e in (self.contact, self.friction) if e is not None]
        own = sorted((e for e in self.energies if isinstance(e, VertexEnergy)), key=lambda e: e.bit)
        return (*own, *self.couplings, *contact)

    def constants(self, energy: VertexEnergy | Coupling | PairBarrier | Friction) -> dict[str, Tensor]:
        """The parameters of one of the Model's energies, as tensors of its dtype and device."""
        if energy.name not in self._constants:
            self._constants[energy.name] = check_held(energy.constants(self._rest_points), energy)
        return self._constants[energy.name]

    def _arrange(self, points: Tensor, tets: Tensor, device: torch.device) -> None:
        """The order of the sweeps, in the form that a device wants; everything still on the CPU."""
        plan = ops.direct.build_plan(points, tets, ~self._unswept, ops.LANES[device.type])  # see csrc/cpu/plan.h
        self._plan, self._color_ptr, self._color_vertices, star_ptr, star = plan
        self._topology = (tets, star_ptr, star)
        self._sizes = ops.plan_sizes(self._plan, device.type)

    def _measure(self, points: Tensor) -> None:
        """Everything that follows from the rest positions, in float64."""
        rest, volume = rest_metric(ops.tet_gather(points[None], *self._topology))
        self._rest_points = points
        self._mass = self.mass_of(self._density[None], volume)[0]
        self._rest = rest
        if self.contact is not None:  # potentials of bodies decide
            elastic = bool(self.energy_mask & ELASTIC)
            self._moving = moving_bodies(points, self._topology[0], self._pinned, elastic)
        data = [e.pack({k: t[None] for k, t in e.constants(points).items()}, None) for e in self.vertex_energies]
        self._energy_data = torch.cat(data, -1) if data else points.new_zeros((1, 0))

    def _place(self, dtype: torch.dtype, device: torch.device) -> None:
        self.dtype, self.device = dtype, device
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(self, name, value.to(device, dtype) if value.is_floating_point() else value.to(device))
        self._topology = tuple(t.to(device) for t in self._topology)
        self._bodies, self._other_bodies = self._bodies.to(device), self._other_bodies.to(device)
        placed = [e.placed(self.num_vertices, device) if isinstance(e, PLACED) else e for e in self.energies]
        self._set_energies(tuple(placed))
        if self.patches is not None:
            self.patches = self.patches.to(device)
        if self.rigid_bodies is not None:
            self.rigid_bodies = self.rigid_bodies.to(device, dtype)
        if hasattr(self, "_rest"):
            self._packed_rest = ops.pack_rest(self._rest, self._plan, self._sizes)
            del self._rest
        if self.surface_of_contact is not None:
            self.surface_of_contact = self.surface_of_contact.to(device, dtype)
        if self.contact is not None:
            self._moving = self._moving.to(device, dtype)
        for energy in (*self.parametric_energies, *self.vertex_energies):
            self.constants(energy)

    @lasting_tensors()
    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Model:
        """A new Model on another device or of another dtype; raises TypeError unless that is float64 or float32."""
        if isinstance(device, torch.dtype):
            raise TypeError(f"device: expected a device, got {device}: give it as to(dtype={device})")
        dtype = self.dtype if dtype is None else dtype
        check_dtype(dtype)
        device = self.device if device is None else checked_device(device)
        out = object.__new__(type(self))
        out.__dict__.update(self.__dict__)
        out._derived = {}
        out._place(torch.float64, torch.device("cpu"))
        # from the mesh's own float64 positions, so that a way through float32 loses nothing
        points = torch.from_numpy(self.mesh.points.copy())
        out.surface_of_contact = out._build_surface(self.colliders)
        if device.type != self.device.type:
            out._arrange(points, out.tets, device)
        out._measure(points)
        out._place(dtype, device)
        out.energy_mask = out._mask(dtype, device)
        out._executed_by(DEFAULT)
        return out

    def replace(self, **changes: Any) -> Model:
        """A new Model of the same mesh with other arguments of the constructor; other names raise TypeError."""
        cpu = torch.device("cpu")
        given = [self._given_contact if e is self.contact else e for e in self.energies]
        own = {
            "density": self._density.cpu(),
            "pinned": self._pinned.cpu() if self._pinned.any() else None,
            "energies": [e.placed(self.num_vertices, cpu) if isinstance(e, PLACED) else e for e in given],
            "colliders": self.colliders,
            "rigid": () if self.rigid_bodies is None else self.rigid_bodies.numbers,
            "dtype": self.dtype,
            "device": self.device,
        }
        if unknown := sorted(set(changes) - set(own)):
            names = ", ".join(sorted(own))
            raise TypeError(
                f"{unknown[0]}: expected an argument of Model.replace ({names}){where_it_is(unknown[0], own)}"
            )
        return Model(self.mesh, **own | changes)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_derived": {}}

    @lasting_tensors()
    def __setstate__(self, state: dict[str, Any]) -> None:
        """Unpickles, also where torch.load(map_location=...) has moved the tensors to another device."""
        self.__dict__.update(lasting(state))
        self._derived = {}
        actual = checked_device(self._mass.device)
        self.energy_mask = self._mask(self.dtype, actual)
        if actual != self.device:
            self.__dict__.update(self.to(actual).__dict__)

    def mass_of(self, density: Tensor, volume: Tensor) -> Tensor:
        """Masses of the vertices [B, V] [kg] of tets [B, T]: lumped, and of rigid bodies with their inertia."""
        mass = lumped_mass(density, volume, *self._topology)
        return mass if self.rigid_bodies is None else self.rigid_bodies.masses(mass, density * volume)

    def wrench(self, x: Tensor, body: int, force: Any = None, torque: Any = None) -> Tensor:
        """Forces on the vertices of a body that sum up to a force and to a torque about its center of mass, for the
        input ``force``.

            f_i = m_i (F / M + a x r_i),    a = I^-1 T

        Every vertex is accelerated as by a rigid motion, so that a body, rigid or soft, is not deformed by them.

        Args:
            x: Positions [m], shape [..., V, 3]. Pass those of each step: with old ones the arms are those of an old
                pose. A torque that follows a turning body is of second order in h with ``x + h * v`` alone.
            body: Its number, as in ``body``.
            force: F [N], shape [3] or [..., 3]; None: zero.
            torque: T [N m], likewise.

        Returns:
            Forces [N] [..., V, 3] along the axes of the world, zero on other bodies; differentiable in x, force and
            torque.

        Raises:
            ValueError, TypeError: Naming the argument, what was expected and what came.

        Source: docs/method.md, section 14.
        """
        if not isinstance(x, Tensor) or x.dim() < 2 or x.shape[-2:] != (self.num_vertices, 3):
            got = f"shape {list(x.shape)}" if isinstance(x, Tensor) else type(x).__name__
            fail("x", f"a tensor of shape [..., {self.num_vertices}, 3]", got)
        check_tensor("x", x, self._mass)
        body = check_count("body", body, maximum=self.mesh.num_bodies - 1)
        rows = self.derived(f"vertices of body {body}", lambda: (self.body == body).nonzero()[:, 0])
        if self.derived(f"pins of body {body}", lambda: bool(self._pinned[rows].any())):
            fail("body", "one without pinned vertices, which a force does not move", f"body {body}")
        given = []
        for name, value in (("force", force), ("torque", torque)):
            value = torch.zeros(3, dtype=x.dtype, device=x.device) if value is None else value
            value = value if isinstance(value, Tensor) else real_array(name, value, "three numbers").to(x)
            check_tensor(name, value, x, owner="that of x")
            if (
                not value.dim()
                or value.shape[-1] != 3
                or value.dim() >= x.dim()
                or not all(a in (1, b) for a, b in zip(value.shape[-2::-1], x.shape[-3::-1], strict=False))
            ):
                fail(name, f"shape [3], or [..., 3] of x's scenes {list(x.shape[:-2])}", f"shape {list(value.shape)}")
            if looks_at(value):
                name_value(name, "finite numbers", value.detach(), torch.isfinite(value.detach()))
            given.append(value[..., None, :])
        m, at = self._mass[rows, None], x[..., rows, :]
        total = m.sum()
        arm = at - (m * at).sum(-2, keepdim=True) / total
        inertia = inertias(m, arm).sum(-2).unflatten(-1, (3, 3))
        turn = torch.linalg.solve(inertia, given[1][..., 0, :, None])[..., None, :, 0]
        own = m * (given[0] / total + torch.linalg.cross(turn.expand_as(arm), arm))
        return torch.zeros_like(x).index_copy(-2, rows, own)

    def derived(self, name: str, build: Callable[[], Any]) -> Any:
        """Something that follows from the Model alone, built at its first use and kept."""
        if name not in self._derived:
            with torch.inference_mode(False), torch.no_grad():  # later steps may be differentiated
                value = build()
            if is_captured(self._mass):  # what is captured has no values until it is replayed
                return value
            self._derived[name] = value
        return self._derived[name]

    @property
    def tets(self) -> Tensor:
        """Vertices of each tet, shape [T, 4]; a copy."""
        return self._topology[0].clone()

    @property
    def surface(self) -> Tensor:
        """Outward triangles of the boundary, shape [F, 3]."""
        return torch.from_numpy(self.mesh.surface.copy()).to(self.device)

    # From tensors: torch.compile makes arrays of numpy writable that compiled code reads.
    @property
    def num_vertices(self) -> int:
        return self._rest_points.shape[0]

    @property
    def num_tets(self) -> int:
        return self._topology[0].shape[0]

    @property
    def num_active(self) -> int:
        """Vertices that sweeps move."""
        return self._sizes[0]

    @property
    def num_moving(self) -> int:
        """Vertices that are not pinned, which sweeps or rigid bodies move."""
        return self.num_active + (0 if self.rigid_bodies is None else len(self.rigid_bodies.order))

    @property
    def num_colors(self) -> int:
        """Groups of vertices that a sweep updates one after another."""
        return self._color_ptr.shape[0] - 1

    def __repr__(self) -> str:
        rigid = "" if self.rigid_bodies is None else f"{len(self.rigid_bodies.numbers)} rigid, "
        return (
            f"Model({self.num_vertices} vertices, {self.num_tets} tets, {int(self._pinned.sum())} pinned, "
            f"{rigid}{self.num_colors} colors, mass {float(self._mass.sum()):.4g} kg, "
            f"energies=({', '.join(map(repr, self.energies))})"
            f"{f', {len(self.colliders)} colliders' if self.colliders else ''}, {self.dtype}, {self.device})"
        )

"""A batch of scenes as a vector environment of gymnasium, differentiable or captured in a CUDA graph."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

import diffvbd as dv

from .._common.checks import (
    check_bool,
    check_count,
    check_dtype,
    check_number,
    check_positive,
    check_tensor,
    fail,
    name_value,
    real_array,
)
from .._common.context import looks_at
from ..step.warnings import proven

State = dict[str, Tensor]  # by name, each of shape [B, ...]
Range = tuple[float, float]
SETTLING = 60  # steps in which a body comes to rest before the first episode
WARM_UP = 3  # steps before a capture: kernels are loaded, and the Model keeps what follows from its first step


class Environment(VectorEnv[Tensor, Tensor, Tensor]):
    """B scenes of one Model that are stepped together. A subclass says what actions do and what is rewarded.

    The interface is that of ``gymnasium.vector.VectorEnv``, with tensors of the Model's dtype and device in place
    of arrays. A scene whose episode ends begins anew in the same step (``AutoresetMode.SAME_STEP``): ``step`` returns
    the first observation of the next episode, and ``info["final_obs"]`` has the last one of this. So every action has
    an effect, and nothing waits for the device to learn which scenes end.

    A subclass defines :meth:`build`, :meth:`start`, :meth:`act`, :meth:`observe` and :meth:`reward`, perhaps
    :meth:`moduli` and :meth:`failed`, and the numbers below. Its methods must be functions of their arguments and of
    constants, in torch and without a look at values, so that they can be captured.

    Args:
        num_envs: Number of scenes B >= 1.
        differentiable: Whether steps keep the graph from actions to rewards, observations and state (:meth:`detach`).
            If not, nothing requires grad, and on CUDA steps are replayed from a CUDA graph, captured at the first.
        young, friction: Ranges of Young's modulus [Pa] and of the friction coefficient [-], of which each episode draws
            its own. None: those of the class, as for the next two.
        episode_steps: Steps after which an episode is truncated, >= 1.
        sweeps: Of the solver.
        dtype, device: Of the Model.

    Attributes:
        state: Tensors of all scenes by name: "x" [B, V, 3] [m], "v" [m/s], "mu" and "lam" [B, 1] or [B, T] [Pa],
            "friction" [B], "steps" [B] of the episode, and those of the subclass. To be read; a captured step
            overwrites them in place.
        model, solver: What is stepped.
        rest: Positions in which the Model has come to rest [V, 3] [m].

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
    actions: ClassVar[int]  # of a scene, each in [-1, 1]
    draws: ClassVar[int] = 0  # random numbers with which an episode begins, besides material and friction
    time_step: ClassVar[float] = 1 / 60  # [s]
    sweeps: int = 20
    episode_steps: int = 120
    young: Range = (3e4, 6e4)
    poisson: float = 0.4
    friction: Range = (0.4, 0.8)

    def __init__(
        self, num_envs: int, *, differentiable: bool = False, young: Range | None = None, friction: Range | None = None,
        episode_steps: int | None = None, sweeps: int | None = None, dtype: torch.dtype = torch.float64,
        device: str | torch.device = "cpu",
    ) -> None:  # fmt: skip
        self.num_envs, self.differentiable = check_count("num_envs", num_envs, 1), differentiable
        check_bool("differentiable", differentiable)
        check_dtype(dtype)
        self.young = _range("young", self.young if young is None else young, positive=True)
        self.friction = _range("friction", self.friction if friction is None else friction)
        self.episode_steps = check_count(
            "episode_steps", self.episode_steps if episode_steps is None else episode_steps, 1
        )
        self.model = self.build(dtype, device)
        self._drawn = [
            name for name in ("mu", "lam", "friction") if name in self.model.inputs
        ]  # rigid bodies lack some
        self.solver = dv.VBD(self.time_step, self.sweeps if sweeps is None else sweeps)
        self._generator = torch.Generator(self.model.device)
        self._generator.seed()
        self._graph: torch.cuda.CUDAGraph | None = None
        self.rest = self._settled()
        self.state: State = self._begun(self._random())
        size = self._observed()
        numbers = np.float64 if dtype == torch.float64 else np.float32
        self.single_action_space = Box(-1.0, 1.0, (self.actions,), numbers)
        self.single_observation_space = Box(-np.inf, np.inf, (size,), numbers)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    # --- what a subclass defines --------------------------------------------------------------------------------------

    def build(self, dtype: torch.dtype, device: str | torch.device) -> dv.Model:
        """The scene, and constants of the subclass."""
        raise NotImplementedError

    def moduli(self, young: Tensor) -> tuple[Tensor, Tensor]:
        """Lame parameters [B, 1] or [B, T] [Pa] of scenes with these Young's moduli [B] [Pa]."""
        return dv.lame(young[:, None], self.poisson)

    def start(self, draws: Tensor) -> State:
        """Entries of the state that episodes begin with, given random numbers even in [0, 1), [B, draws]: those of the
        subclass, and "x" unless it is at rest. Velocities are 0."""
        raise NotImplementedError

    def act(self, state: State, action: Tensor) -> tuple[dict[str, Tensor], State]:
        """Inputs of :func:`diffvbd.step` for actions [B, n] in [-1, 1], and the entries of the state that change."""
        raise NotImplementedError

    def observe(self, state: State) -> Tensor:
        """Observations [B, m], of order one."""
        raise NotImplementedError

    def reward(self, before: State, after: State, action: Tensor) -> Tensor:
        """Rewards [B] of a step."""
        raise NotImplementedError

    def failed(self, state: State) -> Tensor:
        """Scenes whose episode ends early, bool [B]; by default none."""
        return torch.zeros_like(state["steps"], dtype=torch.bool)

    # --- gymnasium's interface ----------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """New episodes: observations of all scenes [B, m], and an empty dict.

        Args:
            seed: Of the random numbers of this and later episodes.
            options: ``{"mask": bool [B]}``: only these scenes begin anew, the others stay as they are, to the bit.
                ``"reset_mask"``, the name in gymnasium's own environments, does the same.
        """
        if not isinstance(options, dict | None):
            raise TypeError(f"options: expected a dict, got {type(options).__name__}")
        seed = None if seed is None else check_count("seed", seed, maximum=2**63 - 1)
        if len(given := dict(options or {})) > 1 or not set(given) <= {"mask", "reset_mask"}:
            fail("options", "mask alone", ", ".join(map(repr, given)))
        mask = next(iter(given.values()), None)
        if mask is not None:
            mask = mask if isinstance(mask, Tensor) else torch.from_numpy(np.asarray(mask, bool))
            if mask.dtype != torch.bool or mask.shape != (self.num_envs,):
                fail("options", f"a bool mask of shape [{self.num_envs}]", f"{mask.dtype} of shape {list(mask.shape)}")
            mask = mask.to(self.model.device)
        if seed is not None:
            self._generator.manual_seed(seed)
        begun = self._begun(self._random())
        if mask is not None:
            begun = _chosen(mask, begun, self.state)
        if self._graph is None:
            self.state = begun
        else:  # the graph reads these tensors
            for name, value in begun.items():
                self.state[name].copy_(value)
        return self.observe(self.state), {}

    def step(self, actions: Tensor | np.ndarray) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """A step of all scenes: observations [B, m], rewards [B], terminated [B], truncated [B], and a dict of
        ``final_obs`` [B, m] and ``_final_obs``, which says where episodes have ended [B].

        Scenes that failed, or whose positions are no longer finite, are terminated.

        Args:
            actions: [B, n], clamped to [-1, 1]: a tensor of the Model's dtype and device, or an array.

        Raises:
            ValueError, TypeError: For actions of another shape, dtype or device; as :func:`diffvbd.step`.
        """
        like = self.state["x"]
        if isinstance(actions, np.ndarray):
            actions = real_array("actions", actions, "an array of numbers").to(like)
        actions = check_tensor("actions", actions, like, "a tensor or an array")
        if actions.shape != (self.num_envs, self.actions):
            fail("actions", f"shape {[self.num_envs, self.actions]}", list(actions.shape))
        if looks_at(actions):
            name_value("actions", "numbers", actions.detach(), ~torch.isnan(actions.detach()), ("scene", "action"))
        if self.differentiable:
            self.state, results = self._advanced(self.state, actions, self._random())
        else:
            with torch.no_grad():
                results = self._without_gradient(actions.detach(), self._random())
        observation, reward, terminated, truncated, final = results
        return observation, reward, terminated, truncated, {"final_obs": final, "_final_obs": terminated | truncated}

    def detach(self) -> Tensor:
        """Cuts the graph between past and coming steps, for truncated backpropagation through time; the current
        observations [B, m], detached."""
        self.state = {name: value.detach() for name, value in self.state.items()}
        with torch.no_grad():
            return self.observe(self.state)

    # --- steps --------------------------------------------------------------------------------------------------------

    def _advanced(self, state: State, action: Tensor, draws: Tensor) -> tuple[State, tuple[Tensor, ...]]:
        """State after a step in which ended episodes begin anew; observations, rewards, ends, and last observations."""
        action = action.clamp(-1.0, 1.0)
        inputs, changed = self.act(state, action)
        given: dict[str, Any] = {**inputs, **{name: state[name] for name in self._drawn}}
        with proven():  # the numbers of a class were tried; each new modulus would be tried again
            x, v = dv.step(self.model, state["x"], state["v"], self.solver, **given)
        after = {**state, **changed, "x": x, "v": v, "steps": state["steps"] + 1}
        lost = ~torch.isfinite(x).flatten(1).all(1)
        terminated = lost | self.failed(after)
        truncated = ~terminated & (after["steps"] >= self.episode_steps)
        reward = torch.where(lost, 0.0, self.reward(state, after, action))
        final = torch.where(lost[:, None], 0.0, self.observe(after))
        after = _chosen(terminated | truncated, self._begun(draws), after)
        return after, (self.observe(after), reward, terminated, truncated, final)

    def _without_gradient(self, action: Tensor, draws: Tensor) -> tuple[Tensor, ...]:
        if not action.is_cuda:
            self.state, results = self._advanced(self.state, action, draws)
            return results
        with torch.cuda.device(action.device):
            if self._graph is None:
                self._graph = self._captured(action, draws)
            for buffer, value in zip(self._buffers, (action, draws), strict=True):
                buffer.copy_(value)
            self._graph.replay()
            return tuple(value.clone() for value in self._outputs)

    def _captured(self, action: Tensor, draws: Tensor) -> torch.cuda.CUDAGraph:
        """A step from and into the tensors of the state, which is left as it is."""
        self._buffers = action.clone(), draws.clone()
        self.state = {name: value.clone() for name, value in self.state.items()}  # none shares memory with another
        kept = {name: value.clone() for name, value in self.state.items()}
        side, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(WARM_UP):
                self._in_place()
        torch.cuda.current_stream().wait_stream(side)
        with torch.cuda.graph(graph):
            self._outputs = self._in_place()
        for name, value in kept.items():
            self.state[name].copy_(value)
        return graph

    def _in_place(self) -> tuple[Tensor, ...]:
        after, results = self._advanced(self.state, *self._buffers)
        for name, value in after.items():
            self.state[name].copy_(value)
        return results

    # --- episodes -----------------------------------------------------------------------------------------------------

    def _observed(self) -> int:
        """Size of an observation; raises where a method of the subclass returns another shape or dtype than it
        must."""
        with torch.no_grad():
            seen = self.observe(self.state)
            found = {"observe": (seen, 2), "reward": (self.reward(self.state, self.state, self._no_action()), 1)}
            found |= {f"start: {name}": (value, value.dim()) for name, value in self.state.items()}
        for name, (value, dims) in found.items():
            if value.dim() != dims or not value.dim() or len(value) != self.num_envs:
                wanted = f"{self.num_envs} scenes in {dims} dimension{'s' * (dims > 1)}"
                fail(f"{type(self).__name__}.{name}", wanted, f"shape {list(value.shape)}")
            if value.is_floating_point() and value.dtype != self.model.dtype:
                fail(f"{type(self).__name__}.{name}", str(self.model.dtype), str(value.dtype))
        failed = self.failed(self.state)
        if failed.dtype != torch.bool or failed.shape != (self.num_envs,):
            fail(f"{type(self).__name__}.failed", f"bool of shape [{self.num_envs}]",
                 f"{failed.dtype} of shape {list(failed.shape)}")  # fmt: skip
        return seen.shape[-1]

    def _no_action(self) -> Tensor:
        return self.model.rest_points.new_zeros((self.num_envs, self.actions))

    def _random(self) -> Tensor:
        """Numbers for a new episode of each scene. They are drawn in each step and outside of graphs, so that they
        depend on the seed and the number of calls alone."""
        like, size = self.model.rest_points, (self.num_envs, 2 + self.draws)
        return torch.rand(size, generator=self._generator, dtype=like.dtype, device=like.device)

    @torch.no_grad()
    def _begun(self, draws: Tensor) -> State:
        """State of new episodes of all scenes."""
        ranges = (self.young, self.friction)
        young, friction = (low + (high - low) * draws[:, k] for k, (low, high) in enumerate(ranges))
        mu, lam = self.moduli(young)
        x = self.rest.expand(self.num_envs, -1, -1)
        steps = torch.zeros(self.num_envs, dtype=torch.int64, device=x.device)
        return {"x": x, "v": torch.zeros_like(x), "mu": mu, "lam": lam, "friction": friction, "steps": steps,
                **self.start(draws[:, 2:])}  # fmt: skip

    @torch.no_grad()
    def _settled(self) -> Tensor:
        """On the CPU, where one scene is fastest."""
        model, young = self.model.to("cpu"), self.model.rest_points.new_full((1,), sum(self.young) / 2)
        x, (mu, lam) = model.rest_points[None], (value.cpu() for value in self.moduli(young))
        v, given = torch.zeros_like(x), dict[str, Any](mu=mu, lam=lam) if "mu" in self._drawn else {}
        with proven():
            for _ in range(SETTLING):
                x, v = dv.step(model, x, v, self.solver, **given)
        return x[0].to(self.model.device)


def _chosen(mask: Tensor, yes: State, no: State) -> State:
    """The state of one or the other by scene; mask: bool [B]."""
    return {name: torch.where(mask.view(-1, *[1] * (value.dim() - 1)), value, no[name]) for name, value in yes.items()}


def _range(name: str, given: Any, positive: bool = False) -> Range:
    if not isinstance(given, (tuple, list)) or len(given) != 2:
        fail(name, "two numbers, the least and the largest", repr(given))
    low, high = (check_positive(name, value) if positive else check_number(name, value) for value in given)
    if low > high:
        fail(name, "the least before the largest", f"{low:g}, {high:g}")
    return low, high

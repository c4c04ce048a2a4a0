"""A policy for one of the environments: by gradients through the simulation (SHAC), or by PPO of stable-baselines3.

python examples/train_env.py --env lift --algorithm shac --seconds 60 --envs 64 --device cpu --out curve.json
"""

import argparse
import copy
import itertools
import json
import time

import torch
from torch import nn

import diffvbd as dv

ENVIRONMENTS = {"lift": dv.envs.SoftLift, "crawler": dv.envs.Crawler, "push": dv.envs.TactilePush}
HORIZON, DISCOUNT, LAMBDA = 16, 0.99, 0.95
RATE = 3e-3  # of the actor at first; it falls to 0 over the budget
EVALUATIONS = 5  # while training, of episodes that it does not see


def network(sizes, dtype, device):
    layers = [part for a, b in itertools.pairwise(sizes) for part in (nn.Linear(a, b), nn.ELU(), nn.LayerNorm(b))]
    return nn.Sequential(*layers[:-2]).to(device, dtype)


@torch.no_grad()
def mean_return(env, policy):
    """Mean undiscounted return of one episode of each scene."""
    observation, _ = env.reset(seed=10_000)
    total, running = 0.0, torch.ones(env.num_envs, dtype=torch.bool, device=observation.device)
    for _ in range(env.episode_steps):
        observation, reward, _, _, info = env.step(policy(observation))
        total = total + torch.where(running, reward, 0.0)
        running &= ~info["_final_obs"]
    return total.mean().item()


class Curve:
    """Returns over samples and seconds of training; the time of evaluations does not count."""

    def __init__(self, env, seconds):
        self.env, self.budget, self.rows, self.begun = env, seconds, [], None

    def spent(self):
        """Share of the budget that is spent."""
        return (time.perf_counter() - self.begun) / self.budget

    def due(self, samples, policy):
        """Evaluates the policy where it is time to; whether the budget is spent."""
        if self.env.model.device.type == "cuda":
            torch.cuda.synchronize()
        now = time.perf_counter()
        self.begun = now if self.begun is None else self.begun
        seconds = now - self.begun
        if seconds >= self.budget * len(self.rows) / EVALUATIONS:
            self.rows.append({"samples": samples, "seconds": seconds, "return": mean_return(self.env, policy)})
            self.begun += time.perf_counter() - now
        return seconds >= self.budget


def shac(make, envs, curve):
    """Short-horizon actor-critic (Xu et al. 2022): the actor follows the gradient of the rewards of some steps and of a
    critic at their end; the critic learns TD(lambda) values."""
    env = make(envs, differentiable=True)
    env.reset(seed=0)
    (observed,), (actions,) = env.single_observation_space.shape, env.single_action_space.shape
    like = {"dtype": env.model.dtype, "device": env.model.device}
    actor, critic = (network((observed, 64, 64, last), **like) for last in (actions, 1))
    with torch.no_grad():
        actor[-1].weight *= 0.1  # begins with little motion, where no action is at its limit
    spread = nn.Parameter(torch.full((actions,), -1.0, **like))  # log of the standard deviation
    parameters, target, samples = [*actor.parameters(), spread], copy.deepcopy(critic), 0
    of_actor = torch.optim.Adam(parameters, lr=RATE, betas=(0.7, 0.95))
    of_critic = torch.optim.Adam(critic.parameters(), lr=2e-3, betas=(0.7, 0.95))
    while not curve.due(samples, lambda seen: actor(seen).tanh()):
        observation = env.detach()
        total, weight, rows = 0.0, torch.ones(envs, **like), []
        for step in range(HORIZON):
            mean = actor(observation)
            seen = observation.detach()
            action = (mean + spread.exp() * torch.randn_like(mean)).tanh()
            observation, reward, terminated, _, info = env.step(action)
            value = torch.where(terminated, 0.0, target(info["final_obs"])[:, 0])
            done = info["_final_obs"]
            total = total + weight * reward
            weight = weight * DISCOUNT
            total = total + (weight * value if step == HORIZON - 1 else torch.where(done, weight * value, 0.0))
            weight = torch.where(done, 1.0, weight)
            rows.append((seen, reward.detach(), value.detach(), done))
        of_actor.zero_grad()
        (-total.mean() / HORIZON).backward()
        for group in of_actor.param_groups:
            group["lr"] = RATE * max(0.05, 1 - curve.spent())
        norm = nn.utils.clip_grad_norm_(parameters, 1.0)
        if torch.isfinite(norm):
            of_actor.step()
        samples += HORIZON * envs
        wanted, after = [], rows[-1][2]
        for _, reward, value, done in reversed(rows):
            after = reward + DISCOUNT * torch.where(done, value, (1 - LAMBDA) * value + LAMBDA * after)
            wanted.insert(0, after)
        seen, wanted = torch.cat([row[0] for row in rows]), torch.cat(wanted)
        for _ in range(8):
            for part in torch.randperm(len(seen), device=seen.device).chunk(4):
                of_critic.zero_grad()
                (critic(seen[part])[:, 0] - wanted[part]).square().mean().backward()
                of_critic.step()
        with torch.no_grad():
            for slow, fast in zip(target.parameters(), critic.parameters(), strict=True):
                slow.lerp_(fast, 0.6)


def ppo(make, envs, curve):
    """Proximal policy optimisation by stable-baselines3, which sees rewards alone."""
    import numpy as np
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv

    class Scenes(VecEnv):
        """An environment with numpy arrays, as stable-baselines3 wants it; both reset in the step that ends."""

        def __init__(self, env):
            self.env = env
            super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

        def reset(self):
            return self.env.reset(seed=0)[0].cpu().numpy()

        def step_async(self, actions):
            self.actions = actions

        def step_wait(self):
            observation, reward, terminated, truncated, info = self.env.step(np.asarray(self.actions))
            seen, reward, final, late = (t.cpu().numpy() for t in (observation, reward, info["final_obs"], truncated))
            done = terminated.cpu().numpy() | late
            infos = [{} for _ in range(self.num_envs)]
            for k in done.nonzero()[0]:
                infos[k] = {"terminal_observation": final[k], "TimeLimit.truncated": bool(late[k])}
            return seen, reward, done, infos

        def close(self): ...

        def get_attr(self, name, indices=None):
            return [getattr(self.env, name, None)] * self.num_envs

        def set_attr(self, name, value, indices=None):
            setattr(self.env, name, value)

        def env_method(self, name, *args, indices=None, **kwargs):
            return [getattr(self.env, name)(*args, **kwargs)] * self.num_envs

        def env_is_wrapped(self, wrapper, indices=None):
            return [False] * self.num_envs

    class Clock(BaseCallback):
        def _on_step(self):
            return not curve.due(self.num_timesteps, self.act)

        def act(self, seen):
            return self.model.predict(seen.cpu().numpy(), deterministic=True)[0]

    scenes = Scenes(make(envs))
    learner = PPO("MlpPolicy", scenes, n_steps=32, batch_size=max(32, 8 * envs), gamma=DISCOUNT, seed=0, device="cpu")
    learner.learn(10**12, callback=Clock())


def train(name, algorithm, seconds, envs, device):
    """Returns over samples and seconds."""
    torch.manual_seed(0)

    def make(number, differentiable=False):
        return ENVIRONMENTS[name](number, differentiable=differentiable, device=device)

    curve = Curve(make(min(envs, 256)), seconds)
    mean_return(
        curve.env, lambda seen: seen.new_zeros(curve.env.action_space.shape)
    )  # captures the step, which is no part of the training
    {"shac": shac, "ppo": ppo}[algorithm](make, envs, curve)
    return curve.rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", choices=ENVIRONMENTS, default="lift")
    parser.add_argument("--algorithm", choices=("shac", "ppo"), default="shac")
    parser.add_argument("--seconds", type=float, default=20.0, help="of training")
    parser.add_argument("--envs", type=int, default=16)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", help="a JSON file of returns over samples and seconds")
    options = parser.parse_args()
    rows = train(options.env, options.algorithm, options.seconds, options.envs, options.device)
    print(f"return {rows[0]['return']:.2f} before and {rows[-1]['return']:.2f} after training")
    if options.out:
        with open(options.out, "w") as file:
            json.dump({**vars(options), "rows": rows}, file, indent=1)

"""Runs that must come out equal bit for bit, in one process and in another (python -m tests.runs SEED STEPS)."""

from __future__ import annotations

import hashlib
import json
import sys
from typing import Any

import gymnasium as gym
import numpy as np

from agents.loop import LoopConfig
from agents.training import train
from ncs_gym import Channel, ChannelContract, GilbertElliott
from tests.product import linear_plant, safety_shield, synthesize, vector_shield

CHANNEL = Channel(
    GilbertElliott(p_good_to_bad=0.2, p_bad_to_good=0.4), quantization_step=0.05, send_period=2, delay=1, jitter=2
)
IDS = ("TruckTrailer-v0", "TruckTrailerCruise-v0", "CartPole-v0")


def digest_of(*values: Any) -> str:
    """SHA-256 of values, down to the kinds and bits of numbers and the order of keys."""

    def spelled(value: Any) -> Any:
        return [str(value.dtype), value.shape, value.tolist()]

    return hashlib.sha256(json.dumps(values, default=spelled).encode()).hexdigest()


def stepped(env: Any, seed: int, steps: int, shape: tuple[int, ...]) -> str:
    """Digest of everything that an environment returns."""
    rng, returned = np.random.default_rng(0), [env.reset(seed=seed)]
    for _ in range(steps):
        returned.append(env.step(rng.uniform(-1.0, 1.0, shape).astype(np.float32)))
        if len(shape) == 1 and any(returned[-1][2:4]):
            returned.append(env.reset())
    return digest_of(*returned)


def stepped_runs(seed: int, steps: int) -> dict[str, str]:
    """Trajectories of single environments and of vectors, bare and behind a shield."""
    runs = {}
    for name in IDS:
        changes: dict[str, Any] = {"channel": CHANNEL} if name != "CartPole-v0" else {}
        one = gym.make(f"ncs_gym/{name}", **changes | ({"disturbance": "sphere"} if changes else {}))
        runs[name] = stepped(one, seed, steps, (1,))
        many = gym.make_vec(f"ncs_gym/{name}", num_envs=8, max_episode_steps=20, **changes)
        runs[f"{name} many"] = stepped(many, seed, steps, (8, 1))
    runs["shield"] = stepped(safety_shield(gym.make(f"ncs_gym/{IDS[1]}")), seed, steps, (1,))
    many = vector_shield(gym.make_vec(f"ncs_gym/{IDS[1]}", num_envs=8))
    return runs | {"shields": stepped(many, seed, steps, (8, 1))}


def synthesized() -> dict[str, str]:
    """Whole certificate files, without a contract and with one."""
    sizes = {"B": [[0.1], [0.2]], "box": np.eye(2), "u_max": 2.0, "dt": 0.1, "gamma": 1e-6}
    stable = linear_plant(A=[[0.9, 0.1], [0.0, 0.8]], **sizes)
    unstable = linear_plant(A=[[1.02, 0.1], [0.0, 0.8]], measurement_noise_cov=1e-6 * np.eye(2), **sizes)
    certificates = {
        "certified": synthesize(stable),
        "contract": synthesize(unstable, contract=ChannelContract(1)),
    }
    return {name: json.dumps(certificate.document) for name, certificate in certificates.items()}


def trained(seed: int, steps: int) -> dict[str, str]:
    """Every weight of an agent."""
    hyperparams = dict(n_envs=4, n_steps=32, batch_size=64, n_epochs=2)
    model = train(LoopConfig(env=f"ncs_gym/{IDS[1]}"), steps, seed, hyperparams=hyperparams).agent.model
    weights = {name: value.detach().numpy() for name, value in model.policy.state_dict().items()}
    return {"PPO": digest_of(weights)}


def seeded(seed: int, steps: int) -> dict[str, str]:
    """All runs that have a seed, by name."""
    return stepped_runs(seed, steps) | trained(seed, 16 * steps)


def everything(seed: int, steps: int) -> dict[str, str]:
    """All runs, by name."""
    return seeded(seed, steps) | synthesized()


if __name__ == "__main__":
    json.dump(everything(int(sys.argv[1]), int(sys.argv[2])), sys.stdout)

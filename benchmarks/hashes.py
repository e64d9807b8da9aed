"""Hashes of what environments, shields and loops do, before and after a rearrangement: `python -m benchmarks.hashes`.

Commands: record, compare.

Hashes are of every bit of observations, rewards, ends and infos. They hold on one machine: record them with the state
before, and compare them with the state after.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode

from benchmarks.commands import run
from ncs_gym import NCSEnv, Packet
from ncs_gym.envs.env import ncs_env
from shields import SafeLoop, SafetyShield, VectorSafetyShield, certificate_for

STEPS, COUNT = 300, 5
MODES = "project", "switch", "boundary", "monitor", "lookahead"
AUTORESETS = tuple(AutoresetMode)
File = tyro.conf.Positional[Path]
Names = tuple[str, ...]


def record(file: File, names: Names = ()) -> None:
    """Writes the hashes of 300 steps of every registered environment, or of those that are named."""
    found = {}
    for name, what, digest in hashes(names):
        found[f"{name} {what}"] = digest
        print(f"{name} {what}: {digest}", flush=True)
    file.write_text(json.dumps(found, indent=1) + "\n")


def compare(file: File, names: Names = ()) -> None:
    """Prints which hashes are others than those of a file; exits with 1 if any is."""
    before, count, others = json.loads(file.read_text()), 0, []
    for name, what, digest in hashes(names):
        count += 1
        if before.get(f"{name} {what}") != digest:
            others.append(f"{name} {what}")
            print(f"{others[-1]}: {digest}, before {before.get(others[-1])}", flush=True)
    print(f"{len(others)} of {count} hashes differ")
    raise SystemExit(bool(others))


def hashes(names: Names = ()) -> Iterator[tuple[str, str, str]]:
    """Yields name, what was run and hash: alone, in each mode, as a vector in each autoreset mode, and as a loop."""
    for name in names or registered():
        yield name, "bare", episodes_hash(gym.make(name))
        vectors: dict[str, Callable[[gym.vector.VectorEnv], gym.vector.VectorEnv]] = {"bare": lambda env: env}
        if has_certificate(name):
            for mode in MODES:
                yield name, mode, episodes_hash(SafetyShield(gym.make(name), mode=mode, on_unproved="ignore"))
            yield name, "loop", loop_hash(ncs_env(gym.make(name)))
            vectors["project"] = partial(VectorSafetyShield, on_unproved="ignore")
        for how, wrapped in vectors.items():
            for autoreset in AUTORESETS:
                env = gym.make_vec(name, COUNT, vectorization_mode="vector_entry_point", autoreset_mode=autoreset)
                yield name, f"vector {how} {autoreset.value}", vector_hash(wrapped(env), autoreset)


def registered() -> list[str]:
    """Returns the registered environments that can be made here."""
    found = []
    for name in sorted(each for each in gym.registry if each.startswith("ncs_gym/")):
        try:
            gym.make(name).close()
        except (ModuleNotFoundError, TypeError, ValueError):  # an extra is missing, or a plant is to be given
            continue
        found.append(name)
    return found


def has_certificate(name: str) -> bool:
    """Returns whether the package has a certificate for an environment, or makes one in a moment."""
    try:
        SafetyShield(gym.make(name), on_unproved="ignore").close()
    except ValueError:
        return False
    return True


def episodes_hash(env: gym.Env) -> str:
    """Returns the hash of steps of random actions; an episode that ends is followed by the next."""
    digest, rng, seed = hashlib.sha256(), np.random.default_rng(0), 0
    _add(digest, env.reset(seed=seed))
    for action in _actions(env.action_space):
        told = env.step(action)
        _add(digest, told)
        if told[2] or told[3]:
            seed += 1
            _add(digest, env.reset(seed=seed, options={} if rng.random() < 0.5 else None))
    env.close()
    return digest.hexdigest()[:16]


def _actions(space: gym.Space) -> Iterator[Any]:
    """Yields random actions, each for three steps in a row, so that limits are met."""
    space.seed(0)
    for _ in range(STEPS // 3):
        yield from [space.sample()] * 3


def vector_hash(env: gym.vector.VectorEnv, autoreset: AutoresetMode) -> str:
    """Returns the hash of steps of random actions of several environments; those that end are reset as they ask."""
    digest = hashlib.sha256()
    _add(digest, env.reset(seed=0))
    for step, action in enumerate(_actions(env.action_space)):
        told = env.step(action)
        _add(digest, told)
        if autoreset == AutoresetMode.DISABLED and (done := told[2] | told[3]).any():
            _add(digest, env.reset(seed=step, options={"reset_mask": done}))
    env.close()
    return digest.hexdigest()[:16]


def loop_hash(env: NCSEnv) -> str:
    """Returns the hash of estimates and decisions of a loop whose samples are lost and late; the plant is simulated."""
    plant, digest, rng = env.plant, hashlib.sha256(), np.random.default_rng(0)
    certificate = certificate_for(plant, env.certificate_contract)
    downlinks = {"downlink": env.downlink, "downlink_contract": env.downlink_contract} if env.downlink else {}
    loop = SafeLoop(certificate, plant, env.channel, on_unproved="ignore", **downlinks)
    loop.start(np.zeros(plant.n))
    state, under_way = np.zeros(plant.n), [np.zeros(plant.m)] * loop.input_delay
    arriving: dict[int, list[Packet]] = {}
    for step in range(STEPS):
        _add(digest, loop.receive(arriving.pop(step, [])))
        decision = loop.decide(plant.input_middle + plant.input_half * rng.uniform(-1.0, 1.0, plant.m))
        _add(digest, (decision.input, decision.intervened, decision.proved, loop.guaranteed, loop.reason))
        under_way.append(np.asarray(decision.input))
        state = plant.A @ state + plant.B @ under_way.pop(0)
        if rng.random() < 0.7:
            late = int(rng.integers(env.channel.longest_delay + 1))
            sample = Packet(step + 1, plant.H @ state, loop.episode)
            arriving.setdefault(step + 1 + late, []).append(sample)
    return digest.hexdigest()[:16]


def _add(digest: Any, told: Any) -> None:
    """Adds every bit of arrays, numbers and texts to a hash, in whatever they are held."""
    if isinstance(told, Mapping):
        for key in sorted(told):
            digest.update(str(key).encode())
            _add(digest, told[key])
    elif isinstance(told, (tuple, list)) or (isinstance(told, np.ndarray) and told.dtype == object):
        for each in told:
            _add(digest, each)
    elif isinstance(told, np.ndarray | np.generic | float | int):
        array = np.ascontiguousarray(told)
        digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    else:
        digest.update(repr(told).encode())


if __name__ == "__main__":
    run(__doc__, (record, compare))

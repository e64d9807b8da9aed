"""For how many steps the box is kept when the network goes silent: `python -m benchmarks.silence COMMAND`.

Commands: back, attack. All are about registered environments with a contract, of which --ids are names.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.commands import run
from benchmarks.random_plants import under_contracts
from ncs_gym import ChannelContract, NCSEnv, NCSVectorEnv, TraceChannel
from ncs_gym.envs.env import ncs_env
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.kalman_filter import ErrorRecursion
from ncs_gym.registration import registered_ids
from shields import Certificate, VectorSafetyShield, certificate_for
from shields.silence import OUTAGES, silence_of, way_back

# What the attack is about.
ATTACKED = ("CartPole", "CartPoleTwoWay", "CartPoleNonlinear", "BatchReactor", "CSTR", "Convoy", "LaneKeeping")
# Steps of an episode before the network goes silent, and afterwards.
HEARD, SILENT = 40, 60


def with_contracts(ids: Sequence[str]) -> Iterator[tuple[str, NCSEnv, ChannelContract]]:
    """Yields environments by name, with the contracts of their certificates; all that have one if no ids are given."""
    for name in ids or [each.removeprefix("ncs_gym/").removesuffix("-v0") for each in registered_ids()]:
        env = ncs_env(gym.make(f"ncs_gym/{name}-v0"))
        if env.certificate_contract is not None:
            yield name, env, env.certificate_contract


def rare_then_silent(name: str) -> TraceChannel:
    """Returns a channel over which samples come as rarely as the contract allows, and then no more."""
    env = ncs_env(gym.make(name))
    assert env.certificate_contract is not None
    period = env.certificate_contract.max_age - env.channel.delay + 1
    heard = [env.channel.delay if k % period == 0 else -1 for k in range(HEARD)]
    return TraceChannel(trace=(*heard, *[-1] * SILENT), quantization_step=env.channel.quantization_step)


def back(ids: Sequence[str] = ()) -> None:
    """What `shields.silence_of` says in advance, of all registered environments with a contract if no --ids are given.

    Until which age of the newest sample the box is kept, from any belief that the contract allows, and with the
    fallback input from half of the set and from rest; and after how many steps the error's ellipsoid lies in its
    certified set again, so that the guarantee can return, after outages of 2, 10 and 100 contracts; samples come again
    at every step, or as rarely as the contract allows. The last row is the worst of 30 random plants of 2 to 5 states,
    half of them unstable.
    """
    print(f"{'':20} {'kept until an age of':>29}" + "".join(f" {f'{many} contracts':>13}" for many in OUTAGES))
    columns = ("contract", "any", "half", "rest", *("each", "rarely") * 3)
    row = "{:20} {:>8} {:>6} {:>6} {:>6}" + 3 * " {:>6} {:>6}"
    print(row.format("[steps]", *columns))
    for name, env, contract in with_contracts(ids):
        input_delay = env.downlink_protocol.input_delay
        found = silence_of(certificate_for(env.plant, contract), env.plant, input_delay)
        assert found is not None
        kept = [found.max_age + steps for steps in (0, found.anywhere, found.at_half, found.at_rest)]
        print(row.format(name, *kept, *(steps for way in found.ways_back for steps in way[1:])), flush=True)
    steps = []
    for plant, contract in under_contracts(30):
        recursion = ErrorRecursion(plant, contract.quantization_step, certified_error_set(plant, contract))
        age = contract.max_age
        ways = [way_back(recursion, many * age, period) for many in OUTAGES for period in (1, age + 1)]
        steps.append([np.inf if each is None else each for each in ways])
    print(row.format("30 random plants", "1 to 4", "", "", "", *(f"{each:.0f}" for each in np.max(steps, axis=0))))


def attack(ids: Sequence[str] = ATTACKED, envs: int = 64, steps: int = 150) -> None:
    """How often the box is left sooner than `silence_of` says from any belief that the contract allows.

    Samples come as rarely as the contract allows for a while and then no more for a while, again and again, an agent
    pushes one way and then another, and disturbances are adversarial; in every mode that protects, with the
    certificate's own set and with its ellipsoid alone. "silent" are the steps that were promised though the contract
    was broken, "left" those of them and of the others in which the state was outside the box.
    """
    modes = ("project", "switch", "boundary", "lookahead")
    print(f"{'':20} {'set':10} {'steps':>9} {'silent':>9} {'left':>6}")
    for name, env, contract in with_contracts(ids):
        own = certificate_for(env.plant, contract)
        for certificate in (own, certificate_for(env.plant, contract, "ellipsoid")):
            found = [left_in_silence(f"ncs_gym/{name}-v0", certificate, mode, envs, steps) for mode in modes]
            silent, left = np.sum(found, axis=0)
            kind = type(certificate.safe_set).__name__.lower()
            print(f"{name:20} {kind:10} {len(modes) * envs * steps:9,} {silent:9,} {left:6}", flush=True)


def left_in_silence(name: str, certificate: Certificate, mode: str, count: int, steps: int) -> tuple[int, int]:
    """Returns at how many steps a promise counted though the contract was broken, and at how many one was broken."""
    settings: dict[str, Any] = {"disturbance": "adversarial", "terminate_on_violation": False}
    env = gym.make_vec(name, count, channel=rare_then_silent(name), **settings)
    shield = VectorSafetyShield(env, certificate, mode=mode, on_unproved="ignore")
    inner = shield.unwrapped
    assert isinstance(inner, NCSVectorEnv)
    found, rng = silence_of(certificate, inner.plant), np.random.default_rng(2)
    assert found is not None
    held, ended, silent, left = np.zeros(count, np.bool_), np.zeros(count, np.bool_), 0, 0
    _, info = shield.reset(seed=2)
    for k in range(steps):
        if k % 25 == 0:
            pushed = rng.choice([-1.0, 1.0], shield.action_space.shape).astype(np.float32)
        held = np.where(info["contract_broken"], held, info["shield_guaranteed"])
        promised = held & (info["measurement_age"] < found.max_age + found.anywhere)
        *_, terminated, truncated, info = shield.step(pushed)
        silent += np.count_nonzero(promised & info["contract_broken"])
        left += np.count_nonzero(promised & (info["cost"] > 0.0) & ~ended)
        ended = terminated | truncated
    return int(silent), int(left)


COMMANDS = (back, attack)

if __name__ == "__main__":
    run(__doc__, COMMANDS)

"""For how many steps the box is kept when the network goes silent, and what it costs to ask for them.

    python -m benchmarks.silence [--envs 64] [--steps 150] [--ids CartPole ...] [--back | --ways | --attack]

Registered environments with a contract under adversarial disturbances. With random actions, "safe"
is the largest number of steps of a ladder that mode "lookahead", asked for it, promises at 95 % of the steps over the
environment's own network; "overridden" the share of steps overridden when it is asked for, and when none are.
"left at" is how old the newest sample had become when a state left the box first, the smallest of all episodes: samples
come as rarely as the contract allows for a while and then no more for sixty steps, and the agent pushes all the time,
behind mode "project", and behind "lookahead" that is asked for the steps. "never" stands for no state.

With --back what `shields.silence_of` says in advance: until which age of the newest sample the box is kept, from any
belief that the contract allows, and with the fallback input from half of the set and from rest; and after how many
steps the error's ellipsoid lies in its certified set again, so that the guarantee can return, after outages of 2, 10
and 100 contracts; samples come again at every step, or as rarely as the contract allows. The last row is the worst of
30 random plants of 2 to 5 states, half of them unstable.

With --ways the same after 10 contracts for three ways: an update that is chosen for the way back, which estimators use;
an estimate from the newest samples alone, as at an unknown start; and a ladder of multiples of the certified set, each
carried into the next by one sample.

With --attack: how many promises are broken where samples come as rarely as the contract allows for a while and then no
more for a while, again and again, an agent pushes one way and then another, and disturbances are adversarial: states
outside the box within the steps that were promised, and promises that fall by more than one per step. In mode
"lookahead" the promise is what is asked for, in the others what `silence_of` says from any belief that the contract
allows; each with the certificate's own set and with its ellipsoid alone.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from ncs_gym import (
    BrokenContractWarning,
    ChannelContract,
    ClippedObservationWarning,
    LinearPlant,
    NCSEnv,
    TraceChannel,
    certified_error_set,
)
from ncs_gym.estimation.error_bound import ErrorSet
from ncs_gym.estimation.first_estimate import first_estimate
from ncs_gym.estimation.kalman_filter import ErrorRecursion
from ncs_gym.registration import registered_ids
from shields import Certificate, VectorSafetyShield, certificate_for
from shields.silence import OUTAGES, silence_of, way_back
from tests.plants import random_plant

IDS = ("CartPole", "CartPoleNonlinear", "BatchReactor", "CSTR", "Convoy", "LaneKeeping", "Pendulum")
# Steps that the attack asks for, behind a downlink, too.
ATTACKED = {"CartPole": 35, "CartPoleTwoWay": 20, "CartPoleNonlinear": 20, "BatchReactor": 15, "CSTR": 5}
ATTACKED |= {"Convoy": 10, "LaneKeeping": 10}
ATTACKED_MODES = ("lookahead", "project", "switch", "boundary")
# More samples, and longer ways by a ladder, are not looked for.
MOST_SAMPLES, LONGEST_LADDER = 30, 10_000
LADDER = (5, 10, 15, 20, 25, 30, 35, 40, 45)
# Share of steps at which all steps asked for are promised.
MOST_STEPS = 0.95
# Steps of an episode before the network goes silent, and afterwards.
HEARD, SILENT = 40, 60


def shielded(name: str, count: int, least: int | None, **settings: Any) -> VectorSafetyShield:
    """Returns environments behind mode "lookahead" that is asked for so many steps; for None behind "project"."""
    env = gym.make_vec(name, count, disturbance="adversarial", terminate_on_violation=False, **settings)
    given = {"mode": "project"} if least is None else {"mode": "lookahead", "least_safe_steps": least}
    return VectorSafetyShield(env, **given, on_unproved="ignore")


def over_its_network(name: str, count: int, steps: int, least: int) -> tuple[float, float]:
    """Returns the shares of steps at which all steps asked for are promised, and at which the shield overrides."""
    env, rng = shielded(name, count, least), np.random.default_rng(0)
    env.reset(seed=0)
    promised, overridden = 0, 0
    for _ in range(steps):
        *_, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
        promised += np.count_nonzero(info["shield_safe_steps"] == least)
        overridden += np.count_nonzero(info["shield_intervened"])
    return promised / (count * steps), overridden / (count * steps)


def rare_then_silent(name: str) -> TraceChannel:
    """Returns a channel over which samples come as rarely as the contract allows, and then no more."""
    env = gym.make(name).unwrapped
    assert isinstance(env, NCSEnv)
    contract = env.certificate_contract
    assert contract is not None
    period = contract.max_age - env.channel.delay + 1
    heard = [env.channel.delay if k % period == 0 else -1 for k in range(HEARD)]
    return TraceChannel(trace=(*heard, *[-1] * SILENT), quantization_step=env.channel.quantization_step)


def left_at(name: str, count: int, least: int | None) -> int | None:
    """Returns how old the newest sample had become when a state left the box, the least of all; None if none did."""
    channel = rare_then_silent(name)
    env, rng = shielded(name, count, least, channel=channel), np.random.default_rng(1)
    pushed = rng.choice([-1.0, 1.0], env.action_space.shape).astype(np.float32)
    env.reset(seed=1)
    ages, out, oldest = [], np.zeros(count, np.bool_), np.zeros(count, np.int64)
    for _ in range(HEARD + SILENT):
        *_, info = env.step(pushed)
        now = (info["cost"] > 0.0) & ~out
        oldest = np.maximum(oldest, info["measurement_age"])
        ages += oldest[now].tolist()
        out |= now
    return min(ages, default=None)


def random_plants(count: int) -> Iterator[tuple[LinearPlant, ChannelContract]]:
    """Yields random plants, every second one unstable, with contracts."""
    for seed in range(count):
        plant = random_plant(seed, *((2, 1, 1), (3, 2, 1), (4, 2, 2), (4, 1, 3), (5, 2, 2))[seed % 5])
        if seed % 2:
            plant = replace(plant, A=plant.A * (1.0 + 0.02 * (seed % 7)) / plant.spectral_radius)
        yield plant, ChannelContract(1 + seed % 4)


def in_advance(ids: Sequence[str] | None) -> None:
    """Prints the table of --back, of all ids with a contract if none are given."""
    names = [f"ncs_gym/{name}-v0" for name in ids] if ids else registered_ids()
    print(f"{'':20} {'kept until an age of':>29}" + "".join(f" {f'{many} contracts':>13}" for many in OUTAGES))
    print(f"{'[steps]':20} {'contract':>8} {'any':>6} {'half':>6} {'rest':>6}" + 3 * f" {'each':>6} {'rarely':>6}")
    for name in names:
        env = gym.make(name).unwrapped
        assert isinstance(env, NCSEnv)
        if env.certificate_contract is None:
            continue
        found = silence_of(certificate_for(env.plant, env.certificate_contract), env.plant)
        assert found is not None
        kept = [found.max_age + steps for steps in (0, found.anywhere, found.at_half, found.at_rest)]
        back = [steps for way in found.ways_back for steps in way[1:]]
        print(f"{name[8:-3]:20} {kept[0]:8}" + "".join(f" {each:6}" for each in [*kept[1:], *back]), flush=True)
    steps = []
    for plant, contract in random_plants(30):
        recursion = ErrorRecursion(plant, contract.quantization_step, certified_error_set(plant, contract))
        age = contract.max_age
        ways = [way_back(recursion, many * age, period) for many in OUTAGES for period in (1, age)]
        steps.append([np.inf if each is None else each for each in ways])
    print(
        f"{'30 random plants':20} {'1 to 4':>8}" + " " * 21 + "".join(f" {each:6.0f}" for each in np.max(steps, axis=0))
    )


def by_newest_samples(plant: LinearPlant, contract: ChannelContract, errors: ErrorSet, gap: int) -> float:
    """Returns how many steps samples must come until they alone prove the error certified; infinite if never."""
    noise = plant.sensor_error_with(contract.quantization_step).shape_matrix
    for count in range(1, MOST_SAMPLES + 1):
        span = (count - 1) * gap
        samples = {age: np.zeros(plant.p) for age in range(0, span + 1, gap)}
        if first_estimate(plant, errors, samples, [np.zeros(plant.m)] * span, noise) is not None:
            return span
    return np.inf


def by_ladder(recursion: ErrorRecursion, outage: int, gap: int) -> float:
    """Returns how many steps a ladder takes: after every sample a multiple of the certified shape is put in its place.

    What happens between two rungs is then known offline. (C2) ends it.
    """
    certified = recursion.error_set.shape_at(0)
    inward = np.linalg.inv(np.linalg.cholesky(certified))
    known = recursion.first
    for steps in range(1 - outage, LONGEST_LADDER):
        known = recursion.predicted(known)
        if steps < 0 or steps % gap:
            continue
        updated = recursion.updated(known)
        assert updated is not None
        rung = max(float(np.linalg.eigvalsh(inward @ updated[1].shape @ inward.T)[-1]), 1.0)
        known = updated[1]._replace(shape=rung * certified)
        if rung == 1.0:
            return steps
    return np.inf


def ways(ids: Sequence[str] | None) -> None:
    """Prints the table of --ways, of all ids with a contract if none are given."""
    print(f"{'':20} {'update for it':>15} {'samples alone':>15} {'ladder':>15}")
    print(f"{'[steps]':20}" + 3 * f" {'each':>7} {'rarely':>7}")

    def steps_of(plant: LinearPlant, contract: ChannelContract) -> list[float]:
        errors, age = certified_error_set(plant, contract), contract.max_age
        recursion = ErrorRecursion(plant, contract.quantization_step, errors)
        chosen = [way_back(recursion, 10 * age, gap) for gap in (1, age)]
        alone = [by_newest_samples(plant, contract, errors, gap) for gap in (1, age)]
        ladder = [by_ladder(recursion, 10 * age, gap) for gap in (1, age)]
        return [np.inf if each is None else each for each in chosen] + alone + ladder

    def show(name: str, columns: Sequence[float]) -> None:
        texts = ["never" if np.isinf(each) else f"{each:.0f}" for each in columns]
        print(f"{name:20}" + "".join(f" {text:>7}" for text in texts), flush=True)

    for name in ids or [each[8:-3] for each in registered_ids()]:
        env = gym.make(f"ncs_gym/{name}-v0").unwrapped
        assert isinstance(env, NCSEnv)
        if env.certificate_contract is not None:
            show(name, steps_of(env.plant, env.certificate_contract))
    steps = np.array([steps_of(*each) for each in random_plants(30)])
    show("30 random, at most", np.where(np.isfinite(steps), steps, -np.inf).max(axis=0).tolist())
    show("  of these never", np.isinf(steps).sum(axis=0).tolist())


def broken_promises(
    name: str, certificate: Certificate, mode: str, least: int, count: int, steps: int
) -> tuple[int, int]:
    """Returns how many promises were broken, and at how many steps one counted though the contract was broken."""
    settings: dict[str, Any] = {"disturbance": "adversarial", "terminate_on_violation": False}
    env = gym.make_vec(name, count, channel=rare_then_silent(name), **settings)
    least = least if mode == "lookahead" else 0
    shield = VectorSafetyShield(env, certificate, mode=mode, on_unproved="ignore", least_safe_steps=least)
    silence, rng = silence_of(certificate, shield.unwrapped.plant), np.random.default_rng(2)
    assert silence is not None
    held = np.zeros(count, np.bool_)

    def promise(info: dict[str, Any]) -> np.ndarray:
        """For how many steps the box is promised; in most modes while what was guaranteed under the contract was."""
        if mode == "lookahead":
            return np.asarray(info["shield_safe_steps"])
        held[:] = np.where(info["contract_broken"], held, info["shield_guaranteed"])
        return held * np.maximum(silence.max_age + silence.anywhere - info["measurement_age"], 0)

    _, info = shield.reset(seed=2)
    promised, broken, kept, ended = promise(info), 0, 0, np.zeros(count, np.bool_)
    for k in range(steps):
        if k % 25 == 0:
            pushed = rng.choice([-1.0, 1.0], shield.action_space.shape).astype(np.float32)
        *_, terminated, truncated, info = shield.step(pushed)
        now = promise(info)
        broken += np.count_nonzero(((promised > 0) & (info["cost"] > 0.0) | (now < promised - 1)) & ~ended)
        kept += np.count_nonzero((promised > 0) & info["contract_broken"])
        promised, ended = now, terminated | truncated
    return broken, kept


def attack(ids: Sequence[str], count: int, steps: int) -> None:
    """Prints the table of --attack."""
    print(f"{'':20} {'':10} {'':>9} {'silent and promised':>21} {'broken promises':>17}")
    print(f"{'':20} {'set':10} {'steps':>9} {'lookahead':>10} {'others':>10} {'lookahead':>10} {'others':>6}")
    for name in ids:
        env = gym.make(f"ncs_gym/{name}-v0").unwrapped
        assert isinstance(env, NCSEnv)
        own = certificate_for(env.plant, env.certificate_contract)
        for certificate in [own] if own.polytope is None else [own, own.without_polytope()]:
            given = env.spec.id, certificate
            found = [broken_promises(*given, mode, ATTACKED[name], count, steps) for mode in ATTACKED_MODES]
            (broken, kept), *others = found
            others_broken, others_kept = np.sum(others, axis=0)
            kind = "ellipsoid" if certificate.polytope is None else "polytope"
            print(
                f"{name:20} {kind:10} {len(found) * count * steps:9,} {kept:10,} {others_kept:10,} {broken:10} "
                f"{others_broken:6}",
                flush=True,
            )


def row(name: str, count: int, steps: int) -> str:
    """Returns the row of an environment."""
    env = gym.make(name).unwrapped
    assert isinstance(env, NCSEnv)
    assert env.certificate_contract is not None
    free, most = over_its_network(name, count, steps, 0)[1], (0, float("nan"))
    for least in LADDER:
        promised, overridden = over_its_network(name, count, steps, least)
        if promised < MOST_STEPS:
            break
        most = least, overridden
    ages = [left_at(name, count, each) for each in (None, most[0])]
    texts = ["never" if age is None else str(age) for age in ages]
    seconds = f"{most[0] * env.plant.dt:.2g}" if env.plant.dt else "-"
    return (
        f"{name.removeprefix('ncs_gym/'):20} {env.certificate_contract.max_age:8} {most[0]:5} {seconds:>8} "
        f"{100 * free:6.1f} {100 * most[1]:6.1f} {texts[0]:>8} {texts[1]:>10}"
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--ids", nargs="+")
    parser.add_argument("--back", action="store_true")
    parser.add_argument("--ways", action="store_true")
    parser.add_argument("--attack", action="store_true")
    options = parser.parse_args()
    if options.back:
        return in_advance(options.ids)
    if options.ways:
        return ways(options.ids)
    for category in (BrokenContractWarning, ClippedObservationWarning):
        warnings.simplefilter("ignore", category)
    if options.attack:
        return attack(options.ids or tuple(ATTACKED), options.envs, options.steps)
    print(f"{'':20} {'contract':>8} {'safe':>5} {'':>8} {'overridden [%]':>13} {'left at an age of':>18}")
    print(f"{'':20} {'[steps]':>8} {'':>5} {'[s]':>8} {'none':>6} {'asked':>6} {'project':>8} {'lookahead':>10}")
    for name in options.ids or IDS:
        print(row(f"ncs_gym/{name}-v0", options.envs, options.steps), flush=True)


if __name__ == "__main__":
    main()

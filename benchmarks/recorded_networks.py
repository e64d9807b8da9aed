"""Loops over networks as records have them: how often the box is left behind each filter, and what is claimed then.

    python -m benchmarks.recorded_networks [--hours 1] [--envs 64] [--ids CartPole ...] [--filters ...]

The records are made here, with a seed, in the shapes of real ones: "Wi-Fi" stalls in clusters, for lengths with a heavy
tail; in a "car" a handover stops everything every half minute, now and then for seconds; an interferer's "burst" takes
nine of ten packets for .3 s every ten seconds. All are replayed by their clock, and all break the contracts.

The agent pushes in one direction for half a second to two, then in another; disturbances are adversarial. An episode
ends where the box is left, or after a minute. "left" counts these ends per hour of plant time. "ever" and "promised"
are the shares of steps at which the guarantee holds, and at which the box is kept for at least one step whatever the
network does. A dash stands for a filter that claims nothing.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from experiments.baselines import EstimateFilterSettings
from ncs_gym import BrokenContractWarning, NCSEnv, NCSVectorEnv, PacketLog
from shields import VectorSafetyShield, certificate_for

# Environments, with the steps that are asked for (`python -m benchmarks.silence`).
IDS = {"CartPole": 35, "BatchReactor": 15, "Convoy": 10, "LaneKeeping": 10}
SPAN, PERIOD, EPISODE = 3600.0, 0.02, 60.0


def wifi(rng: np.random.Generator, sent: np.ndarray) -> np.ndarray:
    """Returns delays of packets sent at these times [s], NaN for lost ones, over a Wi-Fi."""
    delays = rng.gamma(4.0, 0.002, len(sent))
    lost = rng.random(len(sent)) < 0.02
    for cluster in rng.uniform(0.0, SPAN, 12):
        for begin in cluster + np.cumsum(rng.exponential(8.0, rng.integers(1, 12))):
            end = begin + 0.06 * (1.0 + rng.pareto(1.2))
            stalled = (sent >= begin) & (sent < end)
            lost |= stalled & (rng.random(len(sent)) < 0.5)
            delays = np.where(stalled, np.maximum(delays, end - sent), delays)
    return np.where(lost, np.nan, delays)


def car(rng: np.random.Generator, sent: np.ndarray) -> np.ndarray:
    """Returns such delays over a mobile network from a car."""
    delays, lost = rng.gamma(6.0, 0.0025, len(sent)), rng.random(len(sent)) < 0.005
    for begin in np.cumsum(rng.exponential(30.0, round(1.5 * SPAN / 30.0))):
        seconds = rng.uniform(1.0, 5.0) if rng.random() < 0.05 else rng.uniform(0.05, 0.3)
        lost |= (sent >= begin) & (sent < begin + seconds)
    return np.where(lost, np.nan, delays)


def bursts(rng: np.random.Generator, sent: np.ndarray) -> np.ndarray:
    """Returns such delays beside an interferer with a period of ten seconds."""
    lost = rng.random(len(sent)) < np.where(sent % 10.0 < 0.3, 0.9, 0.005)
    return np.where(lost, np.nan, rng.gamma(4.0, 0.001, len(sent)))


NETWORKS: dict[str, Callable[[np.random.Generator, np.ndarray], np.ndarray]] = {
    "Wi-Fi": wifi,
    "car": car,
    "burst": bursts,
}
FILTERS = ("none", "trusting", "trusting:20", "psf:20", "psf:tube", "project", "lookahead", "lookahead, asked")
# Which of them claim what.
CLAIMS = {"ever": ("project", "lookahead", "lookahead, asked"), "promised": ("lookahead, asked",)}


def behind(env: VectorEnv, name: str, least: int) -> VectorEnv:
    """Returns environments behind a filter."""
    if name == "none":
        return env
    if name in ("project", "lookahead"):
        return VectorSafetyShield(env, mode=name, on_unproved="ignore")
    if name == "lookahead, asked":
        return VectorSafetyShield(env, mode="lookahead", least_safe_steps=least, on_unproved="ignore")
    inner = env.unwrapped
    assert isinstance(inner, NCSVectorEnv)
    return EstimateFilterSettings(name, certificate_for(inner.plant, inner.certificate_contract))(env)


def measured(env_id: str, network: str, name: str, least: int, count: int, hours: float) -> tuple[float, float, float]:
    """Returns how often the box is left per hour, and at which shares of steps the two claims are made."""
    plant = gym.make(env_id).unwrapped
    assert isinstance(plant, NCSEnv)
    dt, rng = plant.plant.dt, np.random.default_rng(0)
    sent = PERIOD * np.arange(round(SPAN / PERIOD))
    channel = PacketLog(sent, NETWORKS[network](rng, sent)).channel(dt)
    settings = {"disturbance": "adversarial", "terminate_on_violation": True, "channel": channel}
    settings |= {"contract": plant.contract, "max_episode_steps": round(EPISODE / dt)}
    env = behind(gym.make_vec(env_id, count, **settings), name, least)
    env.reset(seed=0)
    shape = env.action_space.shape
    assert shape is not None
    pushed, left = np.zeros(shape, np.float32), np.zeros(count, np.int64)
    kept = np.zeros(count, np.int64)
    ended, ever, promised, steps = 0, 0, 0, round(hours * 3600.0 / (dt * count))
    for _ in range(steps):
        turned = left == 0
        left = np.where(turned, rng.integers(round(0.5 / dt), round(2.0 / dt) + 1, count), left - 1)
        pushed[turned] = rng.choice([-1.0, 1.0], pushed.shape)[turned]
        _, _, terminated, _, info = env.step(pushed)
        if np.any(terminated & (kept > 0)):
            raise AssertionError("the box was left within the steps that were promised")
        kept = np.where(terminated, 0, info.get("shield_safe_steps", kept))
        ended += np.count_nonzero(terminated)
        ever += np.count_nonzero(info.get("shield_guaranteed", False))
        promised += np.count_nonzero(info.get("shield_safe_steps", False))
    number = steps * count
    return ended / (number * dt / 3600.0), ever / number, promised / number


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--ids", nargs="+", default=[*IDS], choices=[*IDS])
    parser.add_argument(
        "--filters", nargs="+", default=FILTERS, choices=FILTERS, metavar="NAME", help=", ".join(FILTERS)
    )
    options = parser.parse_args()
    warnings.simplefilter("ignore", BrokenContractWarning)
    shares_of = "  " + "".join(f"{each:>6}" for each in NETWORKS)
    for name in options.ids:
        print(f"{name:16}{'left per hour':>24}  {'ever [%]':>18}  {'promised [%]':>18}")
        print(f"{'':16}" + "".join(f"{each:>8}" for each in NETWORKS) + 2 * shares_of)
        for each in options.filters:
            given = IDS[name], options.envs, options.hours
            found = [measured(f"ncs_gym/{name}-v0", network, each, *given) for network in NETWORKS]
            left, ever, promised = zip(*found, strict=True)
            texts = ["".join(f"{number:8.1f}" for number in left)]
            for claim, shares in (("ever", ever), ("promised", promised)):
                texts += ["  "] + [
                    f"{100.0 * share:6.1f}" if each in CLAIMS[claim] else f"{'-':>6}" for share in shares
                ]
            print(f"{each:16}" + "".join(texts), flush=True)
        print()


if __name__ == "__main__":
    main()

"""Loops over networks as records have them: how often the box is left behind each filter, and what is claimed then.

    python -m benchmarks.recorded_networks [--hours 1] [--envs 64] [--ids CartPole ...] [--filters ...] [--out PNG]

The records are made here, with a seed, in the shapes of real ones: "Wi-Fi" stalls in clusters, for lengths with a heavy
tail; in a "car" a handover stops everything every half minute, now and then for seconds; an interferer's "burst" takes
nine of ten packets for .3 s every ten seconds. All are replayed by their clock, and all break the contracts.

The agent pushes in one direction for half a second to two, then in another; "mpc" and "mpc:20" are model predictive
control of the task instead, without a margin and with one of a fifth. Disturbances are adversarial. An episode
ends where the box is left, or after a minute. "left" counts these ends per hour of plant time. "ever" and "promised"
are the shares of steps at which the guarantee holds, and at which the box is kept for at least one step whatever the
network does. A dash stands for a filter that claims nothing.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib
import numpy as np
from gymnasium.vector import VectorEnv
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from experiments.baselines import EstimateFilterSettings
from experiments.baselines.controllers import REGULATORS, controller
from experiments.baselines.tuned import tuned_weights
from experiments.plots.figure_style import STYLE, CaptionedFigure, legend_below
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
FILTERS = (
    "none", "mpc", "mpc:20", "trusting", "trusting:20", "psf:20", "psf:tube", "project", "lookahead",
    "lookahead, asked",
)  # fmt: skip
# Which of them claim what.
CLAIMS = {"ever": ("project", "lookahead", "lookahead, asked"), "promised": ("lookahead, asked",)}


# Colors and markers of the networks in the figure, apart for color-blind readers (Okabe and Ito).
MARKS = {"Wi-Fi": ("#0072b2", "o"), "car": ("#d55e00", "s"), "burst": ("#009e73", "^")}


class Measured(NamedTuple):
    """How often the box is left per hour, and at which shares of the steps the two claims are made."""

    left: float
    ever: float
    promised: float


def behind(env: VectorEnv, name: str, least: int) -> VectorEnv:
    """Returns environments behind a filter."""
    if name == "none" or name in REGULATORS:
        return env
    if name in ("project", "lookahead"):
        return VectorSafetyShield(env, mode=name, on_unproved="ignore")
    if name == "lookahead, asked":
        return VectorSafetyShield(env, mode="lookahead", least_safe_steps=least, on_unproved="ignore")
    inner = env.unwrapped
    assert isinstance(inner, NCSVectorEnv)
    return EstimateFilterSettings(name, certificate_for(inner.plant, inner.certificate_contract))(env)


def pushes(rng: np.random.Generator, dt: float, shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Yields actions, shape (N, m), that push in one direction for half a second to two, then in another."""
    pushed, left = np.zeros(shape, np.float32), np.zeros(shape[0], np.int64)
    while True:
        turned = left == 0
        left = np.where(turned, rng.integers(round(0.5 / dt), round(2.0 / dt) + 1, shape[0]), left - 1)
        pushed[turned] = rng.choice([-1.0, 1.0], pushed.shape)[turned]
        yield pushed


def measured(env_id: str, network: str, name: str, least: int, count: int, hours: float) -> Measured:
    """Returns what a filter, or a controller, does over a network, asked for so many least safe steps."""
    plant = gym.make(env_id).unwrapped
    assert isinstance(plant, NCSEnv)
    dt, rng = plant.plant.dt, np.random.default_rng(0)
    sent = PERIOD * np.arange(round(SPAN / PERIOD))
    channel = PacketLog(sent, NETWORKS[network](rng, sent)).channel(dt)
    settings = {"disturbance": "adversarial", "terminate_on_violation": True, "channel": channel}
    settings |= {"contract": plant.contract, "max_episode_steps": round(EPISODE / dt)}
    env = behind(gym.make_vec(env_id, count, **settings), name, least)
    observation, info = env.reset(seed=0)
    shape = env.action_space.shape
    assert shape is not None
    agent, kept = pushes(rng, dt, shape), np.zeros(count, np.int64)
    controls = None
    if name in REGULATORS:
        gain = certificate_for(plant.plant, plant.certificate_contract).K
        controls = controller(name, plant, gain, 0, tuned_weights(env_id, name.partition(":")[0]))
    ended, ever, promised, steps = 0, 0, 0, round(hours * 3600.0 / (dt * count))
    for _ in range(steps):
        action = next(agent) if controls is None else controls(observation, info)
        observation, _, terminated, _, info = env.step(action)
        if np.any(terminated & (kept > 0)):
            raise AssertionError("the box was left within the steps that were promised")
        kept = np.where(terminated, 0, info.get("shield_safe_steps", kept))
        ended += np.count_nonzero(terminated)
        ever += np.count_nonzero(info.get("shield_guaranteed", False))
        promised += np.count_nonzero(info.get("shield_safe_steps", False))
    number = steps * count
    return Measured(ended / (number * dt / 3600.0), ever / number, promised / number)


def figure(found: dict[str, dict[str, dict[str, Measured]]]) -> CaptionedFigure:
    """Returns the figure of what was measured, by environment, filter and network."""
    with matplotlib.rc_context(STYLE):
        return _figure(found)


def _figure(found: dict[str, dict[str, dict[str, Measured]]]) -> CaptionedFigure:
    drawn = CaptionedFigure((8.0, 0.8 + 0.24 * sum(map(len, found.values())) + 0.5 * len(found)))
    heights = [len(filters) for filters in found.values()]
    axes = drawn.subplots(len(found), 2, squeeze=False, width_ratios=(3, 2), height_ratios=heights)
    handles: dict[str, Artist] = {}
    for (left, claimed), (env, filters) in zip(axes, found.items(), strict=True):
        for axis in (left, claimed):
            axis.set_yticks(range(len(filters)), filters if axis is left else [""] * len(filters))
            axis.set_ylim(len(filters) - 0.4, -0.6)
        left.set_xscale("symlog", linthresh=5.0)
        left.set_xlim(-0.6, 60000.0)
        left.set_xticks([0, 10, 100, 1000, 10000], ["0", "10", "100", "1,000", "10,000"])
        left.xaxis.set_minor_locator(NullLocator())
        left.set_title(env, loc="left")
        claimed.set_xlim(96.9, 100.15)
        for row, (name, networks) in enumerate(filters.items()):
            for offset, (network, each) in zip((-0.22, 0.0, 0.22), networks.items(), strict=True):
                color, marker = MARKS[network]
                given = {"color": color, "marker": marker, "linestyle": "", "markersize": 4.5, "clip_on": False}
                handles[network] = left.plot(each.left, row + offset, **given)[0]
                for claim, share in (("ever", each.ever), ("promised", each.promised)):
                    if name in CLAIMS[claim]:
                        fill = "full" if claim == "ever" else "none"
                        claimed.plot(100.0 * share, row + offset, fillstyle=fill, **given)
    axes[-1][0].set_xlabel("ends of episodes per hour")
    axes[-1][1].set_xlabel("steps with a claim [%]")
    gray: dict[str, Any] = {"color": "#555555", "marker": "o", "linestyle": "", "markersize": 4.5}
    handles["guaranteed"] = Line2D([], [], **gray)
    handles["the box is kept for a step at least"] = Line2D([], [], fillstyle="none", **gray)
    legend_below(drawn, handles)
    return drawn


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--ids", nargs="+", default=[*IDS], choices=[*IDS])
    parser.add_argument(
        "--filters", nargs="+", default=FILTERS, choices=FILTERS, metavar="NAME", help=", ".join(FILTERS)
    )
    parser.add_argument("--out", type=Path, help="file for the figure")
    options = parser.parse_args()
    warnings.simplefilter("ignore", BrokenContractWarning)
    shares_of = "  " + "".join(f"{each:>6}" for each in NETWORKS)
    found: dict[str, dict[str, dict[str, Measured]]] = {}
    for name in options.ids:
        print(f"{name:16}{'left per hour':>24}  {'ever [%]':>18}  {'promised [%]':>18}")
        print(f"{'':16}" + "".join(f"{each:>8}" for each in NETWORKS) + 2 * shares_of)
        of_env = found[name] = {}
        for each in options.filters:
            given = IDS[name], options.envs, options.hours
            over = of_env[each] = {
                network: measured(f"ncs_gym/{name}-v0", network, each, *given) for network in NETWORKS
            }
            text = "".join(f"{one.left:8.1f}" for one in over.values())
            for claim, names in CLAIMS.items():
                shares = [
                    f"{100.0 * getattr(one, claim):6.1f}" if each in names else f"{'-':>6}" for one in over.values()
                ]
                text += "  " + "".join(shares)
            print(f"{each:16}{text}", flush=True)
        print()
    if options.out is not None:
        options.out.write_bytes(figure(found).png)


if __name__ == "__main__":
    main()

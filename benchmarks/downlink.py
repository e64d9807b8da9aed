"""What an imperfect downlink costs: safe set, overrides and return against the number c of steps inputs are committed.

    python benchmarks/downlink.py [--leads 0 1 2 4 8] [--episodes 200]
    python benchmarks/downlink.py --picture docs/images/downlink.png

A downlink of c steps delays every command by c. The controller is the linear-quadratic regulator of `ncs compare --arms
lqr+shielded`, for c = 0 as for every other c. The set is the certified one in the safe box; return and overrides are
those of episodes with the same seed. The picture shows what one lost command does, which is simulated.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np

from experiments.baselines import controller
from experiments.plots.figure_style import STYLE, CaptionedFigure
from ncs_gym import Actuator, Channel
from ncs_gym.network import CommittedInputs
from shields import VectorSafetyShield, certificate_for

ENVS = ("ncs_gym/TruckTrailerCruise-v0", "ncs_gym/CartPole-v0", "ncs_gym/BatchReactor-v0")
# The picture: commands of steps 0 .. 7, one step late, of which one is lost; c = 2.
STEPS, LEAD, DELAY, LOST = 8, 2, 1, 3


def row(env_id: str, input_delay: int, episodes: int) -> str:
    """A line of the table."""
    settings: dict[str, Any] = {"downlink": Channel(delay=input_delay)} if input_delay else {}
    env = gym.make(env_id, **settings).unwrapped
    certificate = certificate_for(env.plant, env.certificate_contract)
    shield = VectorSafetyShield(gym.make_vec(env_id, num_envs=episodes, **settings), certificate, on_unproved="ignore")
    policy = controller("lqr", env, certificate.K, 0)
    observation, info = shield.reset(seed=0)
    returns, overridden, steps, violations = np.zeros(episodes), 0.0, 0, 0.0
    running = np.ones(episodes, np.bool_)
    while running.any():
        observation, rewards, terminated, truncated, info = shield.step(policy(observation, info))
        returns += np.where(running, rewards, 0.0)
        overridden += np.count_nonzero(info["shield_intervened"] & running)
        violations += float(info["cost"][running].sum())
        steps += np.count_nonzero(running)
        running &= ~(terminated | truncated)
    contract = env.certificate_contract
    age = "-" if contract is None else str(contract.max_age)
    share = certificate.provenance["share_of_box"]
    return (
        f"{env_id.removeprefix('ncs_gym/'):24s}{input_delay:3d}{age:>9s}{share:10.1%}{overridden / steps:12.1%}"
        f"{returns.mean():10.1f}{violations:12.0f}"
    )


def picture(path: str) -> None:
    """Draws commands on their way, and from which of them each input that is applied comes."""
    queue, actuator = CommittedInputs(LEAD, 1), Actuator(LEAD, 1)
    flights, sources = [], []
    for step in range(STEPS):
        queue.commit(np.array([float(step + LEAD)]))
        flights.append(queue.command(step, 0))
        queue.pop()
        arrived = [each for each in flights if each.stamp + DELAY == step and each.stamp != LOST]
        actuator.receive(arrived)
        newest = max(
            (each.stamp for each in flights if each.stamp + DELAY <= step and each.stamp != LOST), default=None
        )
        sources.append((step, newest, actuator.apply(step).item(), actuator.missing))
    with matplotlib.rc_context(STYLE), matplotlib.rc_context({"axes.grid": False}):
        figure = CaptionedFigure((9.0, 3.9))
        axes = figure.subplots()
        axes.axhline(1.0, color="#555555", lw=1)
        axes.axhline(0.0, color="#555555", lw=1)
        for command in flights:
            k, lost = command.stamp, command.stamp == LOST
            label = "  ".join(f"$u_{int(u)}$" if k + j >= LEAD else "0" for j, u in enumerate(command.inputs[:, 0]))
            color = "#b3261e" if lost else "#1f5f99"
            axes.text(k, 1.1, label, ha="center", va="bottom", color=color, fontsize=9)
            end = (k + 0.5 * DELAY, 0.5) if lost else (k + DELAY, 0.03)
            if k + DELAY < STEPS or lost:
                axes.annotate("", end, (k, 0.97), arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.4})
            if lost:
                axes.plot(*end, "x", color=color, ms=11, mew=2.5)
                axes.text(end[0] + 0.12, end[1] + 0.03, "lost", color=color, va="bottom")
        for step, newest, u, missing in sources:
            assert not missing
            text = f"$u_{int(u)}$" if step >= LEAD else "0"
            axes.text(step, -0.1, text, ha="center", va="top", fontsize=12, weight="bold")
            source = "agreed" if step < LEAD else f"of command {newest}"
            second = step == LOST + DELAY
            axes.text(step, -0.32, source, ha="center", va="top", fontsize=8, color="#b3261e" if second else "#555555")
        axes.text(-0.75, 1.0, "controller\nsends", ha="right", va="center")
        axes.text(-0.75, 0.0, "actuator\napplies", ha="right", va="center")
        axes.set(xlim=(-0.7, STEPS - 0.4), ylim=(-0.5, 1.35), xticks=range(STEPS), yticks=[], xlabel="step")
        for spine in ("left", "bottom"):
            axes.spines[spine].set_visible(False)
        figure.savefig(path, dpi=200, metadata={"Software": ""})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--leads", type=int, nargs="+", default=[0, 1, 2, 4, 8])
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--envs", nargs="+", default=ENVS)
    parser.add_argument("--picture", default=None, help="file for a picture of one lost command, in place of the table")
    options = parser.parse_args()
    if options.picture is not None:
        picture(options.picture)
        return
    print(
        f"{'environment':24s}{'c':>3s}{'max_age':>9s}{'S in box':>10s}"
        f"{'overridden':>12s}{'return':>10s}{'violations':>12s}"
    )
    for env_id in options.envs:
        for input_delay in options.leads:
            print(row(env_id, input_delay, options.episodes), flush=True)


if __name__ == "__main__":
    main()
